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
    - ``cpu``: the name of the processor, where the system reports one.
    - ``dot_products``: the dot products that it uses on this CPU: ``bf16`` for the precision bfloat16, and
      ``vnni``, ``dotprod`` or ``i8mm`` for int8. Both precisions also work without them.
    - ``family``: the family of this CPU, and ``rates``: the family whose measured rates choose between its
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
    family, rates, tiles = _saccade.cpu_report()
    config = {
        "saccade": _saccade.__version__,
        "cpu": cpu_name(),
        "isa": isa,
        "dot_products": _saccade.dot_products(),
        "available_isas": _saccade.available_isas(),
        "family": family,
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
    """Name of the processor as Linux reports it, or as Python's ``platform`` does.

    Linux reports ARM processors by number. saccade_lab knows their names.
    """
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    return _name_in(text) or platform.processor() or platform.machine()


def _name_in(cpuinfo: str) -> str:
    r"""What /proc/cpuinfo calls the first processor; empty if nothing does.

    Example:
        >>> _name_in("model name\t: Some CPU 3000\n")
        'Some CPU 3000'
        >>> _name_in("CPU implementer\t: 0x41\nCPU part\t: 0xd0b\n")
        'implementer 0x41 part 0xd0b'
    """
    pairs = [line.partition(":") for line in reversed(cpuinfo.splitlines())]
    fields = {key.strip(): value.strip() for key, _, value in pairs}
    part = fields.get("CPU part")
    numbers = f"implementer {fields.get('CPU implementer', 'unknown')} part {part}" if part else ""
    return fields.get("model name", "") or numbers
