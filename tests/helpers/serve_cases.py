"""Helpers of the server's tests: a policy in memory, servers in threads, raw clients.

The policy has the interface of `saccade.Policy` and no weights, so that tests of the protocol are fast and
show which requests were computed together. Real checkpoints are served in `tests/serve/test_checkpoints.py`.
"""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import zmq

from saccade.observations import Camera, ParsedObservation, Requirements
from saccade.policy.encoding import PolicyContext
from saccade.serve import Limits, Server
from saccade.serve.transport import bind

HORIZON, WIDTH, BUCKETS = 8, 3, 1000
PONG = {"status": "ok", "message": "Server is running"}
#: What ZMTP 3 begins with, and the first command of a REQ socket.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
GROUPS = (SimpleNamespace(key="arm", size=2), SimpleNamespace(key="gripper", size=1))


def process(frames: Sequence[Any], instruction: str | None, *, plain_text: bool) -> SimpleNamespace:
    """Stands in for the processor: the brightness of the first frame, `(1, 1, 1)`."""
    if "explode" in str(instruction):
        raise RuntimeError("exploded")
    mean = frames[0].mean(dtype=np.float64)
    return SimpleNamespace(brightness=np.full((1, 1, 1), mean), crashes="crash" in str(instruction))


def brightness(features: Any, **masks: Any) -> Any:
    """Stands in for `encode` of the head."""
    return features[:, 0, 0]


@dataclass
class MemoryPolicy:
    """Actions are the noise plus the state, and the brightness of the frames.

    Attributes:
        batches: The sizes of the batches of which features were computed.
        chunkings: The `Chunking` of each call of `sample`, or None.
        steps: The number of Euler steps of each call of `sample`, or None.
        weights: The guidance of each call of `sample`, or None.
        gate: Features are computed once it is set.
        begun: The sizes of the batches that have come to the gate.
        nbytes: Size of its backbone.
    """

    version: str = "n1.5"
    batches: list[int] = field(default_factory=list)
    begun: list[int] = field(default_factory=list)
    chunkings: list[Any] = field(default_factory=list)
    steps: list[int | None] = field(default_factory=list)
    weights: list[float | None] = field(default_factory=list)
    gate: threading.Event = field(default_factory=threading.Event)
    nbytes: int = 1 << 32

    def __post_init__(self) -> None:
        self.gate.set()
        config = SimpleNamespace(
            action_horizon=HORIZON,
            encoder_action_dim=WIDTH,
            version=self.version,
            num_timestep_buckets=BUCKETS,
        )
        self.head = SimpleNamespace(config=config, source=None, num_threads=2, encode=brightness)
        self.backbone = SimpleNamespace(nbytes=self.nbytes, encode_many=self.encode_many)
        self.processor = process
        self.normalizer = SimpleNamespace(state_groups=GROUPS, action_groups=GROUPS, action_horizon=HORIZON)
        self.requirements = Requirements(
            "robot", (Camera("front"),), (("arm", 2), ("gripper", 1)), language_keys=("annotation.task",)
        )

    def encode_many(self, inputs: Sequence[Any], *, previous: Sequence[Any] = ()) -> list[Any]:
        self.begun.append(len(inputs))
        self.gate.wait(60)
        self.batches.append(len(inputs))
        if any(one.crashes for one in inputs):
            raise MemoryError("crashed")
        return [
            SimpleNamespace(backbone_features=one.brightness, image_mask=np.ones((1, 1), bool))
            for one in inputs
        ]

    def sample(
        self, encoded: PolicyContext, observations: Sequence[ParsedObservation], **options: Any
    ) -> list[Any]:
        context: Any = encoded.context
        self.chunkings.append(options.get("chunking"))
        self.steps.append(options.get("num_steps"))
        self.weights.append(options.get("guidance"))
        assert (encoded.without is None) == (options.get("guidance") is None)
        state = np.concatenate([parsed.state[:, -1] for parsed in observations])
        actions = options["noise"] + state[:, None] + context[:, None, None].astype(np.float32)
        if options.get("chunking") is not None:
            chunking = options["chunking"]
            previous = np.concatenate([chunk["arm"] for chunk in options["previous_chunk"]])
            start = (chunking.horizon or HORIZON) - chunking.overlap
            kept = previous[:, start : start + chunking.frozen]
            actions[:, : chunking.frozen, :2] = kept
        answers, start = [], 0
        for parsed in observations:
            chunk = actions[start : start + len(parsed)]
            parts = {"arm": chunk[..., :2], "gripper": chunk[..., 2:]}
            answers.append(parsed.format.write_actions(parts, parsed))
            start += len(parsed)
        return answers


class MemoryLog:
    """A log in memory."""

    every = 0.2

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []

    def event(self, name: str, **fields: Any) -> None:
        self.lines.append({"event": name, **fields})

    def request(self, **fields: Any) -> None:
        self.lines.append({"event": "request", **fields})

    def statistics(self, summary: dict[str, Any]) -> None:
        self.lines.append({"event": "statistics", **summary})

    def close(self) -> None:
        pass

    def warnings(self) -> list[str]:
        return [str(line["message"]) for line in self.lines if line["event"] == "warning"]

    def requests(self) -> list[dict[str, Any]]:
        return [line for line in self.lines if line["event"] == "request"]


