"""The plugin in lerobot: `make test-compat` runs this in an environment of each release."""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import doctest
import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import plugin_cases
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from plugin_cases import HORIZON, WIDTH, joined, plain

import saccade
from lerobot_policy_saccade import SaccadeConfig, SaccadeEnv
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy

# Fixtures.
checkpoint, policy, batch = plugin_cases.checkpoint, plugin_cases.policy, plugin_cases.batch


def test_lerobot_finds_policy_and_environment_by_the_name_of_the_package() -> None:
    code = (
        "import sys; from lerobot.utils.import_utils import register_third_party_plugins as register;"
        "assert 'saccade' not in sys.modules; register();"
        "from lerobot.configs.policies import PreTrainedConfig; from lerobot.envs.configs import EnvConfig;"
        "print(PreTrainedConfig.get_choice_class('saccade').__name__,"
        "EnvConfig.get_choice_class('saccade').__name__, 'saccade_lab.sim' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    # The simulation would decide how MuJoCo draws in other environments.
    assert done.stdout.split() == ["SaccadeConfig", "SaccadeEnv", "False"]


@pytest.mark.parametrize("name", ["configuration_saccade", "modeling_saccade", "processor_saccade", "files"])
def test_examples_in_docstrings(name: str) -> None:
    assert doctest.testmod(importlib.import_module(f"lerobot_policy_saccade.{name}")).failed == 0


def test_the_factories_make_it(checkpoint: Path, batch: dict[str, Any]) -> None:
    register_third_party_plugins()
    config = make_policy_config("saccade", checkpoint=str(checkpoint), num_threads=1)
    policy = make_policy(config, env_cfg=SaccadeEnv())
    assert isinstance(policy, SaccadePolicy)
    assert not list(policy.parameters())
    before, after = make_pre_post_processors(policy_cfg=config)
    action = after(policy.select_action(before(dict(batch))))
    assert action.shape == (3, WIDTH)
    assert action.dtype == torch.float32


def test_a_chunk_has_the_bits_of_saccade(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    policy.reset()
    for seed in (7, 8):
        chunk = policy.predict_action_chunk(batch)
        assert chunk.shape == (3, HORIZON, WIDTH)
        assert chunk.device.type == "cpu"
        np.testing.assert_array_equal(chunk.numpy(), joined(policy.policy.act(plain(batch), seed=seed)))
    policy.reset()
    again = policy.predict_action_chunk(batch)
    np.testing.assert_array_equal(again.numpy(), joined(policy.policy.act(plain(batch), seed=7)))


def test_noise_may_be_given(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    config = policy.policy.head.config
    noise = torch.randn(3, config.action_horizon, config.encoder_action_dim)
    chunk = policy.predict_action_chunk(batch, noise=noise)
    np.testing.assert_array_equal(chunk.numpy(), joined(policy.policy.act(plain(batch), noise=noise.numpy())))


def test_without_a_seed_torch_decides(checkpoint: Path, batch: dict[str, Any]) -> None:
    policy = SaccadePolicy(SaccadeConfig(checkpoint=str(checkpoint), num_threads=1))
    chunks = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        policy.reset()
        chunks.append(policy.predict_action_chunk(batch))
        assert not torch.equal(policy.predict_action_chunk(batch), chunks[-1])
    assert torch.equal(chunks[0], chunks[1])
    assert not torch.equal(chunks[0], chunks[2])


def test_actions_are_queued(checkpoint: Path, batch: dict[str, Any]) -> None:
    config = SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=0, n_action_steps=3, num_steps=2)
    policy = SaccadePolicy(config)
    chunks = [joined(policy.policy.act(plain(batch), seed=seed, num_steps=2)) for seed in (0, 1)]
    expected = [chunk[:, step] for chunk in chunks for step in range(3)]
    for action in expected:
        np.testing.assert_array_equal(policy.select_action(batch).numpy(), action)
    policy.select_action(batch)
    policy.reset()
    np.testing.assert_array_equal(policy.select_action(batch).numpy(), expected[0])


def test_keys_are_renamed(checkpoint: Path, policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    renamed = {"observation.images.image2": "observation.images.right"}
    other = SaccadePolicy(
        SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=7, rename_map=renamed)
    )
    policy.reset()
    expected = policy.predict_action_chunk(batch)
    batch["observation.images.image2"] = batch.pop("observation.images.right")
    assert torch.equal(other.predict_action_chunk(batch), expected)
    with pytest.raises(saccade.InputError, match="embodiment 'new_embodiment' needs cameras left"):
        policy.predict_action_chunk(batch)


def action_of(width: int) -> dict[str, PolicyFeature]:
    return {"action": PolicyFeature(type=FeatureType.ACTION, shape=(width,))}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"checkpoint": None}, "checkpoint: expected a path or an id, got none"),
        ({"checkpoint": "no/such"}, "no/such: no such path, .*not in the cache"),
        ({"device": "cuda"}, "device: expected 'cpu', got 'cuda'"),
        ({"n_action_steps": 0}, "n_action_steps: expected at least 1, got 0"),
        ({"n_action_steps": 17}, "n_action_steps: expected at most 16"),
        ({"precision": "fp4"}, "precision: .*fp4"),
        ({"preprocessing": "other"}, "preprocessing: .*other"),
        ({"embodiment": "other"}, "other"),
        ({"embodiment": "3"}, "3"),
        ({"cameras": ["front"]}, "cameras: .*front"),
        (
            {"output_features": action_of(7)},
            r"action: expected an environment of 4 numbers, hand \(3\), gripper \(1\), got 7",
        ),
    ],
)
def test_wrong_options_are_errors(checkpoint: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        SaccadePolicy(SaccadeConfig(**{"checkpoint": str(checkpoint), "num_threads": 1, **options}))


def test_training_is_an_error(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    methods = (
        policy.get_optim_params,
        policy.config.get_optimizer_preset,
        policy.config.get_scheduler_preset,
    )
    for method in (*methods, lambda: policy.forward(batch), lambda: policy(batch)):
        with pytest.raises(NotImplementedError, match="saccade policies are for inference only"):
            method()
