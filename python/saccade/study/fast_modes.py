"""Ways to compute a chunk faster, by name: precision, steps, integrator, held rows, dropped tokens."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError
from saccade.head import ActionHead, Context
from saccade.sim.policy import EMBODIMENT_ID, Float32Array, Interventions
from saccade.study.cells import digest

BoolArray = npt.NDArray[np.bool_]
#: From noisy actions `(1, horizon, encoder_action_dim)` and a time in 0..1 to `(1, horizon, action_dim)`.
Velocity = Callable[[Float32Array, float], npt.NDArray[np.floating[Any]]]

PRECISIONS = ("float32", "bfloat16", "int8")
# With how often each asks for the velocity in a step.
INTEGRATORS = {"euler": 1, "midpoint": 2, "heun": 2, "adams": 1, "times": 1}
OF_THE_HEAD = ("euler", "midpoint")  # the others are done here, by `velocity`
EXACT_STEPS = 16  # of the midpoint rule, for what many steps lead to
SEARCH_STRIDES = (0.1, 0.04, 0.02, 0.01)  # by which step times are moved, one after the other


@dataclass(frozen=True)
class Mode:
    """One way to compute a chunk.

    Attributes:
        precision: Of the head.
        integrator: Of `INTEGRATORS`. `midpoint` and `heun` ask for the velocity twice a step; `adams`
            (Adams-Bashforth, second order) asks once and goes on from the last answer; `times` is Euler at
            step times that were optimised for the checkpoint.
        num_steps: Of the integrator.
        refresh: State and future rows are computed anew at every so many evaluations; 1 is exact.
        drop: Percent of the vision-language tokens that are removed, those with the least attention.

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
        """How often the velocity is asked for."""
        return self.num_steps * INTEGRATORS[self.integrator]

    @property
    def calibrated(self) -> bool:
        """Whether it takes numbers that are found on observations first."""
        return self.integrator == "times" or self.drop > 0

    @classmethod
    def parse(cls, name: str) -> Mode:
        """The mode of that name.

        Raises:
            InputError: it is none.
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
                f"mode: given {name!r}, expected PRECISION-INTEGRATOR-STEPS, then -refresh-NUMBER and "
                f"-drop-PERCENT if wanted; precisions {', '.join(PRECISIONS)}; integrators "
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
    """What calibrated modes take.

    Attributes:
        times: By number of steps, the times at which steps begin, from 0 on, and 1 at the end.
        mass: Of each vision-language position, its share of the cross-attention.
    """

    times: tuple[tuple[float, ...], ...] = ()
    mass: tuple[float, ...] = ()

    def grid(self, num_steps: int) -> tuple[float, ...]:
        """The times for so many steps."""
        return next(grid for grid in self.times if len(grid) == num_steps + 1)

    def least(self, percent: int, removed: BoolArray | None) -> BoolArray:
        """Which positions go, `(1, T_vl)`: so many percent of those not yet `removed`, rounded down."""
        gone = np.zeros((1, len(self.mass)), bool) if removed is None else removed.copy()
        there = np.flatnonzero(~gone[0])
        order = there[np.argsort(np.asarray(self.mass)[there], kind="stable")]
        gone[0, order[: len(there) * percent // 100]] = True
        return gone

    def of(self, mode: Mode) -> str:
        """A digest of what the mode takes of it, to tell apart what was measured with other numbers."""
        times = self.grid(mode.num_steps) if mode.integrator == "times" else ()
        return digest([times, self.mass if mode.drop else ()])


@functools.lru_cache(maxsize=len(PRECISIONS))
def head_of(source: str, config: str | None, precision: str, num_threads: int | None) -> ActionHead:
    """A head; one of each precision is kept."""
    return ActionHead.load(source, config=config, precision=precision, num_threads=num_threads)


def encode(
    head: ActionHead, mode: Mode, calibration: Calibration, features: Float32Array, removed: BoolArray | None
) -> Context:
    """An observation `(1, T_vl, context_dim)` as the mode encodes it; `removed (1, T_vl)` are not there."""
    if mode.drop:
        removed = calibration.least(mode.drop, removed)
    return head.encode(features, drop_vl=removed)


def sample(
    head: ActionHead,
    mode: Mode,
    calibration: Calibration,
    context: Context,
    state: Float32Array,
    embodiment_id: int,
    noise: Float32Array,
) -> Float32Array:
    """A chunk `(batch, horizon, action_dim)` as the mode computes it."""
    if mode.integrator in OF_THE_HEAD:
        found = head.sample(
            context,
            state,
            embodiment_id,
            noise=noise,
            num_steps=mode.num_steps,
            integrator=mode.integrator,
            future_refresh=mode.refresh,
        )
        return np.asarray(found)
    times = calibration.grid(mode.num_steps) if mode.integrator == "times" else even_times(mode.num_steps)
    velocity = velocity_of(head, context, state, embodiment_id)
    return integrate(velocity, noise, mode.integrator, times)[..., : head.config.action_dim]


def many_steps(
    head: ActionHead, context: Context, state: Float32Array, embodiment_id: int, noise: Float32Array
) -> Float32Array:
    """What many small steps lead to, `(batch, horizon, action_dim)`."""
    found = head.sample(
        context, state, embodiment_id, noise=noise, num_steps=EXACT_STEPS, integrator="midpoint"
    )
    return np.asarray(found)


def velocity_of(head: ActionHead, context: Context, state: Float32Array, embodiment_id: int) -> Velocity:
    """The head's velocity as a function of time in 0..1, which it knows in whole buckets."""
    buckets = head.config.num_timestep_buckets

    def velocity(actions: Float32Array, time: float) -> Float32Array:
        bucket = min(int(time * buckets), buckets - 1)
        return np.asarray(head.velocity(context, state, embodiment_id, actions, bucket))

    return velocity


