"""lerobot's async inference with the plugin: its client, its server, gRPC. `make test-compat` runs this."""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import pickle
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import plugin_cases
import pytest
import torch
from lerobot.async_inference.configs import PolicyServerConfig, RobotClientConfig
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.async_inference.robot_client import RobotClient
from lerobot.transport import services_pb2
from plugin_cases import VIEWS
from plugin_robot import JOINTS, TASK, TrialRobotConfig, observation

from lerobot_policy_saccade.async_server import SaccadePolicyServer
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy

# Fixtures.
checkpoint, policy = plugin_cases.checkpoint, plugin_cases.policy

CHUNK = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("async")


@pytest.fixture(scope="module")
def saved(policy: SaccadePolicy, folder: Path) -> Path:
    policy.save_pretrained(folder / "saved")
    return folder / "saved"


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    """A server, started as users start it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "lerobot_policy_saccade.async_server", f"--port={port}"]
    with (folder / "server.txt").open("w") as log:
        server = subprocess.Popen(
            [*command, "--host=127.0.0.1"], cwd=folder, stdout=log, stderr=subprocess.STDOUT
        )
        try:
            with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
                grpc.channel_ready_future(channel).result(timeout=180)
            yield f"127.0.0.1:{port}"
        finally:
            server.kill()
            server.wait()


def client_of(address: str, saved: Path, **options: Any) -> RobotClient:
    config = RobotClientConfig(
        policy_type="saccade",
        pretrained_name_or_path=str(saved),
        robot=TrialRobotConfig(**options),
        actions_per_chunk=CHUNK,
        server_address=address,
        fps=5,
        task=TASK,
    )
    return RobotClient(config)


def batch_of(seen: dict[str, Any]) -> dict[str, Any]:
    """An observation as lerobot's rollout gives it."""
    frames = {
        f"observation.images.{name}": torch.from_numpy(seen[name]).movedim(-1, 0)[None] for name in VIEWS
    }
    state = torch.tensor([[seen[name] for name in JOINTS]], dtype=torch.float32)
    return {**frames, "observation.state": state, "task": [TASK]}


def test_a_chunk_over_grpc(policy: SaccadePolicy, address: str, saved: Path) -> None:
    client = client_of(address, saved)
    assert client.start()
    policy.reset()
    for number in range(2):
        seen = observation(number)
        sent = TimedObservation(
            timestamp=time.time(), timestep=10 * number, observation={**seen, "task": TASK}, must_go=True
        )
        assert client.send_observation(sent)
        answer = client.stub.GetActions(services_pb2.Empty())
        actions = pickle.loads(answer.data)
        assert [action.get_timestep() for action in actions] == [10 * number + step for step in range(CHUNK)]
        expected = policy.predict_action_chunk(batch_of(seen))[0, :CHUNK]
        assert torch.equal(torch.stack([action.get_action() for action in actions]), expected)
    client.stop()


def test_a_robot_runs(address: str, saved: Path) -> None:
    """lerobot's client with both of its threads."""
    finished = threading.Event()
    client = client_of(address, saved, after=lambda _, count: finished.set() if count >= 8 else None)
    client.shutdown_event = finished
    assert client.start()
    receiver = threading.Thread(target=client.receive_actions, daemon=True)
    receiver.start()
    limit = threading.Timer(120, client.shutdown_event.set)
    limit.start()
    client.control_loop(task=TASK)
    limit.cancel()
    receiver.join(timeout=60)
    actions = np.array([[action[joint] for joint in JOINTS] for action in client.robot.actions])
    client.stop()
    assert len(actions) >= 8
    assert np.isfinite(actions).all()


def test_other_types_are_as_in_lerobot(address: str, saved: Path) -> None:
    client = client_of(address, saved)
    client.policy_config = RemotePolicyConfig("none", str(saved), {}, CHUNK)
    assert not client.start()
    client.stop()


def test_frames_are_resized_as_the_policy_says() -> None:
    """To the size that it names, and otherwise not."""
    server = SaccadePolicyServer(PolicyServerConfig())
    feature = object()
    server.policy = type("Policy", (), {"config": type("Config", (), {"image_features": {}})})
    server.lerobot_features = {
        "observation.state": {"shape": (4,)},
        "observation.images.front": {"shape": (48, 64, 3)},
    }
    assert server.policy_image_features["observation.images.front"].shape == (3, 48, 64)
    server.policy.config.image_features = {"observation.images.front": feature}
    assert server.policy_image_features == {"observation.images.front": feature}
