"""The instruction set, threads and processor of this machine."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np

import saccade._saccade as _saccade


@overload
def show_config(mode: Literal["stdout"] = "stdout") -> None: ...
@overload
def show_config(mode: Literal["dicts"]) -> dict[str, Any]: ...
def show_config(mode: Literal["stdout", "dicts"] = "stdout") -> dict[str, Any] | None:
    """Prints what a head that is loaded now would use on this machine.

    - ``isa``: the instruction set. The environment variable ``SACCADE_ISA`` selects one of
      ``available_isas``.
    - ``dot_products``: the dot products that it uses on this CPU: ``bf16`` for the precision bfloat16 and
      ``vnni`` for int8. Both precisions also work without them.
    - ``cpu``: the family of this CPU, and ``rates``: the family whose measured rates choose between its
      instructions. A family that was not measured gets what the newest one of its vendor gets.
    - ``tiles``: whether AMX can be used; if not, why.
    - ``num_threads``: the default number of threads, which ``SACCADE_NUM_THREADS`` sets.

    Args:
        mode: ``"stdout"`` prints, ``"dicts"`` returns a dict instead.

    Raises:
        InputError: ``SACCADE_ISA`` or ``SACCADE_NUM_THREADS`` has a value that cannot be used here.

    Example:
        >>> import saccade
        >>> "portable" in saccade.show_config(mode="dicts")["available_isas"]
        True
    """
    isa = _saccade.selected_isa()
    cpu, rates, tiles = _saccade.cpu_report()
    config = {
        "saccade": _saccade.__version__,
        "isa": isa,
        "dot_products": _saccade.dot_products(),
        "available_isas": _saccade.available_isas(),
        "cpu": cpu,
        "rates": rates,
        "tiles": tiles,
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
    """Name of the processor as Linux reports it, or as Python's ``platform`` does."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
