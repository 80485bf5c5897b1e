"""Real-time chunking: a chunk that continues the previous one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from saccade._internal.arrays import integer, real
from saccade.errors import InputError

#: The options of real-time chunking in the released head of N1.7, which needs all of them.
RELEASED = ("action_horizon", "rtc_overlap_steps", "rtc_frozen_steps", "rtc_ramp_rate")


@dataclass(frozen=True)
class Chunking:
    """How a chunk continues the previous one.

    The next chunk is computed while a robot executes a chunk. If its first actions do not agree with those
    that are executed meanwhile, the robot jerks at the transition.

    The last ``overlap`` of the first ``horizon`` actions of the previous chunk become the first actions of
    the new one, in place of noise. The velocity of action ``j`` is multiplied by a factor: 0 for the first
    ``frozen`` actions, which do not change; ``(1 - exp(-a r)) / (1 - exp(-a))`` for the rest of the overlap,
    with ``a = ramp_rate`` and ``r = (j - frozen + 1) / (overlap - frozen + 1)``, which increases from 0 to 1;
    and 1 from ``overlap`` on. This is the rule of GR00T N1.7 (its options ``rtc_overlap_steps``,
    ``rtc_frozen_steps`` and ``rtc_ramp_rate``), here available for every head. With
    ``integrator="midpoint"`` the factor applies to both velocities of a step.

    Attributes:
        overlap: Number of actions that are taken from the previous chunk, at most ``horizon``.
        frozen: Number of these that do not change, counted from the first, at most ``overlap``. The robot
            executes them before the new chunk is available.
        ramp_rate: How fast the factor increases; above 0. A smaller rate gives a straighter ramp.
        horizon: Number of actions of the previous chunk that are used, at most the head's ``action_horizon``.
            Default: all.

    Raises:
        InputError: A number is out of range.

    Example:
        A robot executes 8 actions of a chunk of 16, and computing the next chunk takes as long as 3 actions.
        It is requested after 5 of the 8 actions, so it begins with the last 11 actions of the old one:

        >>> import numpy as np, saccade
        >>> head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint())
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


def from_released(options: Mapping[str, Any]) -> Chunking:
    """Real-time chunking by the released names, all of which are needed.

    Args:
        options: Values by name; other names are not read.

    Raises:
        InputError: A name is missing, or a value is not a number in its range.
    """
    missing = [name for name in RELEASED if name not in options]
    if missing:
        given = ", ".join(name for name in RELEASED if name in options)
        raise InputError(
            f"options: real-time chunking: expected all of {', '.join(RELEASED)}, got {given or 'none'} "
            f"without {', '.join(missing)}"
        )
    counts = {name: integer(f"options: {name}", options[name], least=0) for name in RELEASED[:3]}
    for limit, name in itertools.pairwise(counts):
        if counts[name] > counts[limit]:
            raise InputError(
                f"options: {name}: expected at most {counts[limit]} ({limit}), got {counts[name]}"
            )
    horizon, overlap, frozen = counts.values()
    integer("options: action_horizon", horizon)
    ramp_rate = check_ramp_rate("options: rtc_ramp_rate", options["rtc_ramp_rate"])
    return Chunking(overlap, frozen, ramp_rate, horizon)


def check_ramp_rate(name: str, value: object) -> float:
    """How fast the factor of :class:`Chunking` increases.

    Raises:
        InputError: It is not a finite number above 0.
    """
    rate = real(value)
    if not 0 < rate < math.inf:
        raise InputError(f"{name}: expected a finite number above 0, got {value!r:.100}")
    return rate
