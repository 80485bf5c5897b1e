"""The parts of a head, by the names of their tensors."""

from __future__ import annotations

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


def in_order(parts: Mapping[str, Part]) -> dict[str, Part]:
    """Parts in the order of `PARTS`."""
    return {name: parts[name] for name in (*PARTS, UNUSED) if name in parts}
