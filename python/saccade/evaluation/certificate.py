"""A certificate: what a checkpoint computed on recordings, for another machine to check."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from saccade._internal.arrays import LOADING_OPTIONS, Float32Array
from saccade._internal.environment import arithmetic, cpu_name
from saccade._internal.small_files import read_json
from saccade.errors import InputError
from saccade.evaluation.prediction import noise_of
from saccade.evaluation.recordings import Recordings, length_of, observation_at
from saccade.evaluation.source import OPTION_FILES, Source, forget_policy, named
from saccade.head.options import is_float32
from saccade.policy.policy import Policy
from saccade.robots import Normalizer

FORMAT = 2
MOST = 16  # observations in a certificate, evenly spaced
#: What a certificate may say of loading and of sampling.
OPTIONS = (*LOADING_OPTIONS, "precision")
SAMPLING = ("num_steps", "integrator", "future_refresh")
TOLERANCE = 1e-3  # of normalised actions elsewhere, or twice the precision's own difference
#: Where these are equal, the actions must have the same bits. Dot products matter to other precisions.
EXACT, ROUNDED = ("saccade", "library", "instruction_set"), ("dot_products",)


@dataclass(frozen=True)
class Certificate:
    """What was computed, with what, and how much depends on how.

    Attributes:
        checkpoint, recordings: ``name``, ``path`` and ``sha256`` of each. The path is absolute, or the id and
            commit of a published one.
        options: How the checkpoint was loaded, with absolute paths.
        option_files: SHA-256 of the tokenizer and of the data config, if they are not the checkpoint's.
        stride, seed, sampling: As of :func:`saccade.evaluate`.
        observations: ``[episode, step]`` of each observation.
        made_with: ``saccade``, ``library`` (the build), ``instruction_set``, ``dot_products``, ``cpu``,
            ``num_threads``.
        actions: The actions, in base64: float32, little-endian, ``(observations, horizon, width)`` in the
            robot's units.
        actions_sha256: Hash of their bytes.
        from_float32: Largest absolute difference from saccade in float32: ``normalized``, which is not
            clipped, and ``by_key`` in the robot's units. Zero for float32.
        equal_over_batches: Whether each observation has the same bits alone and in a batch of several.
        equal_over_threads: Whether the actions have the same bits with the numbers of ``threads``.
        threads: These numbers.
    """

    checkpoint: Mapping[str, str]
    recordings: Mapping[str, str]
    options: Mapping[str, Any]
    option_files: Mapping[str, str]
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
        values = read_json(path, InputError)
        try:
            if values.pop("format") != FORMAT:
                raise InputError(f"{path}: expected a certificate of format {FORMAT}")
            found = cls(**values)
            found.check_types()
        except (ValueError, KeyError, TypeError, AttributeError) as error:
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
        for name in ("checkpoint", "recordings", "options", "option_files", "sampling", "made_with"):
            if not isinstance(getattr(self, name), dict):
                raise TypeError(f"{name}: expected an object")
        for part in (self.checkpoint, self.recordings):
            if not all(isinstance(part[name], str) for name in ("name", "path", "sha256")):
                raise TypeError("checkpoint, recordings: expected texts")
        if self.actions_sha256 != _sha256(base64.b64decode(self.actions, validate=True)):
            raise ValueError("actions_sha256: expected that of the actions")
        equal: list[Any] = [self.equal_over_batches, self.equal_over_threads]
        if any(type(one) is not bool for one in equal):
            raise TypeError("equal_over_batches, equal_over_threads: expected true or false")
        for name, known in (("options", OPTIONS), ("option_files", OPTION_FILES), ("sampling", SAMPLING)):
            given = getattr(self, name)
            if any(key not in known for key in given):
                raise ValueError(f"{name}: expected {', '.join(known)}, got {given!r:.100}")
        if not all(isinstance(value, str) for value in self.option_files.values()):
            raise TypeError("option_files: expected texts")
        numbers = [self.stride, self.seed, *(number for place in self.observations for number in place)]
        if any(type(number) is not int for number in (*numbers, *self.threads)) or any(
            len(place) != 2 for place in self.observations
        ):
            raise TypeError("stride, seed, observations, threads: expected integers")
        if min(numbers) < 0 or not 1 <= len(self.observations) <= MOST:
            raise ValueError(f"seed, observations: expected 1 to {MOST} observations, and no negative number")
        if len(set(self.threads)) != 2 or min(self.threads) < 1:
            raise ValueError(f"threads: expected two numbers of at least 1, got {self.threads!r:.100}")
        for number in (self.from_float32["normalized"], *self.from_float32["by_key"].values()):
            if not 0 <= float(number) < math.inf:
                raise ValueError("from_float32: expected finite numbers of at least 0")


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

    With the version, build, instruction set and dot products of the certificate, the actions must have its
    bits; in float32 whatever the dot products are. Elsewhere the normalised actions may differ by 0.001, or
    by twice what the precision differs from float32, on the machine where it differs less.

    Raises:
        SaccadeError: As :func:`saccade.evaluate`.
    """
    identity = source.identity()
    found = [
        _equal(f"{part}, sha256", getattr(certificate, part)["sha256"], identity[part]["sha256"])
        for part in ("checkpoint", "recordings")
    ]
    files = [certificate.option_files, identity["option_files"]]
    found += [
        _equal(f"{name}, sha256", *(one.get(name, "the checkpoint's") for one in files))
        for name in OPTION_FILES
        if any(name in one for one in files)
    ]
    if not all(one.holds for one in found):
        return found
    here = _certified(
        source, certificate.observations, certificate.stride, certificate.seed, certificate.sampling
    )
    differences = [float(one.from_float32["normalized"]) for one in (certificate, here)]
    # What the certificate says of itself must not widen what it may differ by.
    most = max(TOLERANCE, 2 * min(differences))
    exact = is_float32(certificate.options.get("precision", "float32"))
    other = [
        f"{name} {_shown(certificate.made_with.get(name))}"
        for name in (EXACT if exact else EXACT + ROUNDED)
        if certificate.made_with.get(name) != here.made_with[name]
    ]
    if not other:
        found.append(_equal("actions, bits", certificate.actions_sha256, here.actions_sha256))
    else:
        apart = _largest_normalized(source, certificate, here)
        name = f"actions, normalised, made with {', '.join(other)}"
        found.append(Finding(name, f"at most {most:.3g} apart", f"{apart:.3g}", apart <= most))
    for name, label in (("equal_over_batches", "batches"), ("equal_over_threads", "threads")):
        expected, got = getattr(certificate, name), getattr(here, name)
        found.append(Finding(f"the same bits over {label}", str(expected), str(got), got and expected))
    certified, got = (f"{one:.3g}" for one in differences)
    found.append(Finding("largest difference from float32", certified, got, max(differences) <= most))
    return found


