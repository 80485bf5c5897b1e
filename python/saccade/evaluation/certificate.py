"""A certificate: what a checkpoint computed on recordings, for another machine to check."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade._internal.environment import show_config
from saccade.errors import InputError
from saccade.evaluation.prediction import noise_of
from saccade.evaluation.recordings import Recordings, length_of, observation_at
from saccade.evaluation.source import Source, forget_policy
from saccade.policy.policy import Policy

FORMAT = 1
MOST = 16  # observations in a certificate, evenly spaced
#: What a certificate may say of loading and of sampling.
OPTIONS = (
    *("embodiment", "preprocessing", "tokenizer", "data_config", "action_horizon", "processor_options"),
    "precision",
)
SAMPLING = ("num_steps", "integrator", "future_refresh")
TOLERANCE = 1e-3  # of normalised actions on another instruction set, or twice the precision's own difference


@dataclass(frozen=True)
class Certificate:
    """What was computed, with what, and how much depends on how.

    Attributes:
        checkpoint, recordings: ``name``, ``path`` and ``sha256`` of each.
        options: How the checkpoint was loaded.
        stride, seed, sampling: As of :func:`saccade.evaluate`.
        observations: ``[episode, step]`` of each observation.
        made_with: ``saccade``, ``instruction_set``, ``cpu``, ``num_threads``.
        actions: The actions, in base64: float32, little-endian, ``(observations, horizon, width)`` in the
            robot's units.
        actions_sha256: Hash of their bytes.
        from_float32: Largest absolute difference from saccade in float32: ``normalized``, and ``by_key`` in
            the robot's units. Zero for float32.
        equal_over_batches: Whether each observation has the same bits alone and in a batch.
        equal_over_threads: Whether the actions have the same bits with the numbers of ``threads``.
        threads: These numbers.
    """

    checkpoint: Mapping[str, str]
    recordings: Mapping[str, str]
    options: Mapping[str, Any]
    stride: int
    seed: int
    sampling: Mapping[str, Any]
    observations: Sequence[Sequence[int]]
    made_with: Mapping[str, Any]
    actions: str
    actions_sha256: str
    from_float32: Mapping[str, Any]
    equal_over_batches: bool
    equal_over_threads: bool
    threads: Sequence[int]

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON values."""
        return {"format": FORMAT, **asdict(self)}

    @classmethod
    def from_file(cls, path: Path) -> Certificate:
        """Reads a certificate.

        Raises:
            FileNotFoundError: There is no such file.
            InputError: It is no certificate.
        """
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            if values.pop("format") != FORMAT:
                raise InputError(f"{path}: expected a certificate of format {FORMAT}")
            found = cls(**values)
            found.check_types()
        except FileNotFoundError:
            raise
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{path}: expected a certificate of `saccade evaluate --certify`: {error!r}"
            ) from None
        return found

    def check_types(self) -> None:
        """Checks what was read from a file.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or of another type.
        """
        for part in (self.checkpoint, self.recordings):
            if not all(isinstance(part[name], str) for name in ("name", "path", "sha256")):
                raise TypeError("checkpoint, recordings: expected texts")
        base64.b64decode(self.actions, validate=True)
        equal: list[Any] = [self.equal_over_batches, self.equal_over_threads]
        if any(type(one) is not bool for one in equal):
            raise TypeError("equal_over_batches, equal_over_threads: expected true or false")
        for name, given, known in (("options", self.options, OPTIONS), ("sampling", self.sampling, SAMPLING)):
            if any(key not in known for key in dict(given)):
                raise ValueError(f"{name}: expected {', '.join(known)}, got {given!r:.100}")
        numbers = [self.stride, self.seed, *(number for place in self.observations for number in place)]
        if any(type(number) is not int for number in numbers) or any(
            len(place) != 2 for place in self.observations
        ):
            raise TypeError("stride, seed, observations: expected integers")
        if min(numbers, default=0) < 0 or not 1 <= len(self.observations) <= MOST:
            raise ValueError(f"seed, observations: expected 1 to {MOST} observations, and no negative number")
        # What another machine may differ by follows from it.
        if not 0 <= float(self.from_float32["normalized"]) < math.inf:
            raise ValueError("from_float32: normalized: expected a finite number of at least 0")
        dict(self.made_with)


@dataclass(frozen=True)
class Finding:
    """One comparison of a certificate with this machine."""

    name: str
    certified: str
    found: str
    holds: bool


def certify(
    source: Source, episodes: Sequence[int], stride: int, seed: int, sampling: Mapping[str, Any]
) -> Certificate:
    """Computes at most 16 of an evaluation's observations in several ways, and records what is equal.

    The checkpoint is loaded again with another number of threads and, unless it is used in float32, in
    float32.

    Raises:
        SaccadeError: As :func:`saccade.evaluate`.
    """
    places = _spread(source.data, episodes, stride)
    return _certified(source, places, stride, seed, sampling)


