"""Random robots of GR00T N1.6 and N1.7 against an oracle written from a description of the released code."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings

from saccade import Normalizer, SaccadeError
from tests.helpers import random_processor
from tests.helpers.random_robots import assert_close, assert_form


def load(robot: random_processor.Robot) -> Normalizer:
    with tempfile.TemporaryDirectory() as folder:
        return Normalizer.from_pretrained(robot.save(Path(folder)), robot.name)


def check(robot: random_processor.Robot) -> None:
    normalizer, oracle = load(robot), robot.oracle
    assert_form(normalizer, oracle)
    assert normalizer.embodiment == robot.tag
    assert normalizer.state_slices == oracle.slices("state")
    assert normalizer.action_slices == oracle.slices("action")
    state, chunk = robot.state(), robot.chunk()
    assert_close(normalizer.state(state), oracle.state(state))
    assert_close(normalizer.actions(chunk, state), oracle.actions(chunk, state))


@given(random_processor.robots())
@settings(max_examples=100)
def test_robots_are_converted_as_the_oracle_does(robot: random_processor.Robot) -> None:
    assert robot.oracle.refused() is None
    check(robot)


@given(random_processor.damaged())
@settings(max_examples=100)
def test_what_the_oracle_refuses_is_refused(robot: random_processor.Robot) -> None:
    if robot.oracle.refused() is None:
        check(robot)
        return
    with pytest.raises(SaccadeError):
        load(robot)
