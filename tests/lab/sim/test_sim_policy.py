"""The policy: numpy against torch, one engine against the other, and checkpoints that do not fit."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import saccade
from saccade import CheckpointError, InputError, Intervention, ShapeError
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Interventions, Policy, check_trained_on
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.sim.settings import statistics_of

Seen = dict[str, Any]


@pytest.fixture(scope="module")
def demo() -> Policy:
    return Policy.from_pretrained(num_threads=1)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the shipped checkpoint to spoil."""
    return Path(shutil.copytree(DEMO_CHECKPOINT, tmp_path / "policy"))


def edit_config(checkpoint: Path, *keys: str, value: Any) -> None:
    """Sets one entry of a checkpoint's config."""
    path = checkpoint / "config.json"
    config = json.loads(path.read_text())
    place = config
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    path.write_text(json.dumps(config))


def seen(policy: Policy, *, fill: int = 0, size: int = 68, instruction: str = "open the drawer") -> Seen:
    """What a simulator with even pictures would show."""
    images = {camera.name: np.full((size, size, 3), fill, np.uint8) for camera in policy.config.cameras}
    return {**policy.blank(instruction), "images": images}


def test_the_demo_is_a_whole_checkpoint_that_anyone_can_load(demo: Policy) -> None:
    """`saccade.Policy` gives the actions of the simulator's policy, from an observation of Isaac-GR00T's."""
    whole = saccade.Policy.from_pretrained(DEMO_CHECKPOINT, num_threads=1)
    assert whole.embodiment_id == 0
    assert whole.requirements.cameras is not None
    assert [camera.name for camera in whole.requirements.cameras] == ["left", "right", "top"]
    given, noise = seen(demo, fill=90), demo.noise(np.random.default_rng(2))
    answer = whole.act(demo.observation(given), noise=noise)
    assert {name: part.shape for name, part in answer.items()} == {"hand": (1, 16, 3), "gripper": (1, 16, 1)}
    expected = np.concatenate([answer["hand"][0], answer["gripper"][0]], axis=-1).clip(-1, 1)
    np.testing.assert_array_equal(demo.act(given, noise=noise).actions, expected)


def test_features_are_those_of_the_reference(demo: Policy) -> None:
    other = Policy.from_pretrained(engine="torch", num_threads=1)
    rng = np.random.default_rng(1)
    given = seen(demo)
    given["images"] = {
        name: rng.integers(256, size=picture.shape, dtype=np.uint8)
        for name, picture in given["images"].items()
    }
    for instruction in ("reach the green ball", "smash it!", ""):
        given["instruction"] = instruction
        features = demo.features(given)
        assert features.shape == (1, demo.num_vl_tokens(instruction), 128)
        np.testing.assert_allclose(features, other.features(given), atol=2e-4)


def test_both_engines_agree_along_a_trajectory(demo: Policy) -> None:
    other = Policy.from_pretrained(engine="torch", num_threads=1)
    rng = np.random.default_rng(0)
    with contextlib.closing(environment_for(demo, "button-press-topdown")) as environment:
        environment.restart(1)
        for _ in range(6):
            observation, noise = environment.observe(), demo.noise(rng)
            chunk = demo.act(observation, noise=noise)
            np.testing.assert_allclose(chunk.actions, other.act(observation, noise=noise).actions, atol=1e-4)
            for action in chunk.actions[: demo.config.execute_steps]:
                environment.advance(action)


def test_a_batch_of_prompts_of_different_lengths_is_each_alone(demo: Policy) -> None:
    """Also in torch, where the shorter prompt's padding must be removed."""
    noise = np.random.default_rng(4).standard_normal((2, 16, 4), dtype=np.float32)
    texts = ("open the drawer", "please press the button on the box")
    for policy in (demo, Policy.from_pretrained(engine="torch", num_threads=1)):
        given = [policy.observation(seen(policy, fill=60, instruction=text)) for text in texts]
        together = policy.whole.act(given, noise=noise)
        for one, answer, own in zip(given, together, noise, strict=True):
            alone = policy.whole.act(one, noise=own[None])
            for name, part in alone.items():
                np.testing.assert_allclose(answer[name], part, atol=1e-5)


INTERVENTIONS: dict[str, Interventions] = {
    "cut": Intervention(cut=[("action", "future"), ("state", "future")]),
    "bias": Intervention(key_bias={("vl", range(30)): -1.5, ("future", (0, 3)): 2.0}, heads=[1, 2]),
    "tokens": Intervention(future_tokens=np.zeros((5, 128), np.float32)),
    "two": (Intervention(cut=[("future", "vl")], steps=[0]), Intervention(key_bias={"state": 1.0})),
}


