"""What is kept of the inside of the head: attention probabilities, and the rows after a block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from saccade._arrays import Array
from saccade.errors import InputError

#: What can be recorded.
RECORDS = ("attention", "hidden")

ArrayT = TypeVar("ArrayT")


@dataclass(frozen=True, eq=False)
class Trace(Generic[ArrayT]):
    """One run of the Euler loop, seen from inside; made by :meth:`ActionHead.trace`, and by that of
    :class:`saccade.reference.ActionHead`.

    Arrays are float32, NumPy or torch like the features; the reference's are tensors of its own dtype.

    Attributes:
        attention: By ``(step, block)``, the probabilities used, ``(batch, heads, queries, keys)``. Queries
            are all rows; keys are the vision-language tokens in a cross-attention block and the rows in a
            self-attention block, those that a block does not see included. Such a key, and a removed
            one, has exactly 0.
        hidden: By ``(step, block)``, the rows as the next block reads them (after the block, and after what
            was patched there), ``(batch, rows, width)``.
        rows: Where the groups ``"state"``, ``"future"`` and ``"action"`` lie on the axes of rows.
        actions: The result, ``(batch, action_horizon, action_dim)``.
    """

    attention: Mapping[tuple[int, int], ArrayT]
    hidden: Mapping[tuple[int, int], ArrayT]
    rows: Mapping[str, slice]
    actions: ArrayT


@dataclass(frozen=True, eq=False)
class Record:
    """The VL self-attention of one :meth:`ActionHead.encode`, seen from inside.

    Attributes:
        attention: By block, the probabilities used, ``(batch, heads, T_vl, T_vl)``. A dropped key has exactly
            0; as a query, a dropped position means nothing.
        hidden: By block, the tokens after it, ``(batch, T_vl, context_dim)``; dropped positions mean nothing.
    """

    attention: Mapping[int, Array]
    hidden: Mapping[int, Array]

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(int(array.nbytes) for kept in (self.attention, self.hidden) for array in kept.values())


def check_record(record: Any) -> tuple[bool, bool]:
    """Whether attention, and whether hidden rows, are to be recorded.

    Raises:
        InputError: ``record`` is not made of the names ``"attention"`` and ``"hidden"``.
    """
    try:
        names = None if isinstance(record, str) else list(record)
    except TypeError:
        names = None
    if names is None or any(not isinstance(name, str) or name not in RECORDS for name in names):
        raise InputError(f"record: expected a tuple of names among {', '.join(RECORDS)}, got {record!r}")
    return "attention" in names, "hidden" in names