def _shown(value: Any) -> str:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)


def _equal(name: str, certified: str, found: str) -> Finding:
    """A finding that two hashes are equal."""
    return Finding(name, certified[:16], found[:16], certified == found)


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
    # A single observation is in a batch with itself.
    batch = list(places) if len(places) > 1 else [*places, *places]
    batched = _actions(policy, data, batch, seed, sampling)
    alone = np.concatenate([_actions(policy, data, [place], seed, sampling) for place in batch])
    together = batched[: len(places)]
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
    exact = together
    if not is_float32(options.get("precision", "float32")):
        plain = replace(source, options={**options, "precision": "float32"})
        exact = _actions(plain.policy, data, places, seed, sampling)
        forget_policy()
    apart = np.abs(together.astype(np.float64) - exact)
    about, anywhere = named(source.identity(), source.names()), source.from_anywhere()
    stored = together.astype("<f4").tobytes()
    return Certificate(
        checkpoint={**about["checkpoint"], "path": anywhere.checkpoint},
        recordings={**about["recordings"], "path": anywhere.recordings},
        options={name: value for name, value in anywhere.options.items() if name != "num_threads"},
        option_files=about["option_files"],
        stride=stride,
        seed=seed,
        sampling=dict(sampling),
        observations=[[int(one) for one in place] for place in places],
        made_with={**arithmetic(), "cpu": cpu_name(), "num_threads": used},
        actions=base64.b64encode(stored).decode("ascii"),
        actions_sha256=_sha256(stored),
        from_float32={
            "normalized": _apart(normalizer, state, together, exact),
            "by_key": {key: float(apart[..., where].max()) for key, where in keys.items()},
        },
        equal_over_batches=batched.tobytes() == alone.tobytes(),
        equal_over_threads=together.tobytes() == threaded.tobytes(),
        threads=sorted((used, other)),
    )


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


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
    policy = source.policy
    shape = (len(certificate.observations), -1, policy.normalizer.action_width)
    state = _states(policy, source.data, certificate.observations)
    one, other = (values.reshape(shape).astype(np.float32) for values in (first, second))
    return _apart(policy.normalizer, state, one, other)


def _apart(normalizer: Normalizer, state: Float32Array, one: Float32Array, other: Float32Array) -> float:
    """The largest difference of actions as the head sees them, without clipping, which would hide some."""
    scaled = [np.asarray(normalizer.previous_chunk(each, state), np.float64) for each in (one, other)]
    return float(np.abs(scaled[0] - scaled[1]).max())