@pytest.mark.parametrize("name", INTERVENTIONS)
def test_interventions_reach_both_engines(demo: Policy, name: str) -> None:
    change = INTERVENTIONS[name]
    other = Policy.from_pretrained(engine="torch", num_threads=1)
    rng = np.random.default_rng(3)
    observation = seen(demo, fill=120)
    noise = demo.noise(rng)
    plain = demo.act(observation, noise=noise).actions
    changed = demo.act(observation, noise=noise, intervention=change).actions
    expected = other.act(observation, noise=noise, intervention=change).actions
    np.testing.assert_allclose(changed, expected, atol=1e-4)
    assert np.abs(changed - plain).max() > 1e-3
    # The same by hand, from the parts that studies use.
    context = demo.head.encode(demo.features(observation))
    normalised = demo.head.sample(context, demo.state(observation), 0, noise=noise, intervention=change)
    np.testing.assert_array_equal(demo.robot_actions(np.asarray(normalised))[0], changed)


@pytest.mark.parametrize("without", ["default", "empty"])
def test_guidance_reaches_both_engines(demo: Policy, without: Any) -> None:
    other = Policy.from_pretrained(engine="torch", num_threads=1)
    observation = demo.observation(seen(demo, fill=90))
    noise = demo.noise(np.random.default_rng(4))
    chunks = [
        policy.whole.act(observation, noise=noise, guidance=3.0, without=without) for policy in (demo, other)
    ]
    plain = demo.whole.act(observation, noise=noise)
    for key, chunk in chunks[0].items():
        np.testing.assert_allclose(chunk, chunks[1][key], atol=2e-4)
        assert np.abs(chunk - plain[key]).max() > 1e-2


def test_an_intervention_that_does_not_fit_is_refused(demo: Policy) -> None:
    observation = seen(demo)
    noise = demo.noise(np.random.default_rng(0))
    for policy in (demo, Policy.from_pretrained(engine="torch", num_threads=1)):
        with pytest.raises(InputError, match="block"):
            policy.act(
                observation, noise=noise, intervention=Intervention(cut=[("action", "vl")], blocks=[4])
            )


def test_episodes_take_interventions_fixed_and_by_chunk(demo: Policy) -> None:
    change = Intervention(cut=[("future", "vl")])
    asked: list[tuple[int, int]] = []

    def only_the_second(chunk: int, seed: int) -> Intervention | None:
        asked.append((chunk, seed))
        return change if chunk == 1 else None

    class Remembering(Policy):
        given: list[Any]

        def act(self, observation: Any, *, noise: Any, intervention: Interventions = None) -> Any:
            self.given.append(intervention)
            return super().act(observation, noise=noise, intervention=intervention)

    def drive(intervention: Any) -> tuple[list[Any], list[np.ndarray]]:
        policy = Remembering(demo.whole, demo.config, demo.checkpoint)
        policy.given = []
        hands: list[np.ndarray] = []
        with contextlib.closing(environment_for(policy, "button-press-topdown")) as environment:
            environment.task = dataclasses.replace(environment.task, max_steps=20)
            episode = run_episode(
                environment,
                policy,
                1,
                intervention=intervention,
                on_step=lambda seen, episode: hands.append(seen.privileged_state()[:4]),
            )
        assert episode.chunks == len(policy.given) == 5
        return policy.given, hands

    given, hands = drive(None)
    assert set(given) == {None}
    fixed, fixed_hands = drive(change)
    assert set(fixed) == {change}
    by_chunk, chunk_hands = drive(only_the_second)
    assert asked == [(number, 1) for number in range(len(by_chunk))]
    assert by_chunk == [change if number == 1 else None for number in range(len(by_chunk))]
    # Nothing but the second chunk was changed: the hand moves the same until then, and not after.
    first = demo.config.execute_steps + 1
    np.testing.assert_array_equal(chunk_hands[:first], hands[:first])
    assert not np.array_equal(chunk_hands[first + 1], hands[first + 1])
    assert not np.array_equal(fixed_hands[1], hands[1])


def test_blanked_cameras_are_black_to_the_policy(demo: Policy) -> None:
    with contextlib.closing(environment_for(demo, "reach", blanked=["left"])) as environment:
        environment.restart(0)
        images = environment.observe()["images"]
    assert not images["left"].any()
    assert all(picture.any() for name, picture in images.items() if name != "left")


def test_shipped_checkpoint_is_small_and_has_the_released_layout(demo: Policy) -> None:
    tensors = load_file(DEMO_CHECKPOINT / "model.safetensors")
    assert {name.split(".")[0] for name in tensors} == {"backbone", "action_head"}
    assert (DEMO_CHECKPOINT / "model.safetensors").stat().st_size < 10e6
    config = demo.head.config
    assert (config.num_future_tokens, config.action_horizon, config.num_steps) == (32, 16, 4)
    assert config.version == "n1.5"
    assert config.use_vlln is True
    assert config.vl_num_layers >= 1


