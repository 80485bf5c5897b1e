"""The plugin in lerobot's rollout, with real-time chunking. `make test-compat` runs this in lerobot 0.6."""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import plugin_cases
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.rollout import RolloutConfig, build_rollout_context, create_strategy
from lerobot.rollout.inference import RTCInferenceConfig, SyncInferenceConfig
from lerobot.rollout.inference.rtc import supports_rtc_inference
from plugin_robot import JOINTS, TASK, TrialRobotConfig

import saccade
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy

# Fixtures.
checkpoint, policy, batch = plugin_cases.checkpoint, plugin_cases.policy, plugin_cases.batch

EXECUTION_HORIZON = 6


class Rollout:
    """A rollout that ends after some actions, with every chunk that was predicted on the way."""

    def __init__(self, policy: SaccadePolicy, folder: Path, inference: Any, actions: int) -> None:
        policy.save_pretrained(folder)
        stopped = threading.Event()
        config = PreTrainedConfig.from_pretrained(folder)
        config.pretrained_path = folder
        robot = TrialRobotConfig(after=lambda _, count: stopped.set() if count >= actions else None)
        with mock.patch("sys.argv", ["lerobot-rollout"]):
            options = RolloutConfig(
                robot=robot,
                policy=config,
                inference=inference,
                fps=5,
                task=TASK,
                return_to_initial_position=False,
            )
        self.context = build_rollout_context(options, stopped)
        self.policy = self.context.policy.policy
        self.calls: list[tuple[dict[str, Any], dict[str, Any], torch.Tensor]] = []
        self.predict = self.policy.predict_action_chunk
        strategy = create_strategy(options.strategy)
        limit = threading.Timer(120, stopped.set)
        limit.start()
        with mock.patch.object(self.policy, "predict_action_chunk", self._record):
            try:
                strategy.setup(self.context)
                strategy.run(self.context)
            finally:
                limit.cancel()
                strategy.teardown(self.context)
        sent = self.context.hardware.robot_wrapper.inner.actions
        self.sent = np.array([[action[joint] for joint in JOINTS] for action in sent[:actions]], np.float32)

    def _record(self, batch: dict[str, Any], **options: Any) -> torch.Tensor:
        chunk = self.predict(batch, **options)
        self.calls.append((batch, options, chunk))
        return chunk


def test_the_engine_takes_it(policy: SaccadePolicy) -> None:
    assert supports_rtc_inference(policy)


def test_a_rollout_with_real_time_chunking(policy: SaccadePolicy, tmp_path: Path) -> None:
    rtc = RTCConfig(execution_horizon=EXECUTION_HORIZON)
    rollout = Rollout(policy, tmp_path / "saved", RTCInferenceConfig(rtc=rtc), actions=8)
    assert rollout.policy.config.rtc_config is rtc
    assert len(rollout.sent) == 8
    assert len(rollout.calls) >= 2
    chunks = torch.cat([chunk[0] for _, _, chunk in rollout.calls]).numpy()
    for action in rollout.sent:
        assert (chunks == action).all(axis=1).any()
    last: torch.Tensor | None = None
    for number, (batch, options, chunk) in enumerate(rollout.calls):
        left_over, delay = options["prev_chunk_left_over"], options["inference_delay"]
        given: dict[str, Any] = {}
        if last is not None:
            assert len(left_over) == EXECUTION_HORIZON
            used = left_over[: int(left_over.any(dim=1).sum())]
            first = next(row for row in range(len(last)) if torch.equal(last[row], used[0]))
            assert torch.equal(last[first : first + len(used)], used)
            frozen = min(delay, len(used))
            rule = saccade.Chunking(overlap=len(used), frozen=frozen, horizon=len(used))
            given = {"previous_chunk": used[None], "chunking": rule}
            # What the robot executes meanwhile is the beginning of the new chunk.
            torch.testing.assert_close(chunk[0, :frozen], used[:frozen], rtol=1e-5, atol=1e-5)
        observation = {key: value for key, value in batch.items() if key != "action"}
        expected = policy.policy.act(observation, seed=7 + number, **given)
        assert torch.equal(chunk, expected)
        last = chunk[0]


def test_a_rollout_without(policy: SaccadePolicy, tmp_path: Path) -> None:
    rollout = Rollout(policy, tmp_path / "saved", SyncInferenceConfig(), actions=3)
    ((_, options, chunk),) = rollout.calls
    assert options == {"noise": None}
    np.testing.assert_array_equal(rollout.sent, chunk[0, :3].numpy())


def test_a_chunk_is_continued(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    """The same as `saccade.Policy.act`, from one row for all, and from a longer chunk."""
    policy.reset()
    before = policy.predict_action_chunk(batch)
    left_over = before[:, 4:12]
    policy.reset()
    # Other keywords have no effect, as in lerobot's own GR00T policy.
    chunk = policy.predict_action_chunk(
        batch, prev_chunk_left_over=left_over, inference_delay=3, execution_horizon=2
    )
    rule = saccade.Chunking(overlap=8, frozen=3, horizon=12)
    expected = policy.policy.act(
        plugin_cases.plain(batch),
        seed=7,
        chunking=rule,
        previous_chunk={"hand": before[..., :3].numpy(), "gripper": before[..., 3:].numpy()},
    )
    np.testing.assert_array_equal(chunk.numpy(), plugin_cases.joined(expected))
    torch.testing.assert_close(chunk[:, :3], left_over[:, :3], rtol=1e-5, atol=1e-5)
    policy.reset()
    shared = policy.predict_action_chunk(batch, prev_chunk_left_over=left_over[0], inference_delay=8)
    for row in shared[:, :8]:
        torch.testing.assert_close(row, left_over[0], rtol=1e-5, atol=1e-5)


def test_what_does_not_fit_is_refused(policy: SaccadePolicy, batch: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"prev_chunk_left_over: .*B 3, got"):
        policy.predict_action_chunk(batch, prev_chunk_left_over=torch.ones(2, 3, 4))
    with pytest.raises(ValueError, match="finite"):
        policy.predict_action_chunk(batch, prev_chunk_left_over=torch.full((3, 4), torch.nan))
    with pytest.raises(ValueError, match="expected"):
        policy.predict_action_chunk(batch, prev_chunk_left_over=torch.ones(3, 5))
