"""Recordings for the commands that read a data set."""

from __future__ import annotations

from pathlib import Path

import pytest

from saccade.cli import recorded
from tests.helpers.recorded_cases import Recorded
from tests.helpers.recorded_commands import recorded_data, recorded_folder


@pytest.fixture(scope="session")
def data() -> Recorded:
    """Recordings in memory."""
    return recorded_data()


@pytest.fixture(scope="session")
def folder(data: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same recordings in a folder, which tests do not change."""
    return recorded_folder(data, tmp_path_factory.mktemp("recordings"))


@pytest.fixture
def without_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """No page is drawn: the lab has tests of its own."""
    monkeypatch.setattr(recorded, "extension", lambda name: None)
