"""A robot's units to the head's and back, compared with lerobot's steps and Isaac-GR00T's code."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import layouts
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from published import sidecars
from safetensors.numpy import save_file

import saccade
from saccade import Normalizer
from saccade.sim.policy import DEMO_CHECKPOINT

Array = NDArray[np.float32]


def draw(*shape: int, seed: int = 0, scale: float = 2.0) -> Array:
    return scale * np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def as_array(values: Any) -> Array:
    assert isinstance(values, np.ndarray)
    assert values.dtype == np.float32
    return values


# --- lerobot ---


@pytest.fixture(scope="module")
def lerobot_steps() -> Any:
    """lerobot's own `processor_groot.py`, run as it is; what it imports for pictures is not there."""
    package = importlib.util.find_spec("lerobot")
    assert package is not None
    assert package.origin is not None
    root = Path(package.origin).parent

    def load(name: str, path: Path) -> Any:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
        return module

    def made(name: str, **names: Any) -> types.ModuleType:
        module = types.ModuleType(name)
        vars(module).update(names)
        return module

    class Registry:
        @staticmethod
        def register(name: str) -> Callable[[type], type]:
            return lambda step: step

    steps = ("AddBatchDimension", "Device", "RenameObservations")
    stubs = {
        "einops": made("einops", rearrange=None),
        "lerobot.utils.import_utils": made("lerobot.utils.import_utils", _transformers_available=False),
        "lerobot.policies": made("lerobot.policies", __path__=[]),
        "lerobot.policies.groot": made("lerobot.policies.groot", __path__=[]),
        "lerobot.policies.groot.configuration_groot": made("configuration_groot", GrootConfig=object),
        "lerobot.processor": made(
            "lerobot.processor",
            __path__=[],
            ProcessorStep=object,
            ProcessorStepRegistry=Registry,
            PolicyAction=torch.Tensor,
            PolicyProcessorPipeline=dict,
            **{f"{step}ProcessorStep": object for step in steps},
        ),
        "lerobot.processor.converters": made(
            "converters", policy_action_to_transition=None, transition_to_policy_action=None
        ),
    }
    with mock.patch.dict(sys.modules, stubs):
        load("lerobot.processor.core", root / "processor" / "core.py")
        return load("lerobot_processor_groot", root / "policies" / "groot" / "processor_groot.py")


@pytest.mark.parametrize("layout", ["lerobot", "fork", "fork-split"])
def test_a_lerobot_checkpoint_gives_the_bits_of_lerobots_own_steps(
    layout: str, lerobot_steps: Any, tmp_path: Path
) -> None:
    sidecars(tmp_path, layout, seed=3)
    normalizer = Normalizer.load(tmp_path)
    statistics: dict[str, dict[str, torch.Tensor]] = {"observation.state": {}, "action": {}}
    for key in statistics:
        width = 7 if key == "observation.state" else 6
        seed = 3 if key == "observation.state" else 103
        for name, values in layouts.flat_statistics(key, width, seed).items():
            statistics[key][name.rpartition(".")[2]] = values
    pack = lerobot_steps.GrootPackInputsStep(
        state_horizon=1, action_horizon=5, max_state_dim=12, max_action_dim=8, stats=statistics
    )
    unpack = lerobot_steps.GrootActionUnpackUnnormalizeStep(env_action_dim=6, stats=statistics)
    state, chunk, robot = draw(4, 7), draw(4, 5, 8, seed=1), draw(4, 5, 6, seed=2)

    packed = pack(
        {
            "observation": {"observation.state": torch.from_numpy(state)},
            "action": torch.from_numpy(robot),
            "complementary_data": {},
        }
    )
    assert np.array_equal(as_array(normalizer.state(state)), packed["observation"]["state"][:, 0].numpy())
    assert np.array_equal(as_array(normalizer.unactions(robot)), packed["action"].numpy())
    assert packed["complementary_data"]["embodiment_id"].tolist() == [normalizer.embodiment_id] * 4
    # Their step takes one action at a time; the constant dimension comes back as the constant.
    theirs = unpack({"action": torch.from_numpy(chunk).reshape(20, 8)})["action"].reshape(4, 5, 6)
    assert np.array_equal(as_array(normalizer.actions(chunk)), theirs.numpy())
    assert np.array_equal(
        as_array(normalizer.actions(chunk))[..., 5], np.full((4, 5), statistics["action"]["min"][5])
    )


