"""Videos of episodes: whole or not there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import pytest

from saccade_lab.sim import video
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.rollout import Episode

EPISODE = Episode("reach", 0, "reach the green ball")


@pytest.fixture
def environment() -> Iterator[TaskEnvironment]:
    with contextlib.closing(TaskEnvironment("reach", render_mode="rgb_array")) as found:
        found.restart(0)
        found.observe()
        yield found


def write(path: Path, environment: TaskEnvironment) -> None:
    with video.VideoWriter(path) as writer:
        writer.add(environment, EPISODE)


def test_a_video_appears_when_it_is_whole(environment: TaskEnvironment, tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", environment)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert len(imageio.mimread(tmp_path / "a.mp4")) == 1 + video.LINGER_FRAMES
    assert video.INDEX in (tmp_path / "a.mp4").read_bytes()


def test_a_video_without_its_end_is_an_error(
    environment: TaskEnvironment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ffmpeg writes the index last, and imageio does not say that it could not."""
    monkeypatch.setattr(video, "INDEX", b"no index")
    with pytest.raises(OSError, match=r"cannot be written; is the disk full\?: '.*a\.mp4'"):
        write(tmp_path / "a.mp4", environment)
    assert not list(tmp_path.iterdir())


def test_a_video_that_ffmpeg_gave_up_is_an_error(
    environment: TaskEnvironment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(picture: object) -> None:
        raise OSError("Broken pipe\n\nFFMPEG COMMAND:\nffmpeg -y ...")

    def write_and_fail() -> None:
        with video.VideoWriter(tmp_path / "a.mp4") as writer:
            writer.add(environment, EPISODE)
            monkeypatch.setattr(writer._writer, "append_data", fail)
            writer.add(environment, EPISODE)

    with pytest.raises(OSError, match=r"the video cannot be written; is the disk full\?") as caught:
        write_and_fail()
    assert caught.value.filename == str(tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


def test_an_error_in_the_episode_leaves_no_video(environment: TaskEnvironment, tmp_path: Path) -> None:
    def interrupted() -> None:
        with video.VideoWriter(tmp_path / "a.mp4") as writer:
            writer.add(environment, EPISODE)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(tmp_path.iterdir())
