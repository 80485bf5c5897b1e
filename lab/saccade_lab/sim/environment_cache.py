"""The environment that a process used last: it stays open for the next episode of the same task."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from saccade_lab.sim.environment import TaskEnvironment

_open: dict[Hashable, TaskEnvironment] = {}  # at most one


def cached_environment(key: Hashable, create: Callable[[], TaskEnvironment]) -> TaskEnvironment:
    """The environment of that key, created if it is not the one that is open."""
    if key not in _open:
        close()
        _open[key] = create()
    return _open[key]


def close() -> None:
    """Closes the environment of this process, if one is open."""
    while _open:
        _open.popitem()[1].close()
