"""Compares the precisions of a whole checkpoint on a user's own pictures, and recommends one."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array, integer
from saccade.checkpoints.description import describe, quantized_dtypes
from saccade.checkpoints.given_inputs import inputs_sha256
from saccade.errors import InputError
from saccade.observations.pictures import PictureObservation, read_frames
from saccade.policy.policy import Policy
from saccade.processor import Preprocessing
from saccade.robots import Group

#: The precisions that are compared, the exact one first.
PRECISIONS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "float32": {"backbone": "float32", "head": "float32"},
        "bfloat16": {"backbone": "bfloat16", "head": "bfloat16"},
        "int8, head bfloat16": {"backbone": "int8", "head": "bfloat16"},
        "int8": {"backbone": "int8", "head": "int8"},
        "int4": {"backbone": "int4", "head": "int4"},
    }
)

#: Largest difference of an action, relative to its range, at which a precision is recommended: a convention.
#: int8 stays below it in the small policies that were tested, and 300 paired episodes of a sensitive task
#: excluded that int8 costs 2 points of success (docs/precision.md).
TOLERANCE = 0.01

#: Number of chunks that are compared for each observation, from different noise.
NUM_SAMPLES = 4

#: Standard deviations that stand for the range of an action, if the statistics are mean and deviation.
DEVIATIONS = 4.0


@dataclass(frozen=True)
class Difference:
    """The largest difference of actions over all observations, samples, steps and numbers."""

    largest: dict[str, float]
    """By key of the action, in the robot's units."""
    of_range: dict[str, float]
    """By key, relative to the range of each number: maximum minus minimum, 99 % minus 1 % quantile, or
    four standard deviations, whatever the statistics are. Numbers that are constant do not count."""

    @property
    def worst(self) -> float:
        """The largest of ``of_range``."""
        return max(self.of_range.values(), default=0.0)


@dataclass(frozen=True)
class PrecisionError:
    """One precision, compared with float32."""

    name: str
    precision: dict[str, str]
    """Of ``backbone`` and ``head``."""
    features: float
    """Error of the backbone's features: the norm of the difference of a token, relative to the token's norm,
    and of that the mean over tokens and observations."""
    actions: Difference
    nbytes: int
    """Size of the weights in memory, in bytes."""
    milliseconds: float
    """Time of one chunk, from frames to actions: the median over observations."""


@dataclass(frozen=True)
class PrecisionCheck:
    """What :func:`check_precisions` found."""

    source: str
    observations: int
    samples: int
    """Chunks for each observation."""
    precisions: tuple[PrecisionError, ...]
    other_noise: Difference
    """Of float32 with itself, from other noise: how much the policy leaves to chance."""
    tolerance: float
    recommended: str | None
    """The name of the precision with the smallest weights among those whose actions differ by at most
    ``tolerance`` of the range; None if there is none, which only a reference can cause."""
    reference: str | None
    """The checkpoint whose float32 everything is compared with; None for that of ``source`` itself."""
    is_quantized: bool
    """Whether weights of ``source`` are int8 or int4. Without a reference, what rounding them has changed is
    in none of the differences."""


@dataclass(frozen=True)
class _Results:
    """What one precision computes on each observation."""

    features: list[Float32Array]
    actions: list[dict[str, Float32Array]]
    milliseconds: float


