"""Ways to compute a chunk faster, by name: precision, integrator, steps, reused rows, dropped tokens."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import PRECISIONS, Float32Array
from saccade.errors import InputError
from saccade.head.context import Context
from saccade.head.head import ActionHead
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.cell import digest

BoolArray = npt.NDArray[np.bool_]
#: Noisy actions ``(1, horizon, encoder_action_dim)`` and a time in 0..1 -> ``(1, horizon, action_dim)``.
Velocity = Callable[[Float32Array, float], npt.NDArray[np.floating[Any]]]

INTEGRATORS = {"euler": 1, "midpoint": 2, "heun": 2, "adams": 1, "times": 1}  # evaluations per step
OF_THE_HEAD = ("euler", "midpoint")  # the others are computed here, from `ActionHead.velocity`
EXACT_STEPS = 16  # of the midpoint rule: the reference for small steps
SEARCH_STRIDES = (0.1, 0.04, 0.02, 0.01)  # by which step times are moved, one after the other
CROSS_MASS_STEPS = 4


@dataclass(frozen=True)
class Mode:
    """One way to compute a chunk.

    Attributes:
        precision: Precision of the head.
        integrator: One of ``INTEGRATORS``. ``midpoint`` and ``heun`` evaluate the velocity twice per step.
            ``adams`` (Adams-Bashforth, second order) evaluates it once and extrapolates from the previous
            value. ``times`` is Euler at step times that are optimised for the checkpoint.
        num_steps: Number of steps of the integrator.
        refresh: State and future rows are recomputed every ``refresh`` evaluations; 1 is exact.
        drop: Percentage of the vision-language tokens that are removed, those with the least attention.

    Example:
        >>> Mode.parse("int8-euler-4-refresh-2").name
        'int8-euler-4-refresh-2'
        >>> Mode.parse("float32-heun-2").evaluations
        4
    """

    precision: str
    integrator: str
    num_steps: int
    refresh: int = 1
    drop: int = 0

    @property
    def name(self) -> str:
        """For the command line and the tables."""
        parts = [self.precision, self.integrator, str(self.num_steps)]
        parts += ["refresh", str(self.refresh)] * (self.refresh > 1) + ["drop", str(self.drop)] * (
            self.drop > 0
        )
        return "-".join(parts)

    @property
    def evaluations(self) -> int:
        """How often the velocity is evaluated."""
        return self.num_steps * INTEGRATORS[self.integrator]

    @property
    def calibrated(self) -> bool:
        """Whether it depends on numbers that are first found on other observations."""
        return self.integrator == "times" or self.drop > 0

    @classmethod
    def parse(cls, name: str) -> Mode:
        """The mode of that name.

        Raises:
            InputError: There is none.
        """
        words = name.split("-")
        options = dict(zip(words[3::2], words[4::2], strict=False))
        numbers = [*words[2:3], *options.values()]
        fits = (
            len(words) in (3, 5, 7)
            and words[0] in PRECISIONS
            and words[1] in INTEGRATORS
            and all(number.isascii() and number.isdigit() for number in numbers)
            and 2 * len(options) + 3 == len(words)
            and set(options) <= {"refresh", "drop"}
        )
        if not fits:
            raise InputError(
                f"mode: given {name!r}, expected PRECISION-INTEGRATOR-STEPS, optionally with -refresh-NUMBER "
                f"and -drop-PERCENT; precisions {', '.join(PRECISIONS)}; integrators "
                f"{', '.join(INTEGRATORS)}"
            )
        mode = cls(
            words[0], words[1], int(words[2]), int(options.get("refresh", 1)), int(options.get("drop", 0))
        )
        least = 2 if mode.integrator in ("adams", "times") else 1  # with one step both are Euler
        if not least <= mode.num_steps <= 1000 or mode.refresh < 1 or not 0 <= mode.drop < 100:
            raise InputError(
                f"mode: given {name!r}, expected {least} to 1000 steps, refresh at least 1, drop 0 to 99"
            )
        if mode.refresh > 1 and mode.integrator not in OF_THE_HEAD:
            raise InputError(f"mode: given {name!r}, expected refresh with {' or '.join(OF_THE_HEAD)} only")
        return mode


@dataclass(frozen=True)
class Calibration:
    """The numbers that calibrated modes depend on.

    Attributes:
        times: The step times for each number of steps, from 0 to 1.
        mass: Share of the cross-attention of each vision-language position.
    """

    times: tuple[tuple[float, ...], ...] = ()
    mass: tuple[float, ...] = ()

    def grid(self, num_steps: int) -> tuple[float, ...]:
        """The times of ``num_steps`` steps."""
        return next(grid for grid in self.times if len(grid) == num_steps + 1)

    def least(self, percent: int, removed: BoolArray) -> BoolArray:
        """Removed positions, ``(1, T_vl)`` each: ``percent`` of those not ``removed`` yet, rounded down.

        Positions that no calibrated observation had, those of longer instructions, go last.
        """
        gone = removed.copy()
        mass = np.full(gone.shape[1], np.inf)
        known = self.mass[: len(mass)]
        mass[: len(known)] = known
        there = np.flatnonzero(~gone[0])
        order = there[np.argsort(mass[there], kind="stable")]
        gone[0, order[: len(there) * percent // 100]] = True
        return gone

    def of(self, mode: Mode) -> str:
        """A digest of what the mode depends on, to distinguish measurements with different calibrations."""
        times = self.grid(mode.num_steps) if mode.integrator == "times" else ()
        return digest([times, self.mass if mode.drop else ()])


def encode(head: ActionHead, mode: Mode, calibration: Calibration, observation: HeadInputs) -> Context:
    """A single observation as the mode encodes it."""
    if mode.drop:
        there = observation.drop_vl
        removed = np.zeros((1, observation.num_vl_tokens), np.bool_) if there is None else there
        observation = dataclasses.replace(observation, drop_vl=calibration.least(mode.drop, removed))
    return observation.encode(head)


def sample(
    head: ActionHead, mode: Mode, calibration: Calibration, context: Context, observation: HeadInputs
) -> Float32Array:
    """A chunk ``(1, horizon, action_dim)`` as the mode computes it, from the observation's noise."""
    if mode.integrator in OF_THE_HEAD:
        return observation.sample(
            head,
            context,
            num_steps=mode.num_steps,
            integrator=mode.integrator,
            future_refresh=mode.refresh,
        )
    times = calibration.grid(mode.num_steps) if mode.integrator == "times" else even_times(mode.num_steps)
    assert observation.noise is not None
    chunk = integrate(velocity_of(head, context, observation), observation.noise, mode.integrator, times)
    return chunk[..., : head.config.action_dim]


