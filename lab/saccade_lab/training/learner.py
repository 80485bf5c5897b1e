"""The policy as a torch module for training: backbone, head, and modules that only training needs."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from saccade.head.config import HeadConfig
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.reference import ActionHead, Backbone
from saccade_lab.reference.backbone import BackboneFeatures, PreparedInputs
from saccade_lab.reference.layers import TABLE_STD, CategoryLinear
from saccade_lab.training.policy_files import PolicyFiles
from saccade_lab.training.settings import TrainingSettings

NUM_TARGETS = 6  # object and goal position
# The initial weights of every N are drawn as for this one, which is that of the bundled policy.
SHARED_TOKENS = 32
NUM_QUERIES = 12  # of ImageTargets: two for each view and position


@dataclass(frozen=True)
class Batch:
    """Samples of a training step, on the device of the policy. Numbers are normalised.

    Attributes:
        inputs: The observations, or the features of a backbone that is not trained; prompts are padded on the
            left, as the released processors do.
        state: ``(B, state_dim)``.
        actions: ``(B, T, action_dim)``.
        mask: ``(B, T, 1)``, 1 where an action is valid.
        targets: ``(B, 6)``, positions of object and goal.
        later: With alignment, the observations after the chunk was executed.
    """

    inputs: PreparedInputs | BackboneFeatures
    state: Tensor
    actions: Tensor
    mask: Tensor
    targets: Tensor
    later: PreparedInputs | BackboneFeatures | None = None


class Learner(nn.Module):
    """All modules that are trained.

    In addition to the policy there is a layer that predicts object and goal positions, whose loss makes the
    backbone locate them early in training: a linear one on the last token of the prompt, which has seen all
    others, or :class:`ImageTargets` where the backbone is trained alone. With an ``alignment_block`` there is
    also a projector from the hidden rows of the future tokens to the backbone's features one horizon later.
    None of them is part of the checkpoint.

    Args:
        backbone_sizes: Sizes of the backbone.
        head_config: Sizes of the head.
        alignment_block: Block of the head after which the future rows are aligned; None for no alignment.
        only: What is trained, see ``TrainingSettings``.
    """

    def __init__(
        self,
        backbone_sizes: BackboneSizes,
        head_config: HeadConfig,
        alignment_block: int | None = None,
        only: str = "",
    ) -> None:
        super().__init__()
        self.only = only
        self.backbone = Backbone(backbone_sizes)
        for module in self.backbone.modules():
            if isinstance(module, nn.Embedding):
                nn.init.normal_(module.weight, std=TABLE_STD)
        self.action_head = ActionHead(head_config)
        width = backbone_sizes.features_width
        self.target_head = ImageTargets(width) if only == "backbone" else nn.Linear(width, NUM_TARGETS)
        if only == "head":
            self.backbone.requires_grad_(False)
        self.alignment_block = alignment_block
        if alignment_block is not None:
            # Created last, so that a seed gives the other layers the same weights with and without it.
            self.projector = nn.Sequential(
                nn.Linear(head_config.width, width),
                nn.GELU(),
                nn.Linear(width, width),
            )

    def draw_noise(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draws the noise of a batch, ``(B, T, action_dim)``, and the times of its flow, ``(B,)``."""
        noise = torch.randn(batch.actions.shape, generator=generator)
        return self.action_head.as_input(noise), self.action_head.sample_time(len(noise), generator)

    def losses(
        self, batch: Batch, noise: Tensor, time: Tensor, average: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """All losses of a batch.

        Args:
            batch: The samples.
            noise, time: As ``draw_noise`` returns them.
            average: The averaged tensors of the policy, whose backbone encodes the later observations.

        Returns:
            Scalars: ``loss`` of flow matching, or of the positions where the backbone is trained alone;
            ``target_loss`` of the positions where both are trained; with alignment ``alignment_loss``.
        """
        seen = self.seen(batch.inputs)
        features = seen.backbone_features  # (B, S, width)
        if self.only == "backbone":
            return {"loss": F.mse_loss(self.target_head(seen), batch.targets.to(features))}
        with self.watched_rows() as rows:
            flow = self.action_head.loss(
                features,
                batch.state,
                0,
                batch.actions,
                noise=noise,
                time=time,
                action_mask=batch.mask,
                drop_vl=~seen.attention_mask,
                **self.masks(seen),
            )
        losses = {"loss": flow}
        if not self.only:
            losses["target_loss"] = F.mse_loss(self.target_head(features[:, -1]), batch.targets.to(features))
        if batch.later is not None:
            config = self.action_head.config
            first = config.num_state_rows
            future = rows[0][:, first : first + config.num_future_tokens]  # (B, N, width)
            targets = self.alignment_targets(batch.later, average)
            losses["alignment_loss"] = 1 - F.cosine_similarity(self.projector(future), targets, dim=-1).mean()
        return losses

    def masks(self, seen: BackboneFeatures) -> dict[str, Tensor]:
        """The masks that alternating cross-attention takes; none for a head without it."""
        if self.action_head.config.mask_mode == "none":
            return {}
        return {"attention_mask": seen.attention_mask, "image_mask": seen.image_mask}

    def seen(self, inputs: PreparedInputs | BackboneFeatures) -> BackboneFeatures:
        """The backbone's features of observations, unless that is what is given."""
        return inputs if isinstance(inputs, BackboneFeatures) else self.backbone(inputs)

    @torch.no_grad()
    def alignment_targets(
        self, later: PreparedInputs | BackboneFeatures, average: Mapping[str, Tensor]
    ) -> Tensor:
        """The targets of the future rows: what the averaged backbone sees later.

        Args:
            later: See ``Batch``.
            average: See ``losses``.

        Returns:
            ``(B, N, width)``: the image tokens, averaged over N runs of neighbours.
        """
        if isinstance(later, PreparedInputs):
            prefix = "backbone."
            tensors = {
                name.removeprefix(prefix): tensor
                for name, tensor in average.items()
                if name.startswith(prefix)
            }
            seen: BackboneFeatures = functional_call(self.backbone, tensors, (later,))
        else:
            seen = later
        return pool_tokens(image_tokens(seen), self.action_head.config.num_future_tokens)

    @contextmanager
    def watched_rows(self) -> Iterator[list[Tensor]]:
        """Collects the rows ``(B, R, width)`` that the alignment block returns; none without alignment."""
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


def new_learner(settings: TrainingSettings, config: PolicyFiles) -> Learner:
    """The modules with their initial weights.

    Runs of one seed that differ in N start from the same weights of everything else, and the tokens of the
    smaller N are the first ones of the larger N. So policies can be compared in pairs of one seed. With
    another ``category_std``, the category-specific weights are the same numbers on another scale.
    """
    sizes, head, block = config.backbone_sizes, config.head_config, settings.aligned_block
    torch.manual_seed(settings.seed)
    shared = SHARED_TOKENS if head.version == "n1.5" else 0  # later versions have no future tokens
    drawn = Learner(sizes, replace(head, num_future_tokens=shared), block, settings.only)
    scale_categories(drawn, settings.category_std)
    if head.num_future_tokens == shared:
        return drawn
    more = max(0, head.num_future_tokens - SHARED_TOKENS)
    generator = torch.Generator().manual_seed(
        int(np.random.default_rng((settings.seed, SHARED_TOKENS)).integers(2**63))
    )
    state = drawn.state_dict()
    name = "action_head.future_tokens.weight"
    extra = TABLE_STD * torch.randn((more, head.width), generator=generator)
    state[name] = torch.cat((state[name], extra))[: head.num_future_tokens]
    learner = Learner(sizes, head, block, settings.only)
    learner.load_state_dict(state)
    return learner


@torch.no_grad()
def scale_categories(module: nn.Module, std: float) -> None:
    """Gives the new category-specific weights of a module another standard deviation than ``TABLE_STD``."""
    for inner in module.modules():
        if isinstance(inner, CategoryLinear):
            inner.W.mul_(std / TABLE_STD)


class ImageTargets(nn.Module):
    """Positions of object and goal from the image tokens alone.

    Learned queries weight the tokens of all views by a softmax, and a linear layer reads the means that are
    weighted so. No single token has to contain everything, unlike the last one of a prompt.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.queries = nn.Linear(width, NUM_QUERIES)
        self.positions = nn.Linear(NUM_QUERIES * width, NUM_TARGETS)

    def forward(self, features: BackboneFeatures) -> Tensor:
        """``(B, 6)``."""
        tokens = image_tokens(features)  # (B, image tokens, width)
        weights = self.queries(tokens).softmax(dim=1)  # (B, image tokens, queries)
        return self.positions((weights.transpose(1, 2) @ tokens).flatten(1))


def image_tokens(features: BackboneFeatures) -> Tensor:
    """The features of the image tokens, ``(B, image tokens, width)``."""
    tokens = features.backbone_features
    chosen = tokens.flatten(0, 1).index_select(0, features.image_places)
    return chosen.unflatten(0, (len(tokens), -1))


def pool_tokens(tokens: Tensor, count: int) -> Tensor:
    """``(B, S, width)`` to ``(B, count, width)``: means over runs of neighbours that cover all tokens."""
    return F.adaptive_avg_pool1d(tokens.transpose(1, 2), count).transpose(1, 2)