def check_precisions(
    source: str | os.PathLike[str],
    directory: Path,
    *,
    reference: str | os.PathLike[str] | None = None,
    instruction: str | None = None,
    state: Path | None = None,
    embodiment: str | int | None = None,
    preprocessing: Preprocessing | None = None,
    tokenizer: str | os.PathLike[str] | None = None,
    data_config: str | os.PathLike[str] | Mapping[str, Any] | None = None,
    action_horizon: int | None = None,
    processor_options: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> PrecisionCheck:
    """Runs a whole checkpoint at every precision on the same pictures from the same noise.

    One precision at a time is in memory.

    Args:
        source: The checkpoint, as for :meth:`saccade.Policy.from_pretrained`.
        directory: Pictures, as :func:`saccade.observations.pictures.read_frames` reads them.
        reference: The checkpoint whose float32 is the exact result, such as the one that ``source`` was
            quantised from. Default: ``source``.
        instruction, state: As for :func:`saccade.observations.pictures.read_frames`.
        embodiment, preprocessing, tokenizer, data_config, action_horizon, processor_options, num_threads: As
            for :meth:`saccade.Policy.from_pretrained`.
        seed: Seed of the noise, at least 0.
        progress: Called with the number of precisions that are done, and of all.

    Raises:
        FileNotFoundError, CheckpointError, InputError, ShapeError, DtypeError: As
            :meth:`saccade.Policy.from_pretrained` and :func:`saccade.observations.pictures.read_frames`.
        InputError: ``reference`` differs from ``source`` in more than its weights: sizes of the head,
            embodiment, statistics, preprocessing, or the shape of its features.

    Example:
        >>> from pathlib import Path
        >>> from saccade.checkpoints import check_precisions
        >>> def best(checkpoint: str) -> str | None:
        ...     return check_precisions(checkpoint, Path("frames"), instruction="open the drawer").recommended
    """
    seed = integer("seed", seed, least=0)

    load = partial(
        Policy.from_pretrained,
        embodiment=embodiment,
        preprocessing=preprocessing,
        tokenizer=tokenizer,
        data_config=data_config,
        action_horizon=action_horizon,
        processor_options=processor_options,
        num_threads=num_threads,
    )
    report = progress or (lambda done, total: None)
    done, todo = count(), len(PRECISIONS) + (reference is not None)
    report(next(done), todo)
    first, first_precision = next(iter(PRECISIONS.items()))
    policy = load(source, precision=first_precision)
    groups = policy.normalizer.action_groups
    recorded = read_frames(directory, policy, instruction=instruction, state=state)
    if reference is not None:
        expected = _described(policy, recorded)
        del policy  # before the next one is loaded
        policy = load(reference, precision=first_precision)
        _check_alike(_described(policy, recorded), expected)
    exact = run(policy, recorded, seed)
    others = run(policy, recorded, seed + len(recorded))
    other_noise = difference(exact.actions, others.actions, groups)
    found: list[PrecisionError] = []
    for name, precision in PRECISIONS.items():
        results = exact
        if reference is not None or name != first:
            report(next(done), todo)
            del policy
            policy = load(source, precision=precision)
            results = run(policy, recorded, seed)
        found.append(
            PrecisionError(
                name=name,
                precision=dict(precision),
                features=features_error(exact.features, results.features),
                actions=difference(exact.actions, results.actions, groups),
                nbytes=policy.nbytes,
                milliseconds=results.milliseconds,
            )
        )
    return PrecisionCheck(
        source=os.fspath(source),
        observations=len(recorded),
        samples=NUM_SAMPLES,
        precisions=tuple(found),
        other_noise=other_noise,
        tolerance=TOLERANCE,
        recommended=recommended(found),
        reference=None if reference is None else os.fspath(reference),
        is_quantized=bool(quantized_dtypes(describe(source))),
    )


def _described(policy: Policy, recorded: Sequence[PictureObservation]) -> dict[str, Any]:
    """All of a policy but its weights: sizes, statistics, and what the models are given."""
    sizes = dataclasses.asdict(policy.head.config)
    found = {f"{name} of the head": value for name, value in sizes.items()}
    for group in policy.normalizer.action_groups:
        fields = vars(group).items()
        found[f"statistics of the action {group.key}"] = {
            name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in fields
        }
    found["embodiment"] = policy.embodiment_id
    observations = [one.observation for one in recorded]
    found["images, tokens or states, as the models are given them"] = inputs_sha256(policy, observations)
    return found


def _check_alike(reference: Mapping[str, Any], source: Mapping[str, Any]) -> None:
    """Checks that two policies differ in their weights alone, so that their actions can be compared."""
    names = dict.fromkeys((*source, *reference))
    other = [name for name in names if name not in source or reference.get(name) != source[name]]
    if other:
        raise InputError(
            "reference: expected one that differs from source in its weights alone, got other "
            f"{'; other '.join(other)}"
        )


def recommended(found: Sequence[PrecisionError]) -> str | None:
    """The name of the smallest whose actions differ by at most `TOLERANCE` of the range; None without one."""
    close = [one for one in found if one.actions.worst <= TOLERANCE]
    return min(close, key=lambda one: one.nbytes).name if close else None


def run(policy: Policy, recorded: Sequence[PictureObservation], seed: int) -> _Results:
    """Features, chunks from `NUM_SAMPLES` draws of noise, and the time of a chunk."""
    features, actions, seconds = [], [], []
    policy.act(recorded[0].observation, seed=seed)  # claims memory
    for index, one in enumerate(recorded):
        started = time.perf_counter()
        context = policy.encode(one.observation)
        policy.sample(context, one.observation, seed=seed + index)
        seconds.append(time.perf_counter() - started)
        chunks = policy.sample(context, one.observation, seed=seed + index, num_samples=NUM_SAMPLES)
        features.append(np.asarray(context.features[0].backbone_features[0]))
        actions.append({key: np.asarray(chunk[0]) for key, chunk in chunks.items()})
    return _Results(features, actions, 1e3 * float(np.median(seconds)))


def features_error(exact: Sequence[Float32Array], given: Sequence[Float32Array]) -> float:
    """The mean over tokens of the norm of the difference, relative to the token's norm."""
    rows = []
    for expected, got in zip(exact, given, strict=True):
        if got.shape != expected.shape:
            raise InputError(
                f"reference: expected one that gives source's features {got.shape}, got {expected.shape}"
            )
        norms = np.linalg.norm(expected.astype(np.float64), axis=-1)
        differences = np.linalg.norm(got.astype(np.float64) - expected, axis=-1)
        rows.append(differences / np.maximum(norms, np.finfo(np.float64).tiny))
    return float(np.concatenate(rows).mean())


def difference(
    exact: Sequence[Mapping[str, Float32Array]],
    given: Sequence[Mapping[str, Float32Array]],
    groups: Sequence[Group],
) -> Difference:
    """The largest differences of chunks `(samples, T, size)` by key, over all observations."""
    largest = {group.key: 0.0 for group in groups}
    of_range = dict(largest)
    for expected, got in zip(exact, given, strict=True):
        for group in groups:
            apart = np.abs(got[group.key].astype(np.float64) - expected[group.key])
            span = range_of(group, apart.shape[-2])
            scaled = np.divide(apart, span, out=np.zeros_like(apart), where=span > 0)
            largest[group.key] = max(largest[group.key], float(apart.max()))
            of_range[group.key] = max(of_range[group.key], float(scaled.max()))
    return Difference(largest, of_range)


def range_of(group: Group, steps: int) -> npt.NDArray[Any]:
    """The range of each number of an action, ``(size,)`` or ``(steps, size)``; 0 if it is constant."""
    if group.first is None or group.second is None or group.moving is None:
        # Normalised actions are from -1 to 1, and binary ones 0 or 1.
        return np.full(group.size, 1.0 if group.mode == "binary" else 2.0)
    first, second = np.asarray(group.first, np.float64), np.asarray(group.second, np.float64)
    span = DEVIATIONS * second if group.mode == "mean_std" else second - first
    span = np.where(group.moving, span, 0.0)
    return span[:steps] if span.ndim > 1 else span
