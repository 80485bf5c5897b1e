"""Recordings for the commands that read a data set."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade.cli import recorded
from saccade.evaluation.source import forget_policy
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
def held_at_loads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many policies this process holds whenever one is loaded; none is held at first."""
    load, most = saccade.Policy.from_pretrained, []
    loaded: list[weakref.ref[saccade.Policy]] = []

    def counted(*arguments: Any, **options: Any) -> saccade.Policy:
        gc.collect()
        most.append(sum(one() is not None for one in loaded))
        policy = load(*arguments, **options)
        loaded.append(weakref.ref(policy))
        return policy

    forget_policy()
    monkeypatch.setattr(saccade.Policy, "from_pretrained", counted)
    return most


@pytest.fixture
def without_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """No page is drawn: the lab has tests of its own."""
    monkeypatch.setattr(recorded, "extension", lambda name: None)