def test_actions_are_bounded_and_repeatable(demo: Policy) -> None:
    observation = seen(demo, fill=90)
    noise = demo.noise(np.random.default_rng(5))
    first, second = (demo.act(observation, noise=noise) for _ in range(2))
    assert first.actions.shape == (16, 4)
    assert np.abs(first.actions).max() <= 1.0
    np.testing.assert_array_equal(first.actions, second.actions)
    assert set(first.milliseconds) == {"backbone", "encode", "sample"}


def test_observations_of_the_wrong_form_are_refused(demo: Policy) -> None:
    good = seen(demo)
    images = good["images"]
    noise = demo.noise(np.random.default_rng(0))
    with pytest.raises(ShapeError, match="none of camera left"):
        demo.act({**good, "images": {"top": images["top"]}}, noise=noise)
    with pytest.raises(ShapeError, match="proprio"):
        demo.act({**good, "proprio": np.zeros(3)}, noise=noise)
    with pytest.raises((InputError, ShapeError), match="left"):
        demo.act({**good, "images": {**images, "left": images["left"][..., :2]}}, noise=noise)


def test_missing_files_are_named(copied: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Policy.from_pretrained(copied / "nowhere")
    (copied / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors"):
        Policy.from_pretrained(copied)
    (copied / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        Policy.from_pretrained(copied)


@pytest.mark.parametrize("name", ["tokenizer.json", "experiment_cfg/metadata.json"])
def test_every_file_is_needed(copied: Path, name: str) -> None:
    (copied / name).unlink()
    with pytest.raises(FileNotFoundError, match=Path(name).name):
        Policy.from_pretrained(copied)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("backbone_cfg", "eagle_config", "text_config", "hidden_size"), 64, "embed_tokens"),
        (("backbone_cfg", "eagle_config", "vision_config", "image_size"), 32, "image size is 32"),
        (("simulation_cfg", "cameras"), [], "cameras: expected at least one"),
        (("simulation_cfg", "cameras"), [{"name": "left"}], "'lookat' is missing"),
        (("simulation_cfg", "execute_steps"), 17, "execute_steps: expected 1 to 16, got 17"),
        (("simulation_cfg", "image_size"), 3, "image_size: expected at least 8, got 3"),
        (("simulation_cfg",), 3, "config.json"),
    ],
)
def test_configs_that_do_not_fit_are_refused(
    copied: Path, keys: tuple[str, ...], value: Any, message: str
) -> None:
    edit_config(copied, *keys, value=value)
    with pytest.raises(CheckpointError, match=message):
        Policy.from_pretrained(copied)


def test_text_that_is_no_json_is_refused(copied: Path) -> None:
    (copied / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"config\.json"):
        Policy.from_pretrained(copied)


def test_all_tensors_that_do_not_fit_are_listed(copied: Path) -> None:
    path = copied / "model.safetensors"
    tensors = load_file(path)
    del tensors["backbone.eagle_model.mlp1.0.bias"]
    tensors["backbone.eagle_model.surplus"] = torch.zeros(1)
    save_file(tensors, path)
    with pytest.raises(CheckpointError) as caught:
        Policy.from_pretrained(copied)
    assert "mlp1.0.bias" in str(caught.value)
    assert "surplus" in str(caught.value)


def test_engine_and_threads_are_checked(demo: Policy) -> None:
    with pytest.raises(InputError, match="unknown name 'gpu', expected one of rust, torch"):
        Policy.from_pretrained(engine="gpu")
    with pytest.raises(InputError, match="num_threads: given 0"):
        Policy.from_pretrained(num_threads=0)
    with pytest.raises(CheckpointError, match="does not know sweep"):
        check_trained_on(demo, ["reach", "sweep"])


def test_statistics_are_those_of_the_groups() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, size=(500, 4)).astype(np.float32)
    found = statistics_of(values)
    assert {name: len(group["mean"]) for name, group in found.items()} == {"hand": 3, "gripper": 1}
    np.testing.assert_allclose(found["hand"]["min"], values[:, :3].min(axis=0), atol=1e-6)
    np.testing.assert_allclose(found["gripper"]["max"], values[:, 3:].max(axis=0), atol=1e-6)
    np.testing.assert_allclose(found["hand"]["std"], values[:, :3].std(axis=0), atol=1e-5)
    np.testing.assert_allclose(found["hand"]["q99"], np.quantile(values[:, :3], 0.99, axis=0), atol=1e-5)
