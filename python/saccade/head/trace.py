"""Records of a run of the head: attention probabilities, and the rows after each block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from saccade._internal.arrays import Array
from saccade.errors import InputError

#: What can be recorded.
RECORDS = ("attention", "hidden")

ArrayT = TypeVar("ArrayT")


@dataclass(frozen=True, eq=False, repr=False)
class Trace(Generic[ArrayT]):
    """The record of a call of :meth:`saccade.ActionHead.trace`. ``repr`` lists keys, shapes and sizes.

    Arrays are float32, NumPy or torch like the features. Those of
    :class:`saccade_lab.reference.ActionHead` are torch tensors in its dtype.

    Attributes:
        attention: The attention probabilities by ``(step, block)``, ``(batch, heads, queries, keys)``.
            Queries are all rows. Keys are all vision-language tokens in a cross-attention block, and all rows
            in a self-attention block. A key that a block cannot attend to has probability 0.
        hidden: The rows by ``(step, block)`` as the next block reads them, patches included, ``(batch, rows,
            width)``.
        rows: The slice of the rows of each group, ``"state"``, ``"future"`` and ``"action"``.
        actions: The sampled actions, ``(batch, action_horizon, action_dim)``.

    Example:
        >>> import numpy as np, saccade
        >>> head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint())
        >>> context = head.encode(np.zeros((1, 60, head.config.context_dim), np.float32))
        >>> head.trace(context, np.zeros((1, head.config.state_dim)), 0, seed=7, blocks=[0, 2])
        <saccade.Trace 0.4 MB
          attention[step, block]: steps 0-3, blocks 0, 2: (1, 4, 49, 60)
          hidden: not recorded
          rows: state 0, future 1-32, action 33-48
          actions: (1, 16, 4)>
    """

    attention: Mapping[tuple[int, int], ArrayT]
    hidden: Mapping[tuple[int, int], ArrayT]
    rows: Mapping[str, slice]
    actions: ArrayT

    def __repr__(self) -> str:
        nbytes = _nbytes(self.attention, self.hidden) + getattr(self.actions, "nbytes", 0)
        rows = ", ".join(
            f"{group} {_span(range(*span.indices(span.stop)))}" for group, span in self.rows.items()
        )
        lines = [
            f"<saccade.Trace {_size(nbytes)}",
            *_listed("attention", self.attention),
            *_listed("hidden", self.hidden),
            f"  rows: {rows}",
            f"  actions: {_shape(self.actions)}>",
        ]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False, repr=False)
class Record:
    """The record of a call of :meth:`saccade.ActionHead.encode`. ``repr`` lists keys, shapes and sizes.

    Arrays are float32, NumPy or torch like the features.

    Attributes:
        attention: The probabilities of the VL self-attention by block, ``(batch, heads, T_vl, T_vl)``. A
            dropped key has probability 0. The rows of a dropped query have no meaning.
        hidden: The vision-language tokens after each block, ``(batch, T_vl, context_dim)``. Dropped positions
            have no meaning.
    """

    attention: Mapping[int, Array]
    hidden: Mapping[int, Array]

    @property
    def nbytes(self) -> int:
        """Size in memory, in bytes."""
        return _nbytes(self.attention, self.hidden)

    def __repr__(self) -> str:
        lines = [
            f"<saccade.Record {_size(self.nbytes)}",
            *_listed("attention", self.attention),
            *_listed("hidden", self.hidden),
        ]
        return "\n".join(lines) + ">"


def check_record(record: Any, known: tuple[str, ...] = RECORDS) -> list[bool]:
    """Whether to record each of the known names.

    Raises:
        InputError: ``record`` contains anything else.
    """
    try:
        names = None if isinstance(record, str) else list(record)
    except TypeError:
        names = None
    if names is None or any(not isinstance(name, str) or name not in known for name in names):
        raise InputError(f"record: expected a tuple of names among {', '.join(known)}, got {record!r}")
    return [name in names for name in known]


def _nbytes(*recorded: Mapping[Any, Any]) -> int:
    return sum(int(array.nbytes) for arrays in recorded for array in arrays.values())


def _listed(name: str, arrays: Mapping[Any, Any]) -> list[str]:
    """The keys and shapes of recorded arrays: a line for each shape."""
    if not arrays:
        return [f"  {name}: not recorded"]
    by_shape: dict[str, list[Any]] = {}
    for place, array in arrays.items():
        by_shape.setdefault(_shape(array), []).append(place)
    lines = []
    for shape, places in by_shape.items():
        if isinstance(places[0], tuple):
            steps, blocks = ([place[axis] for place in places] for axis in (0, 1))
            lines.append(f"  {name}[step, block]: steps {_span(steps)}, blocks {_span(blocks)}: {shape}")
        else:
            lines.append(f"  {name}[block]: blocks {_span(places)}: {shape}")
    return lines


def _span(indices: Any) -> str:
    """Indices with runs of neighbours shortened, such as ``"0-3, 6"``."""
    ordered = sorted(set(indices))
    runs: list[list[int]] = []
    for index in ordered:
        if runs and index == runs[-1][-1] + 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs) or "none"


def _shape(array: Any) -> str:
    return str(tuple(array.shape))


def _size(nbytes: int) -> str:
    return f"{nbytes / 1e6:,.1f} MB"