def test_a_tag_that_lerobot_does_not_know_is_embodiment_0(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")
    edit(
        tmp_path / "policy_preprocessor.json",
        lambda values: step_config(values).update(embodiment_tag="mine"),
    )
    assert Normalizer.load(tmp_path).embodiment_id == 0


def test_without_min_max_lerobot_leaves_the_numbers_alone(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        edit(tmp_path / name, lambda values: step_config(values).update(normalize_min_max=False))
    normalizer, state = Normalizer.load(tmp_path), draw(2, 7)
    assert np.array_equal(as_array(normalizer.state(state))[:, :7], state)
    assert np.array_equal(as_array(normalizer.actions(draw(2, 3, 8))), draw(2, 3, 8)[..., :6])


def test_lerobot_after_0_5_1_clips_states(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot-n17", seed=5)
    normalizer, state = Normalizer.load(tmp_path), draw(50, 7, scale=5.0)
    low, high = (layouts.flat_statistics("s", 7, 5)[f"s.{name}"].numpy() for name in ("min", "max"))
    expected = np.clip(2 * (state[:, :6] - low[:6]) / (high[:6] - low[:6]) - 1, -1, 1)
    assert np.allclose(as_array(normalizer.state(state))[:, :6], expected, atol=1e-6)
    assert not as_array(normalizer.state(state))[:, 6:].any()
    assert normalizer.embodiment_id == layouts.N17_EMBODIMENTS["new_embodiment"]


# --- Isaac-GR00T N1.5 ---


def row(size: int, seed: int, *, constant: int | None = 1) -> dict[str, list[float]]:
    """Statistics of a key, one dimension constant."""
    rng = np.random.default_rng(seed)
    centre, half = rng.standard_normal(size), rng.random(size) + 0.1
    if constant is not None and constant < size:
        half[constant] = 0.0
    shares = {"min": -1.0, "max": 1.0, "mean": 0.2, "q01": -0.8, "q99": 0.7}
    return {name: (centre + share * half).tolist() for name, share in shares.items()} | {
        "std": (half / 3).tolist()
    }


def metadata(tag: str = "new_embodiment", **about: Any) -> dict[str, Any]:
    sizes = {"state": {"arm": 3, "gripper": 2}, "action": {"arm": 3, "gripper": 1}}
    modality = {"absolute": True, "rotation_type": None, "continuous": True}
    return {
        tag: {
            "statistics": {
                kind: {key: row(size, number) for number, (key, size) in enumerate(keys.items())}
                for kind, keys in sizes.items()
            },
            "modalities": {
                "video": {},
                **{
                    kind: {
                        key: {**modality, "shape": [size], **about.get(key, {})} for key, size in keys.items()
                    }
                    for kind, keys in sizes.items()
                },
            },
            "embodiment_tag": tag,
        }
    }


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


# --- Isaac-GR00T N1.6 and N1.7 ---


def processor(**changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """`processor_config.json` and `statistics.json` of one robot: arm 3, gripper 1."""
    keys = ["arm", "gripper"]
    kwargs = {
        "modality_configs": {
            "robot": {
                "state": {"delta_indices": [0], "modality_keys": keys, **changes.pop("state", {})},
                "action": {"delta_indices": [0, 1, 2, 3], "modality_keys": keys, **changes.pop("action", {})},
            }
        },
        "max_state_dim": 9,
        "max_action_dim": 8,
        **changes,
    }
    numbers = {"arm": row(3, 0), "gripper": row(1, 1)}
    return {"processor_kwargs": kwargs}, {
        "robot": {"state": numbers, "action": numbers, "relative_action": {}}
    }


def load_processor(folder: Path, config: dict[str, Any], statistics: dict[str, Any]) -> Normalizer:
    layouts.write_json(folder / "processor_config.json", config)
    layouts.write_json(folder / "statistics.json", statistics)
    layouts.write_json(folder / "embodiment_id.json", {"robot": 5, "other": 6})
    return Normalizer.load(folder)


@pytest.mark.parametrize("percentiles", [False, True])
@pytest.mark.parametrize("clip", [False, True])
def test_n17_clips_scales_and_cuts_the_chunk(percentiles: bool, clip: bool, tmp_path: Path) -> None:
    config, statistics = processor(use_percentiles=percentiles, clip_outliers=clip)
    normalizer = load_processor(tmp_path, config, statistics)
    low, high = (
        np.array(statistics["robot"]["state"]["arm"][name])
        for name in (("q01", "q99") if percentiles else ("min", "max"))
    )
    state, chunk = draw(3, 4), draw(3, 6, 8)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * (state[:, :3] - low) / (high - low) - 1
    expected[:, 1] = 0  # the constant one
    found = as_array(normalizer.state(state))
    assert np.allclose(found[:, :3], expected.clip(-1, 1) if clip else expected, atol=1e-6)
    assert normalizer.embodiment_id == 5
    robot = as_array(normalizer.actions(chunk))
    assert robot.shape == (3, 4, 4)
    # Values from the head are clipped with either setting.
    back = (chunk[:, :4, :3].clip(-1, 1) + 1) / 2 * (high - low) + low
    assert np.allclose(robot[..., :3], back, atol=1e-6)


def test_n17_takes_nearly_equal_bounds_for_constant(tmp_path: Path) -> None:
    config, statistics = processor()
    arm = statistics["robot"]["state"]["arm"]
    arm["min"][0], arm["max"][0] = 1.0, 1.0 + 1e-9
    assert as_array(load_processor(tmp_path, config, statistics).state(draw(1, 4)))[0, 0] == 0


def test_n17_mean_and_deviation_and_sine_and_cosine_by_key(tmp_path: Path) -> None:
    config, statistics = processor(
        state={"mean_std_embedding_keys": ["gripper"], "sin_cos_embedding_keys": ["arm"]},
        action={"mean_std_embedding_keys": ["arm"]},
        apply_sincos_state_encoding=True,
    )
    normalizer = load_processor(tmp_path, config, statistics)
    arm, gripper = (statistics["robot"]["state"][key] for key in ("arm", "gripper"))
    state = draw(2, 4)
    found = as_array(normalizer.state(state))
    assert np.allclose(found[:, :6], np.concatenate([np.sin(state[:, :3]), np.cos(state[:, :3])], 1))
    assert np.allclose(found[:, 6], (state[:, 3] - gripper["mean"][0]) / gripper["std"][0], atol=1e-5)
    chunk = draw(1, 4, 8)
    expected = chunk[..., :3] * np.array(arm["std"]) + np.array(arm["mean"])
    expected[..., 1] = chunk[..., 1]  # no deviation: as it is
    assert np.allclose(as_array(normalizer.actions(chunk))[..., :3], expected, atol=1e-6)
    with pytest.raises(saccade.InputError, match="mode 'sin_cos'"):
        normalizer.unstate(found)


RELATIVE = {"rep": "RELATIVE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
ABSOLUTE = {**RELATIVE, "rep": "ABSOLUTE"}


def relative(folder: Path, *, by_step: bool) -> tuple[Normalizer, dict[str, Any]]:
    config, statistics = processor(action={"action_configs": [RELATIVE, ABSOLUTE]}, use_relative_action=True)
    rows = [row(3, 10 + step, constant=None) for step in range(4)]
    if by_step:
        own: dict[str, Any] = {name: [row[name] for row in rows] for name in ("min", "max", "mean", "std")}
    else:
        own = rows[0]
    statistics["robot"]["relative_action"] = {"arm": own}
    return load_processor(folder, config, statistics), statistics


@pytest.mark.parametrize("by_step", [False, True])
def test_relative_actions_are_added_to_the_state(by_step: bool, tmp_path: Path) -> None:
    normalizer, statistics = relative(tmp_path, by_step=by_step)
    own = statistics["robot"]["relative_action"]["arm"]
    low, high = np.array(own["min"]), np.array(own["max"])
    state, chunk = draw(2, 4), draw(2, 4, 8, scale=0.4)
    robot = as_array(normalizer.actions(chunk, state))
    expected = (chunk[..., :3] + 1) / 2 * (high - low) + low + state[:, None, :3]
    assert np.allclose(robot[..., :3], expected, atol=1e-5)
    alone = Normalizer.load(tmp_path).actions(chunk, np.zeros((2, 4)))
    assert np.array_equal(robot[..., 3], as_array(alone)[..., 3])  # the gripper is not relative
    # Of a history the newest state counts; samples share it; without a batch it works too.
    history = np.stack([draw(2, 4, seed=9), state], axis=1)
    assert np.array_equal(as_array(normalizer.actions(chunk, history)), robot)
    samples = as_array(normalizer.actions(np.repeat(chunk[:, None], 3, axis=1), state))
    assert np.array_equal(samples, np.repeat(robot[:, None], 3, axis=1))
    assert np.array_equal(as_array(normalizer.actions(chunk[1], state[1])), robot[1])
    back = as_array(normalizer.unactions(robot, state))
    assert np.allclose(back[..., [0, 1, 2]], chunk[..., [0, 1, 2]], atol=1e-5)
    with pytest.raises(saccade.InputError, match="the actions of arm are relative to it"):
        normalizer.actions(chunk)
    with pytest.raises(saccade.ShapeError, match="expected a shape that fits actions"):
        normalizer.actions(chunk, draw(3, 4))


def test_statistics_of_each_step_need_their_steps(tmp_path: Path) -> None:
    normalizer, _ = relative(tmp_path, by_step=True)
    with pytest.raises(saccade.ShapeError, match="arm has statistics of 4 steps"):
        normalizer.unactions(draw(1, 5, 4), draw(1, 4))


def test_what_n17_can_say_and_is_not_supported(tmp_path: Path) -> None:
    pose = {**RELATIVE, "type": "EEF", "format": "XYZ_ROT6D"}
    config, statistics = processor(action={"action_configs": [pose, ABSOLUTE]}, use_relative_action=True)
    statistics["robot"]["relative_action"] = {"arm": row(3, 0)}
    with pytest.raises(saccade.CheckpointError, match=r"action\.arm: relative poses of an end effector"):
        load_processor(tmp_path, config, statistics)
    with pytest.raises(saccade.CheckpointError, match="tactile"):
        load_processor(tmp_path, *processor(use_tactile=True))


def test_a_head_trained_without_a_state_gets_zeros(tmp_path: Path) -> None:
    normalizer = load_processor(tmp_path, *processor(exclude_state=True))
    assert not as_array(normalizer.state(draw(2, 4))).any()
    with pytest.raises(saccade.InputError, match="gets zeros"):
        normalizer.unstate(np.zeros((2, 9)))


@pytest.mark.parametrize("layout", ["n16", "n17"])
def test_published_layouts_of_n16_and_n17(layout: str, tmp_path: Path) -> None:
    sidecars(tmp_path, layout)
    normalizer = Normalizer.load(tmp_path, "libero_sim")
    assert (normalizer.embodiment_id, normalizer.action_horizon, normalizer.state_width) == (2, 16, 7)
    assert as_array(normalizer.actions(draw(1, 40, 10))).shape == (1, 16, 6)


def test_a_lerobot_checkpoint_with_isaacs_groups_is_read_like_isaacs(tmp_path: Path) -> None:
    config, statistics = processor(use_percentiles=True)
    isaac = load_processor(tmp_path / "isaac", config, statistics)
    sidecars(tmp_path / "lerobot", "lerobot-n17")
    edit(
        tmp_path / "lerobot" / "policy_preprocessor.json",
        lambda values: step_config(values).update(
            raw_stats=statistics["robot"],
            modality_config=config["processor_kwargs"]["modality_configs"]["robot"],
            use_percentiles=True,
        ),
    )
    lerobot = Normalizer.load(tmp_path / "lerobot")
    assert np.array_equal(as_array(lerobot.state(draw(3, 4)))[:, :9], as_array(isaac.state(draw(3, 4))))
    assert np.array_equal(as_array(lerobot.actions(draw(3, 4, 8))), as_array(isaac.actions(draw(3, 4, 8))))


# --- mappings ---


def test_an_id_may_be_given_for_a_robot_without_one() -> None:
    """The demo's robot is none of the released code's: the id selects the head's embodiment."""
    assert Normalizer.load(DEMO_CHECKPOINT, 0).embodiment == "metaworld_sawyer"
    assert saccade.Policy.load(DEMO_CHECKPOINT, embodiment=0, num_threads=1).embodiment_id == 0
    with pytest.raises(saccade.InputError, match=r"embodiment_id|embodiment"):
        saccade.Policy.load(DEMO_CHECKPOINT, embodiment=3)
    with pytest.raises(saccade.InputError, match="expected one of those in"):
        Normalizer.load(DEMO_CHECKPOINT, "gr1")


def test_mappings_may_be_lerobots_or_plain() -> None:
    plain = Normalizer.load({"state": row(3, 0), "action": row(2, 1)}, 7)
    theirs = Normalizer.load({"observation.state": row(3, 0), "action": row(2, 1)}, "gr1")
    assert (plain.embodiment, plain.embodiment_id) == (None, 7)
    assert (theirs.embodiment, theirs.embodiment_id) == ("gr1", 24)
    assert np.array_equal(as_array(plain.state(draw(2, 3))), as_array(theirs.state(draw(2, 3))))


sizes = st.integers(1, 9)


@settings(max_examples=40, deadline=None)
@given(
    groups=st.lists(
        st.tuples(sizes, st.sampled_from(["min_max", "q99", "mean_std"])), min_size=1, max_size=4
    ),
    seed=st.integers(0, 2**20),
    padding=st.integers(0, 5),
)
def test_there_and_back(groups: list[tuple[int, str]], seed: int, padding: int) -> None:
    """Within the statistics' range nothing is lost but the constants, which come back as the constant."""
    rng = np.random.default_rng(seed)
    names = [f"key{number}" for number in range(len(groups))]
    statistics = {
        name: row(size, seed + number, constant=int(rng.integers(2 * size)))
        for number, (name, (size, _)) in enumerate(zip(names, groups, strict=True))
    }
    entry = {"state": statistics, "action": statistics}
    modes = {f"{kind}.{name}": mode for kind in entry for name, (_, mode) in zip(names, groups, strict=True)}
    total = sum(size for size, _ in groups)
    normalizer = Normalizer.load(
        {"robot": {"statistics": entry, "modalities": {}}},
        state_dim=total + padding,
        action_dim=total + padding,
        modes=modes,
    )
    low, high = (
        np.concatenate([np.array(statistics[name][bound]) for name in names]) for bound in ("q01", "q99")
    )
    robot = (low + rng.random((2, 3, total)) * (high - low)).astype(np.float32)
    for there, back in ((normalizer.state, normalizer.unstate), (normalizer.unactions, normalizer.actions)):
        normalised = as_array(there(robot))
        assert normalised.shape == (2, 3, total + padding)
        assert not normalised[..., total:].any()
        moving = low != high
        assert np.allclose(as_array(back(normalised))[..., moving], robot[..., moving], atol=1e-5)
        for name, (_, mode) in zip(names, groups, strict=True):
            where = normalizer.state_slices[name]
            still = ~moving[where]
            if mode == "min_max":
                bound = np.array(statistics[name]["min"], np.float32)[still]
                assert np.array_equal(
                    as_array(back(normalised))[..., where][..., still],
                    np.broadcast_to(bound, (2, 3, still.sum())),
                )


# --- arguments ---


def test_arrays_of_every_kind() -> None:
    normalizer = Normalizer.load({"state": row(3, 0), "action": row(2, 1)})
    state = draw(4, 3)
    expected = as_array(normalizer.state(state))
    assert np.array_equal(as_array(normalizer.state(state.astype(np.float64))), expected)
    assert np.array_equal(as_array(normalizer.state(np.asfortranarray(state))), expected)
    assert np.array_equal(as_array(normalizer.state(state[2])), expected[2])
    assert as_array(normalizer.state(state[:0])).shape == (0, 3)
    found = normalizer.state(torch.from_numpy(state))
    assert isinstance(found, torch.Tensor)
    assert np.array_equal(found.numpy(), expected)
    with pytest.raises(saccade.DtypeError, match="state"):
        normalizer.state(np.ones((1, 3), np.int64))
    before = state.copy()
    expected[:] = 0
    assert np.array_equal(state, before)


def test_a_state_of_the_wrong_width_names_the_robot_and_its_parts() -> None:
    normalizer = Normalizer.load(metadata())
    with pytest.raises(
        saccade.ShapeError,
        match=r"state: the Normalizer of 'new_embodiment' expected \(\.\.\., 5\) in the robot's units "
        r"\(arm 3, gripper 2\), got \(1, 64\)",
    ):
        normalizer.state(np.zeros((1, 64)))
    for values in (np.float32(1.0), np.zeros((2, 4))):
        with pytest.raises(saccade.ShapeError, match="state"):
            normalizer.state(values)
    with pytest.raises(saccade.ShapeError, match=r"actions: the Normalizer expected \(\.\.\., at least 4\)"):
        normalizer.actions(np.zeros((1, 16, 3)))
    with pytest.raises(saccade.InputError, match="state: expected finite numbers"):
        normalizer.state(np.array([[0.0, np.nan, 0, 0, 0]]))


def step_config(values: dict[str, Any]) -> dict[str, Any]:
    """The config of the step of GR00T in a lerobot pipeline."""
    found = next(step["config"] for step in values["steps"] if step["registry_name"].startswith("groot"))
    assert isinstance(found, dict)
    return found


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Normalizer.load(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="hf download nobody/nothing"):
        Normalizer.load("nobody/nothing")
    with pytest.raises(saccade.CheckpointError, match="too long"):
        Normalizer.load(tmp_path / ("x" * 300))
    with pytest.raises(saccade.InputError, match="expected a path"):
        Normalizer.load(5)  # type: ignore[arg-type]
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(saccade.CheckpointError, match="not a regular file"):
        Normalizer.load(tmp_path / "pipe.json")
    with pytest.raises(
        saccade.CheckpointError, match=r"no statistics.*policy_preprocessor\.json.*metadata\.json"
    ):
        Normalizer.load(tmp_path)
    sidecars(tmp_path / "lerobot", "lerobot")
    next((tmp_path / "lerobot").glob("policy_postprocessor_step*")).unlink()
    with pytest.raises(FileNotFoundError, match="policy_postprocessor_step"):
        Normalizer.load(tmp_path / "lerobot")
    (tmp_path / "lerobot" / "policy_postprocessor.json").unlink()
    with pytest.raises(saccade.CheckpointError, match="no step of GR00T"):
        Normalizer.load(tmp_path / "lerobot")


@pytest.mark.parametrize("text", ["", "[]", "{", "null", '{"state": 1}', "[" * 100_000, '"\xff'])
def test_broken_json(text: str, tmp_path: Path) -> None:
    path = tmp_path / "experiment_cfg" / "metadata.json"
    path.parent.mkdir()
    path.write_bytes(text.encode("latin-1"))
    for source in (tmp_path, path):
        with pytest.raises(saccade.CheckpointError, match="metadata"):
            Normalizer.load(source)


@pytest.mark.parametrize(
    "name",
    ["processor_config.json", "statistics.json", "policy_preprocessor.json", "policy_postprocessor.json"],
)
@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"steps": 3, "processor_kwargs": 4}',
        '{"steps": [5], "processor_kwargs": {"modality_configs": {"a": 6}}, "a": 7}',
    ],
)
def test_json_of_another_form(name: str, text: str, tmp_path: Path) -> None:
    sidecars(tmp_path, "n17" if name in ("processor_config.json", "statistics.json") else "lerobot")
    (tmp_path / name).write_text(text)
    with pytest.raises(saccade.CheckpointError):
        Normalizer.load(tmp_path, "new_embodiment")


def test_all_that_is_wrong_with_statistics_is_listed() -> None:
    values = metadata()
    stats = values["new_embodiment"]["statistics"]
    del stats["state"]["arm"]["max"]
    stats["state"]["gripper"]["min"] = [5.0, 5.0]
    stats["action"]["arm"]["min"] = [0.0]
    stats["action"]["gripper"]["max"] = [float("nan")]
    with pytest.raises(saccade.CheckpointError) as found:
        Normalizer.load(values)
    for problem in (
        "arm: min_max needs max",
        "gripper: max is below min",
        "arm: expected statistics of one shape, got [(1,), (3,)]",
        "gripper: expected max to be a row of finite numbers",
    ):
        assert problem in str(found.value)


def test_options_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(saccade.InputError, match=r"state_keys: expected keys in source .*, got leg"):
        Normalizer.load(metadata(), state_keys=["leg"])
    with pytest.raises(saccade.InputError, match="state_keys: expected distinct names"):
        Normalizer.load(metadata(), state_keys="arm")
    with pytest.raises(saccade.InputError, match=r"modes: expected keys among .*, got state\.leg"):
        Normalizer.load(metadata(), modes={"state.leg": "q99"})
    with pytest.raises(
        saccade.InputError, match=r"modes: action\.arm: expected one of min_max.*, got 'sin_cos'"
    ):
        Normalizer.load(metadata(), modes="sin_cos")
    with pytest.raises(saccade.InputError, match=r"embodiment: expected one of those in .*, got 'gr1'"):
        Normalizer.load(metadata(), "gr1")
    with pytest.raises(saccade.InputError, match="state_dim"):
        Normalizer.load(metadata(), state_dim=0)
    with pytest.raises(saccade.CheckpointError, match=r"4 numbers, the head's only 3 \(action_dim\)"):
        Normalizer.load(metadata(), action_dim=3)
    sidecars(tmp_path, "lerobot")
    with pytest.raises(saccade.InputError, match=r"modes: expected None, because .* contains them"):
        Normalizer.load(tmp_path, modes="q99")
    with pytest.raises(saccade.InputError, match=r"state_dim: expected 12, the head's in .*, got 64"):
        Normalizer.load(tmp_path, state_dim=64)
    with pytest.raises(saccade.InputError, match=r"embodiment: expected 'new_embodiment' .*, got 5"):
        Normalizer.load(tmp_path, 5)


def test_a_wide_state_is_cut_off_as_the_code_bases_do() -> None:
    wide, narrow = Normalizer.load(metadata(), state_dim=9), Normalizer.load(metadata(), state_dim=4)
    assert np.array_equal(as_array(narrow.state(draw(2, 5))), as_array(wide.state(draw(2, 5)))[:, :4])


def test_statistics_may_have_any_dtype(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")
    expected = as_array(Normalizer.load(tmp_path).state(draw(1, 7)))
    statistics = layouts.flat_statistics("observation.state", 7, 0) | layouts.flat_statistics(
        "action", 6, 100
    )
    doubles = {name: values.double().numpy() for name, values in statistics.items()}
    for path in tmp_path.glob("policy_*.safetensors"):
        save_file({**doubles, "action.count": np.array([5])}, path)
    assert np.array_equal(as_array(Normalizer.load(tmp_path).state(draw(1, 7))), expected)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00" * 7,
        b"\xff" * 8,
        (5).to_bytes(8, "little") + b"hello",
        (2).to_bytes(8, "little") + b"[]",
        b'\x3c\x00\x00\x00\x00\x00\x00\x00{"action.min":{"dtype":"F32","shape":[6],"data_offsets":[0,24]}}',
        b'\x41\x00\x00\x00\x00\x00\x00\x00{"action.min":{"dtype":"F32","shape":[6],"data_offsets":[-24,0]}}'
        + b"\0" * 24,
        b'\x40\x00\x00\x00\x00\x00\x00\x00{"action.min":{"dtype":"F99","shape":[6],"data_offsets":[0,24]}}'
        + b"\0" * 24,
    ],
)
def test_broken_files_of_statistics(content: bytes, tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")
    next(tmp_path.glob("policy_preprocessor_step*")).write_bytes(content)
    with pytest.raises(saccade.CheckpointError, match="policy_preprocessor_step"):
        Normalizer.load(tmp_path)


@pytest.mark.parametrize("name", ["../elsewhere.safetensors", "a/b.safetensors", "", 7])
def test_a_step_may_only_name_a_file_beside_it(name: Any, tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")

    def rename(values: dict[str, Any]) -> None:
        next(step for step in values["steps"] if "state_file" in step)["state_file"] = name

    edit(tmp_path / "policy_preprocessor.json", rename)
    with pytest.raises(saccade.CheckpointError, match="state_file"):
        Normalizer.load(tmp_path)


def test_it_says_what_it_is() -> None:
    text = repr(Normalizer.load(metadata()))
    assert "new_embodiment" in text
    assert "arm 3 min_max, gripper 2 min_max) to 5" in text
