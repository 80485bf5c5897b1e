"""What N1.7 does in another way: Qwen3-VL's vision tower and the positions of its prompts.

Module names follow the checkpoint. Shapes in comments: P are the patches of all views.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade.errors import InputError
from saccade_lab.backbone_sizes import BackboneSizes, VisionSizes
from saccade_lab.reference.backbone.attention import attend, split_heads
from saccade_lab.reference.backbone.rotary import grid_angles, rotate
from saccade_lab.reference.backbone.tables import embedding


class PatchEmbedding(nn.Module):
    """A linear layer of a patch, stored as a convolution."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        kernel = (sizes.temporal_patch_size, sizes.patch_size, sizes.patch_size)
        self.proj = nn.Conv3d(3, sizes.width, kernel_size=kernel, stride=kernel)

    def forward(self, patches: Tensor) -> Tensor:
        """``(P, values)`` to ``(P, vision_width)``."""
        # As a product: torch's convolution of single patches costs four times as much in training.
        return F.linear(patches, self.proj.weight.flatten(1), self.proj.bias)


class SelfAttention(nn.Module):
    """Attention of all patches of a view to each other, with rotary positions."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.head_dim = sizes.width // sizes.num_heads
        self.qkv = nn.Linear(sizes.width, 3 * sizes.width)
        self.proj = nn.Linear(sizes.width, sizes.width)

    def forward(self, x: Tensor, angles: Tensor, lengths: list[int]) -> Tensor:
        """``x (P, vision_width)``, ``angles (P, head_dim / 2)``, the patches of each view; to its shape."""
        q, k, v = (split_heads(part, self.head_dim) for part in self.qkv(x).chunk(3, dim=-1))
        q, k = rotate(q, angles), rotate(k, angles)  # (heads, P, head_dim)
        if len(set(lengths)) == 1:  # together: a batch of training has many views of one size
            sides = (-1, lengths[0])
            views = attend(*(part.unflatten(1, sides).transpose(0, 1) for part in (q, k, v)))
            return self.proj(views.flatten(0, 1))
        separate = zip(q.split(lengths, 1), k.split(lengths, 1), v.split(lengths, 1), strict=True)
        return self.proj(torch.cat([attend(*view) for view in separate]))


class Mlp(nn.Module):
    """Two linear layers with GELU, approximated by tanh, between them."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.linear_fc1 = nn.Linear(sizes.width, sizes.mlp_width)
        self.linear_fc2 = nn.Linear(sizes.mlp_width, sizes.width)

    def forward(self, x: Tensor) -> Tensor:
        """``(P, vision_width)`` to the same shape."""
        return self.linear_fc2(F.gelu(self.linear_fc1(x), approximate="tanh"))


class Block(nn.Module):
    """Attention and feed-forward layer, each after a LayerNorm and with a residual."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(sizes.width, eps=sizes.eps)
        self.attn = SelfAttention(sizes)
        self.norm2 = nn.LayerNorm(sizes.width, eps=sizes.eps)
        self.mlp = Mlp(sizes)

    def forward(self, x: Tensor, angles: Tensor, lengths: list[int]) -> Tensor:
        """``x (P, vision_width)`` to the same shape; the others are as in ``SelfAttention``."""
        x = x + self.attn(self.norm1(x), angles, lengths)
        return x + self.mlp(self.norm2(x))


class Merger(nn.Module):
    """Joins the patches of each square into an image token.

    The merger after the last block normalises patches, the "deepstack" ones normalise joined patches.
    """

    def __init__(self, sizes: BackboneSizes, *, norm_joined: bool) -> None:
        super().__init__()
        width = sizes.vision.width
        self.joined = width * sizes.merge**2
        self.norm_joined = norm_joined
        self.norm = nn.LayerNorm(self.joined if norm_joined else width, eps=sizes.vision.eps)
        self.linear_fc1 = nn.Linear(self.joined, self.joined)
        self.linear_fc2 = nn.Linear(self.joined, sizes.text.width)

    def forward(self, x: Tensor) -> Tensor:
        """``(P, vision_width)``, the patches of a square together, to ``(image tokens, width)``."""
        joined = (-1, self.joined)
        x = self.norm(x.reshape(joined)) if self.norm_joined else self.norm(x).reshape(joined)
        return self.linear_fc2(F.gelu(self.linear_fc1(x)))  # the exact GELU, by erf


class VisionTower(nn.Module):
    """The vision tower with its mergers."""

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        vision = sizes.vision
        self.merge = sizes.merge
        self.deepstack = vision.deepstack
        self.head_dim = vision.width // vision.num_heads
        self.patch_embed = PatchEmbedding(vision)
        self.pos_embed = embedding(vision.num_positions, vision.width)
        self.blocks = nn.ModuleList(Block(vision) for _ in range(vision.num_layers))
        self.merger = Merger(sizes, norm_joined=False)
        self.deepstack_merger_list = nn.ModuleList(Merger(sizes, norm_joined=True) for _ in vision.deepstack)

    def forward(self, patches: Tensor, grids: list[tuple[int, int]]) -> tuple[Tensor, list[Tensor]]:
        """The image tokens of all views.

        Args:
            patches: ``(P, values)``, square after square.
            grids: Rows and columns of patches of each view.

        Returns:
            The image tokens ``(N, width)``, and as many again for each deepstack layer.
        """
        places = {grid: patch_places(*grid, self.merge, patches.device) for grid in set(grids)}
        tables = {grid: self.positions(*grid, *place) for grid, place in places.items()}
        x = self.patch_embed(patches) + torch.cat([tables[grid] for grid in grids])  # (P, vision_width)
        rows, columns = (torch.cat([places[grid][axis] for grid in grids]) for axis in (0, 1))  # (P,) each
        angles = grid_angles(rows, columns, self.head_dim // 2, x.dtype)  # (P, head_dim / 2)
        lengths = [rows * columns for rows, columns in grids]
        stacked = []
        for index, block in enumerate(self.blocks):
            x = block(x, angles, lengths)
            if index in self.deepstack:
                stacked.append(self.deepstack_merger_list[self.deepstack.index(index)](x))
        return self.merger(x), stacked

    def positions(self, num_rows: int, num_columns: int, rows: Tensor, columns: Tensor) -> Tensor:
        """The table at places of a view, bilinear between its entries.

        Args:
            num_rows, num_columns: The grid of the view, stretched over the whole table.
            rows, columns: Places on that grid, ``(patches,)``.

        Returns:
            ``(patches, vision_width)``.
        """
        table = self.pos_embed.weight
        side = round(table.shape[0] ** 0.5)
        y = torch.linspace(0, side - 1, num_rows, dtype=table.dtype, device=table.device)[rows]
        x = torch.linspace(0, side - 1, num_columns, dtype=table.dtype, device=table.device)[columns]
        top, left = y.long(), x.long()
        down, right = (y - top)[:, None], (x - left)[:, None]  # shares of the next entries, (patches, 1)
        bottom, next_column = (top + 1).clamp(max=side - 1), (left + 1).clamp(max=side - 1)
        above = table[top * side + left] * (1 - right) + table[top * side + next_column] * right
        below = table[bottom * side + left] * (1 - right) + table[bottom * side + next_column] * right
        return above * (1 - down) + below * down


def patch_places(rows: int, columns: int, merge: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Row and column of each patch of a view, square after square as in the inputs, ``(patches,)``."""
    row = torch.arange(rows, device=device)[:, None].expand(rows, columns)
    column = torch.arange(columns, device=device).expand(rows, columns)

    def by_square(x: Tensor) -> Tensor:
        return x.unflatten(1, (-1, merge)).unflatten(0, (-1, merge)).transpose(1, 2).flatten()

    return by_square(row), by_square(column)