@dataclass
class Running:
    """A server in a thread."""

    server: Server
    policy: Any
    log: MemoryLog
    thread: threading.Thread
    results: list[str]

    @property
    def port(self) -> int:
        return int(self.server.address.rpartition(":")[2])

    def stop(self, why: str = "test") -> str:
        self.server.stop(why)
        self.thread.join(30)
        assert not self.thread.is_alive()
        return self.results[0]


@contextlib.contextmanager
def serving(policy: Any = None, limits: Limits = Limits(), **options: Any) -> Iterator[Running]:  # noqa: B008
    """A server on a free port."""
    policy = MemoryPolicy() if policy is None else policy
    log = MemoryLog()
    server = Server(policy, bind("127.0.0.1", 0), log, limits=limits, **options)
    results: list[str] = []
    thread = threading.Thread(target=lambda: results.append(server.run()), daemon=True)
    thread.start()
    wait_until(lambda: bool(log.lines))
    running = Running(server, policy, log, thread, results)
    try:
        yield running
    finally:
        if isinstance(policy, MemoryPolicy):
            policy.gate.set()
        server.stop("end of the test")
        thread.join(30)


@contextlib.contextmanager
def requester(port: int, kind: int = zmq.REQ, seconds: float = 10.0) -> Iterator[zmq.Socket[bytes]]:
    """A socket of ZeroMQ that is connected to a server."""
    with zmq.Context() as context, context.socket(kind) as made:
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.RCVTIMEO, int(1e3 * seconds))
        made.connect(f"tcp://127.0.0.1:{port}")
        yield made


def ask(made: zmq.Socket[bytes], value: Any) -> Any:
    """Sends a value as the released clients do, or bytes as they are; returns the decoded answer."""
    made.send(value if isinstance(value, bytes) else packed(value))
    return msgpack.unpackb(made.recv(), object_hook=decoded)


def post(made: zmq.Socket[bytes], value: Any, envelope: tuple[bytes, ...] = (b"",)) -> None:
    """Sends a request from a DEALER, and returns when the server has read it.

    The server reads the requests of a client in their order, and answers a ping at once.
    """
    for request in (value, {"endpoint": "ping"}):
        made.send_multipart([*envelope, packed(request)])
    assert answer(made) == PONG


def ping(port: int) -> Any:
    """The answer to a ping on a new connection.

    The server has noticed every connection that was closed before.
    """
    with requester(port) as made:
        return ask(made, {"endpoint": "ping"})


def answer(made: zmq.Socket[bytes]) -> Any:
    """The next answer to a DEALER, decoded."""
    return msgpack.unpackb(made.recv_multipart()[-1], object_hook=decoded)


def packed(value: Any) -> bytes:
    """msgpack with arrays as `.npy` bytes."""

    def encode(array: Any) -> Any:
        output = io.BytesIO()
        np.save(output, array, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": output.getvalue()}

    result: bytes = msgpack.packb(value, default=encode)
    return result


def decoded(value: dict[str, Any]) -> Any:
    """The hook that gives arrays."""
    if "__ndarray_class__" in value:
        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    return value


def observation(brightness: int = 7, rows: int = 1, text: str = "go") -> dict[str, Any]:
    """An observation of `MemoryPolicy` in Isaac-GR00T's nested form."""
    return {
        "video": {"front": np.full((rows, 1, 4, 4, 3), brightness, np.uint8)},
        "state": {"arm": np.ones((rows, 1, 2), np.float32), "gripper": np.zeros((rows, 1, 1), np.float32)},
        "language": {"annotation.task": [[text]] * rows},
    }


def flat_observation(brightness: int = 7, text: str = "go") -> dict[str, Any]:
    """The same as N1.5's clients send it, without a batch axis."""
    return {
        "video.front": np.full((1, 4, 4, 3), brightness, np.uint8),
        "state.arm": np.ones((1, 2), np.float32),
        "state.gripper": np.zeros((1, 1), np.float32),
        "annotation.task": [text],
    }


def get_action(seen: Any = None, **options: Any) -> dict[str, Any]:
    """A request for actions as N1.6's and N1.7's clients send it."""
    data = {"observation": observation() if seen is None else seen, "options": options or None}
    return {"endpoint": "get_action", "data": data}


def connect(port: int, data: bytes = b"") -> socket.socket:
    """A TCP connection on which some bytes were sent."""
    made = socket.create_connection(("127.0.0.1", port), timeout=10)
    made.sendall(data)
    return made


def shake_hands(port: int, data: bytes = b"") -> socket.socket:
    """A TCP connection that has greeted as a REQ socket does, and then sent some bytes."""
    made = connect(port, GREETING + READY)
    received = b""
    while b"READY" not in received:
        piece = made.recv(4096)
        assert piece, received
        received += piece
    made.sendall(data)
    return made


def wait_until(condition: Any, seconds: float = 60.0) -> None:
    """Waits until a condition holds.

    Raises:
        AssertionError: It does not within some time.
    """
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition was not reached"
        time.sleep(0.005)
