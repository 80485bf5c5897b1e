"""Whole checkpoints behind the server: the bits of `Policy.act`, sessions, the command until SIGTERM."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import pty
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq.auth

import saccade
from saccade import Policy
from saccade.observations import read
from saccade.serve import Client, ServerError, engine
from saccade.serve.batching import Job
from saccade.serve.requests import Call, Options
from saccade.serve.sessions import Sessions
from tests.helpers import whole_checkpoints
from tests.helpers.serve_cases import ask, packed, requester, serving, wait_until

#: One of each release, and lerobot's.
LAYOUTS = ("nvidia", "n16", "n17", "lerobot")
WORDS = ("push", "open the drawer with the handle", "", "pick up the red block and put it on the left plate")


@functools.cache
def policy(layout: str) -> Policy:
    return Policy.from_pretrained(
        whole_checkpoints.whole(layout), embodiment=whole_checkpoints.EMBODIMENT, num_threads=2
    )


def nested(layout: str, seed: int) -> dict[str, Any]:
    seen = policy(layout).example_observation(seed)
    (key,) = seen["language"]
    return seen | {"language": {key: [[WORDS[seed % len(WORDS)]]]}}


def flat(seen: dict[str, Any]) -> dict[str, Any]:
    """As N1.5's clients send it, without a batch axis."""
    found = {f"{part}.{key}": seen[part][key][0] for part in ("video", "state") for key in seen[part]}
    return found | {key: rows[0] for key, rows in seen["language"].items()}


def assert_same(found: Any, expected: Any) -> None:
    """The same keys and bits."""
    if isinstance(expected, np.ndarray):
        found, expected = {"": found}, {"": expected}
    assert found.keys() == expected.keys()
    for key in expected:
        assert found[key].dtype == expected[key].dtype
        np.testing.assert_array_equal(found[key], expected[key])