def prompt_positions(
    input_ids: Tensor, attention_mask: Tensor, grids: list[tuple[int, int]], sizes: BackboneSizes
) -> Tensor:
    """Positions of tokens on the axes of time, height and width.

    A text token takes the next number on all axes. An image that starts at p has its token (r, c) at
    (p, p + r, p + c), and the next number is p plus the longer side of its grid. Padding has 1.

    Args:
        input_ids: ``(B, T)``, on the CPU.
        attention_mask: Bool ``(B, T)``, on the CPU.
        grids: Rows and columns of patches of each view, those of the first prompt first.
        sizes: Of the backbone.

    Returns:
        Int64 ``(3, B, T)``.

    Raises:
        InputError: The image tokens of a prompt are not those of its views.
    """
    positions = torch.ones((3, *input_ids.shape), dtype=torch.long)
    are_equal = len(set(grids)) == 1
    # A batch of training repeats few prompts, and a prompt takes a thousand times as long as a copy.
    known: dict[bytes, tuple[Tensor, int]] = {}
    used = 0
    for row, (ids, attended) in enumerate(zip(input_ids, attention_mask, strict=True)):
        key = ids.numpy().tobytes() + attended.numpy().tobytes()
        found = known.get(key) if are_equal else None
        if found is None or used + found[1] > len(grids):
            found = known[key] = row_positions(ids, attended, grids[used:], sizes, row)
        positions[:, row], used = found[0], used + found[1]
    return positions


def row_positions(
    ids: Tensor, attended: Tensor, grids: list[tuple[int, int]], sizes: BackboneSizes, row: int
) -> tuple[Tensor, int]:
    """The positions of one prompt, ``(3, T)``, and the number of its views.

    Args:
        ids, attended: ``(T,)``, see ``prompt_positions``.
        grids: Of its views, and of those of later prompts.
        sizes: Of the backbone.
        row: The number of the prompt in its batch, for messages.
    """
    places = attended.nonzero()[:, 0]
    tokens = ids[places].tolist()
    found: list[tuple[int, int, int]] = []  # of each token: time, height, width
    number, views = 0, 0
    while len(found) < len(tokens):
        if tokens[len(found)] != sizes.image_token:
            found.append((number, number, number))
            number += 1
            continue
        height, width = (side // sizes.merge for side in (grids[views] if views < len(grids) else (0, 0)))
        image = tokens[len(found) : len(found) + height * width]
        if image != [sizes.image_token] * (height * width) or not image:
            raise InputError(
                f"input_ids: expected {height} x {width} image tokens of a view from position "
                f"{int(places[len(found)])} of prompt {row}"
            )
        found += [(number, number + r, number + c) for r in range(height) for c in range(width)]
        number, views = number + max(height, width), views + 1
    positions = torch.ones((3, len(ids)), dtype=torch.long)
    positions[:, places] = torch.tensor(found, dtype=torch.long).reshape(-1, 3).T
    return positions, views