def check(certificate: Certificate, source: Source) -> list[Finding]:
    """Computes what a certificate says, and compares.

    On the instruction set and version of the certificate, the actions must have its bits. Elsewhere the
    normalised actions may differ by 0.001, or by twice what the precision differs from float32.

    Raises:
        SaccadeError: As :func:`saccade.evaluate`.
    """
    found = []
    identity = source.identity()
    for part in ("checkpoint", "recordings"):
        expected, got = getattr(certificate, part)["sha256"], identity[part]["sha256"]
        found.append(Finding(f"{part}, sha256", expected[:16], got[:16], expected == got))
    if not all(one.holds for one in found):
        return found
    here = _certified(
        source, certificate.observations, certificate.stride, certificate.seed, certificate.sampling
    )
    same = [
        certificate.made_with.get(name) == here.made_with[name] for name in ("saccade", "instruction_set")
    ]
    if all(same):
        holds = certificate.actions == here.actions
        found.append(
            Finding("actions, bits", certificate.actions_sha256[:16], here.actions_sha256[:16], holds)
        )
    else:
        apart = _largest_normalized(source, certificate, here)
        most = max(TOLERANCE, 2 * float(certificate.from_float32["normalized"]))
        elsewhere = " ".join(str(certificate.made_with.get(name)) for name in ("saccade", "instruction_set"))
        found.append(
            Finding(
                f"actions, normalised, of {elsewhere}", f"at most {most:.3g}", f"{apart:.3g}", apart <= most
            )
        )
    for name, label in (("equal_over_batches", "batches"), ("equal_over_threads", "threads")):
        expected, got = getattr(certificate, name), getattr(here, name)
        found.append(Finding(f"the same bits over {label}", str(expected), str(got), got and expected))
    limit, got = (float(one.from_float32["normalized"]) for one in (certificate, here))
    found.append(
        Finding(
            "largest difference from float32", f"{limit:.3g}", f"{got:.3g}", got <= max(TOLERANCE, 2 * limit)
        )
    )
    return found


def _spread(data: Recordings, episodes: Sequence[int], stride: int) -> list[tuple[int, int]]:
    """At most ``MOST`` of the observations of an evaluation, evenly spaced."""
    every = [(one, step) for one in episodes for step in range(0, length_of(data, one), stride)]
    chosen = np.linspace(0, len(every) - 1, min(MOST, len(every))).round().astype(int)
    return [every[place] for place in chosen]


def _certified(
    source: Source,
    places: Sequence[Sequence[int]],
    stride: int,
    seed: int,
    sampling: Mapping[str, Any],
) -> Certificate:
    policy, data = source.policy, source.data
    together = _actions(policy, data, places, seed, sampling)
    alone = np.concatenate([_actions(policy, data, [place], seed, sampling) for place in places])
    used = policy.head.num_threads
    other = 1 if used > 1 else 2
    keys, normalizer = policy.normalizer.action_slices, policy.normalizer
    state = _states(policy, data, places)
    del policy
    forget_policy()  # one checkpoint at a time is in memory
    options = dict(source.options)
    rethreaded = replace(source, options={**options, "num_threads": other})
    threaded = _actions(rethreaded.policy, data, places, seed, sampling)
    forget_policy()
    precisions = options.get("precision", "float32")
    names = set(precisions.values()) if isinstance(precisions, Mapping) else {precisions}
    exact = together
    if names != {"float32"}:
        plain = replace(source, options={**options, "precision": "float32"})
        exact = _actions(plain.policy, data, places, seed, sampling)
        forget_policy()
    apart = np.abs(together.astype(np.float64) - exact)
    scaled = [np.asarray(normalizer.normalize_actions(one, state), np.float64) for one in (together, exact)]
    about, config = source.identity(), show_config("dicts")
    return Certificate(
        checkpoint={**about["checkpoint"], "path": source.checkpoint},
        recordings={**about["recordings"], "path": source.recordings},
        options={name: value for name, value in options.items() if name != "num_threads"},
        stride=stride,
        seed=seed,
        sampling=dict(sampling),
        observations=[[int(one) for one in place] for place in places],
        made_with={
            "saccade": config["saccade"],
            "instruction_set": config["isa"],
            "cpu": config["cpu"],
            "num_threads": used,
        },
        actions=base64.b64encode(together.astype("<f4").tobytes()).decode("ascii"),
        actions_sha256=hashlib.sha256(together.astype("<f4").tobytes()).hexdigest(),
        from_float32={
            "normalized": float(np.abs(scaled[0] - scaled[1]).max()),
            "by_key": {key: float(apart[..., where].max()) for key, where in keys.items()},
        },
        equal_over_batches=together.tobytes() == alone.tobytes(),
        equal_over_threads=together.tobytes() == threaded.tobytes(),
        threads=sorted((used, other)),
    )


def _actions(
    policy: Policy,
    data: Recordings,
    places: Sequence[Sequence[int]],
    seed: int,
    sampling: Mapping[str, Any],
) -> Float32Array:
    """The actions of observations that are computed together, ``(observations, horizon, width)``."""
    parsed = [observation_at(policy, data, episode, step) for episode, step in places]
    noise = np.concatenate([noise_of(policy, seed, episode, step, 1) for episode, step in places])
    state = np.concatenate([one.state for one in parsed])
    actions = policy.sample(policy.encode(parsed), state, noise=noise, **sampling)
    return np.ascontiguousarray(actions, np.float32)


def _states(policy: Policy, data: Recordings, places: Sequence[Sequence[int]]) -> Float32Array:
    return np.concatenate([observation_at(policy, data, episode, step).state for episode, step in places])


def _largest_normalized(source: Source, certificate: Certificate, here: Certificate) -> float:
    """The largest difference of the normalised actions of two certificates; infinite if they do not fit."""
    held = [base64.b64decode(one.actions) for one in (certificate, here)]
    if len(held[0]) != len(held[1]):
        return float("inf")
    first, second = (np.frombuffer(one, "<f4") for one in held)
    if not np.isfinite(first).all():
        return float("inf")
    normalizer = source.policy.normalizer
    state = _states(source.policy, source.data, certificate.observations)
    shape = (len(certificate.observations), -1, normalizer.action_width)
    scaled = [
        np.asarray(normalizer.normalize_actions(one.reshape(shape).astype(np.float32), state), np.float64)
        for one in (first, second)
    ]
    return float(np.abs(scaled[0] - scaled[1]).max())
