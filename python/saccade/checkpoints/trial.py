"""Computes one chunk of a checkpoint at each precision, one after another, and compares with float32."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.arrays import Float32Array
from saccade.checkpoints.precisions import PRECISIONS, Difference, difference
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
        CheckpointError, InputError, FileNotFoundError: It cannot be loaded, or the example observation is
            refused.
    """
    found = PolicyRuns()
    exact: dict[str, Float32Array] | None = None
    compare: Callable[[], dict[str, float]] | None = None
    for name, precision in PRECISIONS.items():
        say(f"a chunk in {name}")
        started = time.perf_counter()
        try:
            policy = Policy.from_pretrained(source, precision=precision, **options)
            loaded = time.perf_counter() - started
            observation = policy.example_observation(seed)
            noise = _noise(policy.head.config, seed)
            policy.act(observation, noise=noise)
            started = time.perf_counter()
            chunk = {key: part[0] for key, part in policy.act(observation, noise=noise).items()}
            spent = time.perf_counter() - started
        except MemoryError as error:
            found.runs.append(Run(name, problem=f"too large for this machine's memory: {error}"))
            continue
        groups = policy.normalizer.action_groups
        apart, problem = None, not_finite(chunk)
        if name == "float32":
            exact = chunk if problem is None else None
            found.robot = policy.normalizer.embodiment or str(policy.embodiment_id)
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
    embodiment: str | int | None,
    num_threads: int | None,
    seed: int,
    say: Callable[[str], object],
) -> list[Run]:
    """Runs the head alone at each precision, on random features and a state of zeros.

    Args:
        source: The checkpoint.
        embodiment: An id; a tag or None takes the first one that the checkpoint still has.
        num_threads: As for :meth:`saccade.ActionHead.from_pretrained`.
        seed: Seed of features and noise.
        say: Called with what is done next.

    Raises:
        CheckpointError, InputError: It cannot be loaded.
    """
    kept = _saccade.HeadCheckpoint.open(str(source), None).kept_embodiments() or [0]
    chosen = embodiment if isinstance(embodiment, int) else kept[0]
    runs: list[Run] = []
    exact: Float32Array | None = None
    for name in dict.fromkeys(precision["head"] for precision in PRECISIONS.values()):
        say(f"a chunk of the head in {name}")
        started = time.perf_counter()
        head = ActionHead.from_pretrained(
            source, embodiment_ids=[chosen], precision=name, num_threads=num_threads
        )
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
        head(features, state, chosen, noise=noise, image_mask=images)
        started = time.perf_counter()
        actions = np.asarray(head(features, state, chosen, noise=noise, image_mask=images))
        spent = time.perf_counter() - started
        apart = None
        if exact is None:
            exact = actions
        else:
            largest = float(np.abs(actions.astype(np.float64) - exact).max())
            apart = Difference({NORMALISED: largest}, {NORMALISED: largest / 2})  # from -1 to 1
        runs.append(Run(name, head.nbytes, loaded, 1e3 * spent, apart, not_finite({NORMALISED: actions})))
        del head
    return runs


def not_finite(chunk: Mapping[str, Float32Array]) -> str | None:
    """Says which actions are NaN or infinite; None if none are."""
    wrong = [key for key, part in chunk.items() if not np.isfinite(part).all()]
    return f"NaN or infinity in the actions of {', '.join(wrong)}" if wrong else None


def _noise(config: HeadConfig, seed: int) -> Float32Array:
    """``(1, T, width)``."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((1, config.action_horizon, config.encoder_action_dim), np.float32)


def _batched(chunk: Mapping[str, Float32Array]) -> dict[str, Float32Array]:
    return {key: part[None] for key, part in chunk.items()}
