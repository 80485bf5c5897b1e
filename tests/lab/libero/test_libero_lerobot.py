"""Checkpoints that lerobot saved, and the embodiment that it knows: as its groot policy (7427f31) acts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.errors import CheckpointError, InputError
from saccade.robots.libero import is_isaac_libero
from saccade_lab.libero.execution import execute_steps, lerobot_steps
from saccade_lab.libero.gripper import gripper_rule
from saccade_lab.libero.policy import LiberoPolicy
from saccade_lab.libero.protocols import PROTOCOLS
from tests.helpers.libero_runs import checkpoint, whole

LEROBOT = PROTOCOLS["lerobot"]


def with_robot(version: str, **robot: Any) -> saccade.Policy:
    """The small policy of another robot."""
    given = whole(version)
    return saccade.Policy(
        given.head,
        replace(given.normalizer, **robot),
        backbone=given.backbone,
        processor=given.processor,
        requirements=given.requirements,
    )


def saved_by_lerobot(low: float, high: float, gripper: int | None, **robot: Any) -> saccade.Policy:
    """The small N1.7 as if lerobot had saved it, with bounds of its gripper and what its config says."""
    groups = tuple(
        replace(group, mode="min_max", first=np.array([low]), second=np.array([high]))
        if group.key == "gripper"
        else group
        for group in whole("n1.7").normalizer.action_groups
    )
    # The chunk's length and the gripper's number were read from the pipeline before.
    pipeline = SimpleNamespace(is_n17=True)
    return with_robot("n1.7", action_groups=groups, pipeline=pipeline, gripper=gripper, **robot)


def write_config(folder: Path, **config: Any) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"type": "groot", **config}))
    return folder


def write_base(folder: Path, steps: Any, tag: str = "libero_sim") -> str:
    """The checkpoint that a policy was made from."""
    folder.mkdir()
    about = {"modality_configs": {tag: {"action": {"delta_indices": steps}}}}
    (folder / "processor_config.json").write_text(json.dumps({"processor_kwargs": about}))
    return str(folder)


@pytest.mark.parametrize("version", ["n1.5", "n1.6", "n1.7"])
def test_only_n17_has_the_rule_of_the_embodiment(version: str) -> None:
    policy = with_robot(version, embodiment="libero_sim")
    is_one = version == "n1.7"
    assert is_isaac_libero(policy.normalizer, version) is is_one
    rule = gripper_rule(policy, LEROBOT, by_statistics=False)
    assert rule.rule == ("-sign(2 g - 1)" if is_one else "as given")
    steps, reason = execute_steps(policy, checkpoint(version), LEROBOT)
    assert steps == (8 if is_one else 16)
    assert ("libero_sim" in reason) is is_one
    if not is_one:
        with pytest.raises(InputError, match="its program does not load"):
            LiberoPolicy(policy, checkpoint(version), "lerobot")


@pytest.mark.parametrize(("gripper", "rule"), [(6, "-sign(2 g - 1)"), (None, "as given")])
def test_the_config_decides_about_the_gripper(gripper: int | None, rule: str) -> None:
    """`action_decode_transform: none` is off whatever the statistics are."""
    fitting: tuple[float, float]
    other: tuple[float, float]
    fitting, other = ((0, 1), (-1, 1)) if gripper is not None else ((-1, 1), (0, 1))
    for by_statistics in (True, False):
        for bounds in (fitting, (-0.3, 0.7)):  # others do not say anything
            found = gripper_rule(
                saved_by_lerobot(bounds[0], bounds[1], gripper), LEROBOT, by_statistics=by_statistics
            )
            assert found.rule == "as given"  # it is done already
            assert (
                found.reason == f"lerobot's steps in the checkpoint did it, {rule}, as its config.json says"
            )
    against = saved_by_lerobot(*other, gripper)
    with pytest.raises(InputError, match=r"--protocol auto: the gripper is .*pass --protocol lerobot to do"):
        gripper_rule(against, LEROBOT, by_statistics=True)
    found = gripper_rule(against, LEROBOT, by_statistics=False)
    assert found.rule == "as given"
    assert f"statistics from {other[0]} to {other[1]} say" in found.reason


def test_statistics_decide_for_known_embodiments_only() -> None:
    policy = with_robot("n1.7", embodiment="new_embodiment")
    with pytest.raises(
        InputError, match=r"libero_sim of n1\.7, got new_embodiment: pass --protocol isaac-n17"
    ):
        gripper_rule(policy, PROTOCOLS["isaac-n17"], by_statistics=True)
    for version in ("n1.5", "n1.6", "n1.7"):
        found = gripper_rule(whole(version), PROTOCOLS["isaac-n17"], by_statistics=True)
        assert found.rule == "-sign(2 g - 1)"


@pytest.mark.parametrize(
    ("said", "tag", "horizon", "expected"),
    [
        (16, "libero_sim", 16, 8),
        (40, "libero_sim", 16, 8),
        (5, "libero_sim", 16, 5),
        (16, "libero_sim", 6, 6),
        (16, "new_embodiment", 16, 16),
        (40, "new_embodiment", 12, 12),
        (50, "new_embodiment", 45, 40),  # N1.5's default is replaced
        (None, "libero_sim", 16, 8),
        (16, "libero_sim", 0, 16),  # the folder has no horizon
    ],
)
def test_lerobot_executes_the_least(
    said: int | None, tag: str, horizon: int, expected: int, tmp_path: Path
) -> None:
    base = write_base(tmp_path / "base", list(range(horizon)), tag)
    config: dict[str, Any] = {"base_model_path": base, "embodiment_tag": tag}
    if said is not None:
        config["n_action_steps"] = said
    steps, reason = lerobot_steps(write_config(tmp_path / "policy", **config))
    assert steps == expected
    assert (f"horizon {horizon}" in reason) is (horizon > 0)


def test_a_hub_id_limits_nothing(tmp_path: Path) -> None:
    """lerobot looks for `processor_config.json` under the id as if it were a folder, and finds none."""
    for base in ("nvidia/GR00T-N1.7-3B", None):
        folder = write_config(
            tmp_path / "policy", base_model_path=base, embodiment_tag="libero_sim", n_action_steps=16
        )
        assert lerobot_steps(folder)[0] == 16


@pytest.mark.parametrize("base", ["/nowhere/GR00T-N1.7", "outputs/train/base", "~/nowhere", "./nowhere/base"])
def test_a_folder_that_is_not_there_is_refused(base: str, tmp_path: Path) -> None:
    folder = write_config(
        tmp_path / "policy", base_model_path=base, embodiment_tag="libero_sim", n_action_steps=16
    )
    with pytest.raises(
        InputError, match=r"base_model_path: .* is not on this machine.*n_action_steps \(16\)"
    ):
        lerobot_steps(folder)
    write_config(folder, base_model_path=base, n_action_steps=1)
    assert lerobot_steps(folder)[0] == 1  # whatever is in it


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"n_action_steps": 0}, "n_action_steps: expected a number from 1 on, got 0"),
        ({"n_action_steps": "8"}, "n_action_steps: expected a number from 1 on, got '8'"),
        ({"chunk_size": True}, "chunk_size: expected a number from 1 on, got True"),
        ({"chunk_size": 8, "n_action_steps": 16}, "at most chunk_size, 8, as lerobot does, got 16"),
        ({"base_model_path": 3}, "base_model_path: expected a path or an id, got 3"),
    ],
)
def test_damaged_numbers_are_refused(config: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=message):
        lerobot_steps(write_config(tmp_path / "policy", **config))


def test_policies_that_lerobot_does_not_execute_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="use_relative_actions: lerobot-eval refuses such policies"):
        lerobot_steps(write_config(tmp_path / "policy", use_relative_actions=True, n_action_steps=1))
    assert lerobot_steps(write_config(tmp_path / "policy", use_relative_actions=False))[0] == 40


def test_a_chunk_bounds_what_is_executed(tmp_path: Path) -> None:
    folder = write_config(tmp_path / "policy", n_action_steps=30)
    policy = saved_by_lerobot(-1, 1, None, trained_horizon=4)
    steps, reason = execute_steps(policy, folder, LEROBOT)
    assert steps == 16  # a chunk has no more
    assert reason.endswith("; only 4 were trained")
    assert execute_steps(policy, write_config(folder, n_action_steps=3), LEROBOT)[0] == 3
