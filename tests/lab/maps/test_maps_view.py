"""Where the observations of maps come from: the simulator, and files of features."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file as save_torch_file

import saccade
from saccade.errors import InputError, ShapeError
from saccade_lab.maps.layout import ViewLayout
from saccade_lab.maps.view import LayoutOptions, View, from_file, from_simulator
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import Episode, environment_for, run_episode
from tests.helpers.maps_cases import demo_policy, feature_arrays, written
from tests.helpers.released import load_released


@pytest.fixture
def policy() -> Policy:
    return demo_policy()


def test_the_observation_is_that_of_the_rollout(policy: Policy) -> None:
    looks = (0, 13)  # at the start, within the second chunk
    seen: dict[int, Any] = {}

    def on_step(environment: TaskEnvironment, episode: Episode) -> None:
        if episode.steps in looks:
            seen[episode.steps] = environment.observe()["images"]

    with contextlib.closing(environment_for(policy, "button-press-topdown")) as environment:
        episode = run_episode(environment, policy, 2, on_step=on_step)
    for steps in looks:
        found = from_simulator(policy, "button-press-topdown", 2, steps)
        assert found.images.keys() == seen[steps].keys()
        for name, picture in found.images.items():
            np.testing.assert_array_equal(picture, seen[steps][name])
    with pytest.raises(InputError, match=f"--after: given 190, but .* ends after {episode.steps} steps"):
        from_simulator(policy, "button-press-topdown", 2, 190)


def taken(path: Path, **options: Any) -> View:
    config = saccade.HeadConfig.from_dict(load_released("n15_single_view").config)
    return from_file(path, config, row=0, options=LayoutOptions(**options), seed=5)


def test_a_file_of_features(tmp_path: Path) -> None:
    arrays = feature_arrays()
    found = taken(written(tmp_path / "f.npz", arrays))
    np.testing.assert_array_equal(found.observation.backbone_features, arrays["backbone_features"])
    np.testing.assert_array_equal(found.observation.noise, arrays["noise"])
    assert found.observation.embodiment_id == arrays["embodiment_id"][0]
    assert found.layout.cameras == (ViewLayout("camera 1", 20, 16, 16),)
    assert found.images["camera 1"].shape == (32, 32, 3)
    by_hand = taken(tmp_path / "f.npz", text="text:20,image:16x16=left,text:*")
    assert list(by_hand.images) == ["left"]
    del arrays["noise"], arrays["images"]
    drawn = taken(written(tmp_path / "g.npz", {f"_in.{name}": array for name, array in arrays.items()}))
    assert drawn.images == {}
    expected = np.random.default_rng(5).standard_normal((16, 32), dtype=np.float32)
    assert drawn.observation.noise is not None
    np.testing.assert_array_equal(drawn.observation.noise[0], expected)


def test_safetensors_with_bfloat16_and_token_strings(tmp_path: Path) -> None:
    arrays = feature_arrays()
    tensors = {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}
    tensors["backbone_features"] = tensors["backbone_features"].bfloat16()
    names = [f"<{place}>" for place in range(296)]
    save_torch_file(tensors, tmp_path / "f.safetensors", metadata={"tokens": json.dumps(names)})
    found = taken(tmp_path / "f.safetensors")
    np.testing.assert_array_equal(
        found.observation.backbone_features, tensors["backbone_features"].float().numpy()
    )
    assert found.layout.tokens[0].name == "<0>"


def test_a_row_of_a_batch(tmp_path: Path) -> None:
    given = load_released("n15_tiny")
    mask = np.zeros((2, 11), np.int64)
    mask[0, 1:5], mask[1, 2:6] = 1, 1  # as tokenizers write masks
    arrays = {
        "backbone_features": given.backbone_features,
        "state": given.state,
        "embodiment_id": given.embodiment_id,
        "image_mask": mask,
        "attention_mask": np.array([[1] * 11, [0] + [1] * 10]),
    }
    config = saccade.HeadConfig.from_dict(given.config)
    path = written(tmp_path / "f.npz", arrays)
    found = from_file(path, config, row=1, options=LayoutOptions(), seed=0)
    np.testing.assert_array_equal(found.observation.backbone_features, given.backbone_features[1:])
    np.testing.assert_array_equal(found.observation.state, given.state[1:])
    assert found.observation.embodiment_id == given.embodiment_id[1]
    assert found.layout.cameras == (ViewLayout("camera 1", 2, 2, 2),)
    assert found.layout.parts()["pad"].tolist() == [0]
    with pytest.raises(InputError, match="--row: given 2"):
        from_file(path, config, row=2, options=LayoutOptions(), seed=0)


FILES: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"backbone_features": None}, InputError, "no backbone_features; there are embodiment_id"),
    ({"state": None, "embodiment_id": None}, InputError, "no state, embodiment_id"),
    (
        {"backbone_features": np.zeros((1, 296, 64), np.float32)},
        ShapeError,
        r"expects \(batch, T_vl, 128\)",
    ),
    ({"backbone_features": np.zeros((296, 128), np.float32)}, ShapeError, "backbone_features: shape"),
    ({"backbone_features": np.zeros((0, 296, 128), np.float32)}, InputError, "expected no empty axis"),
    ({"backbone_features": np.zeros((1, 296, 128), np.int64)}, InputError, "floating point"),
    ({"input_ids": None}, InputError, "neither input_ids nor image_mask; give the positions"),
    ({"input_ids": np.zeros((1, 295), np.int64)}, ShapeError, r"input_ids: shape .* expected \(1, 296\)"),
    ({"input_ids": np.zeros((1, 296))}, InputError, "input_ids: expected integers"),
    ({"image_mask": np.full((1, 296), 2)}, InputError, "image_mask: expected booleans"),
    ({"images": np.zeros((2, 32, 32, 3), np.uint8)}, ShapeError, r"images: shape .* \(1, 1, any, any, 3\)"),
    ({"images": np.zeros((1, 32, 32, 3), np.float32)}, InputError, "images: expected uint8"),
    ({"embodiment_id": np.array([0.5])}, InputError, "embodiment_id: expected an integer"),
    ({"noise": np.zeros((1, 16, 31), np.float32)}, ShapeError, r"noise: shape .* \(1, 16, 32\)"),
    ({"state": np.zeros((2, 64), np.float32)}, ShapeError, "state: shape"),
    ({"tokens": np.array(["x"] * 5)}, ShapeError, "tokens: shape"),
]


@pytest.mark.parametrize(("changed", "error", "message"), FILES)
def test_files_that_do_not_fit(
    tmp_path: Path, changed: dict[str, Any], error: type[Exception], message: str
) -> None:
    arrays = {name: array for name, array in (feature_arrays() | changed).items() if array is not None}
    with pytest.raises(error, match=message):
        taken(written(tmp_path / "f.npz", arrays))


def test_files_that_are_none(tmp_path: Path) -> None:
    for name, message in (("f.npz", r"cannot be read as \.npz"), ("f.safetensors", "cannot be read as")):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(InputError, match=message):
            taken(tmp_path / name)
    (tmp_path / "f.pt").touch()
    with pytest.raises(InputError, match=r"ends in \.npz or \.safetensors"):
        taken(tmp_path / "f.pt")
    with pytest.raises(FileNotFoundError, match="no such file"):
        taken(tmp_path / "missing.npz")
