"""The policy as a torch module for training: backbone, head, and modules that only training needs."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from saccade.config import HeadConfig
from saccade.reference import ActionHead
from saccade.sim.backbone import KERNEL, NORM_EPS, PADDING, STRIDE, BackboneConfig

TABLE_STD = 0.02  # initial scale of learned positions and embeddings
NUM_TARGETS = 6  # object and goal position


class Block(nn.Module):
    """One pre-norm transformer block without masks."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPS)
        self.up = nn.Linear(width, 4 * width)
        self.down = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """`(B, S, width)` to the same."""
        qkv = self.qkv(self.norm1(x)).unflatten(-1, (3, self.num_heads, -1))  # (B, S, 3, heads, head_dim)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # (B, heads, S, head_dim) each
        attended = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)  # (B, S, width)
        x = x + self.out(attended)
        return x + self.down(F.gelu(self.up(self.norm2(x)), approximate="tanh"))


class Backbone(nn.Module):
    """`saccade.sim.backbone.Backbone` with gradients and the same tensor names.

    Args:
        config: its sizes.
    """

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        channels = (3, *config.stem_channels)
        self.stem = nn.ModuleList(
            nn.Conv2d(before, after, KERNEL, STRIDE, PADDING)
            for before, after in itertools.pairwise(channels)
        )
        self.image_position = table(config.num_cameras, config.tokens_per_camera, width)
        self.word_embedding = nn.Embedding(config.vocabulary_size, width)
        nn.init.normal_(self.word_embedding.weight, std=TABLE_STD)
        self.word_position = table(config.text_length, width)
        self.register = table(1, width)
        self.blocks = nn.ModuleList(Block(width, config.num_heads) for _ in range(config.num_layers))
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)

    def forward(self, images: Tensor, word_numbers: Tensor) -> Tensor:
        """`images (B, cameras, H, W, 3)` uint8, `word_numbers (B, text_length)`; to `(B, T_vl, width)`."""
        batch = images.shape[0]
        x = images.flatten(0, 1).permute(0, 3, 1, 2).float() / 127.5 - 1.0  # (B * cameras, 3, H, W)
        for convolution in self.stem:
            x = F.relu(convolution(x))
        x = x.flatten(2).transpose(1, 2).unflatten(0, (batch, -1))  # (B, cameras, tokens, width)
        x = (x + self.image_position).flatten(1, 2)  # (B, image tokens, width)
        said = self.word_embedding(word_numbers) + self.word_position  # (B, words, width)
        x = torch.cat((x, said, self.register.expand(batch, 1, -1)), dim=1)  # (B, T_vl, width)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)


class Learner(nn.Module):
    """All modules that are trained.

    In addition to the policy there is a linear layer that predicts object and goal positions from the
    register token. Its loss makes the backbone locate them early in training. With an `alignment_block` there
    is also a projector from the hidden rows of the future tokens to the backbone's features one horizon
    later. Neither is part of the checkpoint.

    Args:
        backbone_config: sizes of the backbone.
        head_config: sizes of the head.
        alignment_block: block of the head after which the future rows are aligned; None for no alignment.
    """

    def __init__(
        self, backbone_config: BackboneConfig, head_config: HeadConfig, alignment_block: int | None = None
    ) -> None:
        super().__init__()
        self.backbone = Backbone(backbone_config)
        self.action_head = ActionHead(head_config)
        self.target_head = nn.Linear(backbone_config.width, NUM_TARGETS)
        self.alignment_block = alignment_block
        if alignment_block is not None:
            # Created last, so that a seed gives the other layers the same weights with and without it.
            self.projector = nn.Sequential(
                nn.Linear(head_config.width, backbone_config.width),
                nn.GELU(),
                nn.Linear(backbone_config.width, backbone_config.width),
            )

    def losses(
        self, batch: Mapping[str, Tensor], generator: torch.Generator, average: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """All losses of a batch.

        Args:
            batch: `images (B, cameras, H, W, 3)` uint8, `words (B, text_length)`, `state (B, state_dim)`,
                `actions (B, T, action_dim)`, `mask (B, T, 1)`, `targets (B, 6)`; numbers are normalised. With
                alignment also `later_images`, like `images`.
            generator: generator of noise and times.
            average: the averaged tensors of the policy, whose backbone encodes the later images.

        Returns:
            Scalars: `loss` of flow matching, `target_loss` of the positions and, with alignment,
            `alignment_loss`.
        """
        features = self.backbone(batch["images"], batch["words"])
        noise = torch.randn(batch["actions"].shape, generator=generator)
        time = self.action_head.sample_time(len(noise), generator)
        with self.watched_rows() as rows:
            flow = self.action_head.loss(
                features,
                batch["state"],
                0,
                batch["actions"],
                noise=noise,
                time=time,
                action_mask=batch["mask"],
            )
        losses = {
            "loss": flow,
            "target_loss": F.mse_loss(self.target_head(features[:, -1]), batch["targets"]),
        }
        if self.alignment_block is not None:
            future = rows[0][:, 1 : 1 + self.action_head.config.num_future_tokens]  # (B, N, width)
            targets = self.alignment_targets(batch, average)
            losses["alignment_loss"] = 1 - F.cosine_similarity(self.projector(future), targets, dim=-1).mean()
        return losses

    @torch.no_grad()
    def alignment_targets(self, batch: Mapping[str, Tensor], average: Mapping[str, Tensor]) -> Tensor:
        """The targets of the future rows: the averaged backbone's tokens of the later images.

        Args:
            batch: `later_images` and `words`, as in `losses`.
            average: see `losses`.

        Returns:
            `(B, N, width)`: the T_vl tokens, averaged over N runs of neighbours.
        """
        prefix = "backbone."
        tensors = {
            name.removeprefix(prefix): tensor for name, tensor in average.items() if name.startswith(prefix)
        }
        tokens = functional_call(self.backbone, tensors, (batch["later_images"], batch["words"]))
        return pool_tokens(tokens, self.action_head.config.num_future_tokens)

    @contextmanager
    def watched_rows(self) -> Iterator[list[Tensor]]:
        """Collects the rows `(B, R, width)` that the alignment block returns; none without alignment."""
        rows: list[Tensor] = []
        if self.alignment_block is None:
            yield rows
            return
        block = self.action_head.model.transformer_blocks[self.alignment_block]
        handle = block.register_forward_hook(lambda module, inputs, output: rows.append(output))
        try:
            yield rows
        finally:
            handle.remove()

    def policy_tensors(self) -> dict[str, Tensor]:
        """The tensors of a checkpoint, in the published layout."""
        return {
            name: tensor
            for name, tensor in self.state_dict().items()
            if name.startswith(("backbone.", "action_head."))
        }


def pool_tokens(tokens: Tensor, count: int) -> Tensor:
    """`(B, S, width)` to `(B, count, width)`: means over runs of neighbours that cover all tokens."""
    return F.adaptive_avg_pool1d(tokens.transpose(1, 2), count).transpose(1, 2)


def table(*shape: int) -> nn.Parameter:
    """A learned table with small initial values."""
    return nn.Parameter(TABLE_STD * torch.randn(shape))
