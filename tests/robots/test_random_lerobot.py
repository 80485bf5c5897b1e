"""Random robots of lerobot's groot policy against an oracle written from a description of its code."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path

import pytest
from hypothesis import assume, given, settings

from saccade import Normalizer, SaccadeError
from tests.helpers import random_lerobot
from tests.helpers.random_robots import assert_close, assert_form


def load(robot: random_lerobot.Robot) -> Normalizer:
    with tempfile.TemporaryDirectory() as folder:
        return Normalizer.from_pretrained(robot.save(Path(folder)))


def check(robot: random_lerobot.Robot) -> None:
    normalizer, oracle = load(robot), robot.oracle
    assert_form(normalizer, oracle)
    state, chunk = robot.state(), robot.chunk()
    assert_close(normalizer.state(state), oracle.state(state))
    assert_close(normalizer.actions(chunk, state), oracle.actions(chunk, state))


@given(random_lerobot.robots() | random_lerobot.damaged())
@settings(max_examples=200)
def test_robots_are_converted_or_refused_as_the_oracle_does(robot: random_lerobot.Robot) -> None:
    if robot.oracle.refused() is None:
        check(robot)
        return
    with pytest.raises(SaccadeError):
        load(robot)


@given(random_lerobot.robots())
@settings(max_examples=20)
def test_actions_that_lerobot_does_not_decode_are_refused(robot: random_lerobot.Robot) -> None:
    """With null in place of a list, its decode step returns the head's actions unchanged."""
    assume(robot.oracle.native is not None)
    robot = copy.deepcopy(robot)
    robot.after[0]["config"]["modality_config"]["action"]["action_configs"] = None
    with pytest.raises(SaccadeError, match="action_configs"):
        load(robot)
