"""Computes one chunk of a checkpoint at each precision, one after another, and compares with float32."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.checkpoints.precisions import PRECISIONS, Difference, difference
from saccade.errors import SaccadeError
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.policy.policy import Policy

#: Vision-language tokens of the random features of a head alone.
NUM_VL_TOKENS = 64

#: The key of actions of a head alone.
NORMALISED = "normalised action"


@dataclass(frozen=True)
class Run:
    """One chunk at one precision."""

    name: str
    """The name of the precision."""
    nbytes: int | None = None
    """Size of the weights in memory, in bytes."""
    load_seconds: float | None = None
    """Time of loading."""
    milliseconds: float | None = None
    """Time of the second chunk; the first one also allocates."""
    difference: Difference | None = None
    """From float32, with the same inputs and noise; None for float32 itself, and where there is nothing to
    compare."""
    problem: str | None = None
    """Why there is no chunk, or what is wrong with it."""


@dataclass
class PolicyRuns:
    """What :func:`run_policy` computed."""

    robot: str | None = None
    """The robot: its tag, or else its id."""
    runs: list[Run] = field(default_factory=list)
    """One of each precision."""
    reference: dict[str, float] | None = None
    """What the reference found; None without one."""


class Reference(Protocol):
    """Another implementation to compare with."""

    def __call__(
        self, policy: Policy, observation: Mapping[str, Any], noise: Float32Array
    ) -> Callable[[], dict[str, float]]:
        """Keeps what ``policy`` computes in float32 from an observation and noise ``(1, T, width)``.

        Returns:
            Computes the same with the other implementation; called when ``policy`` is no longer in memory.
            The largest differences by what they are of; ``"of range"`` is that of the actions, relative to
            their range.
        """


def run_policy(
    source: Path,
    options: Mapping[str, Any],
    seed: int,
    reference: Reference | None,
    say: Callable[[str], object],
) -> PolicyRuns:
    """Runs the whole policy at each precision.

    Args:
        source: The checkpoint.
        options: Of :meth:`saccade.Policy.from_pretrained`.
        seed: Seed of frames and noise.
        reference: See :class:`Reference`.
        say: Called with what is done next.

    Raises:
        CheckpointError, InputError, FileNotFoundError: It cannot be loaded in float32, or there is no example
            observation of it. What fails later is the problem of a run.
        MissingExtraError: The reference lacks a package.
    """
    found = PolicyRuns()
    exact: dict[str, Float32Array] | None = None
    compare: Callable[[], dict[str, float]] | None = None
    for name, precision in PRECISIONS.items():
        say(f"a chunk in {name}")
        started = time.perf_counter()
        accepted = name != "float32"  # what float32 accepts, the other precisions must too
        try:
            policy = Policy.from_pretrained(source, precision=precision, **options)
            loaded = time.perf_counter() - started
            observation = policy.example_observation(seed)
            found.robot = policy.normalizer.embodiment or str(policy.embodiment_id)
            accepted = True
            noise = _noise(policy.head.config, seed)
            policy.act(observation, noise=noise)
            started = time.perf_counter()
            chunk = {key: part[0] for key, part in policy.act(observation, noise=noise).items()}
            spent = time.perf_counter() - started
        except (MemoryError, SaccadeError) as error:
            if not accepted and not isinstance(error, MemoryError):
                raise
            found.runs.append(Run(name, problem=_why(error)))
            continue
        groups = policy.normalizer.action_groups
        apart, problem = None, not_finite(chunk)
        if name == "float32":
            exact = chunk if problem is None else None
            compare = None if reference is None else reference(policy, observation, noise)
        elif exact is not None and problem is None:
            apart = difference([_batched(exact)], [_batched(chunk)], groups)
        found.runs.append(Run(name, policy.nbytes, loaded, 1e3 * spent, apart, problem))
        del policy  # before the next one is loaded
    if compare is not None:
        say("the torch reference")
        found.reference = compare()
    return found


def run_head(
    source: Path,
    embodiment_id: int,
    num_threads: int | None,
    seed: int,
    say: Callable[[str], object],
) -> list[Run]:
    """Runs the head alone at each precision, on random features and a state of zeros.

    Args:
        source: The checkpoint.
        embodiment_id: The embodiment whose layers are used.
        num_threads: As for :meth:`saccade.ActionHead.from_pretrained`.
        seed: Seed of features and noise.
        say: Called with what is done next.

    Raises:
        CheckpointError, InputError: It cannot be loaded in float32. What fails later is the problem of a run.
    """
    runs: list[Run] = []
    exact: Float32Array | None = None
    for name in dict.fromkeys(precision["head"] for precision in PRECISIONS.values()):
        say(f"a chunk of the head in {name}")
        started = time.perf_counter()
        try:
            head = ActionHead.from_pretrained(
                source, embodiment_ids=[embodiment_id], precision=name, num_threads=num_threads
            )
        except (MemoryError, SaccadeError) as error:
            if name == "float32" and not isinstance(error, MemoryError):
                raise
            runs.append(Run(name, problem=_why(error)))
            continue
        loaded = time.perf_counter() - started
        config = head.config
        features = np.random.default_rng(seed).standard_normal(
            (1, NUM_VL_TOKENS, config.context_dim), np.float32
        )
        images = None
        if config.mask_mode == "alternate":  # text, then images
            images = np.arange(NUM_VL_TOKENS)[None] >= NUM_VL_TOKENS // 2
        state = np.zeros((1, config.num_states, config.state_dim), np.float32)
        noise = _noise(config, seed)
        try:
            head(features, state, embodiment_id, noise=noise, image_mask=images)
            started = time.perf_counter()
            actions = np.asarray(head(features, state, embodiment_id, noise=noise, image_mask=images))
            spent = time.perf_counter() - started
        except (MemoryError, SaccadeError) as error:
            runs.append(Run(name, problem=_why(error)))
            continue
        apart = None
        if name == "float32":
            exact = actions
        elif exact is not None:
            largest = float(np.abs(actions.astype(np.float64) - exact).max())
            apart = Difference({NORMALISED: largest}, {NORMALISED: largest / 2})  # from -1 to 1
        runs.append(Run(name, head.nbytes, loaded, 1e3 * spent, apart, not_finite({NORMALISED: actions})))
        del head
    return runs


def not_finite(chunk: Mapping[str, Float32Array]) -> str | None:
    """Says which actions are NaN or infinite; None if none are."""
    wrong = [key for key, part in chunk.items() if not np.isfinite(part).all()]
    return f"NaN or infinity in the actions of {', '.join(wrong)}" if wrong else None


def lines_of(error: BaseException) -> list[str]:
    """The lines of a message: each names a problem."""
    return [line.strip() for line in str(error).splitlines() if line.strip()]


def _why(error: MemoryError | SaccadeError) -> str:
    """The problem of a run, on one line."""
    text = "; ".join(lines_of(error))
    return f"too large for this machine's memory: {text}" if isinstance(error, MemoryError) else text


def _noise(config: HeadConfig, seed: int) -> Float32Array:
    """``(1, T, width)``."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((1, config.action_horizon, config.encoder_action_dim), np.float32)


def _batched(chunk: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    return {key: part[None] for key, part in chunk.items()}
