"""The environment that a process used last: it stays open for the next episode of the same task."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Protocol, TypeVar


class Closable(Protocol):
    """An environment."""

    def close(self) -> None:
        """Frees what it holds."""
        ...


Environment = TypeVar("Environment", bound=Closable)

_open: dict[Hashable, Any] = {}  # at most one


def cached_environment(key: Hashable, create: Callable[[], Environment]) -> Environment:
    """The environment of that key, created if it is not the one that is open."""
    if key not in _open:
        close()
        _open[key] = create()
    found: Environment = _open[key]
    return found


def close() -> None:
    """Closes the environment of this process, if one is open."""
    while _open:
        _open.popitem()[1].close()
