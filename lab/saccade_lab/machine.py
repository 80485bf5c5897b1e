"""What records say about the machine."""

from __future__ import annotations

import functools
import platform

from saccade._internal import environment


@functools.cache
def cpu_name() -> str:
    """Name of the processor.

    Linux has it for x86. Elsewhere py-cpuinfo asks other programs, which takes a second.
    """
    if (platform.system(), platform.machine()) == ("Linux", "x86_64"):
        return environment.cpu_name()
    import cpuinfo  # not at the top: records of x86 need no name from it

    return str(cpuinfo.get_cpu_info().get("brand_raw") or environment.cpu_name())
