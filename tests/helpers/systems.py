"""What the system that runs the tests has."""

from __future__ import annotations

import os

IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0
