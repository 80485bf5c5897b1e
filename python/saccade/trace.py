"""What `trace` keeps of the inside of the head."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

ArrayT = TypeVar("ArrayT")


@dataclass(frozen=True, eq=False)
class Trace(Generic[ArrayT]):
    """Attention probabilities and rows of one run, by ``(step, block)``; made by :meth:`ActionHead.trace`.

    Attributes:
        attention: The probabilities used, ``(batch, heads, queries, keys)``. Keys are the vision-language
            tokens in a cross-attention block and the rows in a self-attention block, removed ones included;
            a removed key has exactly 0.
        hidden: The rows as the next block reads them (after the block, and after what was patched there),
            ``(batch, rows, width)``.
        rows: Where the groups ``"state"``, ``"future"`` and ``"action"`` lie on the axes of rows.
        actions: The result, ``(batch, action_horizon, action_dim)``.
    """

    attention: Mapping[tuple[int, int], ArrayT]
    hidden: Mapping[tuple[int, int], ArrayT]
    rows: Mapping[str, slice]
    actions: ArrayT
