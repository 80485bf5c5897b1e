"""A robot's units to the head's and back as Isaac-GR00T's N1.5 does it, written from its description."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import saccade
from saccade import Normalizer
from saccade.robots import RELEASED
from tests.helpers.normalizer_cases import as_array, data_config, draw, metadata
from tests.helpers.paths import DATA
from tests.helpers.published import sidecars


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
    normalizer = Normalizer.from_pretrained(values, data_config=data_config(mode), state_dim=12)
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
    normalizer = Normalizer.from_pretrained(values, data_config=data_config(action_modes=mode), action_dim=9)
    stats = values["new_embodiment"]["statistics"]["action"]
    low, high = {"min_max": ("min", "max"), "q99": ("q01", "q99"), "mean_std": ("mean", "std")}[mode]
    first = np.array(stats["arm"][low] + stats["gripper"][low])
    second = np.array(stats["arm"][high] + stats["gripper"][high])
    cut = chunk[..., :4].astype(np.float64)
    expected = cut * second + first if mode == "mean_std" else (cut + 1) / 2 * (second - first) + first
    assert np.allclose(as_array(normalizer.actions(chunk)), expected, atol=1e-5)


def test_keys_are_taken_in_the_order_of_the_data_config() -> None:
    plain = Normalizer.from_pretrained(metadata(), data_config=data_config())
    turned = data_config(
        action_modes={"action.gripper": "min_max"},
        state_keys=["state.gripper", "state.arm"],
        action_keys=["action.gripper"],
    )
    other = Normalizer.from_pretrained(metadata(), data_config=turned)
    assert plain.state_slices == {"arm": slice(0, 3), "gripper": slice(3, 5)}
    assert other.state_slices == {"gripper": slice(0, 2), "arm": slice(2, 5)}
    assert other.action_slices == {"gripper": slice(0, 1)}
    state = draw(2, 5)
    found = as_array(other.state(np.concatenate([state[:, 3:], state[:, :3]], 1)))
    assert np.array_equal(found[:, [2, 3, 4, 0, 1]], as_array(plain.state(state)))


def test_without_a_data_config_the_whole_file_is_used_with_one_warning() -> None:
    with pytest.warns(UserWarning, match="data config") as found:
        normalizer = Normalizer.from_pretrained(metadata(gripper={"continuous": False}))
    assert len(found) == 1
    assert found[0].filename == __file__
    assert [group.mode for group in normalizer.state_groups] == ["min_max", "binary"]
    assert as_array(normalizer.actions(np.full((1, 2, 4), 0.6)))[0, 0, 3] == 1.0
    assert normalizer.data_config is None
    assert normalizer.action_horizon is None


def test_a_rotation_and_gr1_need_a_data_config() -> None:
    values = metadata(arm={"rotation_type": "axis_angle"})
    with pytest.raises(
        saccade.InputError, match=r"data_config: .*state\.arm, action\.arm are rotations"
    ) as found:
        Normalizer.from_pretrained(values)
    assert "no released data config fits" in str(found.value)
    said = Normalizer.from_pretrained(values, data_config=data_config())
    plain = Normalizer.from_pretrained(metadata(), data_config=data_config())
    assert np.array_equal(as_array(said.state(draw(1, 5))), as_array(plain.state(draw(1, 5))))
    with pytest.raises(saccade.InputError, match="data_config: expected one for id_or_path: gr1"):
        Normalizer.from_pretrained(metadata("gr1"))


def test_the_message_names_the_data_configs_that_fit() -> None:
    """NVIDIA's own gr1 has more keys than a head's action has room for."""
    path = DATA / "robots" / "n15" / "02-gr1-arms-waist"
    with pytest.raises(saccade.InputError, match="data_config: expected one") as found:
        Normalizer.from_pretrained(path, "gr1")
    assert "These fit the file: fourier_gr1_arms_waist, fourier_gr1_arms_only" in str(found.value)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"surprise": 1}, "surprise: unknown"),
        ({"state_keys": "state.arm"}, "state_keys: expected a list"),
        ({"state_keys": []}, "state_keys: expected at least one"),
        ({"state_keys": None}, "state_keys: expected a list"),
        ({"action_keys": 5}, "action_keys: expected a list"),
        ({"surprise": np.ones(3)}, "surprise: unknown"),
        ({"action_modes": {"action.arm": ["min_max"]}}, "action_modes: "),
        ({"state_keys": ["state.arm", "state.arm"]}, "state_keys: expected distinct"),
        ({"action_keys": ["state.arm"]}, r"action_keys: expected action\.<name>"),
        ({"observation_indices": [0, 1]}, "observation_indices"),
        ({"observation_indices": [-3, -1, 0]}, "observation_indices"),
        ({"action_indices": [0.5]}, "action_indices: expected integers"),
        ({"state_modes": {"state.leg": "min_max"}}, r"state_modes: state\.leg"),
        ({"state_modes": {"state.arm": "median"}}, "state_modes: .*'median'"),
        ({"action_modes": {"action.arm": "sin_cos"}}, "action_modes: .*'sin_cos'"),
        ({"target_rotations": {"state.arm": "matrix"}}, "target_rotations: .*'matrix'"),
    ],
)
def test_what_no_data_config_is(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(saccade.InputError, match=f"data_config: .*{problem}"):
        Normalizer.from_pretrained(metadata(), data_config=data_config(**change))


def test_a_data_config_may_be_a_name_a_file_or_a_mapping(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(data_config("q99")))
    by_file = Normalizer.from_pretrained(metadata(), data_config=path)
    by_mapping = Normalizer.from_pretrained(metadata(), data_config=data_config("q99"))
    assert by_file.data_config == by_mapping.data_config
    with pytest.raises(FileNotFoundError, match=r"fourier_gr1_arms_only.* or a JSON file, got 'mine'"):
        Normalizer.from_pretrained(metadata(), data_config="mine")
    with pytest.raises(saccade.InputError, match="data_config: expected a name"):
        Normalizer.from_pretrained(metadata(), data_config=b"so100")  # type: ignore[arg-type]
    path.write_text("{")
    with pytest.raises(saccade.CheckpointError, match=r"data_config: .*mine\.json"):
        Normalizer.from_pretrained(metadata(), data_config=path)


def test_old_names_are_the_new_ones() -> None:
    for name in ("gr1_arms_waist", "gr1_arms_only", "gr1_full_upper_body"):
        assert RELEASED[name] == RELEASED[f"fourier_{name}"]


@pytest.mark.parametrize("layout", ["nvidia", "isaac", "n1"])
def test_isaac_checkpoints_know_their_embodiments(layout: str, tmp_path: Path) -> None:
    sidecars(tmp_path, layout)
    by_tag = Normalizer.from_pretrained(tmp_path, "new_embodiment")
    by_id = Normalizer.from_pretrained(tmp_path, 31)
    assert (by_tag.embodiment_id, by_id.embodiment, by_tag.state_dim) == (31, "new_embodiment", 12)
    assert np.array_equal(as_array(by_tag.state(draw(1, 7))), as_array(by_id.state(draw(1, 7))))
    if layout == "isaac":
        assert Normalizer.from_pretrained(tmp_path).embodiment == "new_embodiment"
        return
    with pytest.raises(saccade.InputError, match="data_config"):
        Normalizer.from_pretrained(tmp_path, "gr1")
    with pytest.raises(
        saccade.InputError, match=r"expected one of .*gr1 \(24\).*new_embodiment \(31\)\), got None"
    ):
        Normalizer.from_pretrained(tmp_path)
