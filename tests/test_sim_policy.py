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

from saccade import CheckpointError, InputError, Intervention, ShapeError
from saccade.sim import learner
from saccade.sim.backbone import Backbone, BackboneConfig
from saccade.sim.instructions import Tokenizer, build_vocabulary
from saccade.sim.policy import DEMO_CHECKPOINT, Interventions, Policy, check_trained_on
from saccade.sim.rollout import environment_for, run_episode
from saccade.sim.settings import PolicyConfig, Statistics

CONFIGS = [
    BackboneConfig(24, 2, 3, image_size=16, patch_size=4, num_cameras=2, text_length=5, vocabulary_size=7),
    BackboneConfig(8, 0, 1, image_size=8, patch_size=2, num_cameras=1, text_length=1, vocabulary_size=1),
    BackboneConfig(vocabulary_size=40),
]


@pytest.fixture(scope="module")
def demo() -> Policy:
    return Policy.load(num_threads=1)


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


@pytest.mark.parametrize("config", CONFIGS)
def test_numpy_backbone_equals_torch(config: BackboneConfig) -> None:
    torch.manual_seed(0)
    module = learner.Backbone(config)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))  # also what starts at zero
    rng = np.random.default_rng(1)
    size = config.image_size
    images = rng.integers(256, size=(3, config.num_cameras, size, size, 3), dtype=np.uint8)
    words = rng.integers(config.vocabulary_size, size=(3, config.text_length))
    with torch.no_grad():
        expected = module(torch.from_numpy(images), torch.from_numpy(words)).numpy()
    tensors = {name: tensor.numpy() for name, tensor in module.state_dict().items()}
    features = Backbone(config, tensors)(images, words)
    assert features.dtype == np.float32
    assert features.shape == (3, config.num_tokens, config.width)
    np.testing.assert_allclose(features, expected, atol=1e-5)


def test_both_engines_agree_along_a_trajectory(demo: Policy) -> None:
    other = Policy.load(engine="torch", num_threads=1)
    rng = np.random.default_rng(0)
    with contextlib.closing(environment_for(demo, "button-press-topdown")) as environment:
        environment.restart(1)
        for _ in range(6):
            observation, noise = environment.observe(), demo.noise(rng)
            chunk = demo.act(observation, noise=noise)
            np.testing.assert_allclose(chunk.actions, other.act(observation, noise=noise).actions, atol=1e-4)
            for action in chunk.actions[: demo.config.execute_steps]:
                environment.advance(action)


INTERVENTIONS: dict[str, Interventions] = {
    "cut": Intervention(cut=[("action", "future"), ("state", "future")]),
    "bias": Intervention(key_bias={("vl", range(30)): -1.5, ("future", (0, 3)): 2.0}, heads=[1, 2]),
    "tokens": Intervention(future_tokens=np.zeros((5, 128), np.float32)),
    "two": (Intervention(cut=[("future", "vl")], steps=[0]), Intervention(key_bias={"state": 1.0})),
}


@pytest.mark.parametrize("name", INTERVENTIONS)
def test_interventions_reach_both_engines(demo: Policy, name: str) -> None:
    change = INTERVENTIONS[name]
    other = Policy.load(engine="torch", num_threads=1)
    rng = np.random.default_rng(3)
    images = {
        camera.name: rng.integers(256, size=(64, 64, 3), dtype=np.uint8) for camera in demo.config.cameras
    }
    observation = {"images": images, "proprio": demo.config.state.mean, "instruction": "open the drawer"}
    noise = demo.noise(rng)
    plain = demo.act(observation, noise=noise).actions
    changed = demo.act(observation, noise=noise, intervention=change).actions
    expected = other.act(observation, noise=noise, intervention=change).actions
    np.testing.assert_allclose(changed, expected, atol=1e-4)
    assert np.abs(changed - plain).max() > 1e-3
    # The same by hand, from the parts that studies use.
    context = demo.engine.encode(demo.features(observation))
    normalised = demo.engine.sample(context, demo.state(observation), noise, change)[0]
    np.testing.assert_array_equal(np.clip(demo.config.action.restore(normalised), -1, 1), changed)


def test_an_intervention_that_does_not_fit_is_refused(demo: Policy) -> None:
    images = {camera.name: np.zeros((64, 64, 3), np.uint8) for camera in demo.config.cameras}
    observation = {"images": images, "proprio": np.zeros(4), "instruction": ""}
    noise = demo.noise(np.random.default_rng(0))
    for policy in (demo, Policy.load(engine="torch", num_threads=1)):
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
        policy = Remembering(demo.config, demo.backbone, demo.engine, demo.checkpoint)
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
        assert episode.chunks == len(policy.given) == 3
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
    head = demo.config.head
    assert (head["num_target_vision_tokens"], head["action_horizon"], head["num_inference_timesteps"]) == (
        32,
        16,
        4,
    )
    assert head["use_vlln"] is True
    assert head["vl_self_attention_cfg"]["num_layers"] >= 1


