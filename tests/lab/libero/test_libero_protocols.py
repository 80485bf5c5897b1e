"""The table of protocols. Its numbers were read in the released programs."""

from __future__ import annotations

import pytest

from saccade.errors import InputError
from saccade_lab.libero.protocols import PROTOCOLS, choose_protocol, described
from saccade_lab.libero.suites import SUITES

#: Control steps by suite, as `TASK_SUITE_MAX_STEPS` of lerobot, `run_libero_eval.py` of Isaac-GR00T N1.5
#: (with robosuite's limit of 1000 steps, 10 of them settling) and the README of N1.6 have them.
LIMITS = {
    "lerobot": {"spatial": 280, "object": 280, "goal": 300, "10": 520, "90": 400},
    "isaac-n15": {"spatial": 220, "object": 280, "goal": 600, "10": 990, "90": 400},
    "isaac-n17": {"spatial": 720, "object": 720, "goal": 720, "10": 720, "90": 720},
}


@pytest.mark.parametrize("name", PROTOCOLS)
def test_an_episode_has_the_programs_limit(name: str) -> None:
    found = {suite: PROTOCOLS[name].limit(f"libero_{suite}") for suite in LIMITS[name]}
    assert found == LIMITS[name]


def test_a_perturbed_suite_has_the_limit_of_its_base() -> None:
    assert PROTOCOLS["lerobot"].limit("libero_10_swap") == 520
    assert PROTOCOLS["isaac-n15"].limit("libero_goal_lan") == 600
    with pytest.raises(InputError, match="libero_kitchen"):
        PROTOCOLS["isaac-n17"].limit("libero_kitchen")


def test_a_trial_has_the_programs_seed() -> None:
    assert [PROTOCOLS["lerobot"].seed(trial) for trial in (0, 1, 49)] == [1000, 1001, 1049]
    assert [PROTOCOLS["isaac-n15"].seed(trial) for trial in (0, 1, 49)] == [0, 0, 0]
    assert len({PROTOCOLS["isaac-n17"].seed(trial) for trial in range(50)}) == 50


#: What each released program loads: version, and whether lerobot saved it.
LOADED = {
    "lerobot": {("n1.7", False), ("n1.7", True)},
    "isaac-n17": {("n1.6", False), ("n1.7", False)},
    "isaac-n15": {("n1.5", False)},
}
KINDS = [(version, saved) for version in ("n1", "n1.5", "n1.6", "n1.7") for saved in (False, True)]


@pytest.mark.parametrize(
    ("version", "from_lerobot", "expected"),
    [
        ("n1.5", False, "isaac-n15"),
        ("n1.6", False, "isaac-n17"),
        ("n1.7", False, "isaac-n17"),
        ("n1.7", True, "lerobot"),
    ],
)
def test_auto_follows_the_checkpoint(version: str, from_lerobot: bool, expected: str) -> None:
    protocol, reason = choose_protocol("auto", version, from_lerobot=from_lerobot)
    assert protocol.name == expected
    assert ("lerobot" if from_lerobot else version) in reason


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize(("version", "from_lerobot"), KINDS)
def test_a_protocol_is_for_what_its_program_loads(name: str, version: str, from_lerobot: bool) -> None:
    if (version, from_lerobot) in LOADED[name]:
        found = choose_protocol(name, version, from_lerobot=from_lerobot)
        assert found == (PROTOCOLS[name], "as given")
    else:
        with pytest.raises(InputError, match=f"--protocol {name}: .* checkpoints of {version} "):
            choose_protocol(name, version, from_lerobot=from_lerobot)


def test_what_is_not_known_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="auto: no protocol is known for checkpoints of n1 in Isaac"):
        choose_protocol("auto", "n1", from_lerobot=False)
    with pytest.raises(InputError, match="unknown name 'openpi', expected one of auto, lerobot, isaac-n17"):
        choose_protocol("openpi", "n1.5", from_lerobot=False)
    with pytest.raises(InputError, match=r"n1\.5 in Isaac-GR00T's layout: expected one of auto, isaac-n15$"):
        choose_protocol("lerobot", "n1.5", from_lerobot=False)
    for name in ("auto", *PROTOCOLS):
        with pytest.raises(InputError, match=r"n1.5 that lerobot saved: lerobot 0.6.2 does not load N1.5"):
            choose_protocol(name, "n1.5", from_lerobot=True)


def test_lerobots_limits_are_those_of_its_suites() -> None:
    found = {name: PROTOCOLS["lerobot"].limit(name) for name in SUITES}
    assert found == {name: suite.max_steps for name, suite in SUITES.items()}


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_is_told_in_words(name: str) -> None:
    record = {
        **PROTOCOLS[name].record(["libero_object", "libero_goal"]),
        "chosen": "as given",
        "execute_steps": 3,
        "execute_steps_reason": "why",
        "denoising_steps": 4,
        "gripper": {"rule": "as given", "reason": "because"},
        "cameras": {"image": "image", "wrist_image": "image2"},
    }
    told = described(record)
    assert told["protocol"].startswith(f"{name}, as given: ")
    for suite in ("libero_object", "libero_goal"):
        assert f"{PROTOCOLS[name].limit(suite)} ({suite})" in told["steps"]
    assert ("official states" in told["start"]) is (name != "isaac-n17")
    assert "wrist_image as image2" in told["frames"]
    assert told["chunk"].startswith("3 actions executed (why), 4 denoising steps")