@pytest.fixture(params=["small", "large"])
def size(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Whether the server takes the policy for a small one, which several threads compute, each on its own."""
    if request.param == "large":
        monkeypatch.setattr(engine, "SMALL_BACKBONE", 0)
    return str(request.param)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.usefixtures("size")
def test_answers_are_those_of_act(layout: str) -> None:
    whole, seen = policy(layout), nested(layout, 1)
    with serving(whole, seed=9) as running, Client(port=running.port) as client:
        assert_same(client.get_action(seen, {"seed": 5})[0], whole.act(seen, seed=5))
        assert_same(client.get_action(flat(seen), {"seed": 6})[0], whole.act(flat(seen), seed=6))
        assert_same(client.call("get_action", flat(seen)), whole.act(flat(seen), seed=9))
        state = np.concatenate([seen["state"][key][:, -1] for key in seen["state"]], axis=-1)
        as_lerobot = {
            f"observation.images.{name}": np.moveaxis(frames[:, -1], -1, 1)
            for name, frames in seen["video"].items()
        } | {"observation.state": state, "task": ["push"]}
        assert_same(client.get_action(as_lerobot, {"seed": 7})[0], whole.act(as_lerobot, seed=7))


@pytest.mark.parametrize("layout", ["nvidia", "n17"])
def test_an_answer_has_the_same_bits_alone_and_among_others(layout: str, size: str) -> None:
    whole = policy(layout)

    def act(seed: int) -> Any:
        seen = nested(layout, seed)
        with Client(port=running.port) as client:
            return client.get_action(flat(seen) if seed % 2 else seen, {"seed": seed})[0]

    with serving(whole, max_batch=8, max_wait_ms=2000.0) as running, ThreadPoolExecutor(6) as threads:
        assert running.server.num_workers == {"small": 2, "large": 1}[size]
        together = list(threads.map(act, range(6)))
    sizes = {line["batch"] for line in running.log.lines if line["event"] == "request"}
    assert max(sizes) > 1
    for seed, chunk in enumerate(together):
        seen = nested(layout, seed)
        assert_same(chunk, whole.act(flat(seen) if seed % 2 else seen, seed=seed))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.usefixtures("size")
def test_guided_answers_are_those_of_act(layout: str) -> None:
    whole = policy(layout)
    without: Any = "empty" if layout.startswith("n1") else "default"

    def act(seed: int) -> Any:
        weight = {} if seed == 1 else {"guidance": 0.5 * seed}
        with Client(port=running.port) as client:
            return client.get_action(nested(layout, 1), {"seed": seed, **weight})[0]

    with (
        serving(whole, guidance=2.5, without=without, max_batch=8, max_wait_ms=500.0) as running,
        ThreadPoolExecutor(4) as threads,
    ):
        together = list(threads.map(act, range(4)))
    for seed, chunk in enumerate(together):
        weight = 2.5 if seed == 1 else 0.5 * seed
        expected = whole.act(nested(layout, 1), seed=seed, guidance=weight, without=without)
        assert_same(chunk, expected)


@pytest.mark.parametrize("layout", ["nvidia", "n17"])
def test_sessions_are_real_time_chunking(layout: str) -> None:
    whole, first_seen, second_seen = policy(layout), nested(layout, 0), nested(layout, 1)
    with serving(whole) as running, Client(port=running.port) as client:
        first, _ = client.get_action(first_seen, {"seed": 1, "session": "a", "executed": 0})
        assert_same(first, whole.act(first_seen, seed=1))
        options = {"seed": 2, "session": "a", "executed": 5, "frozen": 2}
        second, info = client.get_action(second_seen, options)
        assert (info["session"], info["continued"]) == ("a", True)
        horizon = next(iter(first.values())).shape[1]
        chunking = saccade.Chunking(overlap=horizon - 5, frozen=2)
        expected = whole.act(second_seen, seed=2, previous_chunk=first, chunking=chunking)
        assert_same(second, expected)


@pytest.mark.parametrize("layout", ["nvidia", "n17"])
def test_released_chunking_is_that_of_act(layout: str) -> None:
    whole, first_seen, second_seen = policy(layout), nested(layout, 0), nested(layout, 1)
    chunking = saccade.Chunking(overlap=3, frozen=1, ramp_rate=4.0, horizon=5)
    rtc = {"action_horizon": 5, "rtc_overlap_steps": 3, "rtc_frozen_steps": 1, "rtc_ramp_rate": 4.0}
    with serving(whole) as running, Client(port=running.port) as client:
        first, _ = client.get_action(first_seen, {"seed": 1, "session": "a", **rtc})
        assert_same(first, whole.act(first_seen, seed=1))
        second, info = client.get_action(second_seen, {"seed": 2, "session": "a", **rtc})
        assert info["continued"]
        assert_same(second, whole.act(second_seen, seed=2, previous_chunk=first, chunking=chunking))


@pytest.mark.usefixtures("size")
def test_requests_with_other_numbers_of_steps_in_one_batch() -> None:
    whole, steps = policy("nvidia"), [1, 2, None, 2, 7]

    def act(seed: int) -> Any:
        with Client(port=running.port) as client:
            options = {"seed": seed, "num_steps": steps[seed]}
            return client.get_action(nested("nvidia", seed), options)[0]

    with serving(whole, num_steps=3, max_wait_ms=2000.0) as running, ThreadPoolExecutor(5) as threads:
        for seed, chunk in enumerate(threads.map(act, range(5))):
            assert_same(chunk, whole.act(nested("nvidia", seed), seed=seed, num_steps=steps[seed] or 3))


@pytest.mark.usefixtures("size")
def test_sessions_of_several_robots_in_one_batch() -> None:
    whole = policy("nvidia")

    def act(robot: int, executed: int, seed: int) -> Any:
        with Client(port=running.port) as client:
            options = {"seed": seed, "session": robot, "executed": executed}
            return client.get_action(nested("nvidia", robot), options)[0]

    with serving(whole, max_wait_ms=2000.0) as running, ThreadPoolExecutor(4) as threads:
        first = list(threads.map(act, range(4), [0] * 4, range(4)))
        executed = [3, 4, 3, 16]
        second = list(threads.map(act, range(4), executed, range(10, 14)))
    for robot in range(4):
        seen, options = nested("nvidia", robot), {}
        if executed[robot] < 16:
            chunking = saccade.Chunking(overlap=16 - executed[robot], frozen=0)
            options = {"previous_chunk": first[robot], "chunking": chunking}
        assert_same(second[robot], whole.act(seen, seed=10 + robot, **options))


@pytest.mark.parametrize("layout", ["n16", "n17"])
def test_modality_configs_are_those_of_the_checkpoint(layout: str) -> None:
    file = json.loads((whole_checkpoints.whole(layout) / "processor_config.json").read_text())
    expected = file["processor_kwargs"]["modality_configs"][whole_checkpoints.EMBODIMENT]
    with serving(policy(layout)) as running, Client(port=running.port) as client:
        found = client.call("get_modality_config")
    assert {name: config["as_json"] for name, config in found.items()} == expected


def test_what_does_not_fit_is_refused_with_what_is_needed() -> None:
    seen = nested("nvidia", 0)
    seen["video"] = {"elsewhere": next(iter(seen["video"].values()))}
    with serving(policy("nvidia")) as running, Client(port=running.port) as client:
        with pytest.raises(ServerError, match=r"wrist.*needs cameras"):
            client.get_action(seen)
        with pytest.raises(ServerError, match="needs cameras"):
            client.get_action({})


def time_of_pool() -> int:
    """Nanoseconds that the engine's own threads have run, once they rest."""

    def ran() -> int:
        total = 0
        for task in Path("/proc/self/task").iterdir():
            with contextlib.suppress(FileNotFoundError):
                if re.fullmatch(r"saccade-\d+", (task / "comm").read_text().strip()):
                    total += int((task / "schedstat").read_text().split()[0])
        return total

    before = -1
    while (now := ran()) != before:
        before = now
        time.sleep(0.05)
    return now


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="needs Linux's times of threads")
def test_a_thread_computes_alone_while_others_do_and_no_longer() -> None:
    whole, seen = policy("nvidia"), nested("nvidia", 1)

    def uses_pool(call: Callable[[], Any]) -> bool:
        before = time_of_pool()
        call()
        return time_of_pool() != before

    def jobs() -> list[Job]:
        parsed = read(seen, whole.requirements)
        return [Job(Call("get_action", options=Options(seed=seed)), parsed, None) for seed in range(2)]

    made = engine.Engine(whole, Sessions(1, 1.0))
    assert made.num_workers == 2
    wait_until(lambda: uses_pool(lambda: whole.act(seen, seed=0)))
    assert not uses_pool(lambda: made.run(jobs()))
    wait_until(lambda: uses_pool(lambda: whole.act(seen, seed=0)), 10)
    failing = jobs()
    for job in failing:
        job.inputs = [None]
    assert all(outcome.error is not None for outcome in made.run(failing))
    wait_until(lambda: uses_pool(lambda: whole.act(seen, seed=0)), 10)