def many_steps(head: ActionHead, context: Context, observation: HeadInputs) -> Float32Array:
    """The chunk for many small steps, ``(1, horizon, action_dim)``."""
    return observation.sample(head, context, num_steps=EXACT_STEPS, integrator="midpoint")


def velocity_of(head: ActionHead, context: Context, observation: HeadInputs) -> Velocity:
    """The head's velocity as a function of time in 0..1, which the head rounds down to a bucket."""
    buckets = head.config.num_timestep_buckets

    def velocity(actions: Float32Array, time: float) -> Float32Array:
        bucket = min(int(time * buckets), buckets - 1)
        found = head.velocity(context, observation.state, observation.embodiment_id, actions, bucket)
        return np.asarray(found)

    return velocity


def even_times(num_steps: int) -> tuple[float, ...]:
    """The times of steps of equal length, from 0 to 1."""
    return tuple(step / num_steps for step in range(num_steps + 1))


def integrate(
    velocity: Velocity, start: Float32Array, integrator: str, times: Sequence[float]
) -> Float32Array:
    """Integrates a velocity from noise at time 0 to actions at time 1.

    Args:
        velocity: Velocity of the first ``action_dim`` numbers. The others are not changed.
        start: ``(batch, horizon, encoder_action_dim)``.
        integrator: One of ``INTEGRATORS``, except ``midpoint``.
        times: Step times from 0 to 1. ``adams`` needs steps of equal length.

    Returns:
        An array of the shape of ``start``.

    Example:
        A velocity that grows with time, for which Heun's rule is exact:

        >>> def growing(x, time):
        ...     return np.full_like(x, 2 * time)
        >>> start = np.zeros((1, 1, 1), np.float32)
        >>> [round(float(integrate(growing, start, name, (0.0, 0.5, 1.0))[0, 0, 0]), 3)
        ...  for name in ("euler", "heun", "adams")]
        [0.5, 1.0, 0.75]
    """
    x = np.array(start, np.float32)
    before = None
    for now, after in itertools.pairwise(times):
        length = after - now
        slope = velocity(x, now)
        moving = x[..., : slope.shape[-1]]  # a view: adding to it changes x
        if integrator == "heun":
            slope = (slope + velocity(moved(x, slope, length), after)) / 2
        elif integrator == "adams":
            slope, before = slope if before is None else 1.5 * slope - 0.5 * before, slope
        moving += np.float32(length) * slope
    return x


def moved(x: Float32Array, slope: npt.NDArray[np.floating[Any]], length: float) -> Float32Array:
    """``x`` after a step of that length along ``slope``."""
    further = x.copy()
    further[..., : slope.shape[-1]] += np.float32(length) * slope
    return further


def best_times(error: Callable[[tuple[float, ...]], float], num_steps: int) -> tuple[float, ...]:
    """Step times with a small error: starting from even ones, one at a time is moved while that helps.

    Args:
        error: Function from step times, from 0 to 1, to their error.
        num_steps: At least 2.
    """
    best = even_times(num_steps)
    least = error(best)
    for stride in SEARCH_STRIDES:
        better = True
        while better:
            better = False
            for place, way in itertools.product(range(1, num_steps), (-stride, stride)):
                moved_to = round(best[place] + way, 3)  # buckets are thousandths
                if not best[place - 1] < moved_to < best[place + 1]:
                    continue
                tried = (*best[:place], moved_to, *best[place + 1 :])
                found = error(tried)
                if found < least:
                    best, least, better = tried, found, True
    return best


def cross_mass(head: ActionHead, context: Context, observation: HeadInputs) -> Float32Array:
    """The share of the cross-attention of each vision-language position, ``(T_vl,)``.

    The mean over rows, heads, blocks and four Euler steps.
    """
    cross = range(0, head.config.num_layers, 2 if head.config.interleave_self_attention else 1)
    trace = observation.trace(head, context, num_steps=CROSS_MASS_STEPS, blocks=list(cross))
    shares: Float32Array = np.mean(
        [np.asarray(one).mean(axis=(0, 1, 2)) for one in trace.attention.values()], axis=0
    )
    return shares
