"""Directories of pictures as observations of a policy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from saccade import InputError, Policy, SaccadeError
from saccade.observations import Requirements
from saccade.observations.pictures import read_frames
from tests.helpers.frames_cases import write_pictures
from tests.helpers.policy_cases import policy
from tests.helpers.whole_checkpoints import HEIGHT, WIDTH

STATE = {"arm": [0.1, -0.2, 0.3, 0.4, 0.5], "hand": [0.0, 1.0]}


@pytest.fixture(scope="module")
def isaac() -> Policy:
    """Its cameras are wrist and front, in this order, of `HEIGHT` x `WIDTH` pixels."""
    return policy("isaac")


def pixels(path: Path) -> NDArray[np.uint8]:
    return np.asarray(Image.open(path).convert("RGB"))


def test_a_directory_of_pictures_is_one_moment(isaac: Policy, tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "table")
    (folder / "notes.txt").write_text("not a picture")
    (folder / ".front.jpg").write_text("hidden")
    (folder / "state.json").write_text(json.dumps(STATE))
    (picture,) = read_frames(folder, isaac, instruction="open the drawer")
    assert (picture.name, picture.episode, picture.instruction) == ("table", None, "open the drawer")
    assert list(picture.observation["video"]) == ["wrist", "front"]
    for name, frames in picture.observation["video"].items():
        assert np.array_equal(frames, pixels(folder / f"{name}.png")[None, None])
    for key, values in STATE.items():
        assert np.array_equal(picture.observation["state"][key], np.array([[values]], np.float32))
    isaac.encode(picture.observation)


def test_what_is_not_given_is_that_of_the_example(isaac: Policy, tmp_path: Path) -> None:
    (picture,) = read_frames(write_pictures(tmp_path), isaac)
    example = isaac.example_observation()
    assert picture.observation["language"] == example["language"]
    for key, values in example["state"].items():
        assert np.array_equal(picture.observation["state"][key], values)


def test_folders_are_moments_in_the_order_of_their_numbers(isaac: Policy, tmp_path: Path) -> None:
    for number in (1, 2, 10):
        write_pictures(tmp_path / f"step{number}", number)
    (tmp_path / "step2" / "state.json").write_text(json.dumps([0.0] * 7))
    (tmp_path / "other.json").write_text(json.dumps(STATE))
    found = read_frames(tmp_path, isaac, state=tmp_path / "other.json")
    assert [(picture.name, picture.episode) for picture in found] == [
        ("step1", None),
        ("step2", None),
        ("step10", None),
    ]
    hands = [picture.observation["state"]["hand"][0, 0].tolist() for picture in found]
    assert hands == [[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]]


def test_folders_of_folders_are_episodes(isaac: Policy, tmp_path: Path) -> None:
    for name in ("pour/1", "pour/2", "wipe/1"):
        write_pictures(tmp_path / name)
    found = read_frames(tmp_path, isaac)
    assert [(picture.name, picture.episode) for picture in found] == [
        ("pour/1", "pour"),
        ("pour/2", "pour"),
        ("wipe/1", "wipe"),
    ]


def test_without_known_cameras_every_picture_is_a_view(tmp_path: Path) -> None:
    any_camera = policy("nvidia", Requirements())
    folder = write_pictures(tmp_path, names=("left.jpg", "above.png"))
    (picture,) = read_frames(folder, any_camera)
    assert list(picture.observation["video"]) == ["above", "left"]


def test_a_picture_stands_for_all_frames_of_its_camera(tmp_path: Path) -> None:
    both = policy("n16", Requirements(video_horizon=2))
    (picture,) = read_frames(write_pictures(tmp_path, names=["front.png"]), both)
    frames = picture.observation["video"]["front"]
    assert frames.shape == (1, 2, HEIGHT, WIDTH, 3)
    assert np.array_equal(frames[0, 0], frames[0, 1])


def broken(folder: Path, kind: str) -> dict[str, Any]:
    """Makes a directory that cannot be read; returns arguments of `read_frames`."""
    if kind == "empty":
        folder.mkdir()
    elif kind == "empty picture":
        write_pictures(folder / "1")
        (folder / "2").mkdir()
    elif kind == "too deep":
        write_pictures(folder / "a" / "b" / "c")
    elif kind == "missing":
        write_pictures(folder / "1")
        write_pictures(folder / "2", names=["front.png"])
    elif kind == "unknown":
        write_pictures(folder, names=("front.png", "wrist.png", "depth.png"))
    elif kind == "twice":
        write_pictures(folder, names=("front.png", "front.jpg", "wrist.png"))
    elif kind == "both":
        write_pictures(write_pictures(folder) / "1")
    elif kind == "size":
        write_pictures(folder)
        Image.fromarray(np.zeros((3, 2, 3), np.uint8)).save(folder / "front.png")
    elif kind == "text":
        (write_pictures(folder) / "front.png").write_text("no picture")
    elif kind == "state":
        (write_pictures(folder) / "state.json").write_text("[1.0]")
    elif kind == "part":
        (write_pictures(folder) / "state.json").write_text('{"arm": [0, 0, 0, 0, 0]}')
    elif kind == "huge":
        (write_pictures(folder) / "state.json").write_text(f'{{"arm": [{10**400}]}}')
    elif kind == "no state":
        write_pictures(folder)
        return {"state": folder / "missing.json"}
    return {}


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("empty", r"dir: expected pictures named after the cameras \(wrist.png, front.png\), or a folder of"),
        ("empty picture", r"dir/2: expected pictures named after the cameras"),
        ("too deep", r"dir/a/b: expected pictures"),
        ("missing", r"dir/2: expected one picture for each camera \(wrist.png, front.png\), got front.png$"),
        ("unknown", r"dir: expected one picture for each camera \(.*\), got depth.png, front.png, wrist.png"),
        ("twice", r"dir: expected one picture of front, got front.jpg and front.png"),
        ("both", r"dir: expected pictures or folders of pictures, got pictures and the folder 1"),
        ("size", rf"dir: video.front: expected frames of {HEIGHT} x {WIDTH} pixels, got 3 x 2"),
        ("text", r"dir/front.png: cannot be read as a picture"),
        ("state", r"dir: state: expected 7 numbers \(arm \(5\), hand \(2\)\), got 1"),
        ("part", r"dir: state.hand: expected hand too, got arm"),
        ("huge", r"dir/state.json: expected lists of numbers"),
    ],
)
def test_bad_directories_are_named(isaac: Policy, tmp_path: Path, kind: str, message: str) -> None:
    given = broken(tmp_path / "dir", kind)
    with pytest.raises(SaccadeError, match=message):
        read_frames(tmp_path / "dir", isaac, **given)


def test_paths_that_are_not_there(isaac: Policy, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="dir: no such directory; expected one with a picture"):
        read_frames(tmp_path / "dir", isaac)
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file: no such directory"):
        read_frames(tmp_path / "file", isaac)
    with pytest.raises(FileNotFoundError, match=r"missing\.json"):
        read_frames(tmp_path / "dir", isaac, **broken(tmp_path / "dir", "no state"))


def test_an_instruction_must_be_text(isaac: Policy, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected valid Unicode"):
        read_frames(write_pictures(tmp_path), isaac, instruction="\ud800")
