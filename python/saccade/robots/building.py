"""What every layout shares: the options of a request, checked groups, and the finished robot."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from saccade._internal.arrays import integer
from saccade.errors import CheckpointError, InputError
from saccade.robots.data_configs import DataConfig, says_nothing
from saccade.robots.embodiments import resolved
from saccade.robots.groups import Group, Robot, Statistics

#: The statistics that a mode needs. The other modes need none.
STATISTICS = {
    "min_max": ("min", "max"),
    "q99": ("q01", "q99"),
    "mean_std": ("mean", "std"),
    "scale": ("min", "max"),
}

#: The engine's limit of the width of a head.
MOST_WIDTH = 1 << 20

#: Larger statistics are refused: results could exceed the range of float32, and an action be infinite.
MOST = 1e30
#: So are smaller spans, by which values are divided.
LEAST = 1e-30

#: The widths of state and action that a file says the head has.
Dims = tuple[int | None, int | None]


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

        Only the statistics that the mode needs are looked at. The others may be anything.

        Args:
            key: Its name.
            statistics: Statistics by name.
            mode: One of ``STATISTICS``.
            by_step: Whether there may be a row for each step of a chunk.
            **switches: The remaining fields of :class:`Group`; ``size`` is that of the statistics by default.
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
        if mode == "scale":
            first, second = np.zeros_like(first), np.maximum(np.abs(first), np.abs(second))
        return self.scaled(key, mode, first, second, **switches)

    def scaled(self, key: str, mode: str, first: Statistics, second: Statistics, **switches: Any) -> Group:
        """A group with these statistics, after checking that they are in order."""
        below, above = STATISTICS[mode] if mode != "scale" else ("0", "the largest bound")
        has_bounds = mode in ("min_max", "q99")
        if not has_bounds:
            below = "0"
        start = first if has_bounds else np.zeros_like(first)
        if has_bounds:
            moving = ~np.isclose(second, first) if self.is_close else second != first
        else:
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

    def refuse_unknown(self, what: str, values: Mapping[str, Any], known: Collection[str]) -> None:
        """Records keys that are not known, unless they say nothing: null, empty or false."""
        for name, value in values.items():
            if name not in known and not says_nothing(value):
                self.problems.append(
                    f"{what}: {name} ({value!r:.60}) is not known, and may change the robot's actions"
                )

    def check(self, groups: Iterable[Group | None] = ()) -> tuple[Group, ...]:
        """The groups.

        Raises:
            CheckpointError: There were problems. The message lists them.
        """
        if self.problems:
            raise CheckpointError(f"{self.where}: " + "; ".join(dict.fromkeys(self.problems)))
        return tuple(group for group in groups if group is not None)


def width_of(statistics: Any) -> int | None:
    """Number of values that statistics are of, whichever of them there are; None if there are none."""
    values = list(statistics.values()) if isinstance(statistics, Mapping) else []
    rows = [row for row in values if isinstance(row, (list, tuple)) and row]
    if not rows:
        return None
    first = rows[0][0]
    return len(first) if isinstance(first, (list, tuple)) else len(rows[0])


def finished(
    where: str,
    options: Options,
    embodiment: str | None,
    embodiment_id: int | None,
    state: tuple[Group, ...],
    action: tuple[Group, ...],
    dims: Dims,
    cuts_state: bool = True,
    hint: str = "",
    **more: Any,
) -> Robot:
    """The robot, after checking that the widths of robot and head fit.

    A head may be wider than the file says: what is beyond is padding, which is zero either way.

    Args:
        where: The file, for messages.
        options: What was requested.
        embodiment, embodiment_id: As in :class:`Robot`.
        state, action: Groups.
        dims: The widths that the file says the head has.
        cuts_state: Whether a state that is too wide is cut off.
        hint: What to do about a robot that is too wide, for messages.
        **more: The remaining fields of :class:`Robot`.

    Raises:
        CheckpointError, InputError: The widths do not fit.
    """
    widths = [sum(group.width for group in groups) for groups in (state, action)]
    found, limits = [], []
    for name, width, given, said in zip(
        ("state_dim", "action_dim"), widths, (options.state_dim, options.action_dim), dims, strict=True
    ):
        if given is not None and said is not None and given < said:
            raise InputError(f"{name}: expected at least {said}, the head's in {where}, got {given}")
        found.append(given or said or width)
        limits.append(said or given or width)
        if found[-1] > MOST_WIDTH:
            raise CheckpointError(f"{where}: {name}: expected at most {MOST_WIDTH}, got {found[-1]}")
    if widths[0] > limits[0] and not cuts_state:
        raise CheckpointError(
            f"{where}: the robot's state has {widths[0]} numbers, the head's only {limits[0]} (state_dim)"
        )
    if widths[1] > limits[1]:
        raise CheckpointError(
            f"{where}: the robot's action has {widths[1]} numbers, the head's only {limits[1]} (action_dim)"
            f"{hint}"
        )
    return Robot(embodiment, embodiment_id, state, action, found[0], found[1], **more)


def size_of(value: Any) -> int | None:
    """A positive integer of a file. Any other value is treated as absent."""
    return value if type(value) is int and value > 0 else None
