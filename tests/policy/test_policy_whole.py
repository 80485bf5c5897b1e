"""Whole checkpoints: camera frames and an instruction in, actions out."""

from __future__ import annotations

import functools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

import saccade
from saccade import CheckpointError, InputError, Policy, PolicyContext
from tests.helpers import layouts, whole_checkpoints
from tests.helpers.policy_cases import inputs_of, noise
from tests.helpers.whole_checkpoints import EMBODIMENT, data_config, whole

Observation = dict[str, Any]


@functools.cache
def load(layout: str) -> Any:
    return Policy.from_pretrained(whole(layout), embodiment=EMBODIMENT)


def told(policy: Policy, instruction: str, seed: int = 0) -> Observation:
    """An example observation with this instruction, without the batch axis."""
    example = policy.example_observation(seed)
    return {
        "video": {name: frames[0] for name, frames in example["video"].items()},
        "state": {key: values[0] for key, values in example["state"].items()},
        "language": {key: [instruction] for key in example["language"]},
    }


def same(found: dict[str, Any], expected: dict[str, Any]) -> bool:
    assert list(found) == list(expected)
    return all(np.array_equal(found[key], expected[key]) for key in expected)


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_a_policy_is_processor_backbone_and_head(layout: str) -> None:
    policy = load(layout)
    assert policy.head.embodiment_ids == (policy.embodiment_id,)
    assert policy.head.precision == policy.backbone.precision == "float32"
    observation = policy.example_observation(seed=3)
    (frames,) = [{name: view[0, 0] for name, view in observation["video"].items()}]
    ((text,),) = next(iter(observation["language"].values()))
    inputs = policy.processor(frames, text)
    assert inputs.view_names == tuple(frames) == tuple(camera.name for camera in policy.requirements.cameras)
    features = policy.backbone(inputs)
    context = policy.encode(observation)
    assert isinstance(context, PolicyContext)
    assert (context.batch, context.num_vl_tokens) == (1, inputs.input_ids.shape[1])
    assert np.array_equal(context.features[0].backbone_features, features.backbone_features)
    state = np.concatenate(list(observation["state"].values()), axis=-1)
    head = saccade.Policy(policy.head, embodiment=EMBODIMENT)
    actions = head(features.backbone_features, state, image_mask=features.image_mask, seed=7)
    answer = policy.act(observation, seed=7)
    assert np.array_equal(np.concatenate(list(answer.values()), axis=-1), actions)
    assert same(policy.sample(context, observation, seed=7), answer)
    assert same(policy.sample(context.context, observation, seed=7), answer)
    assert np.array_equal(policy.sample(context, state, seed=7), actions)


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_prompts_of_different_length_keep_the_bits_that_they_have_alone(layout: str) -> None:
    policy = load(layout)
    texts = ("push", "pick up the red block and put it behind the mug", "open the drawer", "")
    observations = [told(policy, text, seed) for seed, text in enumerate(texts)]
    start = noise(policy, len(texts))
    together = policy.act(observations, noise=start)
    lengths = {inputs.input_ids.shape[1] for inputs in inputs_of(policy, observations)}
    assert len(lengths) > 2
    for index, observation in enumerate(observations):
        assert same(policy.act(observation, noise=start[index]), together[index])
    joined = {
        part: {
            key: [one[part][key] for one in observations]
            if part == "language"
            else np.stack([one[part][key] for one in observations])
            for key in observations[0][part]
        }
        for part in observations[0]
    }
    batch = policy.act(joined, noise=start)
    assert all(same({key: batch[key][row] for key in batch}, together[row]) for row in range(len(texts)))


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_what_did_not_change_is_taken_from_the_context_before(layout: str) -> None:
    policy = load(layout)
    first = told(policy, "push the button", seed=1)
    context = policy.encode(first)
    cameras = list(first["video"])
    second = {**first, "video": {**first["video"], cameras[-1]: first["video"][cameras[-1]] ^ np.uint8(1)}}
    third = {**first, "language": {key: ["push the lever"] for key in first["language"]}}
    start = noise(policy, 3)
    for index, changed in enumerate((first, second, third)):
        fresh = policy.encode(changed)
        reused = policy.encode(changed, previous=context)
        assert np.array_equal(fresh.features[0].backbone_features, reused.features[0].backbone_features)
        expected = policy.act(changed, noise=start[index])
        assert same(policy.act(changed, noise=start[index], previous=context), expected)
        assert same(policy.sample(reused, changed, noise=start[index]), expected)
    several = policy.encode([second, first, third], previous=context)
    answers = policy.act([second, first, third], noise=start, previous=several)
    assert same(answers[2], policy.act(third, noise=start[2]))


