"""Renderers that are still open when the interpreter ends are closed in time.

Otherwise their OpenGL contexts would be freed after EGL has been terminated, and each would print a
traceback.
"""

from __future__ import annotations

import atexit
import functools
import os
import weakref
from typing import Protocol


class Closable(Protocol):
    """Something with an OpenGL context."""

    def close(self) -> None:
        """Frees the context."""


#: Open renderers, each with the process that opened it.
_open: weakref.WeakKeyDictionary[Closable, int] = weakref.WeakKeyDictionary()


def close_at_exit(renderer: Closable) -> None:
    """Closes this renderer before the interpreter ends, unless ``closed`` is called before.

    Call it after the renderer has created its context: MuJoCo registers the end of EGL when it creates its
    first context, and functions registered later run earlier.
    """
    _open[renderer] = os.getpid()
    _register(os.getpid())


def closed(renderer: Closable) -> None:
    """Notes that this renderer has been closed."""
    _open.pop(renderer, None)


@functools.cache
def _register(process: int) -> None:
    """Registers, once in a process, that its open renderers are closed."""
    atexit.register(_close_all, process)


def _close_all(process: int) -> None:
    """Closes every renderer that this process has opened, if it is the running one.

    A fork has copies of the contexts but not Mesa's threads, and would wait for them without end.
    """
    if os.getpid() == process:
        for renderer in [renderer for renderer, opener in _open.items() if opener == process]:
            renderer.close()