@contextlib.contextmanager
def command(checkpoint: Path, *arguments: str, **options: Any) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """`saccade serve` in a process, and its port."""
    words = ["serve", str(checkpoint), "--embodiment", whole_checkpoints.EMBODIMENT, "--num-threads", "1"]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    process = subprocess.Popen(
        [sys.executable, "-m", "saccade", *words, "--port", str(port), *arguments], text=True, **options
    )
    with process:
        try:
            wait_until(lambda: is_listening(port) or process.poll() is not None, 120)
            yield process, port
        finally:
            process.kill()


def is_listening(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def test_the_command_from_start_to_sigterm(tmp_path: Path) -> None:
    checkpoint = Path(shutil.copytree(whole_checkpoints.whole("nvidia"), tmp_path / "policy"))
    seen = nested("nvidia", 0)
    with command(checkpoint, "--log", "json") as (process, port), requester(port, seconds=60) as made:
        assert ask(made, {"endpoint": "ping"})["status"] == "ok"
        request = {"endpoint": "get_action", "data": {"observation": seen, "options": {"seed": 5}}}
        actions = ask(made, request)[0]
        assert_same(actions, policy("nvidia").act(seen, seed=5))
        # Weights that are replaced while it runs do not matter.
        shutil.rmtree(checkpoint)
        assert_same(ask(made, request)[0], actions)
        made.send(packed(request))
        time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert made.poll(60_000)
        output, errors = process.communicate(timeout=60)
        assert process.returncode == 0
        assert all("data config" in line for line in errors.splitlines())  # that none was given
    lines = [json.loads(line) for line in output.splitlines()]
    assert lines[0]["event"] == "listening"
    assert lines[0]["address"] == f"tcp://127.0.0.1:{port}"
    assert lines[-1]["event"] == "stopped"
    assert sum(line["event"] == "request" and line["endpoint"] == "get_action" for line in lines) == 3


def test_a_port_in_use_is_one_line_before_anything_is_loaded() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        done = subprocess.run(
            [sys.executable, "-m", "saccade", "serve", "no/such/checkpoint", "--port", port],
            capture_output=True,
            text=True,
            check=False,
        )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"saccade: 127.0.0.1:{port}: Address already in use\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_under_the_log(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123
        checkpoint = whole_checkpoints.whole("nvidia")
        with command(checkpoint, "--log", "json", stdout=full) as (process, port):
            with requester(port, seconds=60) as made:
                for _ in range(3):
                    assert ask(made, {"endpoint": "ping"})["status"] == "ok"
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=60)
            assert process.returncode == 0
            assert all("data config" in line for line in errors.splitlines())


