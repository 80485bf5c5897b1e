"""What saccade uses on this machine."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np

from saccade import _saccade


@overload
def show_config(mode: Literal["stdout"] = "stdout") -> None: ...
@overload
def show_config(mode: Literal["dicts"]) -> dict[str, Any]: ...
def show_config(mode: Literal["stdout", "dicts"] = "stdout") -> dict[str, Any] | None:
    """Prints, or with ``mode="dicts"`` returns, what a head loaded now would use.

    ``isa`` is the instruction set (``SACCADE_ISA`` forces one of ``available_isas``), ``dot_products`` what
    it multiplies in one instruction on this CPU: ``bf16`` for the precision bfloat16, ``vnni`` for int8,
    which run with what there is without them. ``num_threads`` is the default thread count
    (``SACCADE_NUM_THREADS``).

    Raises:
        InputError: ``SACCADE_ISA`` or ``SACCADE_NUM_THREADS`` holds something that cannot be used here.

    Example:
        >>> import saccade
        >>> "portable" in saccade.show_config(mode="dicts")["available_isas"]
        True
    """
    config = {
        "saccade": _saccade.__version__,
        "isa": _saccade.selected_isa(),
        "dot_products": _saccade.dot_products(),
        "available_isas": _saccade.available_isas(),
        "num_threads": _saccade.default_num_threads(),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    if mode == "dicts":
        return config
    for name, value in config.items():
        print(f"{name}: {', '.join(value) or 'none' if isinstance(value, list) else value}")
    return None


def cpu_name() -> str:
    """The processor's name as Linux reports it, or what Python's ``platform`` knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
