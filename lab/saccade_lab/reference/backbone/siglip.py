"""SigLIP, the vision tower of N1.5 and N1.6. Module names follow the checkpoint.

Shapes in comments: V are the views, P the patches of a view.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import torch.nn.functional as F
from torch import Tensor, nn

from saccade_lab.backbone_sizes import VisionSizes
from saccade_lab.reference.backbone.attention import attend, split_heads
from saccade_lab.reference.backbone.tables import embedding


class ConvolutionEmbeddings(nn.Module):
    """Patches and positions of N1.5, whose frames have the size of the table."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        side = sizes.patch_size
        self.patch_embedding = nn.Conv2d(3, sizes.width, kernel_size=side, stride=side)
        self.position_embedding = embedding(sizes.num_positions, sizes.width)

    def forward(self, pixels: Tensor) -> Tensor:
        """``(V, 3, height, width)`` to ``(V, P, vision_width)``."""
        patches = self.patch_embedding(pixels).flatten(2).transpose(1, 2)  # row by row
        return patches + self.position_embedding.weight


class LinearEmbeddings(nn.Module):
    """Patches and positions of N1.6: frames of any size; a patch is flattened as y, x, channel."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.patch_size = sizes.patch_size
        self.patch_embedding = nn.Linear(3 * sizes.patch_size**2, sizes.width)
        self.position_embedding = embedding(sizes.num_positions, sizes.width)

    def forward(self, pixels: Tensor) -> Tensor:
        """``(V, 3, height, width)`` to ``(V, P, vision_width)``."""
        side = self.patch_size
        patches = pixels.unflatten(3, (-1, side)).unflatten(2, (-1, side))  # (V, 3, rows, y, columns, x)
        patches = patches.permute(0, 2, 4, 3, 5, 1)  # (V, rows, columns, y, x, 3)
        grid = patches.shape[1:3]
        patches = patches.flatten(3).flatten(1, 2)  # (V, P, 3 * side * side)
        return self.patch_embedding(patches) + self.positions(*grid)

    def positions(self, rows: int, columns: int) -> Tensor:
        """The table resized to a grid with antialiased linear filters, ``(rows * columns, vision_width)``."""
        table = self.position_embedding.weight
        side = round(table.shape[0] ** 0.5)
        if (rows, columns) == (side, side):
            return table
        image = table.T.unflatten(1, (side, side))[None]  # (1, vision_width, side, side)
        resized = F.interpolate(image, (rows, columns), mode="bilinear", antialias=True)
        return resized[0].flatten(1).T


class SelfAttention(nn.Module):
    """Attention of all patches of a view to each other."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.head_dim = sizes.width // sizes.num_heads
        self.q_proj = nn.Linear(sizes.width, sizes.width)
        self.k_proj = nn.Linear(sizes.width, sizes.width)
        self.v_proj = nn.Linear(sizes.width, sizes.width)
        self.out_proj = nn.Linear(sizes.width, sizes.width)

    def forward(self, x: Tensor) -> Tensor:
        """``(V, P, vision_width)`` to the same shape."""
        projections = (self.q_proj, self.k_proj, self.v_proj)
        q, k, v = (
            split_heads(project(x), self.head_dim) for project in projections
        )  # (V, heads, P, head_dim)
        return self.out_proj(attend(q, k, v))


class Mlp(nn.Module):
    """Two linear layers with GELU, approximated by tanh, between them."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.fc1 = nn.Linear(sizes.width, sizes.mlp_width)
        self.fc2 = nn.Linear(sizes.mlp_width, sizes.width)

    def forward(self, x: Tensor) -> Tensor:
        """``(..., vision_width)`` to the same shape."""
        return self.fc2(F.gelu(self.fc1(x), approximate="tanh"))


class EncoderLayer(nn.Module):
    """Attention and feed-forward layer, each after a LayerNorm and with a residual."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.layer_norm1 = nn.LayerNorm(sizes.width, eps=sizes.eps)
        self.self_attn = SelfAttention(sizes)
        self.layer_norm2 = nn.LayerNorm(sizes.width, eps=sizes.eps)
        self.mlp = Mlp(sizes)

    def forward(self, x: Tensor) -> Tensor:
        """``(V, P, vision_width)`` to the same shape."""
        x = x + self.self_attn(self.layer_norm1(x))
        return x + self.mlp(self.layer_norm2(x))


class Encoder(nn.Module):
    """All layers."""

    def __init__(self, sizes: VisionSizes) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(sizes) for _ in range(sizes.num_layers))

    def forward(self, x: Tensor) -> Tensor:
        """``(V, P, vision_width)`` to the same shape."""
        for layer in self.layers:
            x = layer(x)
        return x


class VisionTransformer(nn.Module):
    """Embeddings, layers and the last norm. The pooling head of the released code is never used."""

    def __init__(self, sizes: VisionSizes, embeddings: nn.Module) -> None:
        super().__init__()
        self.embeddings = embeddings
        self.encoder = Encoder(sizes)
        self.post_layernorm = nn.LayerNorm(sizes.width, eps=sizes.eps)

    def forward(self, pixels: Tensor) -> Tensor:
        """``(V, 3, height, width)`` to ``(V, P, vision_width)``."""
        return self.post_layernorm(self.encoder(self.embeddings(pixels)))


class VisionModel(nn.Module):
    """The level of the checkpoint's names above the tower."""

    def __init__(self, sizes: VisionSizes, embeddings: nn.Module) -> None:
        super().__init__()
        self.vision_model = VisionTransformer(sizes, embeddings)

    def forward(self, pixels: Tensor) -> Tensor:
        """``(V, 3, height, width)`` to ``(V, P, vision_width)``."""
        return self.vision_model(pixels)


def join_squares(x: Tensor, rows: int, columns: int, side: int, *, channels_first: bool) -> Tensor:
    """Joins the patches of each ``side`` x ``side`` square into one token.

    Args:
        x: ``(V, rows * columns, vision_width)``.
        rows, columns: The grid of patches; ``side`` divides both.
        side: Patches along a side of a square.
        channels_first: N1.6's order of the features, (channel, y, x). Otherwise N1.5's, (y, x, channel).

    Returns:
        ``(V, rows * columns / side**2, vision_width * side**2)``.
    """
    if side == 1:
        return x
    squares = x.unflatten(1, (rows // side, side, columns // side, side))  # (V, i, y, j, x, channel)
    order = (0, 1, 3, 5, 2, 4) if channels_first else (0, 1, 3, 2, 4, 5)
    return squares.permute(order).flatten(3).flatten(1, 2)


def connector(inputs: int, width: int, num_layers: int) -> nn.Sequential:
    """``mlp1``: from the vision tower's width to the language model's."""
    if num_layers == 1:
        return nn.Sequential(nn.Linear(inputs, width))
    # nn.GELU is the exact one, by erf, unlike the tower's.
    return nn.Sequential(nn.LayerNorm(inputs), nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width))
