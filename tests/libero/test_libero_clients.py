"""Observations of lerobot's and Isaac-GR00T's clients, bit for bit: pixels, state, words.

`make test-libero` records them in an environment of its own (`released_clients.py`), where hf-libero is
installed, and runs this file in the environment of the extra. `SACCADE_LIBERO_CLIENTS` names the recording.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.state import isaac_state
from tests.libero.released_clients import (
    EPISODES,
    FIRST_SEED,
    ISAAC_N15,
    ISAAC_N17,
    LEROBOT,
    N17_SEED,
    RECORDED,
    actions,
)

#: A unit in the last place: torch's arc cosine and NumPy's differ by that.
LAST_PLACE = 4.8e-7


@pytest.fixture(scope="module")
def recording() -> dict[str, npt.NDArray[np.generic]]:
    with np.load(os.environ["SACCADE_LIBERO_CLIENTS"]) as file:
        return dict(file)


def observed(environment: LiberoEnvironment) -> Iterator[dict[str, object]]:
    """What the program beside this file records after a start."""
    yield environment.observe() | {"exact": isaac_state(environment.proprioception())}
    for number, action in enumerate(actions()):
        environment.advance(action)
        if number in RECORDED:
            yield environment.observe() | {"exact": isaac_state(environment.proprioception())}


def compare(
    recording: dict[str, npt.NDArray[np.generic]], case: str, number: int, ours: dict[str, object]
) -> None:
    """Compares one observation."""
    theirs = {key: recording[f"{case} {number} {key}"] for key in ("image", "wrist_image", "state", "words")}
    for name, image in ours["images"].items():  # type: ignore[attr-defined]
        np.testing.assert_array_equal(image, theirs[name], f"{case} {number} {name}")
    assert ours["instruction"] == str(theirs["words"])
    state = np.asarray(theirs["state"])
    if state.dtype == np.float32:
        np.testing.assert_allclose(np.asarray(ours["state"]), state, rtol=0, atol=LAST_PLACE)
    else:
        np.testing.assert_array_equal(ours["exact"], state)
        np.testing.assert_array_equal(ours["state"], state.astype(np.float32))


@pytest.mark.parametrize(("suite", "task"), LEROBOT)
def test_lerobot(recording: dict[str, npt.NDArray[np.generic]], suite: str, task: int) -> None:
    with contextlib.closing(LiberoEnvironment(suite, task, state_of="lerobot")) as environment:
        number = 0
        for episode in range(EPISODES):
            environment.restart(episode, FIRST_SEED + episode, loads=2 + episode)
            for ours in observed(environment):
                compare(recording, f"lerobot {suite} {task}", number, ours)
                number += 1
    assert number == EPISODES * (1 + len(RECORDED))


def test_isaac_n15(recording: dict[str, npt.NDArray[np.generic]]) -> None:
    suite, task = ISAAC_N15
    with contextlib.closing(LiberoEnvironment(suite, task)) as environment:
        number = 3
        # The second episode first: it depends on the number of resets, and not on what was done before.
        for episode in (1, 0):
            environment.restart(episode, 0, resets=1 + episode)
            for ours in observed(environment):
                compare(recording, f"isaac-n15 {suite} {task}", number, ours)
                number += 1
            number = 0


@pytest.mark.parametrize(("suite", "task"), ISAAC_N17)
def test_isaac_n17(recording: dict[str, npt.NDArray[np.generic]], suite: str, task: int) -> None:
    options = {"official_states": False, "settle_steps": 0}
    with contextlib.closing(LiberoEnvironment(suite, task, **options)) as environment:  # type: ignore[arg-type]
        number = 0
        for episode in range(EPISODES):
            environment.restart(None, None if episode else N17_SEED)  # the second goes on
            for ours in observed(environment):
                compare(recording, f"isaac-n17 {suite} {task}", number, ours)
                number += 1
