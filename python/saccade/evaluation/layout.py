"""Where the keys of a robot's action are in arrays of actions, states and normalised actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from saccade.robots import Normalizer


@dataclass(frozen=True)
class Layout:
    """The keys of an action in their order.

    Attributes:
        keys: Slice of the robot's action by key.
        head_keys: Slice of the normalised action by key.
        holds: Slice of the state that the key of the action would have to repeat to hold still, or None if no
            part of the state belongs to the key.
    """

    keys: Mapping[str, slice]
    head_keys: Mapping[str, slice]
    holds: Mapping[str, slice | None]

    @classmethod
    def of(cls, normalizer: Normalizer) -> Layout:
        """The layout of a robot."""
        start, head_keys, holds = 0, {}, {}
        states, sizes = normalizer.state_slices, {group.key: group.size for group in normalizer.state_groups}
        for group in normalizer.action_groups:
            head_keys[group.key] = slice(start, start + group.width)
            start += group.width
            name = group.key if group.reference is None else group.reference.key
            if name not in states and len(states) == len(normalizer.action_groups) == 1:
                (name,) = states  # lerobot calls them "state" and "action"
            where = states.get(name)
            holds[group.key] = where if where is not None and sizes[name] == group.size else None
        return cls(normalizer.action_slices, head_keys, holds)
