"""Published data sets, downloaded from a server on this machine that plays the Hub."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import dataset_cases as cases
from tests.helpers.hub_server import Hub, Repository, files_of, run

NAME = "lerobot/cubes"
OPEN = """
import saccade.datasets
try:
    data = saccade.datasets.open({arguments})
    print("found", len(data), data.frame(2, 22, "front").pixels.shape, data.version)
except OSError as error:
    print(type(error).__name__, error)
"""


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    server = Hub()
    repository = server.repositories[NAME] = Repository()
    repository.commit(files_of(cases.write_old(tmp_path / "old", "v2.0")), branch="v2.0")
    repository.commit(files_of(cases.write_new(tmp_path / "new")))
    yield server
    server.close()


def opened(hub: Hub, home: Path, arguments: str, **environment: str) -> str:
    result = run(OPEN.format(arguments=arguments), hub.endpoint, home, **environment)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_an_id_is_downloaded_once(hub: Hub, tmp_path: Path) -> None:
    expected = "found 3 (48, 64, 3) v3.0"
    assert opened(hub, tmp_path, repr(NAME)) == expected
    assert opened(hub, tmp_path, repr(NAME), HF_HUB_OFFLINE="1") == expected
    assert opened(hub, tmp_path, f"{NAME!r}, revision='v2.0'") == "found 3 (48, 64, 3) v2.0"
    assert opened(hub, tmp_path, f"'{NAME}@v2.0'") == "found 3 (48, 64, 3) v2.0"


def test_what_cannot_be_downloaded(hub: Hub, tmp_path: Path) -> None:
    for arguments, message in (
        ("'lerobot/none'", "lerobot/none: no such path, and no such repository"),
        (f"{NAME!r}, revision='v1.6'", f"{NAME}: the repository has no revision v1.6"),
    ):
        assert opened(hub, tmp_path, arguments).startswith(f"FileNotFoundError path_or_id: {message}")
    offline = opened(hub, tmp_path, repr(NAME), HF_HUB_OFFLINE="1")
    assert f"{NAME}: no such path, and it cannot be downloaded" in offline
    hub.gated = True
    assert opened(hub, tmp_path, repr(NAME)).startswith(f"PermissionError path_or_id: {NAME}: the Hub denies")


def test_an_incomplete_download_is_said_to_be_one(hub: Hub, tmp_path: Path) -> None:
    hub.cut = "videos/observation.images.front/chunk-000/file-000.mp4"
    stopped = opened(hub, tmp_path, repr(NAME))
    assert stopped.startswith(f"FileNotFoundError path_or_id: {NAME}: the download stopped (")
    offline = opened(hub, tmp_path, repr(NAME), HF_HUB_OFFLINE="1")
    assert offline.startswith(f"FileNotFoundError path_or_id: {NAME}: the download is incomplete: ")
    assert hub.cut in offline
    hub.status = 503  # the Hub answers, but to nothing
    assert opened(hub, tmp_path, repr(NAME)) == offline
    hub.status, hub.cut = None, ""
    expected = "found 3 (48, 64, 3) v3.0"
    assert opened(hub, tmp_path, repr(NAME)) == expected
    assert opened(hub, tmp_path, repr(NAME), HF_HUB_OFFLINE="1") == expected


def test_a_command_names_the_commit(hub: Hub, tmp_path: Path) -> None:
    """Another process, or the reader of a certificate, finds them when the branch has moved."""
    program = f"""
import saccade
from saccade.evaluation.source import Source
print(Source.of(saccade.demo_checkpoint(), {NAME!r}, {{}}).recordings)
"""
    result = run(program, hub.endpoint, tmp_path)
    assert result.returncode == 0, result.stderr
    named = result.stdout.strip()
    assert re.fullmatch(f"{NAME}@[0-9a-f]{{40}}", named)
    hub.repositories[NAME].commit(files_of(cases.write_old(tmp_path / "moved", "v2.1")))
    assert opened(hub, tmp_path, repr(named)) == "found 3 (48, 64, 3) v3.0"
    assert opened(hub, tmp_path, repr(NAME)) == "found 3 (48, 64, 3) v2.1"