def even_times(num_steps: int) -> tuple[float, ...]:
    """Where steps of one length begin, and 1."""
    return tuple(step / num_steps for step in range(num_steps + 1))


def integrate(
    velocity: Velocity, start: Float32Array, integrator: str, times: Sequence[float]
) -> Float32Array:
    """Follows a velocity from noise at time 0 to actions at time 1.

    Args:
        velocity: of the first `action_dim` numbers; the others stay as they are.
        start: `(batch, horizon, encoder_action_dim)`.
        integrator: of `INTEGRATORS`, but for `midpoint`.
        times: where steps begin, and 1. `adams` takes steps of one length.

    Returns:
        Like `start`.

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
        moving = x[..., : slope.shape[-1]]  # a view: what is added to it is added to x
        if integrator == "heun":
            slope = (slope + velocity(moved(x, slope, length), after)) / 2
        elif integrator == "adams":
            slope, before = slope if before is None else 1.5 * slope - 0.5 * before, slope
        moving += np.float32(length) * slope
    return x


def moved(x: Float32Array, slope: npt.NDArray[np.floating[Any]], length: float) -> Float32Array:
    """`x` a step of that length further."""
    further = x.copy()
    further[..., : slope.shape[-1]] += np.float32(length) * slope
    return further


def best_times(error: Callable[[tuple[float, ...]], float], num_steps: int) -> tuple[float, ...]:
    """Step times with a small error: from even ones, one is moved at a time as long as that helps.

    Args:
        error: of a grid of times, from 0 to 1.
        num_steps: at least 2.
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


def cross_mass(
    head: ActionHead, context: Context, state: Float32Array, embodiment_id: int, noise: Float32Array
) -> Float32Array:
    """Of each vision-language position its share of the cross-attention, `(T_vl,)`.

    The mean over rows, heads, blocks and four Euler steps.
    """
    cross = range(0, head.config.num_layers, 2 if head.config.interleave_self_attention else 1)
    trace = head.trace(context, state, embodiment_id, noise=noise, num_steps=4, blocks=list(cross))
    shares: Float32Array = np.mean(
        [np.asarray(one).mean(axis=(0, 1, 2)) for one in trace.attention.values()], axis=0
    )
    return shares


class ModeEngine:
    """A policy's head in one of the modes, on one thread.

    Args:
        checkpoint: directory of the policy.
        mode: how it is computed.
        calibration: what the mode takes.
    """

    def __init__(self, checkpoint: str, mode: Mode, calibration: Calibration) -> None:
        self._head = head_of(checkpoint, None, mode.precision, 1)
        self._mode = mode
        self._calibration = calibration

    def encode(self, features: Float32Array) -> Context:
        """See `saccade.sim.policy.HeadEngine`."""
        return encode(self._head, self._mode, self._calibration, features, None)

    def sample(
        self, context: Context, state: Float32Array, noise: Float32Array, intervention: Interventions = None
    ) -> Float32Array:
        """See `saccade.sim.policy.HeadEngine`; takes no intervention."""
        if intervention is not None:
            raise InputError("intervention: given one, expected None with a faster mode")
        return sample(self._head, self._mode, self._calibration, context, state, EMBODIMENT_ID, noise)

    def describe(self) -> dict[str, Any]:
        """See `saccade.sim.policy.HeadEngine`."""
        return {"name": "rust", "mode": self._mode.name, "isa": self._head.isa, "num_threads": 1}
