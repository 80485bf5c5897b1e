"""What an inspection finds, as dataclasses. ``dataclasses.asdict`` converts them to JSON values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from saccade.checkpoints.description import Description
from saccade.checkpoints.whole import BackboneFindings, RobotFindings

FoundT = TypeVar("FoundT")

#: The parts in the order of the tables, with the prefix of their tensors' names.
PARTS = {
    "DiT blocks": "model.transformer_blocks.",
    "timestep encoder": "model.timestep_encoder.",
    "output projections": "model.proj_out_",
    "VL self-attention": "vl_self_attention.",
    "vlln": "vlln.",
    "state encoder": "state_encoder.",
    "action encoder": "action_encoder.",
    "action decoders": "action_",
    "future tokens": "future_tokens.",
    "positions": "position_embedding.",
}
#: Tensors that only training uses.
UNUSED = "training only"


def part_of(name: str) -> str:
    """The part that a tensor belongs to, by its name without prefix."""
    found = (part for part, start in PARTS.items() if name.startswith(start))
    return next(found, UNUSED)


def in_order(parts: Mapping[str, FoundT]) -> dict[str, FoundT]:
    """What was found of each part, in the order of `PARTS`."""
    return {name: parts[name] for name in (*PARTS, UNUSED) if name in parts}


@dataclass
class Counts:
    """Tensors outside the head that belong to one module."""

    tensors: int = 0
    """Number of tensors."""
    nbytes: int = 0
    """Size in the file, in bytes."""


@dataclass
class Part:
    """The tensors of one part of the head."""

    tensors: int = 0
    """Number of tensors."""
    parameters: int = 0
    """Number of values."""
    nbytes: int = 0
    """Size in the file, in bytes."""
    dtypes: dict[str, int] = field(default_factory=dict)
    """Number of tensors of each dtype."""
    judged: int = 0
    """Number of tensors that are large enough to compare their distribution."""
    as_drawn: int = 0
    """How many of these are distributed as before training (:mod:`saccade.checkpoints.initialisation`)."""


@dataclass(frozen=True)
class Memory:
    """Size of a loaded head's weights at one precision."""

    all: int
    """With every embodiment, in bytes."""
    one: int
    """With one embodiment, in bytes."""


@dataclass(frozen=True)
class Embodiment:
    """The category-specific layers of one embodiment."""

    id: int
    names: list[str]
    """Names of the embodiment in the checkpoint's files, or else in the released code."""
    norm: float
    """Norm of all weights and biases."""
    robust_z: float | None
    """Distance of the norm from the median over all ids, in units of 1.4826 median absolute deviations. None
    if the deviation is 0."""
    weights: str
    """``"zero"``, ``"as initialised"`` (biases are zero, weights are distributed as before any training) or
    ``"trained"``."""


@dataclass(frozen=True)
class Spread:
    """Mean, minimum and maximum."""

    mean: float
    min: float
    max: float


@dataclass(frozen=True)
class TokenGeometry:
    """Norms of the future tokens, and the angles between them."""

    norm: Spread | None
    """Norms of the tokens."""
    cosine: Spread | None
    """Cosines of all pairs; None for fewer than two tokens."""
    effective_rank: float
    """Exponential of the entropy of the singular values' shares (Roy and Vetterli, 2007), from 1 to N."""


@dataclass(frozen=True)
class TokenStatistics(TokenGeometry):
    """Whether future tokens are distinct, and how far they are from their initialisation."""

    count: int
    """Number of tokens."""
    std: float
    """Standard deviation of all values."""
    distance: float
    """Distance from N(0, 0.02), see :func:`saccade.checkpoints.initialisation.distance`."""
    as_drawn: bool | None
    """Whether they are distributed as before any training; None if there are too few values."""
    identical: list[list[int]]
    """Groups of tokens that are equal."""
    zero: list[int]
    """Tokens that are zero."""
    drawn: TokenGeometry
    """The geometry of one seeded random draw of the same shape, for comparison."""
    key_bias: list[float] | None = None
    """The ``future_key_bias`` of the config."""


@dataclass
class PartResemblance:
    """How similar one part is to the same part of the reference."""

    compared: int = 0
    """Number of tensors that were compared. Each embodiment's slice counts separately. Tensors that the
    reference has as initialised (biases, norms) are left out."""
    identical: int = 0
    """How many of them are equal."""
    cosine: Spread | None = None
    """Cosines of the other weights with those of the reference."""
    largest_change: float = 0.0
    """The largest norm of a difference, relative to the norm of the reference's tensor."""


@dataclass(frozen=True)
class Resemblance:
    """How similar a checkpoint is to a reference checkpoint."""

    source: str
    """The reference."""
    different_shapes: list[str]
    """Tensors whose shape differs."""
    not_in_reference: list[str]
    """Tensors that the reference does not have."""
    parts: dict[str, PartResemblance]


@dataclass(frozen=True)
class Inspection(Description):
    """What :func:`saccade.checkpoints.inspection.inspect` found."""

    rounding: str | None
    """How int4 weights were rounded, a sentence; None if there are none."""
    parts: dict[str, Part]
    parameters: int
    """Number of values of the whole head."""
    outside: dict[str, Counts]
    """What is outside the head, by module."""
    backbone: BackboneFindings | None
    """The backbone; None if nothing is outside the head."""
    robots: list[RobotFindings]
    """The robots whose statistics are among the files."""
    memory: dict[str, Memory]
    """Size of a loaded head by precision."""
    embodiments: list[Embodiment]
    """All ids in ascending order."""
    future_tokens: TokenStatistics | None
    """None if there are none, or if they are not finite."""
    reference: Resemblance | None
    """None if no reference was given."""
    odd: list[str]
    """Sentences about what is unusual."""
    from_noise: Mapping[str, list[str]]
    """Evidence on "this checkpoint was trained from a random start, although it was meant to start from a
    pretrained one": sentences under ``for``, ``against`` and ``neither``. Not a verdict."""
