"""The parts of a head, by the names of their tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping

from saccade.checkpoints.findings import Part

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


def parameters(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Part]:
    """Number of tensors and parameters of each part that occurs.

    Args:
        shapes: Shapes of a head's tensors by their names without prefix.

    Example:
        >>> parts = parameters({"vlln.weight": (2048,), "vlln.bias": (2048,)})
        >>> {name: (part.tensors, part.parameters) for name, part in parts.items()}
        {'vlln': (2, 4096)}
    """
    counted: dict[str, Part] = {}
    for name, shape in shapes.items():
        part = counted.setdefault(part_of(name), Part())
        part.tensors += 1
        part.parameters += math.prod(shape)
    return in_order(counted)


def in_order(parts: Mapping[str, Part]) -> dict[str, Part]:
    """Parts in the order of `PARTS`."""
    return {name: parts[name] for name in (*PARTS, UNUSED) if name in parts}