def test_one_string_a_row_of_a_batch_is_rendered_plainly() -> None:
    """As Isaac-GR00T N1.5 does; all other forms are rendered as a list."""
    policy = load("isaac")
    nested = policy.example_observation()
    flat = {
        **{f"video.{name}": frames for name, frames in nested["video"].items()},
        **{f"state.{name}": values for name, values in nested["state"].items()},
    }
    plain = inputs_of(policy, flat | {"annotation.human.task_description": ["push"]})[0]
    listed = inputs_of(policy, flat | {"annotation.human.task_description": [["push"]]})[0]
    assert np.array_equal(listed.input_ids, inputs_of(policy, told(policy, "push"))[0].input_ids)
    words = [policy.processor.tokens(text) for text in ("push", "['push']")]
    assert plain.input_ids.shape[1] - listed.input_ids.shape[1] == len(words[0]) - len(words[1])
    text = policy.act(flat | {"annotation.human.task_description": ["push"]}, seed=0)
    other = policy.act(flat | {"annotation.human.task_description": [["push"]]}, seed=0)
    assert not same(text, other)


@pytest.mark.parametrize("precision", ["bfloat16", {"backbone": "int8", "head": "bfloat16"}])
def test_parts_may_differ_in_precision(precision: Any) -> None:
    policy: Any = Policy.from_pretrained(
        whole("n17"), embodiment=EMBODIMENT, precision=precision, num_threads=1
    )
    both = precision if isinstance(precision, dict) else dict.fromkeys(("backbone", "head"), precision)
    assert {"backbone": policy.backbone.precision, "head": policy.head.precision} == both
    assert policy.backbone.num_threads == policy.head.num_threads == 1
    exact = load("n17").act(told(policy, "push"), seed=0)
    found = policy.act(told(policy, "push"), seed=0)
    assert all(np.allclose(found[key], exact[key], atol=0.3) for key in exact)


def test_the_data_config_of_a_fine_tune_may_differ_from_its_metadata() -> None:
    default = load("isaac")
    policy: Any = Policy.from_pretrained(whole("isaac"), cameras=["front"])
    assert [camera.name for camera in policy.requirements.cameras] == ["front"]
    observation = told(policy, "push")
    assert list(observation["video"]) == ["front"]
    policy.act(observation)
    with pytest.raises(InputError, match="wrist"):
        default.act(observation)
    swapped = Policy.from_pretrained(whole("isaac"), cameras=["front", "wrist"])
    observation = told(default, "push")
    assert not same(swapped.act(observation, seed=0), default.act(observation, seed=0))
    config = data_config("front")
    policy = Policy.from_pretrained(whole("isaac"), data_config=config)
    assert policy.requirements.state == (("hand", 2), ("arm", 5))
    assert [camera.name for camera in policy.requirements.cameras] == ["front"]
    assert policy.head.config.action_horizon == 3
    assert policy.act(observation)["arm"].shape[-2] == 3
    with pytest.raises(InputError, match=r"action_horizon: expected 3, .* got 4"):
        Policy.from_pretrained(whole("isaac"), data_config=config, action_horizon=4)
    with pytest.raises(InputError, match="data_config: expected None with a Normalizer"):
        Policy.from_pretrained(whole("isaac"), data_config=config, normalizer=policy.normalizer)
    assert (
        Policy.from_pretrained(whole("isaac"), action_horizon=2).act(told(default, "push"))["arm"].shape[-2]
        == 2
    )
    wrong: tuple[tuple[Any, str], ...] = (
        (["top"], r"cameras: expected names among those of the checkpoint \(wrist, front\), got top"),
        (["front", "front"], "cameras: expected distinct names"),
        ("front", "cameras: expected distinct names"),
        ([], "cameras: expected distinct names"),
    )
    for cameras, message in wrong:
        with pytest.raises(InputError, match=message):
            Policy.from_pretrained(whole("isaac"), cameras=cameras)


