"""Counting views whose pixels did not change."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benches import unchanged_views
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.sim.demos import Demonstration, RecordingSettings


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Six frames of two cameras: the first never changes, the second only between frames 2 and 3."""
    rng = np.random.default_rng(0)
    still, before, after = rng.integers(0, 256, (3, 68, 68, 3), np.uint8)
    images = np.stack([np.stack([still, before if frame < 3 else after]) for frame in range(6)])
    folder = tmp_path / "reach"
    folder.mkdir()
    settings = RecordingSettings(frame_stride=3, cameras=DEFAULT_CAMERAS[:2])
    (folder / "recording.json").write_text(json.dumps(settings.to_dict()))
    steps = np.arange(6, dtype=np.int32)
    episode = Demonstration(
        images,
        np.zeros((6, 4), np.float32),
        np.zeros((6, 6), np.float32),
        3 * steps,
        np.zeros((18, 4), np.float32),
        np.zeros(18, np.bool_),
    )
    (folder / "1000000.npz").write_bytes(episode.to_bytes())
    return tmp_path


def test_views_are_counted(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unchanged_views, "NOISE", (0.0, 1.0))
    rows = {(row.control_steps, row.noise): row for row in unchanged_views.count("x", recording)}
    first, second = (camera.name for camera in DEFAULT_CAMERAS[:2])
    stands = rows[0, 0.0]
    assert (stands.observations, stands.all_same, stands.some_same) == (6, 6, 6)
    next_one = rows[3, 0.0]
    assert (next_one.observations, next_one.all_same, next_one.some_same) == (5, 4, 5)
    assert next_one.same == {first: 5, second: 4}
    later = rows[12, 0.0]
    assert (later.observations, later.same) == (2, {first: 2, second: 0})
    assert all(row.some_same == 0 for (_, noise), row in rows.items() if noise == 1.0)


def test_no_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no recording"):
        unchanged_views.count("x", tmp_path)


def test_a_recording_without_a_name_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        unchanged_views.main(["out/demos"])
    assert "expected NAME=DIR, got 'out/demos'" in capsys.readouterr().err


def test_the_page_shows_the_record() -> None:
    rows = json.loads(unchanged_views.RECORD.read_text())["rows"]
    page = (Path(unchanged_views.__file__).parents[1] / "docs" / "real-time.md").read_text()
    assert unchanged_views.table(rows) in page
