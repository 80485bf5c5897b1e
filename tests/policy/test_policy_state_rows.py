"""Whole policies whose observations have several states, with the robots of tests/data/robots."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

import saccade
from saccade.checkpoints import describe
from saccade.checkpoints.whole import robots_of
from saccade_lab import random_checkpoint
from saccade_lab.reference import ActionHead as Reference
from tests.helpers import paths
from tests.helpers.policy_cases import inputs_of
from tests.helpers.reference_cases import relative_error
from tests.helpers.tensor_files import read_tensor_file

ROBOTS = paths.DATA / "robots"
N15, N16 = ROBOTS / "n15" / "13-history", ROBOTS / "n16_n17" / "14-n16-history"

Arrays = dict[str, npt.NDArray[Any]]


def edit(file: Path, **values: Any) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def written(folder: Path, version: str) -> Path:
    """A random checkpoint with the robot of a case."""
    random_checkpoint.write(
        folder,
        version,
        backbone=random_checkpoint.small_backbone(version),
        head=random_checkpoint.small_head(version),
        head_dtype="F32",
    )
    if version == "n1.5":
        robots = json.loads((N15 / "experiment_cfg" / "metadata.json").read_text())
        (robot,) = robots.values()
        robot["modalities"]["video"]["wrist"] = robot["modalities"]["video"]["front"]
        (folder / "experiment_cfg" / "metadata.json").write_text(json.dumps(robots))
        return folder
    for name in ("embodiment_id.json", "statistics.json"):
        shutil.copy(N16 / name, folder)
    theirs = json.loads((N16 / "processor_config.json").read_text())["processor_kwargs"]
    mine = json.loads((folder / "processor_config.json").read_text())["processor_kwargs"]
    of_images = ("crop_fraction", "shortest_image_edge", "use_albumentations")
    kwargs = {name: value for name, value in theirs.items() if not name.startswith("image_")}
    kwargs |= {name: mine[name] for name in of_images}
    edit(folder / "processor_config.json", processor_kwargs=kwargs)
    return folder


def data_config(*cameras: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((N15 / "data_config.json").read_text())
    return found | {"video_keys": [f"video.{name}" for name in cameras]}


@functools.cache
def tensors_of(case: Path) -> Arrays:
    return read_tensor_file(case / "case.safetensors")[1]


def observation(policy: saccade.Policy, case: Path) -> dict[str, Any]:
    """The case's states, with frames."""
    keys = [key for key, _ in policy.requirements.state]
    state = {key: tensors_of(case)[f"state.{key}"] for key in keys}
    batch = len(next(iter(state.values())))
    rng = np.random.default_rng(0)
    horizon = policy.requirements.video_horizon or 1
    assert policy.requirements.cameras is not None
    video = {
        camera.name: rng.integers(0, 256, (batch, horizon, 48, 64, 3), np.uint8)
        for camera in policy.requirements.cameras
    }
    language = {key: [["push the red block"]] * batch for key in policy.requirements.language_keys}
    return {"video": video, "state": state, "language": language}


def check(policy: saccade.Policy, folder: Path, case: Path) -> None:
    """That a policy acts as the head in torch does on the case's normalised states."""
    given, head = observation(policy, case), policy.head.config
    states = tensors_of(case)["head.state"]
    assert policy.requirements.state_history == head.num_states == states.shape[1]
    shape = (len(states), head.action_horizon, head.encoder_action_dim)
    noise = np.random.default_rng(1).standard_normal(shape, np.float32)
    actions = policy.act(given, noise=noise)
    reference = Reference.from_pretrained(folder, config=edited(folder, head), num_states=head.num_states)
    raw = np.concatenate([given["state"][group.key] for group in policy.normalizer.state_groups], axis=-1)
    for row, features in enumerate(policy.encode(given).features):
        chosen = slice(row, row + 1)
        masks = {"image_mask": features.image_mask} if head.mask_mode == "alternate" else {}
        with torch.no_grad():
            found = reference.double()(
                np.asarray(features.backbone_features),
                states[chosen],
                policy.embodiment_id,
                noise=noise[chosen],
                **masks,
            )
        robot = np.asarray(policy.normalizer.actions(found.float().numpy(), raw[chosen]))
        for key, where in policy.normalizer.action_slices.items():
            assert relative_error(actions[key][chosen], robot[..., where]) <= 1e-5


