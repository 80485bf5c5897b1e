"""The files next to the weights, changed at one place to an unexpected value: a result or one clear error."""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import saccade
from saccade.checkpoints import describe
from saccade.errors import CheckpointError, SaccadeError
from tests.helpers import hostile_cases, layouts

# Layouts and the files next to their weights.
FILES = [
    ("nvidia", "config.json"),
    ("nvidia", "experiment_cfg/metadata.json"),
    ("lerobot", "config.json"),
    ("lerobot", "policy_preprocessor.json"),
    ("lerobot", "policy_postprocessor.json"),
    ("lerobot-n17", "policy_preprocessor.json"),
    ("fork", "config.json"),
    ("n17", "config.json"),
    ("n17", "processor_config.json"),
    ("n17", "statistics.json"),
    ("n17", "embodiment_id.json"),
]
EMBODIMENTS = {"nvidia": "new_embodiment", "n17": "libero_sim"}

JUNK: list[Any] = [
    *(None, True, False, 0, -1, 1, 3, 2**31, 2**64, -(2**63), 10**400, 0.5, 1e308),
    *(float("nan"), float("inf"), "", "x", "../../x", "/dev/zero", "\x1b[2J\x9b", "\ud800", "1" * 5000),
    *([], {}, [[]], [None], [1, "x"], [[1.0], [1.0, 2.0]], {"": {}}, {"a": 1}),
]


no_hang = hostile_cases.no_hang  # a fixture


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A small checkpoint of each layout."""
    root = tmp_path_factory.mktemp("layouts")
    return {layout: layouts.write(root / layout, layout) for layout, _ in FILES}


def read(layout: str, folder: Path) -> None:
    """Everything that reads these files. It must return a result or say in a few words what is wrong."""
    calls: list[Callable[[], object]] = [
        lambda: describe(folder),
        lambda: use(saccade.Normalizer.from_pretrained(folder, EMBODIMENTS.get(layout))),
    ]
    for call in calls:
        message = refusal(call)
        assert message is None or 0 < len(message) < 100_000
        assert message is None or not {"\x1b", "\x9b"} & set(message)


def refusal(call: Callable[[], object]) -> str | None:
    """What is said against a call, if anything."""
    try:
        call()
    except (SaccadeError, FileNotFoundError) as error:
        return str(error)
    return None


def use(normalizer: saccade.Normalizer) -> None:
    """Both directions: of the widths that it says, and finite."""
    state = np.ones(normalizer.state_width, np.float32)
    assert np.asarray(normalizer.state(state)).shape == (normalizer.state_dim,)
    actions = np.ones((4, normalizer.action_dim), np.float32)
    robot = np.asarray(normalizer.actions(actions, state))
    assert robot.shape[-1] == normalizer.action_width
    assert np.isfinite(robot).all()


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all values in a JSON value; of long lists the first."""
    yield path
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from places(inner, (*path, key))
    elif isinstance(value, list) and value:
        yield from places(value[0], (*path, 0))


def changed(value: Any, path: tuple[Any, ...], change: Callable[[Any, Any], None]) -> Any:
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    change(inner, path[-1])
    return value


@pytest.mark.parametrize(("layout", "name"), FILES)
@settings(max_examples=40)
@given(data=st.data())
def test_one_value_is_something_else(
    layout: str, name: str, data: st.DataObject, checkpoints: dict[str, Path]
) -> None:
    folder = checkpoints[layout]
    original = (folder / name).read_text()
    value = json.loads(original)
    path = data.draw(st.sampled_from([path for path in places(value) if path]), label="path")
    junk = data.draw(st.sampled_from([KeyError, *JUNK]), label="junk")
    if junk is KeyError:
        value = changed(value, path, lambda inner, key: inner.__delitem__(key))
    else:
        value = changed(value, path, lambda inner, key: inner.__setitem__(key, junk))
    try:
        (folder / name).write_text(json.dumps(value))
        read(layout, folder)
    finally:
        (folder / name).write_text(original)


@pytest.mark.parametrize("key", ["max_state_dim", "action_dim"])
@pytest.mark.parametrize("width", [2**20 + 1, 2**64, 10**400])
def test_a_head_is_not_as_wide_as_a_file_likes(
    key: str, width: int, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "nvidia"
    shutil.copytree(checkpoints["nvidia"] / "experiment_cfg", folder / "experiment_cfg")
    config = json.loads((checkpoints["nvidia"] / "config.json").read_text())
    config["action_head_cfg"][key] = width
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(saccade.CheckpointError, match=r"_dim: expected at most 1048576, got"):
        saccade.Normalizer.from_pretrained(folder, "new_embodiment")


def terabytes(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**42)


WHOLE: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "directory": Path.mkdir,
    "dangling link": lambda path: path.symlink_to("nowhere"),
    "link to itself": lambda path: path.symlink_to(path.name),
    "empty": Path.touch,
    "not UTF-8": lambda path: path.write_bytes(b'{"\xff": 1}'),
    "deep": lambda path: path.write_text('{"a": ' * 100_000),
    "deep and whole": lambda path: path.write_text('{"a": ' * 5_000 + "1" + "}" * 5_000),
    "numbers without end": lambda path: path.write_text('{"a": ' + "1" * 100_000 + "}"),
    "a list": lambda path: path.write_text("[]"),
    "a word": lambda path: path.write_text('"x"'),
    "terabytes": terabytes,
}


@pytest.mark.parametrize("case", WHOLE)
@pytest.mark.parametrize(("layout", "name"), FILES)
def test_the_file_is_something_else(layout: str, name: str, case: str, checkpoints: dict[str, Path]) -> None:
    folder = checkpoints[layout]
    path, aside = folder / name, folder / "aside"
    path.rename(aside)
    try:
        WHOLE[case](path)
        read(layout, folder)
    finally:
        if path.is_dir():
            path.rmdir()
        path.unlink(missing_ok=True)
        aside.rename(path)


@pytest.mark.parametrize("case", [*WHOLE, "damaged"])
@pytest.mark.parametrize("name", ["policy_preprocessor", "policy_postprocessor"])
def test_statistics_in_safetensors(
    name: str, case: str, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "lerobot"
    shutil.copytree(checkpoints["lerobot"], folder)
    (path,) = folder.glob(f"{name}*.safetensors")
    if case == "damaged":
        rng = np.random.default_rng(0)
        original = path.read_bytes()
        for _ in range(50):
            damaged = bytearray(original)
            damaged[int(rng.integers(len(original)))] = int(rng.integers(256))
            path.write_bytes(damaged[: int(rng.integers(len(original) + 1))])
            read("lerobot", folder)
        return
    path.unlink()
    WHOLE[case](path)
    read("lerobot", folder)


@pytest.mark.parametrize("layout", ["lerobot", "lerobot-n17"])
@pytest.mark.parametrize(
    "path", [("input_features", "observation.state"), ("output_features", "action")], ids=["state", "action"]
)
@pytest.mark.parametrize("width", [2**20 + 1, 2**31, 10**400])
def test_a_feature_is_not_as_wide_as_a_file_likes(
    layout: str, path: tuple[str, str], width: int, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / layout
    shutil.copytree(checkpoints[layout], folder)
    config = json.loads((folder / "config.json").read_text())
    config[path[0]][path[1]]["shape"] = [width]
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(
        CheckpointError, match=rf"config\.json: {path[0]}: {path[1]}: expected at most 1048576"
    ):
        saccade.Normalizer.from_pretrained(folder)
