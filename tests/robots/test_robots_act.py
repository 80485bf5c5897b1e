"""Robots of the released code, whole: their files with the weights of small random checkpoints act."""

from __future__ import annotations

import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade_lab import random_checkpoint
from tests.helpers import paths

DATA = paths.DATA / "robots"

#: Files that say what a robot is.
ABOUT = ("processor_config.json", "statistics.json", "embodiment_id.json", "experiment_cfg/metadata.json")
#: Heads that are another than the small checkpoint's: 48 actions, and two states in one row of N1.7.
OTHER_HEADS = ("14-wide", "05-n17-rotvec-history")


@functools.cache
def small(version: str) -> Path:
    """A small random checkpoint of published widths."""
    folder = Path(tempfile.mkdtemp(prefix=f"saccade-{version}-")) / "checkpoint"
    return random_checkpoint.write(
        folder,
        version,
        backbone=random_checkpoint.small_backbone(version),
        head=random_checkpoint.small_head(version),
    )


def with_robot(folder: Path, version: str, *sources: Path) -> Path:
    """A whole checkpoint with the robot's files of the given folders, the first that has one."""
    shutil.copytree(small(version), folder)
    for name in ABOUT:
        (folder / name).unlink(missing_ok=True)
        for at in (name, f"processor/{name}"):
            found = next((source / at for source in sources if (source / at).is_file()), None)
            if found is not None:
                (folder / at).parent.mkdir(exist_ok=True)
                shutil.copy(found, folder / at)
    return folder


def act(policy: saccade.Policy) -> dict[str, Any]:
    """A chunk of the example, which must be finite."""
    answer: dict[str, Any] = policy.act(policy.example_observation(), seed=0)
    for key, actions in answer.items():
        assert np.isfinite(actions).all(), key
    return answer


def cases() -> list[Any]:
    folders = [folder for kind in ("n15", "n16_n17") for folder in sorted((DATA / kind).iterdir())]
    return [
        pytest.param(folder, id=folder.name)
        for folder in folders
        if not json.loads((folder / "case.json").read_text()).get("refuses")
        and folder.name not in OTHER_HEADS
    ]


@pytest.mark.parametrize("folder", cases())
def test_every_released_robot_acts(folder: Path, tmp_path: Path) -> None:
    case = json.loads((folder / "case.json").read_text())
    version = "n1.5" if folder.parent.name == "n15" else case["release"].lower()
    config = case.get("data_config")
    if config is not None and config.endswith(".json"):
        config = folder / config
    whole = with_robot(tmp_path / "whole", version, folder)
    policy = saccade.Policy.from_pretrained(
        whole, embodiment=case["embodiment"], data_config=config, num_threads=1
    )
    assert policy.embodiment_id == case["embodiment_id"]
    horizon = case.get("action_horizon", case.get("horizon"))
    sizes = {key: actions.shape for key, actions in act(policy).items()}
    assert sizes == {key: (1, horizon, size) for key, size in case["expects"]["action"]}


@pytest.mark.parametrize("name", ["03-n17-so100-real", "02-n17-droid-real", "10-n16-g1"])
def test_frozen_actions_keep_their_values_where_each_step_has_its_own_statistics(
    name: str, tmp_path: Path
) -> None:
    """Also from another state: joints and poses that are relative to it stay where they are."""
    folder = DATA / "n16_n17" / name
    case = json.loads((folder / "case.json").read_text())
    whole = with_robot(tmp_path / "whole", case["release"].lower(), folder)
    policy = saccade.Policy.from_pretrained(whole, embodiment=case["embodiment"], num_threads=1)
    seen = policy.example_observation()
    context = policy.encode(seen)
    before = policy.sample(context, seen, seed=1)
    moved = {**seen, "state": {key: value + np.float32(0.01) for key, value in seen["state"].items()}}
    horizon = case["horizon"]
    chunking = saccade.Chunking(overlap=5, frozen=3)
    after = policy.sample(context, moved, seed=2, previous_chunk=before, chunking=chunking)
    for key, group in zip(before, policy.normalizer.action_groups, strict=True):
        kept, old = after[key][:, :3], before[key][:, horizon - 5 : horizon - 2]
        # What lies beyond the bounds of its new step is clipped, as everything that the head returns.
        normalised = policy.normalizer.previous_chunk(
            np.concatenate([part[:, horizon - 5 : horizon - 2] for part in before.values()], axis=-1),
            np.concatenate(list(moved["state"].values()), axis=-1),
        )
        where = policy.normalizer.action_slices[key]
        inside = (np.abs(np.asarray(normalised)[..., where]) <= 1).all(axis=-1) | (group.mode == "mean_std")
        assert inside.any() or group.reference is not None
        np.testing.assert_allclose(kept[inside], old[inside], atol=1e-3)
    short = {key: value[:, :4] for key, value in before.items()}
    with pytest.raises(saccade.ShapeError, match="previous_chunk: expected a chunk of at least"):
        policy.sample(context, seen, seed=2, previous_chunk=short, chunking=chunking)
    for wrong in ("x", 5, {**before, next(iter(before)): np.zeros((1, 3, 1), np.float32)}):
        with pytest.raises(saccade.SaccadeError, match="previous_chunk"):
            policy.sample(context, seen, seed=2, previous_chunk=wrong, chunking=chunking)


#: Published processors: their release, and whose statistics they have if none of their own.
PUBLISHED = {"n16_tests": ("n1.6", ()), "n17_tests": ("n1.7", ()), "main_tests": ("n1.7", ("n17_tests",))}


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_robot_of_the_published_processors_acts(name: str, tmp_path: Path) -> None:
    version, others = PUBLISHED[name]
    sources = [DATA / "published" / source for source in (name, *others)]
    whole = with_robot(tmp_path / "whole", version, *sources)
    tags = json.loads((whole / "statistics.json").read_text())
    assert tags
    for tag in tags:
        policy = saccade.Policy.from_pretrained(whole, embodiment=tag, num_threads=1)
        assert {actions.shape[1] for actions in act(policy).values()} == {16}
