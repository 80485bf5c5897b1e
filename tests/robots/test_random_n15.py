"""Random data configs of GR00T N1.5 against an oracle written from a description of the released code."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from saccade import Normalizer, SaccadeError
from tests.helpers import random_n15
from tests.helpers.random_robots import assert_close, assert_form


def load(robot: random_n15.Robot) -> Normalizer:
    with tempfile.TemporaryDirectory() as folder:
        return Normalizer.from_pretrained(robot.save(Path(folder)), robot.tag, data_config=robot.config)


def load_and_act(robot: random_n15.Robot) -> None:
    """An action with the mode "scale" is refused on the way back from the head, as the release does."""
    normalizer = load(robot)
    assert "scale" in robot.config["action_modes"].values()
    normalizer.actions(np.zeros((normalizer.action_horizon or 1, robot.action_dim), np.float32))


def check(robot: random_n15.Robot) -> None:
    normalizer, oracle = load(robot), robot.oracle
    assert_form(normalizer, oracle)
    assert normalizer.state_slices == oracle.slices("state")
    assert normalizer.action_slices == oracle.slices("action")
    state, chunk = robot.state(), robot.chunk()
    assert_close(normalizer.state(state), oracle.state(state))
    assert_close(normalizer.actions(chunk, state), oracle.actions(chunk))


@given(random_n15.robots())
@settings(max_examples=100)
def test_robots_are_converted_as_the_oracle_does(robot: random_n15.Robot) -> None:
    assert robot.oracle.refused() is None
    check(robot)


@given(random_n15.damaged())
@settings(max_examples=100)
def test_what_the_oracle_refuses_is_refused(robot: random_n15.Robot) -> None:
    if robot.oracle.refused() is None:
        check(robot)
        return
    with pytest.raises(SaccadeError):
        load_and_act(robot)
