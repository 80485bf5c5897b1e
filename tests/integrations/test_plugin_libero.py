"""The plugin's rules for LIBERO beside `saccade libero`, which is tested on what released programs do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import saccade
from saccade.errors import InputError
from saccade.robots.libero import EXECUTED_STEPS
from saccade_lab.libero.policy import LiberoPolicy
from tests.helpers.libero_runs import checkpoint, seen, whole
from tests.helpers.plugin_module import plugin_module

libero = plugin_module("libero")


def test_a_raw_checkpoint_acts_as_in_the_command() -> None:
    given = whole("n1.7")
    policy = libero.as_in_lerobot(given)
    command = LiberoPolicy(given, checkpoint("n1.7"), "lerobot")
    shown = seen(360)
    observation = command.observation(shown)
    # The environment of lerobot has another name for the wrist camera.
    observation["observation.images.image2"] = observation.pop("observation.images.wrist_image")
    actions = policy.act(observation, seed=4)
    assert np.array_equal(actions, command.act(shown, seed=4).actions)
    assert command.execute_steps == EXECUTED_STEPS
    with pytest.raises(InputError, match="wrist_image"):
        given.act(observation, seed=4)


@pytest.mark.parametrize("version", ["n1.5", "n1.6"])
def test_other_checkpoints_are_left_as_they_are(version: str) -> None:
    assert libero.as_in_lerobot(whole(version)) is whole(version)
    assert not libero.is_libero(whole(version))


def test_an_action_without_a_gripper_is_refused() -> None:
    given = whole("n1.7")
    groups = tuple(replace(group, key="hand") for group in given.normalizer.action_groups[-1:])
    normalizer = replace(given.normalizer, action_groups=groups)
    policy = saccade.Policy(given.head, normalizer, requirements=given.requirements)
    with pytest.raises(InputError, match=r"gripper of one number for libero_sim, got hand \(1\)"):
        libero.as_in_lerobot(policy)
