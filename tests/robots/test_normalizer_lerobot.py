"""A robot's units to the head's and back as lerobot does it, compared with lerobot's own steps."""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch

import saccade
from saccade import Normalizer
from saccade.observations import read_requirements
from tests.helpers import layout_files
from tests.helpers.normalizer_cases import as_array, draw, edit, step_config
from tests.helpers.paths import DATA
from tests.helpers.published import sidecars


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
    normalizer = Normalizer.from_pretrained(tmp_path)
    statistics: dict[str, dict[str, torch.Tensor]] = {"observation.state": {}, "action": {}}
    for key in statistics:
        width = 7 if key == "observation.state" else 6
        seed = 3 if key == "observation.state" else 103
        for name, values in layout_files.flat_statistics(key, width, seed).items():
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
    assert np.array_equal(as_array(normalizer.normalize_actions(robot)), packed["action"].numpy())
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
    assert Normalizer.from_pretrained(tmp_path).embodiment_id == 0


def test_n15_ignores_normalize_min_max(tmp_path: Path) -> None:
    """lerobot 0.4.4 and 0.5.1 replace the option when they load a policy."""
    sidecars(tmp_path, "lerobot")
    plain, state = Normalizer.from_pretrained(tmp_path), draw(2, 7)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        edit(tmp_path / name, lambda values: step_config(values).update(normalize_min_max=False))
    found = Normalizer.from_pretrained(tmp_path)
    assert np.array_equal(as_array(found.state(state)), as_array(plain.state(state)))
    assert np.array_equal(as_array(found.actions(draw(2, 3, 8))), as_array(plain.actions(draw(2, 3, 8))))


