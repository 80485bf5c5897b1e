"""`saccade libero` in the simulator: the pinned command, processes, starts of the protocols."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saccade import cli
from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.protocols import PROTOCOLS
from saccade_lab.libero.starts import Starts
from saccade_lab.sim import environment_cache
from tests.helpers.libero_runs import checkpoint


def run(out: Path, version: str, *options: str) -> dict[str, Any]:
    """The results of the command."""
    assert cli.main(["libero", str(checkpoint(version)), "--out", str(out), *options]) == 0
    record: dict[str, Any] = json.loads((out / "results.json").read_text())
    return record


def test_the_pinned_command(tmp_path: Path) -> None:
    options = ("--suite", "libero_object", "--tasks", "0", "--trials", "2", "--protocol", "isaac-n17")
    record = run(tmp_path / "one", "n1.7", *options)
    assert [(one["suite"], one["task"], one["trial"]) for one in record["episodes"]] == [
        ("libero_object", 0, 0),
        ("libero_object", 0, 1),
    ]
    assert all(0 < one["steps"] <= 720 for one in record["episodes"])
    assert all(set(one) == {"suite", "task", "trial", "success", "steps"} for one in record["episodes"])
    assert record["packages"]["robosuite"] == "1.4.0"
    assert record["tasks"][0]["instruction"] == "pick up the alphabet soup and place it in the basket"
    pictures = [
        (tmp_path / "one" / "pictures" / f"libero_object-0-{trial}.png").read_bytes() for trial in (0, 1)
    ]
    assert pictures[0] != pictures[1]


def test_processes_give_the_same_episodes(tmp_path: Path) -> None:
    options = ("--suite", "libero_object", "--tasks", "7", "--trials", "2", "--protocol", "lerobot")
    alone = run(tmp_path / "alone", "n1.7", *options)
    several = run(tmp_path / "several", "n1.7", *options, "--jobs", "2")
    assert alone["episodes"] == several["episodes"]
    for trial in (0, 1):
        name = f"pictures/libero_object-7-{trial}.png"
        assert (tmp_path / "alone" / name).read_bytes() == (tmp_path / "several" / name).read_bytes()


def test_a_layout_without_room_counts_however_a_run_is_split() -> None:
    """The third load of the model after the seed has no room for all objects, and LIBERO draws again."""
    from robosuite.utils.errors import RandomizationError

    environment_cache.close()
    protocol = PROTOCOLS["isaac-n15"]
    environment = LiberoEnvironment("libero_spatial", 4, image_size=64, settle_steps=0)
    inner = environment.simulation.inner
    drawn, usual = len(inner.object_property_initializers), inner._reset_internal
    assert drawn > 0  # a drawer is open at the start, so that earlier loads change the layout
    failed = []

    def reset_internal() -> None:
        usual()
        if len(inner.object_property_initializers) == 3 * drawn:
            failed.append(drawn)
            raise RandomizationError("no room")

    inner._reset_internal = reset_internal
    try:
        starts = Starts(environment, protocol)
        in_order = []
        for trial in (0, 1, 2):
            starts.begin(trial)
            in_order.append(np.array(environment.simulation.model.body_pos))
        assert len(failed) == 1
        Starts(environment, protocol).begin(2)
        assert len(failed) == 2
        alone = np.array(environment.simulation.model.body_pos)
    finally:
        environment.close()
    np.testing.assert_array_equal(alone, in_order[2])
    assert np.abs(in_order[2] - in_order[1]).max() > 1e-4


def first_look(starts: Starts, trial: int) -> Any:
    """Pixels and state at the start of a trial."""
    starts.begin(trial)
    seen = starts.environment.observe()
    return [*(picture.copy() for picture in seen["images"].values()), seen["state"]]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_trial_begins_alike_alone_and_after_others(name: str) -> None:
    protocol = PROTOCOLS[name]
    environment_cache.close()
    environment = LiberoEnvironment(
        "libero_goal",
        0,
        image_size=64,
        settle_steps=protocol.settle_steps,
        official_states=protocol.official_states,
    )
    try:
        starts = Starts(environment, protocol)
        looks = []
        for trial in (0, 1, 2):
            looks.append(first_look(starts, trial))
            environment.advance(np.full(7, 0.5, np.float32))
        again = first_look(Starts(environment, protocol), 2)
    finally:
        environment.close()
    assert all(np.array_equal(one, other) for one, other in zip(looks[2], again, strict=True))
    assert not np.array_equal(looks[0][0], looks[1][0])