def test_a_log_that_nobody_reads_does_not_hold_up_the_end() -> None:
    with command(whole_checkpoints.whole("nvidia"), "--log", "json") as (process, port):
        with requester(port, seconds=60) as made:
            for _ in range(2000):  # more lines than a pipe holds
                assert ask(made, {"endpoint": "ping"})["status"] == "ok"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0


def test_an_encrypted_command(tmp_path: Path) -> None:
    (tmp_path / "clients").mkdir()
    for name in ("server", "robot"):
        zmq.auth.create_certificates(tmp_path, name)
    (tmp_path / "robot.key").rename(tmp_path / "clients" / "robot.key")
    words = ["--secret-key", str(tmp_path / "server.key_secret"), "--client-keys", str(tmp_path / "clients")]
    keys: dict[str, Any] = {
        "server_key": tmp_path / "server.key",
        "secret_key": tmp_path / "robot.key_secret",
    }
    with command(whole_checkpoints.whole("nvidia"), *words) as (_, port):
        with Client(port=port, **keys) as client:
            assert client.call("ping")["status"] == "ok"
        with Client(port=port, timeout=0.5) as client, pytest.raises(TimeoutError):
            client.call("ping")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--client-keys", "x"], "--client-keys: expected --secret-key with it, got none"),
        (["--secret-key", "missing.key_secret"], "missing.key_secret: expected a key file"),
    ],
)
def test_keys_that_cannot_be_used_are_one_line(words: list[str], message: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "saccade", "serve", "no/such/checkpoint", *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_live_line_on_a_terminal_and_ctrl_c() -> None:
    ours, theirs = pty.openpty()
    try:
        checkpoint = whole_checkpoints.whole("nvidia")
        environment = os.environ | {"TERM": "xterm", "COLUMNS": "200"}
        with command(checkpoint, stderr=theirs, env=environment) as (process, port):
            with requester(port, seconds=60) as made:
                assert ask(made, {"endpoint": "ping"})["status"] == "ok"
                shown = ""
                while "1 requests, 0 errors" not in shown:
                    shown += os.read(ours, 4096).decode()
            process.send_signal(signal.SIGINT)
            process.wait(60)
            assert process.returncode == 130
        assert f"listening on tcp://127.0.0.1:{port}" in shown
    finally:
        os.close(ours)
        os.close(theirs)
