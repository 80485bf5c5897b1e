"""Keyword arguments that several methods of the reference head share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypedDict

import numpy as np
from torch import Tensor

from saccade.head.chunking import Chunking
from saccade.head.intervention import Intervention, Tokens
from saccade_lab.reference.intervene import Mask


class Conditions(TypedDict, total=False):
    """What a run is subject to. :meth:`saccade_lab.reference.ActionHead.trace` documents each."""

    drop_vl: Mask
    attention_mask: Mask
    image_mask: Mask
    intervention: Intervention | Sequence[Intervention] | None
    stop_gradient: Sequence[tuple[Tokens, Tokens]]


class SampleOptions(Conditions, total=False):
    """The keyword arguments of :meth:`saccade_lab.reference.ActionHead.sample`."""

    noise: Tensor | np.ndarray
    num_steps: int | None
    integrator: str | None
    future_refresh: int | None
    previous_chunk: Tensor | np.ndarray | None
    chunking: Chunking | None


class RunOptions(Conditions, total=False):
    """The keyword arguments of :class:`saccade_lab.reference.intervene.Run`, except the number of steps."""

    in_step: int
    future_refresh: int
    record: Iterable[str]
    blocks: Sequence[int] | int | None
    steps: Sequence[int] | int | None
