"""What is not known is refused by name, wherever it stands in the files of a random robot."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from saccade import Normalizer, SaccadeError
from tests.helpers import oracle_n15, random_lerobot, random_n15, random_processor
from tests.processor import test_random_processor
from tests.robots import test_random_lerobot, test_random_n15

#: Names of the statistics that are used, by kind and key.
Used: TypeAlias = "dict[tuple[str, str], tuple[str, ...]]"
Robot: TypeAlias = "random_n15.Robot | random_processor.Robot | random_lerobot.Robot"

VALUES = st.sampled_from([True, 1, 0.5, "min_max", ["arm"], {"enabled": True}])
NOTHING: st.SearchStrategy[Any] = st.sampled_from([None, False, "", [], {}])
NAMES = st.from_regex(r"\A[a-z]{3,9}_of_a_fork\Z")
NOT_FINITE = st.sampled_from([float("nan"), float("inf"), float("-inf")])


def load(robot: Robot) -> Normalizer:
    if isinstance(robot, random_n15.Robot):
        return test_random_n15.load(robot)
    if isinstance(robot, random_processor.Robot):
        return test_random_processor.load(robot)
    return test_random_lerobot.load(robot)


def mappings(robot: Robot) -> list[dict[str, Any]]:
    """Every mapping in the files of a robot in which an unknown key could change what is computed."""
    if isinstance(robot, random_n15.Robot):
        keys = [name.split(".") for name in robot.config["state_keys"] + robot.config["action_keys"]]
        return [robot.config, *(robot.entry["modalities"][kind][key] for kind, key in keys)]
    if isinstance(robot, random_processor.Robot):
        found = [robot.kwargs]
        for about in robot.kwargs["modality_configs"].values():
            found += [about, *about.values(), *(about["action"].get("action_configs") or [])]
        return found
    steps = robot.before + robot.after
    found = [robot.config, *steps, *(step["config"] for step in steps)]
    for step in steps:
        if about := step["config"].get("modality_config"):
            found += [about, *about.values(), *about["action"]["action_configs"]]
    return found


def all_robots() -> st.SearchStrategy[Robot]:
    return st.one_of(random_n15.robots(), random_processor.robots(), random_lerobot.robots())


@given(all_robots(), NAMES, VALUES, NOTHING, st.randoms(use_true_random=False))
@settings(max_examples=150)
def test_an_unknown_key_is_refused_unless_it_says_nothing(
    robot: Robot, name: str, value: Any, nothing: Any, random: Any
) -> None:
    assume(robot.oracle.refused() is None)
    robot = copy.deepcopy(robot)
    where = random.choice(mappings(robot))
    where[name] = nothing
    load(robot)
    where[name] = value
    with pytest.raises(SaccadeError, match=name):
        load(robot)


@given(
    random_lerobot.robots(),
    NAMES,
    st.sampled_from(["registry_name", "class"]),
    st.randoms(use_true_random=False),
)
@settings(max_examples=40)
def test_an_unknown_step_is_refused(robot: random_lerobot.Robot, name: str, kind: str, random: Any) -> None:
    assume(robot.oracle.refused() is None)
    robot = copy.deepcopy(robot)
    steps = random.choice([robot.before, robot.after])
    steps.insert(random.randint(0, len(steps)), {kind: f"steps.{name}", "config": {}})
    with pytest.raises(SaccadeError, match=name):
        load(robot)


def enums(robot: Robot) -> list[tuple[dict[str, Any], str]]:
    """The mapping and the key of each value of a robot's files that must be on a list."""
    if isinstance(robot, random_n15.Robot):
        config, found = robot.config, []
        for kind in ("state", "action"):
            found += [(config[f"{kind}_modes"], key) for key in config[f"{kind}_keys"]]
        for name in config["target_rotations"]:
            kind, key = name.split(".")
            found.append((config["target_rotations"], name))
            found.append((robot.entry["modalities"][kind][key], "rotation_type"))
        return found
    if isinstance(robot, random_processor.Robot):
        configs = robot.modality("action").get("action_configs") or []
    else:
        about = robot.after[0]["config"].get("modality_config") or {"action": {}}
        configs = about["action"].get("action_configs") or []
    return [(config, name) for config in configs for name in ("rep", "type", "format")]


@given(all_robots(), NAMES, st.randoms(use_true_random=False))
@settings(max_examples=100)
def test_a_value_that_is_on_no_list_is_refused(robot: Robot, value: str, random: Any) -> None:
    assume(robot.oracle.refused() is None)
    robot = copy.deepcopy(robot)
    places = enums(robot)
    assume(places)
    where, key = random.choice(places)
    where[key] = value
    with pytest.raises(SaccadeError, match=value):
        load(robot)


