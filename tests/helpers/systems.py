"""What the system that runs the tests has, and marks for tests of what others do not have."""

from __future__ import annotations

import os
import sys

import pytest

IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0

#: Tests of what Windows does not have, or says in other words.
posix = pytest.mark.skipif(
    os.name != "posix", reason="needs POSIX: pipes, devices, links, signals or shell scripts"
)
#: Tests of what only Linux has.
linux = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="needs Linux: /proc, its limits, or names of any bytes"
)