def test_without_min_max_n17_leaves_the_numbers_alone(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot-n17")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        edit(tmp_path / name, lambda values: step_config(values).update(normalize_min_max=False))
    normalizer, state = Normalizer.from_pretrained(tmp_path), draw(2, 7)
    assert np.array_equal(as_array(normalizer.state(state))[:, :7], state)
    assert np.array_equal(as_array(normalizer.actions(draw(2, 3, 8))), draw(2, 3, 8)[..., :6])


def test_lerobot_after_0_5_1_clips_states(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot-n17", seed=5)
    normalizer, state = Normalizer.from_pretrained(tmp_path), draw(50, 7, scale=5.0)
    low, high = (layout_files.flat_statistics("s", 7, 5)[f"s.{name}"].numpy() for name in ("min", "max"))
    expected = np.clip(2 * (state[:, :6] - low[:6]) / (high[:6] - low[:6]) - 1, -1, 1)
    assert np.allclose(as_array(normalizer.state(state))[:, :6], expected, atol=1e-6)
    assert not as_array(normalizer.state(state))[:, 6:].any()
    assert normalizer.embodiment_id == layout_files.N17_EMBODIMENTS["new_embodiment"]


def test_a_policy_without_its_config_is_refused(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot-n17")
    (tmp_path / "config.json").unlink(missing_ok=True)
    with pytest.raises(saccade.CheckpointError, match=r"config\.json: missing"):
        Normalizer.from_pretrained(tmp_path)


def case(name: str, folder: Path) -> Path:
    """A copy of a case that the released lerobot made."""
    return Path(shutil.copytree(DATA / "robots" / "lerobot" / name, folder / name))


def test_an_empty_name_excludes_no_joint(tmp_path: Path) -> None:
    folder = case("n17-generic-relative", tmp_path)
    plain = Normalizer.from_pretrained(folder).offsets

    def exclude(*names: str) -> Any:
        def change(values: dict[str, Any]) -> None:
            step = next(one for one in values["steps"] if one["registry_name"].startswith("relative"))
            step["config"]["exclude_joints"] = list(names)

        edit(folder / "policy_preprocessor.json", change)
        return Normalizer.from_pretrained(folder).offsets

    assert plain is not None
    assert exclude("").all()
    assert np.array_equal(exclude("", "grip"), plain)


def test_null_fields_of_an_action_config_are_absolute(tmp_path: Path) -> None:
    folder = case("n17-native-keys", tmp_path)
    plain = Normalizer.from_pretrained(folder)

    def change(values: dict[str, Any]) -> None:
        config = values["steps"][0]["config"]["modality_config"]["action"]["action_configs"][0]
        config["format"] = None
        del config["type"]

    edit(folder / "policy_postprocessor.json", change)
    found, chunk = Normalizer.from_pretrained(folder), draw(2, 40, 132)
    assert np.array_equal(as_array(found.actions(chunk)), as_array(plain.actions(chunk)))


@pytest.mark.parametrize("steps", [[0, 2, 4], None, "0 2 4", [0, 0.5]])
def test_the_steps_of_the_actions_are_integers_or_not_a_list_as_in_lerobot(
    steps: Any, tmp_path: Path
) -> None:
    folder = case("n17-native-keys", tmp_path)

    def change(values: dict[str, Any]) -> None:
        values["steps"][0]["config"]["modality_config"]["action"]["delta_indices"] = steps

    plain = Normalizer.from_pretrained(folder)
    edit(folder / "policy_postprocessor.json", change)
    if steps == [0, 0.5]:
        with pytest.raises(saccade.CheckpointError, match="delta_indices, a list of integers, got"):
            Normalizer.from_pretrained(folder)
        with pytest.raises(
            saccade.CheckpointError, match=r"policy_postprocessor.json: action: delta_indices: "
        ):
            read_requirements(folder, dataclasses.replace(plain, pipeline=None))
        return
    found = read_requirements(folder, Normalizer.from_pretrained(folder))
    assert found.action_indices == ((0, 2, 4) if isinstance(steps, list) else None)


@pytest.mark.parametrize("mapping", [{"new_embodiment": "7"}, [1], {"new_embodiment": -2}])
def test_an_embodiment_mapping_that_is_none_is_refused(mapping: Any, tmp_path: Path) -> None:
    folder = case("n17-chunk", tmp_path)

    def change(values: dict[str, Any]) -> None:
        pack = next(one for one in values["steps"] if one["registry_name"].startswith("groot_n1_7_pack"))
        pack["config"]["embodiment_mapping"] = mapping

    edit(folder / "policy_preprocessor.json", change)
    with pytest.raises(saccade.CheckpointError, match="embodiment ids: expected integers"):
        Normalizer.from_pretrained(folder)


def test_a_robot_may_be_named_as_the_release_does() -> None:
    folder = DATA / "robots" / "lerobot" / "n17-chunk"
    for name in ("NEW_EMBODIMENT", "new_embodiment", 10):
        assert Normalizer.from_pretrained(folder, name).embodiment_id == 10
    with pytest.raises(saccade.InputError, match="embodiment: expected an integer"):
        Normalizer.from_pretrained(folder, True)


@pytest.mark.parametrize("file", ["policy_preprocessor.json", "policy_postprocessor.json"])
@pytest.mark.parametrize(
    "step",
    [
        {"registry_name": "so101_action_representation_decode_v2", "config": {}},
        {"class": "my_robot.steps.Invert", "config": {}},
    ],
)
def test_a_step_that_is_not_known_is_refused_by_name(step: dict[str, Any], file: str, tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot-n17")
    edit(tmp_path / file, lambda values: values["steps"].append(step))
    name = step.get("registry_name") or step.get("class")
    with pytest.raises(saccade.CheckpointError, match=f"{file}: the step '{name}' is not known"):
        Normalizer.from_pretrained(tmp_path)


def test_an_option_that_is_not_known_is_refused_unless_it_is_off(tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot-n17")
    path = tmp_path / "policy_postprocessor.json"
    edit(path, lambda values: step_config(values).update(mirror=False, twist=None, shift=[]))
    Normalizer.from_pretrained(tmp_path)
    edit(path, lambda values: step_config(values).update(mirror=True))
    with pytest.raises(saccade.CheckpointError, match=r"mirror \(True\) is not known"):
        Normalizer.from_pretrained(tmp_path)