@pytest.mark.parametrize("layout", ["nvidia", "lerobot", "n17"])
def test_half_a_checkpoint_is_named(layout: str, tmp_path: Path) -> None:
    tensors = layouts.read(whole(layout), "")
    for part, message in (
        ("backbone.", "got a backbone without an action head"),
        ("action_head.", r"got an action head without a backbone"),
    ):
        folder = tmp_path / part
        shutil.copytree(whole(layout), folder, ignore=shutil.ignore_patterns("model*"))
        kept = {name: tensor for name, tensor in tensors.items() if part in name}
        save_file(kept, folder / "model.safetensors")
        with pytest.raises(CheckpointError, match=message):
            Policy.from_pretrained(folder, embodiment=EMBODIMENT)
    alone = tmp_path / "alone"
    layouts.write(alone, "saccade")
    with pytest.raises(CheckpointError, match=r"saccade\.Policy\(saccade\.ActionHead\.from_pretrained"):
        Policy.from_pretrained(alone)


def test_what_cannot_be_loaded_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no-such"):
        Policy.from_pretrained(tmp_path / "no-such")
    with pytest.raises(InputError, match=r"embodiment: expected one of those in .* got None"):
        Policy.from_pretrained(whole("nvidia"))
    with pytest.raises(InputError, match="got 'walker'"):
        Policy.from_pretrained(whole("nvidia"), embodiment="walker")
    with pytest.raises(InputError, match="precision: expected a name, or names for backbone and head"):
        Policy.from_pretrained(whole("isaac"), precision={"head": "int8"})
    with pytest.raises(InputError, match="precision"):
        Policy.from_pretrained(whole("isaac"), precision={"head": "int8", "backbone": "int2"})
    with pytest.raises(InputError, match="preprocessing"):
        Policy.from_pretrained(whole("isaac"), preprocessing="mine")  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match="missing"):
        Policy.from_pretrained(whole("isaac"), tokenizer=tmp_path / "missing.json")
    bare = whole_checkpoints.write(tmp_path / "bare", "isaac", tokenizer=False)
    with pytest.raises((CheckpointError, FileNotFoundError), match="tokenizer"):
        Policy.from_pretrained(bare)
    policy = Policy.from_pretrained(bare, tokenizer=whole("isaac") / "tokenizer.json")
    assert same(policy.act(told(policy, "push"), seed=1), load("isaac").act(told(policy, "push"), seed=1))
    metadata = tmp_path / "bare" / "experiment_cfg" / "metadata.json"
    values = json.loads(metadata.read_text())
    values[EMBODIMENT]["modalities"]["video"] = ["front"]
    metadata.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match="cameras of an unknown form"):
        Policy.from_pretrained(bare, tokenizer=whole("isaac") / "tokenizer.json")


def test_a_policy_needs_numpy_only(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in {'torch', 'transformers', 'tokenizers', 'PIL', 'safetensors'}:\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "import saccade\n"
        f"policy = saccade.Policy.from_pretrained({str(whole('isaac'))!r})\n"
        "print(policy.act(policy.example_observation(), seed=0)['arm'].shape)\n"
        "others = {name.split('.')[0] for name in sys.modules} - set(sys.stdlib_module_names)\n"
        # NumPy's own modules that are compiled by Cython register this one.
        "print(sorted(name for name in others - {'cython_runtime'} if not name.startswith('_')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["(1, 16, 5)", "['numpy', 'saccade']"]


def test_repr_says_how_frames_are_prepared() -> None:
    assert re.search(
        r"backbone=<saccade\.Backbone n1\.5 .*processor=<saccade\.Processor .*isaac", repr(load("isaac"))
    )
    assert "lerobot" in repr(load("lerobot").processor)


def test_the_backbone_of_a_whole_checkpoint_gives_the_released_features() -> None:
    """The frames and the instruction of the fixture, by way of the policy's own processor."""
    file = whole_checkpoints.DATA / "n15_two_views.safetensors"
    tensors = load_file(file)
    policy = load("lerobot")
    about = whole_checkpoints.about_backbone("lerobot")
    frames = [tensors[f"_raw.0.{view}"].numpy() for view in range(2)]
    inputs = policy.processor(frames, about["instructions"][0])
    found = policy.backbone(inputs).backbone_features
    expected = tensors["_out.backbone_features"].numpy()
    assert np.abs(found - expected).max() <= 4 * about["f32_max_abs_vs_f64"] + 1e-6 * np.abs(expected).max()
