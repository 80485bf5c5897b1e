"""A checkpoint to start from."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A checkpoint in NVIDIA's layout. Some test modules have another one of this name."""
    # The core tests run without torch, and pytest imports this module for them too.
    from tests.helpers import layouts

    return layouts.write(tmp_path / "source", "nvidia")
