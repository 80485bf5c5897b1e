"""What every layout shares: the options of a request, checked groups, and the finished robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from saccade._arrays import integer
from saccade.errors import CheckpointError, InputError
from saccade.robots.groups import Group, Robot, Statistics

#: The statistics that a mode needs.
STATISTICS = {"min_max": ("min", "max"), "q99": ("q01", "q99"), "mean_std": ("mean", "std")}
ALL_STATISTICS = frozenset(name for names in STATISTICS.values() for name in names)

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
    """The arguments of :meth:`saccade.Normalizer.load`."""

    embodiment: str | int | None
    state_dim: int | None
    action_dim: int | None
    state_keys: tuple[str, ...] | None
    action_keys: tuple[str, ...] | None
    modes: str | Mapping[str, str] | None

    def refuse_keys(self, where: str) -> None:
        """Raises InputError if keys or modes are given, although the checkpoint contains them."""
        given = [name for name in ("state_keys", "action_keys", "modes") if getattr(self, name) is not None]
        if given:
            raise InputError(f"{', '.join(given)}: expected None, because {where} contains them")

    def choose(self, tags: Sequence[str], ids: Mapping[str, int], where: str) -> str:
        """The tag of the requested embodiment.

        An id may be given for the only robot there is, if it has none: a fine-tune may name a robot that the
        released code does not know. The id then selects the head's embodiment.

        Raises:
            InputError: It is not there, or several are and none is requested.
        """
        wanted = self.embodiment
        listed = ", ".join(f"{tag} ({ids[tag]})" if tag in ids else tag for tag in tags)
        if wanted is None:
            found = list(tags) if len(tags) == 1 else []
        elif isinstance(wanted, str):
            found = [tag for tag in tags if tag == wanted]
        else:
            asked = integer("embodiment", wanted, least=0)
            alone = len(tags) == 1
            found = [tag for tag in tags if ids.get(tag, asked if alone else None) == asked]
        if len(found) != 1:
            raise InputError(f"embodiment: expected one of those in {where} ({listed}), got {wanted!r}")
        return found[0]

    def check_only(self, found: str | None, found_id: int | None, where: str) -> None:
        """Raises InputError if another embodiment is requested than the only one that there is."""
        if self.embodiment is not None and self.embodiment not in (found, found_id):
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

    def group(self, key: str, statistics: Any, mode: str, **switches: Any) -> Group | None:
        """A group of this mode; None if there is a problem, which is recorded.

        ``switches`` are the remaining fields of :class:`Group`.
        """
        if not isinstance(statistics, Mapping):
            self.problems.append(f"{key}: no statistics")
            return None
        names = STATISTICS.get(mode, ())
        found = {
            name: self._row(key, name, statistics[name]) for name in statistics if name in ALL_STATISTICS
        }
        sizes = {values.shape for values in found.values() if values is not None}
        missing = [name for name in names if name not in found]
        if missing:
            self.problems.append(f"{key}: {mode} needs {' and '.join(missing)}")
        if len(sizes) != 1:
            self.problems.append(f"{key}: expected statistics of one shape, got {sorted(sizes)}")
        if missing or len(sizes) != 1 or any(values is None for values in found.values()):
            return None
        size = sizes.pop()[-1]
        if not names:
            return Group(key, size, mode, **switches)
        first, second = (found[name] for name in names)
        assert first is not None
        assert second is not None
        if mode == "mean_std":
            moving = second != 0
        else:
            moving = ~np.isclose(second, first) if self.is_close else second != first
        below = "0" if mode == "mean_std" else names[0]
        if (second < (0 if mode == "mean_std" else first)).any():
            self.problems.append(f"{key}: {names[1]} is below {below}")
        spans = second if mode == "mean_std" else second - first
        if (moving & (spans < LEAST)).any():
            self.problems.append(f"{key}: {names[1]} is less than {LEAST:g} above {below}")
        keeps = mode == "mean_std" or (mode == "q99" and not self.is_close)
        return Group(key, size, mode, first, second, moving, keeps, **switches)

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

    def check(self, groups: Iterable[Group | None]) -> tuple[Group, ...]:
        """The groups.

        Raises:
            CheckpointError: There were problems. The message lists them.
        """
        if self.problems:
            raise CheckpointError(f"{self.where}: " + "; ".join(dict.fromkeys(self.problems)))
        return tuple(group for group in groups if group is not None)


def finished(
    where: str,
    options: Options,
    embodiment: str | None,
    embodiment_id: int | None,
    state: tuple[Group, ...],
    action: tuple[Group, ...],
    dims: Dims,
    cuts_state: bool = True,
    **more: Any,
) -> Robot:
    """The robot, after checking that the widths of robot and head fit.

    Args:
        where: The file, for messages.
        options: What was requested.
        embodiment, embodiment_id: As in :class:`Robot`.
        state, action: Groups.
        dims: The widths that the file says the head has.
        cuts_state: Whether a state that is too wide is cut off.
        **more: The remaining fields of :class:`Robot`.

    Raises:
        CheckpointError, InputError: The widths do not fit.
    """
    widths = [sum(group.width for group in groups) for groups in (state, action)]
    found = []
    for name, width, given, said in zip(
        ("state_dim", "action_dim"), widths, (options.state_dim, options.action_dim), dims, strict=True
    ):
        if given is not None and said is not None and given != said:
            raise InputError(f"{name}: expected {said}, the head's in {where}, got {given}")
        found.append(given or said or width)
        if found[-1] > MOST_WIDTH:
            raise CheckpointError(f"{where}: {name}: expected at most {MOST_WIDTH}, got {found[-1]}")
    if widths[0] > found[0] and not cuts_state:
        raise CheckpointError(
            f"{where}: the robot's state has {widths[0]} numbers, the head's only {found[0]} (state_dim)"
        )
    if widths[1] > found[1]:
        raise CheckpointError(
            f"{where}: the robot's action has {widths[1]} numbers, the head's only {found[1]} (action_dim)"
        )
    return Robot(embodiment, embodiment_id, state, action, found[0], found[1], **more)


def size_of(value: Any) -> int | None:
    """A positive integer of a file. Any other value is treated as absent."""
    return value if type(value) is int and value > 0 else None
