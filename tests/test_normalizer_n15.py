"""A robot's units to the head's and back as Isaac-GR00T's N1.5 does it, written from its description."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from normalizer_cases import as_array, draw, metadata
from numpy.typing import NDArray
from published import sidecars

import saccade
from saccade import Normalizer


def isaac_n15(mode: str, x: NDArray[Any], stats: dict[str, list[float]]) -> NDArray[Any]:
    """What Isaac-GR00T's N1.5 does with a key, in float64 and written from its description."""
    at = {name: np.array(values) for name, values in stats.items()}
    out = np.array(x, np.float64)
    for column in range(x.shape[-1]):
        value = out[..., column]
        if mode == "min_max":
            low, high = at["min"][column], at["max"][column]
            out[..., column] = 0 if low == high else 2 * (value - low) / (high - low) - 1
        elif mode == "q99":
            low, high = at["q01"][column], at["q99"][column]
            if low != high:
                value = 2 * (value - low) / (high - low) - 1
            out[..., column] = value.clip(-1, 1)
        elif mode == "mean_std" and at["std"][column] != 0:
            out[..., column] = (value - at["mean"][column]) / at["std"][column]
        elif mode == "binary":
            out[..., column] = value > 0.5
    return np.concatenate([np.sin(x), np.cos(x)], -1) if mode == "sin_cos" else out


@pytest.mark.parametrize("mode", ["min_max", "q99", "mean_std", "binary", "sin_cos", "none"])
def test_every_mode_of_isaac_n15(mode: str) -> None:
    values, state = metadata(), draw(4, 1, 5)
    normalizer = Normalizer.load(values, state_dim=12, modes={"state.arm": mode, "state.gripper": mode})
    stats = values["new_embodiment"]["statistics"]["state"]
    parts = [isaac_n15(mode, state[..., :3], stats["arm"]), isaac_n15(mode, state[..., 3:], stats["gripper"])]
    expected = np.concatenate(parts, -1)
    found = as_array(normalizer.state(state))
    assert found.shape == (4, 1, 12)
    assert np.allclose(found[..., : expected.shape[-1]], expected, atol=1e-5)
    assert not found[..., expected.shape[-1] :].any()


@pytest.mark.parametrize("mode", ["min_max", "q99", "mean_std"])
def test_actions_of_isaac_n15_come_back(mode: str) -> None:
    values, chunk = metadata(), draw(2, 6, 9)
    normalizer = Normalizer.load(values, action_dim=9, modes=mode)
    stats = values["new_embodiment"]["statistics"]["action"]
    low, high = {"min_max": ("min", "max"), "q99": ("q01", "q99"), "mean_std": ("mean", "std")}[mode]
    first = np.array(stats["arm"][low] + stats["gripper"][low])
    second = np.array(stats["arm"][high] + stats["gripper"][high])
    cut = chunk[..., :4].astype(np.float64)
    expected = cut * second + first if mode == "mean_std" else (cut + 1) / 2 * (second - first) + first
    assert np.allclose(as_array(normalizer.actions(chunk)), expected, atol=1e-5)


def test_keys_are_taken_in_the_order_asked_for() -> None:
    plain, other = (
        Normalizer.load(metadata()),
        Normalizer.load(metadata(), state_keys=["state.gripper", "state.arm"], action_keys=["gripper"]),
    )
    assert plain.state_slices == {"arm": slice(0, 3), "gripper": slice(3, 5)}
    assert other.state_slices == {"gripper": slice(0, 2), "arm": slice(2, 5)}
    assert other.action_slices == {"gripper": slice(0, 1)}
    state = draw(2, 5)
    turned = as_array(other.state(np.concatenate([state[:, 3:], state[:, :3]], 1)))
    assert np.array_equal(turned[:, [2, 3, 4, 0, 1]], as_array(plain.state(state)))


def test_a_key_that_is_not_continuous_is_binary() -> None:
    normalizer = Normalizer.load(metadata(gripper={"continuous": False}))
    assert [group.mode for group in normalizer.state_groups] == ["min_max", "binary"]
    assert as_array(normalizer.actions(np.full((1, 2, 4), 0.6)))[0, 0, 3] == 1.0


def test_a_rotation_needs_a_word_from_the_user() -> None:
    values = metadata(arm={"rotation_type": "quaternion"})
    with pytest.raises(
        saccade.CheckpointError, match=r"state\.arm is a rotation \(quaternion\).*modes="
    ) as found:
        Normalizer.load(values)
    assert "action.arm" in str(found.value)
    said = Normalizer.load(values, modes={"state.arm": "min_max", "action.arm": "min_max"})
    assert np.array_equal(
        as_array(said.state(draw(1, 5))), as_array(Normalizer.load(metadata()).state(draw(1, 5)))
    )


@pytest.mark.parametrize("layout", ["nvidia", "isaac", "n1"])
def test_isaac_checkpoints_know_their_embodiments(layout: str, tmp_path: Path) -> None:
    sidecars(tmp_path, layout)
    by_tag = Normalizer.load(tmp_path, "new_embodiment")
    by_id = Normalizer.load(tmp_path, 31)
    assert (by_tag.embodiment_id, by_id.embodiment, by_tag.state_dim) == (31, "new_embodiment", 12)
    assert np.array_equal(as_array(by_tag.state(draw(1, 7))), as_array(by_id.state(draw(1, 7))))
    if layout == "isaac":
        assert Normalizer.load(tmp_path).embodiment == "new_embodiment"
        return
    assert Normalizer.load(tmp_path, "gr1").embodiment_id == 24
    with pytest.raises(
        saccade.InputError, match=r"expected one of .*gr1 \(24\).*new_embodiment \(31\)\), got None"
    ):
        Normalizer.load(tmp_path)
