"""Guidance: sampling along a velocity that is moved away from that of a second context."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from saccade.errors import InputError
from saccade_lab.reference.masks import Mask


@dataclass(frozen=True)
class Guidance:
    """A second context, such as the observation without its instruction, and a weight.

    With the velocity ``v`` of the first context and ``u`` of this one, at the same actions and time, sampling
    follows ``u + weight (v - u)``: classifier-free guidance (Ho and Salimans, arXiv 2207.12598) for flows.

    Attributes:
        weight: 1 follows the first context alone, 0 this one alone.
        vl_embs: ``(B, S', context_dim)``, from ``ActionHead.encode``.
        drop_vl, attention_mask, image_mask: Those of the second context, ``(B, S')``.

    Raises:
        InputError: The weight is negative or not finite.
    """

    weight: float
    vl_embs: Tensor | np.ndarray
    drop_vl: Mask = None
    attention_mask: Mask = None
    image_mask: Mask = None

    def __post_init__(self) -> None:
        if not 0 <= self.weight < math.inf:
            raise InputError(f"guidance: expected a finite number of at least 0, got {self.weight!r}")
