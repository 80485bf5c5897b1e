"""Real-time chunking: a chunk begins as the last one ended."""

from __future__ import annotations

import math
from dataclasses import dataclass

from saccade._arrays import integer
from saccade.errors import InputError


@dataclass(frozen=True)
class Chunking:
    """How a chunk takes over the end of the chunk before it.

    While a robot carries out a chunk, the next one is computed. Its first actions must agree with those that
    the robot carries out meanwhile, or it jerks at the seam. So the last ``overlap`` of the first ``horizon``
    actions of the chunk before become the first ones of the new chunk, in place of noise. Of these, action j
    follows the velocity by a factor ``g``: 0 for the first ``frozen``, which stay as they are; then
    ``(1 - exp(-a r)) / (1 - exp(-a))`` with ``a = ramp_rate`` and
    ``r = (j - frozen + 1) / (overlap - frozen + 1)``, which grows from 0 to 1; and 1 from ``overlap`` on. It
    is GR00T N1.7's rule (its options ``rtc_overlap_steps``, ``rtc_frozen_steps``, ``rtc_ramp_rate``), here
    for every head; with ``integrator="midpoint"`` the factor stands before both velocities of a step.

    Attributes:
        overlap: Actions that are taken over, at most ``horizon``.
        frozen: Of these, the first that do not change, at most ``overlap``: those that are carried out before
            the new chunk is there.
        ramp_rate: How soon the rest become free; above 0. The smaller, the straighter the ramp.
        horizon: Actions of the chunk before that count, at most the head's ``action_horizon``. Default all.

    Raises:
        InputError: a number is out of range.

    Example:
        A robot carries out 8 actions of a chunk of 16 and then wants the next chunk, which takes as long as 3
        actions. So the next one is asked for after 5 of the 8, and begins with the last 11 of the old chunk,
        of which the first 3 are carried out while it is computed:

        >>> import importlib.resources
        >>> import numpy as np, saccade
        >>> head = saccade.ActionHead.load(importlib.resources.files("saccade") / "sim" / "demo")
        >>> context = head.encode(np.zeros((1, 60, head.config.context_dim), np.float32))
        >>> state = np.zeros((1, head.config.state_dim), np.float32)
        >>> before = head.sample(context, state, 0, seed=7)
        >>> chunking = saccade.Chunking(overlap=11, frozen=3)
        >>> chunk = head.sample(context, state, 0, seed=8, previous_chunk=before, chunking=chunking)
        >>> np.array_equal(chunk[:, :3], before[:, 5:8])
        True
    """

    overlap: int
    frozen: int
    ramp_rate: float = 6.0
    horizon: int | None = None

    def __post_init__(self) -> None:
        horizon = None if self.horizon is None else integer("chunking: horizon", self.horizon)
        overlap = integer("chunking: overlap", self.overlap, least=0)
        frozen = integer("chunking: frozen", self.frozen, least=0)
        if horizon is not None and overlap > horizon:
            raise InputError(f"chunking: overlap: expected at most {horizon} (horizon), got {overlap}")
        if frozen > overlap:
            raise InputError(f"chunking: frozen: expected at most {overlap} (overlap), got {frozen}")
        try:
            ramp_rate = float(self.ramp_rate)
        except (TypeError, ValueError, OverflowError):
            ramp_rate = math.nan
        if not (math.isfinite(ramp_rate) and ramp_rate > 0):
            raise InputError(f"chunking: ramp_rate: expected a finite number above 0, got {self.ramp_rate!r}")
        plain = {"overlap": overlap, "frozen": frozen, "ramp_rate": ramp_rate, "horizon": horizon}
        for name, value in plain.items():
            object.__setattr__(self, name, value)
