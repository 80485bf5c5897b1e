"""Options of heads and policies: checks, and the form that the engine takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np

from saccade._internal.arrays import (
    LARGEST,
    ArrayLike,
    Float32Array,
    apart,
    does_not_fit,
    float32,
    integer,
    real,
)
from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade.head.intervention import Intervention, as_interventions

#: The parts of a policy that have a precision.
PARTS = ("backbone", "head")

#: Velocity evaluations in one step of each integrator.
INTEGRATORS = {"euler": 1, "midpoint": 2}


class LoadOptions(TypedDict, total=False):
    """How a head is loaded: keyword arguments of ``ActionHead.from_pretrained`` and ``from_tensors``."""

    embodiment_ids: Sequence[int] | None
    num_states: int | None
    precision: str
    num_threads: int | None


def check_integrator(integrator: object) -> str:
    """The name of the integrator. None means ``"euler"``.

    Raises:
        InputError: There is no integrator of that name.
    """
    if integrator is None:
        return "euler"
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise InputError(f"integrator: expected {' or '.join(INTEGRATORS)}, got {integrator!r}")
    return integrator


def check_guidance(guidance: object, name: str = "guidance") -> float | None:
    """The weight of a guidance. None and 1, which is without one, are None.

    Raises:
        InputError: It is not a finite number of at least 0; the message begins with ``name``.
    """
    if guidance is None:
        return None
    weight = real(guidance)
    if not 0 <= weight <= LARGEST:
        raise InputError(f"{name}: expected a finite number of at least 0, got {guidance!r:.100}")
    return None if weight == 1 else weight


def optional_integer(name: str, value: int | None) -> int | None:
    """``value`` as an integer of at least 1. None stays None."""
    return None if value is None else integer(name, value)


def precisions_of_parts(precision: str | Mapping[str, str]) -> dict[str, str]:
    """The precision of each part of a policy. The parts check the names.

    Raises:
        InputError: It is a mapping of other parts.
    """
    if isinstance(precision, Mapping):
        if set(precision) != set(PARTS):
            raise InputError(
                f"precision: expected a name, or names for {' and '.join(PARTS)}, got {dict(precision)!r}"
            )
        return dict(precision)
    return dict.fromkeys(PARTS, precision)


def is_float32(precision: str | Mapping[str, str]) -> bool:
    """Whether a policy of this precision, one name or one of each part, computes in float32 alone."""
    return set(precision.values() if isinstance(precision, Mapping) else [precision]) == {"float32"}


def noise_or_draw(
    noise: ArrayLike | None, seed: Any, config: HeadConfig, batch: int, samples: int | None = None
) -> Float32Array:
    """The noise that sampling starts from: the given array, or standard normal float32.

    What is drawn is ``(batch, action_horizon, encoder_action_dim)``, with an axis of samples behind the batch
    unless ``samples`` is None.

    Raises:
        DtypeError, ShapeError: ``noise`` is not a floating point array.
        InputError: Both ``noise`` and ``seed`` are given, or NumPy cannot use ``seed``.
        MemoryError: There is no memory for the noise.
    """
    if noise is not None:
        if seed is not None:
            raise InputError("noise, seed: expected at most one of them, got both")
        return float32("noise", noise)
    try:
        generator = np.random.default_rng(seed)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"seed: expected what numpy.random.default_rng takes, got {seed!r} ({error})"
        ) from None
    leading = (batch,) if samples is None else (batch, samples)
    shape = (*leading, config.action_horizon, config.encoder_action_dim)
    try:
        return generator.standard_normal(shape, dtype=np.float32)
    except (MemoryError, ValueError):
        raise does_not_fit("noise", shape) from None


def plain_chunking(
    previous_chunk: ArrayLike | None, chunking: Chunking | None, output: Float32Array
) -> tuple[Float32Array | None, tuple[int, int, float, int | None] | None]:
    """The previous chunk and the fields of a ``Chunking``; both None without them.

    Raises:
        InputError: One is given without the other, or ``chunking`` is not a ``Chunking``.
    """
    if previous_chunk is None and chunking is None:
        return None, None
    if previous_chunk is None or chunking is None:
        given, missing = ("chunking", "previous_chunk") if chunking else ("previous_chunk", "chunking")
        raise InputError(f"previous_chunk, chunking: expected both or neither, got {given} without {missing}")
    if not isinstance(chunking, Chunking):
        raise InputError(f"chunking: expected a saccade.Chunking, got {type(chunking).__name__}")
    numbers = (chunking.overlap, chunking.frozen, chunking.ramp_rate, chunking.horizon)
    return apart(float32("previous_chunk", previous_chunk), output), numbers


def plain_interventions(given: Intervention | Sequence[Intervention] | None) -> list[dict[str, Any]]:
    """Interventions as dicts whose mappings are lists of items."""
    return [_plain(one) for one in as_interventions(given)]


def _plain(one: Any) -> dict[str, Any]:
    patches = [(place, *item) for place, groups in (one.patch or {}).items() for item in groups.items()]
    return {**vars(one), "key_bias": list((one.key_bias or {}).items()), "patch": patches}
