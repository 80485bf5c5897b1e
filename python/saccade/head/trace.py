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
        >>> trace = head.trace(context, np.zeros((1, head.config.state_dim)), 0, seed=7, blocks=[0, 2])
        >>> trace
        <saccade.Trace 0.4 MB
          attention[step, block]: steps 0-3, blocks 0, 2: (1, 4, 49, 60)
          hidden: not recorded
          rows: state 0, future 1-32, action 33-48
          actions: (1, 16, 4)>

        What the future rows attend to in the first block, averaged over attention heads:

        >>> trace.attention[0, 0][:, :, trace.rows["future"]].mean(axis=1).shape
        (1, 32, 60)
    """

    attention: Mapping[tuple[int, int], ArrayT]
    hidden: Mapping[tuple[int, int], ArrayT]
    rows: Mapping[str, slice]
    actions: ArrayT

    def __repr__(self) -> str:
        nbytes = _nbytes(self.attention, self.hidden) + getattr(self.actions, "nbytes", 0)
        spans = {group: _span(range(*span.indices(span.stop))) for group, span in self.rows.items()}
        rows = ", ".join(f"{group} {span}" for group, span in spans.items())
        return f"{_listed(self, nbytes)}\n  rows: {rows}\n  actions: {tuple(self.actions.shape)}>"  # type: ignore[attr-defined]


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
        return f"{_listed(self, self.nbytes)}>"


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


def _listed(record: Any, nbytes: int) -> str:
    """The keys and shapes of recorded arrays: a line for each shape."""
    lines = [f"<saccade.{type(record).__name__} {nbytes / 1e6:,.1f} MB"]
    for name in RECORDS:
        by_shape: dict[tuple[int, ...], list[Any]] = {}
        for place, array in getattr(record, name).items():
            by_shape.setdefault(tuple(array.shape), []).append(place)
        for shape, places in by_shape.items():
            if isinstance(places[0], tuple):
                steps, blocks = map(_span, zip(*places, strict=True))
                lines.append(f"  {name}[step, block]: steps {steps}, blocks {blocks}: {shape}")
            else:
                lines.append(f"  {name}[block]: blocks {_span(places)}: {shape}")
        if not by_shape:
            lines.append(f"  {name}: not recorded")
    return "\n".join(lines)


def _span(indices: Any) -> str:
    """Indices with runs of neighbours shortened, such as ``"0-3, 6"``."""
    runs: list[list[int]] = []
    for index in sorted(set(indices)):
        if runs and index == runs[-1][-1] + 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs) or "none"
