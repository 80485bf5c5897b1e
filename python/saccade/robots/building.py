"""What every layout shares: the options of a request, and checked groups."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from saccade._internal.arrays import integer
from saccade.errors import CheckpointError, InputError
from saccade.robots.data_configs import DataConfig, says_nothing
from saccade.robots.embodiments import resolved
from saccade.robots.groups import Group, Statistics

#: The engine's limit of the width of a head.
MOST_WIDTH = 1 << 20

#: The statistics that a mode needs. The other modes need none.
STATISTICS = {
    "min_max": ("min", "max"),
    "q99": ("q01", "q99"),
    "mean_std": ("mean", "std"),
    "scale": ("min", "max"),
}

#: Larger statistics are refused: results could exceed the range of float32, and an action be infinite.
MOST = 1e30
#: So are smaller spans, by which values are divided.
LEAST = 1e-30


@dataclass(frozen=True)
class Options:
    """The arguments of :meth:`saccade.Normalizer.from_pretrained`."""

    embodiment: str | int | None
    state_dim: int | None
    action_dim: int | None
    data_config: DataConfig | None

    def refuse_data_config(self, where: str) -> None:
        """Raises InputError if a data config is given, although the checkpoint contains all that it says."""
        if self.data_config is not None:
            raise InputError(
                f"data_config: expected None, because {where} contains keys, order and modes; data configs "
                "are for GR00T N1 and N1.5"
            )

    def check_only(self, found: str, found_id: int, version: str, where: str) -> None:
        """Raises InputError if another embodiment is requested than the only one that there is."""
        asked = self.embodiment
        if isinstance(asked, str):
            is_found = found in (asked, resolved(asked, version, (found,)))
        else:
            is_found = asked is None or integer("embodiment", asked, least=0) == found_id
        if not is_found:
            raise InputError(
                f"embodiment: expected {found!r} ({found_id}), the only one in {where}, got "
                f"{self.embodiment!r}"
            )


@dataclass
class Builder:
    """Creates groups from the contents of a file, and collects the problems of the file."""

    where: str
    dtype: type[np.floating[Any]]
    is_close: bool = False  # N1.6 and later treat a dimension with nearly equal bounds as constant
    problems: list[str] = field(default_factory=list)

    def group(
        self, key: str, statistics: Any, mode: str, *, by_step: bool = False, **switches: Any
    ) -> Group | None:
        """A group of this mode; None if there is a problem, which is recorded.

        Only the statistics that the mode needs are looked at. ``by_step`` is whether there may be a row for
        each step of a chunk, ``switches`` are the remaining fields of :class:`Group`.
        """
        if not isinstance(statistics, Mapping):
            self.problems.append(f"{key}: no statistics")
            return None
        names = STATISTICS[mode]
        missing = [name for name in names if statistics.get(name) is None]
        if missing:
            self.problems.append(f"{key}: {mode} needs {' and '.join(missing)}")
            return None
        first, second = (self._row(key, name, statistics[name]) for name in names)
        if first is None or second is None:
            return None
        if first.shape != second.shape:
            self.problems.append(
                f"{key}: expected {' and '.join(names)} of one shape, got {first.shape} and {second.shape}"
            )
            return None
        if first.ndim > 1 and not by_step:
            self.problems.append(f"{key}: expected one row of statistics, got {len(first)}")
            return None
        if len(first) == 1 and first.ndim > 1:  # one row for every step
            first, second = first[0], second[0]
        if mode == "scale":
            first, second = np.zeros_like(first), np.maximum(np.abs(first), np.abs(second))
        return self.scaled(key, mode, first, second, **switches)

    def scaled(self, key: str, mode: str, first: Statistics, second: Statistics, **switches: Any) -> Group:
        """A group with these statistics, after checking that they are in order."""
        if mode in ("min_max", "q99"):
            (below, above), start = STATISTICS[mode], first
            moving = ~np.isclose(second, first) if self.is_close else second != first
        else:
            below, above, start = (
                "0",
                "std" if mode == "mean_std" else "the largest bound",
                np.zeros_like(first),
            )
            moving = second != 0
        if (second < start).any():
            self.problems.append(f"{key}: {above} is below {below}")
        elif (moving & (second - start < LEAST)).any():
            self.problems.append(f"{key}: {above} is less than {LEAST:g} above {below}")
        switches.setdefault("size", first.shape[-1])
        switches.setdefault("keeps_constant", mode == "mean_std" or (mode == "q99" and not self.is_close))
        return Group(key=key, mode=mode, first=first, second=second, moving=moving, **switches)

    def _row(self, key: str, name: str, values: Any) -> Statistics | None:
        """One statistic; None if there is a problem, which is recorded."""
        try:
            with np.errstate(over="ignore"):  # infinity is refused below
                row = np.atleast_1d(np.asarray(values, dtype=self.dtype))
        except (TypeError, ValueError, OverflowError):
            row = np.empty(0)
        if row.ndim > 2 or not row.size or not (np.abs(row) <= MOST).all():  # false for NaN as well
            self.problems.append(f"{key}: expected {name} to be a row of finite numbers up to {MOST:g}")
            return None
        return row

    def refuse_unknown(self, what: str, values: Any, known: Collection[str]) -> None:
        """Records keys of a mapping that are not known, unless they say nothing: null, empty or false."""
        for name, value in values.items() if isinstance(values, Mapping) else ():
            if name not in known and not says_nothing(value):
                self.problems.append(
                    f"{what}: {name} ({value!r:.60}) is not known, and may change the robot's actions"
                )

    def check(self, groups: Iterable[Group | None] = ()) -> tuple[Group, ...]:
        """The groups, if there were no problems."""
        if self.problems:
            raise CheckpointError(f"{self.where}: " + "; ".join(dict.fromkeys(self.problems)))
        return tuple(group for group in groups if group is not None)


def value_at(values: Any, *names: Any) -> Any:
    """The value under names, one in another; None if there is none, or something else than mappings."""
    for name in names:
        values = values.get(name) if isinstance(values, Mapping) else None
    return values


def is_list_of(kind: type, value: Any) -> bool:
    """Whether a value of JSON is a list of values of one type. True and false are not integers."""
    return isinstance(value, list) and all(type(one) is kind for one in value)


def width_of(statistics: Any) -> int | None:
    """Number of values that statistics are of, whichever of them there are; None if there are none."""
    values = list(statistics.values()) if isinstance(statistics, Mapping) else []
    rows = [row for row in values if isinstance(row, (list, tuple)) and row]
    if not rows:
        return None
    first = rows[0][0]
    return len(first) if isinstance(first, (list, tuple)) else len(rows[0])


def size_of(value: Any) -> int | None:
    """A positive integer of a file. Any other value is treated as absent."""
    return value if type(value) is int and value > 0 else None


def bounded_size(name: str, value: Any) -> int | None:
    """As :func:`size_of`, of a state or action; a `CheckpointError` beyond :data:`MOST_WIDTH`."""
    size = size_of(value)
    if size is not None and size > MOST_WIDTH:
        raise CheckpointError(f"config.json: {name}: expected at most {MOST_WIDTH}, got {size}")
    return size
