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


#: Implementers of ARM CPUs, and the parts that /proc/cpuinfo gives numbers instead of names.
ARM_IMPLEMENTERS = {
    0x41: "ARM",
    0x42: "Broadcom",
    0x43: "Cavium",
    0x46: "Fujitsu",
    0x48: "HiSilicon",
    0x4E: "NVIDIA",
    0x51: "Qualcomm",
    0x53: "Samsung",
    0x61: "Apple",
    0x6D: "Microsoft",
    0xC0: "Ampere",
}
ARM_PARTS = {
    (0x41, 0xD03): "Cortex-A53",
    (0x41, 0xD04): "Cortex-A35",
    (0x41, 0xD05): "Cortex-A55",
    (0x41, 0xD07): "Cortex-A57",
    (0x41, 0xD08): "Cortex-A72",
    (0x41, 0xD09): "Cortex-A73",
    (0x41, 0xD0A): "Cortex-A75",
    (0x41, 0xD0B): "Cortex-A76",
    (0x41, 0xD0C): "Neoverse-N1",
    (0x41, 0xD0D): "Cortex-A77",
    (0x41, 0xD40): "Neoverse-V1",
    (0x41, 0xD41): "Cortex-A78",
    (0x41, 0xD42): "Cortex-A78AE",
    (0x41, 0xD44): "Cortex-X1",
    (0x41, 0xD46): "Cortex-A510",
    (0x41, 0xD47): "Cortex-A710",
    (0x41, 0xD48): "Cortex-X2",
    (0x41, 0xD49): "Neoverse-N2",
    (0x41, 0xD4B): "Cortex-A78C",
    (0x41, 0xD4D): "Cortex-A715",
    (0x41, 0xD4E): "Cortex-X3",
    (0x41, 0xD4F): "Neoverse-V2",
    (0x41, 0xD80): "Cortex-A520",
    (0x41, 0xD81): "Cortex-A720",
    (0x41, 0xD82): "Cortex-X4",
    (0x41, 0xD83): "Neoverse-V3AE",
    (0x41, 0xD84): "Neoverse-V3",
    (0x41, 0xD85): "Cortex-X925",
    (0x41, 0xD87): "Cortex-A725",
    (0x41, 0xD8E): "Neoverse-N3",
    (0x46, 0x001): "A64FX",
    (0x48, 0xD01): "Kunpeng-920",
    (0x4E, 0x004): "Carmel",
    (0x51, 0x001): "Oryon",
    (0x61, 0x022): "M1 Icestorm",
    (0x61, 0x023): "M1 Firestorm",
    (0x61, 0x032): "M2 Blizzard",
    (0x61, 0x033): "M2 Avalanche",
    (0xC0, 0xAC3): "Ampere-1",
    (0xC0, 0xAC4): "Ampere-1a",
}


def cpu_name() -> str:
    """Name of the processor as Linux reports it, or as Python's ``platform`` does.

    Linux reports ARM processors by number. Parts that are not in the table of names keep it; a processor with
    several kinds of cores has all their names.
    """
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    return _name_in(text) or platform.processor() or platform.machine()


def _name_in(cpuinfo: str) -> str:
    """What /proc/cpuinfo calls the processor; empty if nothing does.

    Example:
        >>> _name_in("model name\\t: Some CPU 3000\\n")
        'Some CPU 3000'
        >>> _name_in("CPU implementer\\t: 0x41\\nCPU part\\t: 0xd0b\\n")
        'ARM Cortex-A76'
    """
    pairs = [line.partition(":")[::2] for line in cpuinfo.splitlines()]
    fields = [(key.strip(), value.strip()) for key, value in pairs]
    names = [value for key, value in fields if key == "model name"]
    if names:
        return names[0]
    kinds = []
    implementer = 0
    for key, value in fields:
        if key == "CPU implementer" and value:
            implementer = int(value, 16)
        elif key == "CPU part" and value:
            part = int(value, 16)
            maker = ARM_IMPLEMENTERS.get(implementer, f"implementer {implementer:#x}")
            kinds.append(f"{maker} {ARM_PARTS.get((implementer, part), f'part {part:#x}')}")
    return ", ".join(dict.fromkeys(kinds))
