"""The same policy in torch: ``saccade_lab.reference`` behind the interfaces that ``saccade.Policy`` uses."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import saccade
from saccade._internal.arrays import ArrayLike, Float32Array
from saccade.backbone.inputs import BackboneInputs
from saccade.head.config import HeadConfig
from saccade.observations import read_requirements
from saccade.processor import Processor
from saccade.robots import Normalizer
from saccade_lab.reference import ActionHead, Backbone, Guidance


@dataclass(frozen=True)
class TorchContext:
    """What the head encoded: its tokens ``(batch, T_vl, context_dim)``, and which of them are removed."""

    vl_embs: torch.Tensor
    drop_vl: np.ndarray | None

    @property
    def batch(self) -> int:
        """Number of observations."""
        return int(self.vl_embs.shape[0])

    @property
    def num_vl_tokens(self) -> int:
        """Number of vision-language tokens."""
        return int(self.vl_embs.shape[1])


class TorchHead:
    """``saccade_lab.reference.ActionHead`` as a ``saccade.policy.interfaces.Head``."""

    def __init__(self, checkpoint: Path) -> None:
        self._head = ActionHead.from_pretrained(checkpoint)
        self.source = str(checkpoint)

    @property
    def config(self) -> HeadConfig:
        """Sizes and switches."""
        return self._head.config

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """All embodiments."""
        return tuple(range(self.config.num_embodiments))

    @property
    def num_threads(self) -> int:
        """Number of threads of torch."""
        return torch.get_num_threads()

    @property
    def nbytes(self) -> int:
        """Size of the weights, in bytes."""
        return nbytes_of(self._head)

    def encode(
        self,
        backbone_features: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
    ) -> Any:
        """See ``saccade.ActionHead.encode``. The other masks change nothing in N1.5, and are not read."""
        removed = None if drop_vl is None else np.asarray(drop_vl)
        with torch.no_grad():
            return TorchContext(self._head.encode(np.asarray(backbone_features), drop_vl=removed), removed)

    def sample(self, context: Any, state: ArrayLike, embodiment_id: Any, **options: Any) -> Float32Array:
        """See ``saccade.ActionHead.sample``; ``noise`` is required, and options that are None are dropped."""
        given = {name: value for name, value in options.items() if value is not None}
        if "guidance" in given:
            second = given.pop("without")
            given["guidance"] = Guidance(given["guidance"], second.vl_embs, second.drop_vl)
        with torch.no_grad():
            found = self._head.sample(
                context.vl_embs, np.asarray(state), embodiment_id, drop_vl=context.drop_vl, **given
            )
        return np.asarray(found.numpy())


@dataclass(frozen=True)
class TorchFeatures:
    """Features of one observation: ``(1, T_vl, width)``, and where its image tokens are, ``(1, T_vl)``."""

    backbone_features: Float32Array
    image_mask: Any


class TorchBackbone:
    """``saccade_lab.reference.Backbone`` as ``saccade.Policy`` calls its backbone."""

    def __init__(self, checkpoint: Path) -> None:
        self._backbone = Backbone.from_pretrained(checkpoint)

    @property
    def nbytes(self) -> int:
        """Size of the weights, in bytes."""
        return nbytes_of(self._backbone)

    def encode_many(self, inputs: Sequence[BackboneInputs], *, previous: Sequence[Any] = ()) -> list[Any]:
        """See ``saccade.Backbone.encode_many``. Nothing is taken from ``previous``."""
        with torch.no_grad():
            found = [self._backbone(given) for given in inputs]
        return [TorchFeatures(one.backbone_features.numpy(), one.image_mask.numpy()) for one in found]


def nbytes_of(module: torch.nn.Module) -> int:
    """Size of the parameters and buffers of a module, in bytes."""
    return sum(one.nbytes for one in (*module.parameters(), *module.buffers()))


def load_policy(checkpoint: Path, num_threads: int | None = None) -> saccade.Policy:
    """The policy of a checkpoint with backbone and head in torch.

    Args:
        checkpoint: A directory.
        num_threads: Threads of torch, for the whole process; None leaves torch's default.
    """
    if num_threads is not None:
        torch.set_num_threads(num_threads)
    head = TorchHead(checkpoint)
    normalizer = Normalizer.from_pretrained(
        checkpoint, state_dim=head.config.state_dim, action_dim=head.config.encoder_action_dim
    )
    return saccade.Policy(
        head,
        normalizer,
        backbone=TorchBackbone(checkpoint),
        processor=Processor.from_pretrained(checkpoint),
        requirements=read_requirements(checkpoint, normalizer),
    )


def describe() -> dict[str, Any]:
    """The engine, for a result file."""
    return {"name": "torch", "torch": torch.__version__, "num_threads": torch.get_num_threads()}