def edited(folder: Path, head: saccade.HeadConfig) -> dict[str, Any]:
    """The config of the checkpoint with the chunk of this head."""
    config: dict[str, Any] = describe(folder).head_config
    return config | {"action_horizon": head.action_horizon}


@pytest.fixture(scope="module")
def n15(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("n15"), "n1.5")


@pytest.fixture(scope="module")
def n16(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("n16"), "n1.6")


def test_n15_with_two_observations(n15: Path) -> None:
    policy = saccade.Policy.from_pretrained(n15, data_config=data_config("front", "wrist"))
    assert "with 2 states each" in str(policy.requirements)
    assert "with 2 frames each" in str(policy.requirements)
    assert policy.head.config.action_horizon == 8
    check(policy, n15, N15)


def test_frames_are_ordered_by_time_before_camera(n15: Path) -> None:
    policy = saccade.Policy.from_pretrained(n15, data_config=data_config("wrist", "front"))
    given = observation(policy, N15)
    assert policy.processor is not None
    for row, inputs in enumerate(inputs_of(policy, given)):
        assert inputs.view_names == ("wrist[0]", "front[0]", "wrist[1]", "front[1]")
        frames = [given["video"][name][row, time] for time in (0, 1) for name in ("wrist", "front")]
        expected = policy.processor(frames, "push the red block")
        assert np.array_equal(np.asarray(inputs.pixel_values), np.asarray(expected.pixel_values))
        assert np.array_equal(inputs.input_ids, expected.input_ids)


def test_n16_with_three_states(n16: Path) -> None:
    policy = saccade.Policy.from_pretrained(n16, embodiment="gr1")
    assert "with 3 states each" in str(policy.requirements)
    check(policy, n16, N16)
    one = saccade.Policy.from_pretrained(n16, embodiment="new_embodiment")
    assert (one.requirements.state_history, one.head.config.num_states) == (1, 1)
    one.act(one.example_observation(), seed=0)


def test_examples_samples_and_wrong_numbers_of_states(n16: Path) -> None:
    policy = saccade.Policy.from_pretrained(n16, embodiment="gr1")
    example = policy.example_observation()
    assert example["state"]["arm"].shape == (1, 3, 7)
    chunk = policy.act(example, seed=0)
    options = {"overlap": 6, "frozen": 2}
    again = policy.act(example, seed=1, previous_chunk=chunk, chunking=saccade.Chunking(**options))
    assert again["arm"].shape == (1, 16, 7)
    short = example | {"state": {key: part[:, 1:] for key, part in example["state"].items()}}
    with pytest.raises(
        saccade.ShapeError, match=r"state\.arm: expected 3 along the time axis, .*3 states each"
    ):
        policy.act(short)


def test_a_head_of_another_number_of_states_is_refused(n15: Path, n16: Path) -> None:
    normalizer = saccade.Normalizer.from_pretrained(n15, data_config=data_config("front"))
    head = saccade.ActionHead.from_pretrained(n15, action_horizon=8)
    with pytest.raises(
        saccade.InputError, match=r"expected 1 states .*got 2: load the head with num_states=2"
    ):
        saccade.Policy(head, normalizer)
    policy = saccade.Policy(
        saccade.ActionHead.from_pretrained(n15, action_horizon=8, num_states=2), normalizer
    )
    features = np.zeros((2, 9, head.config.context_dim), np.float32)
    case = tensors_of(N15)
    state = np.concatenate([case["state.arm"], case["state.hand"]], axis=-1)
    assert policy(features, state, seed=0).shape == (2, 8, 7)


def test_inspect_says_how_many_states(n15: Path, n16: Path) -> None:
    (robot,) = robots_of(n15, 1, data_config("front"))
    assert robot.needs is not None
    assert robot.needs.state_history == 2
    needs = {robot.embodiment: robot.needs for robot in robots_of(n16, 1)}
    assert [one.state_history for one in needs.values() if one is not None] == [3, 1]
