"""What saccade is and would use on this machine: its build, instruction set, threads, processor, packages."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.files import remembered_sha256

#: Other packages that a bug report should name, besides those of the extras.
OTHERS = ("saccade-vla-lab", "lerobot-policy-saccade", "lerobot", "transformers", "mujoco")


@overload
def show_config(mode: Literal["stdout"] = "stdout") -> None: ...
@overload
def show_config(mode: Literal["dicts"]) -> dict[str, Any]: ...
def show_config(mode: Literal["stdout", "dicts"] = "stdout") -> dict[str, Any] | None:
    """Prints what a head that is loaded now would use on this machine. ``saccade info`` prints the same.

    - ``library``: the beginning of the SHA-256 of the compiled library, which tells builds apart.
    - ``isa``: the instruction set. The environment variable ``SACCADE_ISA`` selects one of
      ``available_isas``.
    - ``cpu``: the name of the processor, where the system reports one.
    - ``dot_products``: the dot products that it uses on this CPU: ``bf16`` for the precision bfloat16, and
      ``vnni``, ``dotprod`` or ``i8mm`` for int8 and int4. All precisions also work without them.
    - ``family``: the family of this CPU, and ``rates``: the family whose measured rates choose between its
      instructions. A family that was not measured gets what the newest one of its vendor gets.
    - ``tiles``: whether AMX can be used; if not, why.
    - ``num_threads``: the default number of threads, which ``SACCADE_NUM_THREADS`` sets.
    - ``processors``: the number of logical processors that this process may use, and ``quota`` how many of
      them its control groups grant at a time, as ``"1.5"``; None without a quota, and on other systems than
      Linux. Both are already in ``num_threads``.
    - ``caches``: of one processor, as Linux reports them: ``"L2 1024K"``. Empty elsewhere.
    - ``packages``: the optional packages that are installed, with their versions.

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
        "library": library(),
        "cpu": cpu_name(),
        "isa": isa,
        "dot_products": _saccade.dot_products(),
        "available_isas": _saccade.available_isas(),
        "family": family,
        "rates": rates,
        "tiles": tiles,
        "num_threads": _saccade.default_num_threads(),
        "processors": usable_processors(),
        "quota": quota(Path("/")),
        "caches": caches(Path("/sys/devices/system/cpu/cpu0/cache")),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "packages": packages(),
    }
    if mode == "dicts":
        return config
    for name, value in config.items():
        shown = (", ".join(value) if isinstance(value, list) else value) or "none"
        print(f"{name}: {shown}")
    return None


def arithmetic() -> dict[str, Any]:
    """What decides the bits of a result, besides its inputs and options.

    Returns:
        ``saccade``: the version; ``library``: the build, as :func:`show_config` names it;
        ``instruction_set``; and ``dot_products``: those that it uses on this CPU, which are not the same on
        every CPU that has the instruction set. float32 uses none of them.

    Raises:
        InputError: ``SACCADE_ISA`` has a value that cannot be used here.
    """
    return {
        "saccade": _saccade.__version__,
        "library": library(),
        "instruction_set": _saccade.selected_isa(),
        "dot_products": _saccade.dot_products(),
    }


def library() -> str:
    """The beginning of the SHA-256 of the compiled library, which tells builds apart."""
    return remembered_sha256(Path(_saccade.__file__))[:12]


def usable_processors() -> int:
    """The number of logical processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def quota(root: Path) -> str | None:
    """The tightest quota of the control groups that hold this process, in processors.

    The engine reads the same files for its number of threads, and rounds up.

    Args:
        root: The root of the file system; tests have one of their own.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    found = []
    for line in lines:
        _, controllers, group = line.split(":", 2)
        is_second = controllers == ""  # version 2 has one hierarchy for all controllers
        if not is_second and "cpu" not in controllers.split(","):
            continue
        base = root / "sys/fs/cgroup" / ("" if is_second else "cpu")
        # A limit may be on any group above; in a container the root is its own group.
        folder = base / group.lstrip("/")
        while True:
            try:
                if is_second:
                    words = (folder / "cpu.max").read_text().split()
                else:
                    names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
                    words = [(folder / name).read_text().strip() for name in names]
            except OSError:
                words = []
            if len(words) == 2 and words[0].isdecimal() and words[1].isdecimal() and int(words[1]) > 0:
                found.append(int(words[0]) / int(words[1]))
            if folder == base:
                break
            folder = folder.parent
    return f"{min(found):g}" if found else None


def caches(folder: Path) -> list[str]:
    """Level and size of each cache that holds data, from a folder as Linux has one for each processor."""
    found = []
    for cache in sorted(folder.glob("index*")):
        try:
            level, kind, size = ((cache / name).read_text().strip() for name in ("level", "type", "size"))
        except OSError:
            continue
        if kind != "Instruction":
            found.append(f"L{level} {size}")
    return found


def packages() -> list[str]:
    """Name and version of each optional package that is installed, in the order of the extras."""
    import importlib.metadata  # not at the top: `import saccade` should stay cheap
    import re

    from saccade._internal import extras

    requirements = [line for modules in extras.SACCADE.modules.values() for line in modules.values()]
    names = [re.split("[<>=]", line)[0] for line in requirements]
    found = []
    for name in (*names, *OTHERS):
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


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