def read(robot: Robot) -> dict[tuple[str, str, str], bool]:
    """Whether the statistic (kind, key, name) of a robot is used. Of lerobot's groups, only the first."""
    names = ("min", "max", "mean", "std", "q01", "q99")
    used: Used
    if isinstance(robot, random_n15.Robot):
        keys = [*robot.oracle.states, *robot.oracle.actions_]
        used = {
            (key.kind, key.key): oracle_n15.STATISTICS.get(key.mode or "", ()) if not key.converted else ()
            for key in keys
        }
    elif isinstance(robot, random_processor.Robot):
        used = processor_statistics(robot)
    else:
        used = lerobot_statistics(robot)
    return {(*where, name): name in found for where, found in used.items() for name in names}


def processor_statistics(robot: random_processor.Robot) -> Used:
    oracle = robot.oracle
    used: Used = {}
    for kind, keys in (("state", oracle.state_keys), ("action", oracle.action_keys)):
        for key in keys:
            bounds = ("q01", "q99") if oracle.option("use_percentiles") else ("min", "max")
            found: tuple[str, ...] = (
                ("mean", "std") if oracle.in_list(kind, "mean_std_embedding_keys", key) else bounds
            )
            if kind == "state" and (oracle.encoded(key) or oracle.option("exclude_state")):
                found = ()
            if kind == "action" and key in robot.statistics[robot.tag]["relative_action"]:
                relative = found if found == ("mean", "std") else ("min", "max")
                used["relative_action", key] = relative if oracle.converted(key) else ()
                found = () if oracle.converted(key) else found
            used[kind, key] = found
    return used


def lerobot_statistics(robot: random_lerobot.Robot) -> Used:
    oracle = robot.oracle
    used: Used = {}
    scales = oracle.release == "n1.5" or oracle.pack["normalize_min_max"]
    used["observation", "state"] = ("min", "max") if scales else ()
    if oracle.native is None:
        step = oracle.after[oracle.unpack_name]
        used["", "action"] = ("min", "max") if oracle.release == "n1.5" or step["normalize_min_max"] else ()
        return used
    key = next(iter(oracle.groups("action")))
    bounds = ("q01", "q99") if oracle.native["use_percentiles"] else ("min", "max")
    relative = oracle.is_relative(key)
    used["action", key] = () if relative else bounds
    if key in oracle.native["raw_stats"]["relative_action"]:
        used["relative_action", key] = ("min", "max") if relative else ()
    return used


def rows(robot: Robot, kind: str, key: str, name: str) -> Any:
    """The list or array of a statistic; None where the file has none."""
    if isinstance(robot, random_n15.Robot):
        return robot.entry["statistics"][kind][key][name]
    if isinstance(robot, random_processor.Robot):
        return robot.statistics[robot.tag][kind][key][name]
    if kind in ("observation", ""):
        step = robot.oracle.pack_name if kind else robot.oracle.unpack_name
        return robot.states.get(step, {}).get(f"{kind}.{key}.{name}".removeprefix("."))
    return robot.after[0]["config"]["raw_stats"][kind][key][name]


def numbers(robot: Robot) -> list[Any]:
    state, chunk = robot.state(), robot.chunk()
    normalizer = load(robot)
    return [normalizer.state(state), normalizer.actions(chunk, state)]


@given(all_robots(), NOT_FINITE, st.randoms(use_true_random=False))
@settings(max_examples=150)
def test_what_is_not_finite_is_refused_where_it_is_used(robot: Robot, value: float, random: Any) -> None:
    assume(robot.oracle.refused() is None)
    robot = copy.deepcopy(robot)
    expected, used = numbers(robot), read(robot)
    where = random.choice(sorted(used))
    row = rows(robot, *where)
    assume(row is not None)
    (row if np.ndim(row) == 1 else row[0])[0] = value
    if used[where]:
        with pytest.raises(SaccadeError, match=where[1]):
            load(robot)
        return
    for one, other in zip(expected, numbers(robot), strict=True):
        np.testing.assert_array_equal(one, other)


@given(random_lerobot.robots())
@settings(max_examples=10)
def test_a_state_file_that_is_missing_is_an_error(robot: random_lerobot.Robot) -> None:
    assume(robot.states)
    with tempfile.TemporaryDirectory() as folder:
        robot.save(Path(folder))
        for file in Path(folder).glob("*.safetensors"):
            file.unlink()
        with pytest.raises((SaccadeError, FileNotFoundError), match="safetensors"):
            Normalizer.from_pretrained(folder)
