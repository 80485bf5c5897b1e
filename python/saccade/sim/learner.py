"""The policy as a torch module, for training: backbone, head, and what only training needs."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

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
    """`saccade.sim.backbone.Backbone` with gradients; the tensor names are the same.

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
    """All that is trained.

    Besides the policy there is a linear layer that reads object and goal positions off the register token.
    Its loss makes the backbone find them early; it is not part of the checkpoint.

    Args:
        backbone_config: sizes of the backbone.
        head_config: sizes of the head.
        target_weight: weight of the positions' loss.
    """

    def __init__(
        self, backbone_config: BackboneConfig, head_config: HeadConfig, target_weight: float
    ) -> None:
        super().__init__()
        self.backbone = Backbone(backbone_config)
        self.action_head = ActionHead(head_config)
        self.target_head = nn.Linear(backbone_config.width, NUM_TARGETS)
        self.target_weight = target_weight

    def losses(self, batch: dict[str, Tensor], generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Flow-matching loss and the positions' loss.

        Args:
            batch: `images (B, cameras, H, W, 3)` uint8, `words (B, text_length)`, `state (B, state_dim)`,
                `actions (B, T, action_dim)`, `mask (B, T, 1)`, `targets (B, 6)`; numbers are normalised.
            generator: for noise and times.

        Returns:
            Two scalars.
        """
        features = self.backbone(batch["images"], batch["words"])
        noise = torch.randn(batch["actions"].shape, generator=generator)
        time = self.action_head.sample_time(len(noise), generator)
        flow = self.action_head.loss(
            features, batch["state"], 0, batch["actions"], noise=noise, time=time, action_mask=batch["mask"]
        )
        return flow, F.mse_loss(self.target_head(features[:, -1]), batch["targets"])

    def policy_tensors(self) -> dict[str, Tensor]:
        """The tensors of a checkpoint, in the published layout."""
        return {
            name: tensor
            for name, tensor in self.state_dict().items()
            if name.startswith(("backbone.", "action_head."))
        }


def table(*shape: int) -> nn.Parameter:
    """Learned positions, small at first."""
    return nn.Parameter(TABLE_STD * torch.randn(shape))
