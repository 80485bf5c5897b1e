"""Robots of the released code, tests/data/robots: the released numbers, or the released refusal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import saccade
from tests.helpers import paths
from tests.helpers.tensor_files import read_tensor_file

DATA = paths.DATA / "robots"

#: The released numbers, as the fixtures were checked.
TOLERANCE = 1e-5


def cases(*kinds: str) -> list[Any]:
    """The folders of these kinds, with their names as ids."""
    folders = [folder for kind in kinds for folder in sorted((DATA / kind).iterdir())]
    assert folders
    return [pytest.param(folder, id=f"{folder.parent.name}/{folder.name}") for folder in folders]


def case_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "case.json").read_text())
    return found


def load(folder: Path, case: dict[str, Any]) -> saccade.Normalizer:
    config = case.get("data_config")
    if config is not None and config.endswith(".json"):
        config = str(folder / config)
    return saccade.Normalizer.from_pretrained(folder, case["embodiment"], data_config=config)


def state_of(normalizer: saccade.Normalizer, tensors: dict[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
    return np.concatenate([tensors[f"state.{group.key}"] for group in normalizer.state_groups], axis=-1)


def same(found: Any, expected: npt.NDArray[Any], key: str = "") -> None:
    np.testing.assert_allclose(np.asarray(found), expected, rtol=TOLERANCE, atol=TOLERANCE, err_msg=key)


def is_taken(case: dict[str, Any]) -> bool:
    return not case.get("refuses")


@pytest.mark.parametrize(
    "folder", [one for one in cases("n15", "n16_n17") if is_taken(case_of(one.values[0]))]
)
def test_isaac_gr00t(folder: Path) -> None:
    case, tensors = case_of(folder), read_tensor_file(folder / "case.safetensors")[1]
    normalizer = load(folder, case)
    assert normalizer.embodiment_id == case["embodiment_id"]
    assert normalizer.action_horizon == case.get("action_horizon", case.get("horizon"))
    for kind in ("state", "action"):
        groups = getattr(normalizer, f"{kind}_groups")
        assert [[group.key, group.size] for group in groups] == case["expects"][kind]
    state = state_of(normalizer, tensors)
    same(normalizer.state(state), tensors["head.state"])
    actions = np.asarray(normalizer.actions(tensors["head.actions"], state))
    for key, where in normalizer.action_slices.items():
        same(actions[..., where], tensors[f"out.{key}"], key)


@pytest.mark.parametrize("folder", cases("lerobot"))
def test_lerobot(folder: Path) -> None:
    case, tensors = case_of(folder), read_tensor_file(folder / "case.safetensors")[1]
    normalizer = load(folder, case)
    assert normalizer.embodiment_id == case["embodiment_id"]
    assert normalizer.action_horizon == case["horizon"]
    state = tensors["observation.state"]
    same(normalizer.state(state), tensors["head.state"])
    actions = normalizer.actions(tensors["head.actions"], state)
    same(actions, tensors["out.action"])


@pytest.mark.parametrize("folder", [one for one in cases("n15") if not is_taken(case_of(one.values[0]))])
def test_what_n15_refuses(folder: Path) -> None:
    case = case_of(folder)
    if case["stage"] == "load":
        with pytest.raises(saccade.SaccadeError):
            load(folder, case)
        return
    normalizer = load(folder, case)
    chunk = np.zeros((1, 16, normalizer.action_dim), np.float32)
    with pytest.raises(saccade.InputError, match="no inverse"):
        normalizer.actions(chunk, np.zeros((1, normalizer.state_width), np.float32))


#: What the release refuses without need: rep in lower case says the same, and a mean that no rule needs.
TAKEN = ("lower-case-rep", "no-mean")


@pytest.mark.parametrize("folder", cases("n16_n17_refused"))
def test_what_n16_and_n17_refuse(folder: Path) -> None:
    case = case_of(folder)
    if folder.name in TAKEN:
        assert not case["must"]
        load(folder, case)
        return
    with pytest.raises(saccade.SaccadeError):
        load(folder, case)


@pytest.mark.parametrize("folder", cases("n15", "n16_n17", "lerobot"))
def test_a_chunk_in_the_robots_units_goes_back(folder: Path) -> None:
    """What continues a chunk: the inverse of `actions`, also of poses and for a new state."""
    case = case_of(folder)
    if not is_taken(case):
        return
    normalizer = load(folder, case)
    tensors = read_tensor_file(folder / "case.safetensors")[1]
    if folder.parent.name == "lerobot":
        state = tensors["observation.state"].astype(np.float32)
    else:
        state = state_of(normalizer, tensors)
    chunk = np.clip(tensors["head.actions"], -0.9, 0.9)
    robot = np.asarray(normalizer.actions(chunk, state))
    back = np.asarray(normalizer.previous_chunk(robot, state))
    again = np.asarray(normalizer.actions(back, state))
    for group, where in zip(normalizer.action_groups, normalizer.action_slices.values(), strict=True):
        # A pose comes back with a true rotation, whose numbers may lie beyond these random bounds.
        if group.reference is None or group.reference.pose is None:
            np.testing.assert_allclose(again[..., where], robot[..., where], rtol=2e-4, atol=2e-4)
