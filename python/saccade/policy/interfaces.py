"""Interfaces that a policy requires of its action head and its backbone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from saccade._internal.arrays import Array, ArrayLike
from saccade.backbone.features import BackboneFeatures
from saccade.backbone.inputs import BackboneInputs
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade.head.context import Context
from saccade.head.intervention import Intervention


class Head(Protocol):
    """An action head, such as :class:`saccade.ActionHead`."""

    @property
    def config(self) -> HeadConfig:
        """Sizes and switches."""

    @property
    def source(self) -> str | None:
        """Path of the checkpoint, or None."""

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """The loaded embodiments."""

    @property
    def num_threads(self) -> int:
        """Number of threads of a call."""

    @property
    def nbytes(self) -> int:
        """Size of the weights in memory, in bytes."""

    def encode(
        self,
        backbone_features: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
    ) -> Context:
        """See :meth:`saccade.ActionHead.encode`."""

    def sample(
        self,
        context: Context,
        state: ArrayLike,
        embodiment_id: int | ArrayLike,
        *,
        noise: ArrayLike | None = None,
        seed: Any = None,
        num_steps: int | None = None,
        integrator: str | None = None,
        num_samples: int | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: ArrayLike | None = None,
        chunking: Chunking | None = None,
        guidance: float | None = None,
        without: Context | None = None,
    ) -> Array:
        """See :meth:`saccade.ActionHead.sample`. Options that are None are not passed."""


class VisionLanguageBackbone(Protocol):
    """A backbone, such as :class:`saccade.Backbone`."""

    @property
    def nbytes(self) -> int:
        """Size of the weights in memory, in bytes."""

    def encode_many(
        self, inputs: Sequence[BackboneInputs], *, previous: Sequence[BackboneFeatures] = ()
    ) -> list[BackboneFeatures]:
        """See :meth:`saccade.Backbone.encode_many`."""
