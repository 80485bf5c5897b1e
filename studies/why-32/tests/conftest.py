"""Marks the tests of this study: they are of the tier `lab`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.tiers import TIERS


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m core` or `-m torch` nothing here is imported, whose packages may be missing."""
    asked = config.option.markexpr.split(" or ")
    return True if set(asked) <= set(TIERS) - {"lab"} and collection_path.suffix == ".py" else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks each test."""
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker("lab")