def test_actions_are_bounded_and_repeatable(demo: Policy) -> None:
    images = {camera.name: np.full((64, 64, 3), 90, np.uint8) for camera in demo.config.cameras}
    observation = {
        "images": images,
        "proprio": np.array([0, 0.6, 0.2, 1]),
        "instruction": "open the drawer",
    }
    noise = demo.noise(np.random.default_rng(5))
    first, second = (demo.act(observation, noise=noise) for _ in range(2))
    assert first.actions.shape == (16, 4)
    assert np.abs(first.actions).max() <= 1.0
    np.testing.assert_array_equal(first.actions, second.actions)
    assert set(first.milliseconds) == {"backbone", "encode", "sample"}


def test_observations_of_the_wrong_form_are_refused(demo: Policy) -> None:
    images = {camera.name: np.zeros((64, 64, 3), np.uint8) for camera in demo.config.cameras}
    good = {"images": images, "proprio": np.zeros(4), "instruction": ""}
    noise = demo.noise(np.random.default_rng(0))
    with pytest.raises(ShapeError, match="none of camera left"):
        demo.act({**good, "images": {"top": images["top"]}}, noise=noise)
    with pytest.raises(ShapeError, match="proprio"):
        demo.act({**good, "proprio": np.zeros(3)}, noise=noise)
    small = {name: picture[:32] for name, picture in images.items()}
    with pytest.raises(ShapeError, match="images"):
        demo.act({**good, "images": small}, noise=noise)


def test_missing_files_are_named(copied: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Policy.load(copied / "nowhere")
    (copied / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors"):
        Policy.load(copied)
    (copied / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        Policy.load(copied)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("backbone_cfg", "patch_size"), 12, "not a power of two"),
        (("backbone_cfg", "width"), "wide", "expected integers for width"),
        (("backbone_cfg", "width"), 64, "backbone width and backbone_embedding_dim differ: 64 and 128"),
        (("policy_cfg", "cameras"), [], "cameras and num_cameras differ: 0 and 3"),
        (("policy_cfg", "execute_steps"), 17, "execute_steps 17 is not in 1..16"),
        (("policy_cfg", "statistics", "state"), {}, "'mean' is missing"),
        (("policy_cfg",), 3, "config.json"),
    ],
)
def test_configs_that_do_not_fit_are_refused(
    copied: Path, keys: tuple[str, ...], value: Any, message: str
) -> None:
    edit_config(copied, *keys, value=value)
    with pytest.raises(CheckpointError, match=message):
        Policy.load(copied)


def test_text_that_is_no_json_is_refused(copied: Path) -> None:
    (copied / "config.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"config\.json"):
        Policy.load(copied)


def test_backbone_lists_all_tensors_that_do_not_fit(copied: Path) -> None:
    path = copied / "model.safetensors"
    tensors = load_file(path)
    del tensors["backbone.norm.bias"]
    tensors["backbone.surplus"] = torch.zeros(1)
    tensors["backbone.register"] = torch.zeros(2, 128)
    save_file(tensors, path)
    with pytest.raises(CheckpointError) as caught:
        Policy.load(copied)
    message = str(caught.value)
    assert "norm.bias: missing" in message
    assert "surplus: unknown" in message
    assert "register: shape (2, 128), expected (1, 128)" in message


def test_engine_and_threads_are_checked(demo: Policy) -> None:
    with pytest.raises(InputError, match="unknown name 'gpu', expected one of rust, torch"):
        Policy.load(engine="gpu")
    with pytest.raises(InputError, match="num_threads: given 0"):
        Policy.load(num_threads=0)
    with pytest.raises(CheckpointError, match="does not know sweep"):
        check_trained_on(demo, ["reach", "sweep"])


def test_config_survives_a_round_trip(demo: Policy) -> None:
    values = json.loads(json.dumps(demo.config.to_dict()))
    assert PolicyConfig.from_dict(values) == demo.config


def test_tokenizer_pads_cuts_and_knows_what_it_does_not_know() -> None:
    vocabulary = build_vocabulary(["open the drawer", "Press the button!"])
    assert vocabulary == ("<pad>", "<unknown>", "button", "drawer", "open", "press", "the")
    tokenizer = Tokenizer(vocabulary, 4)
    assert tokenizer("Open, the DRAWER.").tolist() == [4, 6, 3, 0]
    assert tokenizer("smash the the the the button").tolist() == [1, 6, 6, 6]
    assert tokenizer("").tolist() == [0, 0, 0, 0]


def test_statistics_normalise_and_restore() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, size=(500, 2)).astype(np.float32)
    values[:, 1] = 7.0  # a constant dimension must not divide by zero
    found = Statistics.of(values)
    normalised = found.normalize(values)
    assert abs(normalised[:, 0].std() - 1.0) < 1e-3
    np.testing.assert_allclose(normalised[:, 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(found.restore(normalised), values, atol=1e-5)
