"""Tests of `saccade serve` with Isaac-GR00T's released clients; `groot` runs them."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade

SOURCES = Path(os.environ["SACCADE_GROOT_SOURCES"])
RELEASES = os.environ["SACCADE_GROOT_RELEASES"].split()
PICKLES = ("n1", "n1.5-early")
VERSIONS = ("n1.5", "n1.6", "n1.7")
SEED = 3  # of the server, for requests without one


class Served:
    """A server in a process, and the same policy in this one."""

    def __init__(self, version: str, folder: Path) -> None:
        command = [sys.executable, "-m", "saccade_lab.random_checkpoint", str(folder), "--small"]
        subprocess.run([*command, "--version", version], check=True, stdout=subprocess.DEVNULL)
        self.policy = saccade.Policy.from_pretrained(folder)
        serve = [sys.executable, "-m", "saccade", "serve", str(folder), "--port", "0", "--log", "json"]
        self.process = subprocess.Popen([*serve, "--seed", str(SEED)], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.port = int(json.loads(self.process.stdout.readline())["address"].rpartition(":")[2])
        self.results: dict[str, dict[str, Any]] = {}

    def observations(self) -> dict[str, Any]:
        one, two = (self.policy.example_observation(seed) for seed in (0, 1))
        both = {
            "video": {
                name: np.concatenate([one["video"][name], two["video"][name]]) for name in one["video"]
            },
            "state": {
                name: np.concatenate([one["state"][name], two["state"][name]]) for name in one["state"]
            },
            "language": {name: [["open the drawer"], ["push"]] for name in one["language"]},
        }
        bad = {**one, "video": {"unknown": next(iter(one["video"].values()))}}
        return {
            "nested": one,
            "nested batch": both,
            "flat": {key: value[0] for key, value in flat(one).items()},
            "flat batch": flat(both),
            "bad": bad,
        }

    def result(self, release: str, folder: Path) -> dict[str, Any]:
        """What the client of a release got."""
        if release not in self.results:
            work, result = folder / "work", folder / release
            work.write_bytes(pickle.dumps(self.observations()))
            program = Path(__file__).with_name("groot_client.py")
            subprocess.run(
                [sys.executable, str(program), release, str(self.port), str(work), str(result)],
                check=True,
                timeout=120,
                env=os.environ | {"PYTHONPATH": str(SOURCES / release)},
            )
            self.results[release] = pickle.loads(result.read_bytes())
        return self.results[release]


def flat(nested: dict[str, Any]) -> dict[str, Any]:
    """An observation in the form of N1.5."""
    found = {f"{part}.{key}": nested[part][key] for part in ("video", "state") for key in nested[part]}
    return found | {key: [row[0] for row in rows] for key, rows in nested["language"].items()}


@pytest.fixture(scope="module", params=VERSIONS)
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    with tempfile.TemporaryDirectory() as folder:
        made = Served(request.param, Path(folder))
        yield made
        made.process.send_signal(signal.SIGTERM)
        assert made.process.wait(30) == 0


def assert_equal(found: Any, expected: Any) -> None:
    """The same keys in any order, and arrays with the same bits."""
    assert found.keys() == expected.keys()
    for key, array in expected.items():
        assert (found[key].dtype, found[key].shape) == (np.float32, array.shape)
        np.testing.assert_array_equal(found[key], array)


@pytest.mark.parametrize("release", [release for release in RELEASES if release in PICKLES])
def test_clients_that_send_pickles_are_told_what_they_need(
    release: str, served: Served, tmp_path: Path
) -> None:
    found = served.result(release, tmp_path)["get_action"]
    # N1's client returns errors, N1.5's raises them.
    error = found["error"] if release == "n1" else found
    assert "message: expected msgpack, got a pickle" in error
    assert "N1.5 with pull request 329" in error


@pytest.mark.parametrize("release", [release for release in RELEASES if release not in PICKLES])
def test_actions_are_those_of_act(release: str, served: Served, tmp_path: Path) -> None:
    found, given, act = served.result(release, tmp_path), served.observations(), served.policy.act
    assert found["ping"] is True
    if release == "n1.5":
        assert_equal(found["get_action"], act(given["flat"], seed=SEED))
        assert_equal(found["batch"], act(given["flat batch"], seed=SEED))
        return
    for name, seen, seed in (
        ("get_action", "nested", SEED),
        ("seeded", "nested", 11),
        ("batch", "nested batch", 12),
        ("flat", "flat batch", 13),
        ("session", "nested", 14),
        ("anew", "nested", 16),
    ):
        assert_equal(found[name][0], act(given[seen], seed=seed))
    first = found["session"][0]
    horizon = next(iter(first.values())).shape[1]
    chunking = saccade.Chunking(overlap=horizon - 3, frozen=0)
    expected = act(given["nested"], seed=15, previous_chunk=first, chunking=chunking)
    assert_equal(found["continued"][0], expected)
    assert [found[name][1].get("continued") for name in ("seeded", "session", "continued", "anew")] == [
        None,
        False,
        True,
        False,
    ]
    assert found["reset"] == {}


@pytest.mark.parametrize("release", [release for release in RELEASES if release not in PICKLES])
def test_the_bundled_policy_drives_its_robot(release: str) -> None:
    """Through the server, by a client as released: the same episodes, bit for bit, as in process."""
    demo = saccade.demo_checkpoint()
    serve = [sys.executable, "-m", "saccade", "serve", str(demo), "--port", "0", "--log", "json"]
    with subprocess.Popen([*serve, "--seed", str(SEED)], stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        port = json.loads(server.stdout.readline())["address"].rpartition(":")[2]
        program = Path(__file__).with_name("groot_episode.py")
        try:
            done = subprocess.run(
                [sys.executable, str(program), release, port, str(SEED)],
                capture_output=True,
                text=True,
                timeout=300,
                env=os.environ | {"PYTHONPATH": f"{SOURCES / release}{os.pathsep}{os.environ['PYTHONPATH']}"},
                check=False,
            )
        finally:
            server.send_signal(signal.SIGTERM)
    assert done.returncode == 0, done.stderr
    remote, local = json.loads(done.stdout.splitlines()[-1])
    assert remote == local
    assert any(success for _, success, _ in remote)


@pytest.mark.parametrize("release", [release for release in RELEASES if release not in PICKLES])
def test_modality_configs_and_errors(release: str, served: Served, tmp_path: Path) -> None:
    found, given = served.result(release, tmp_path), served.observations()
    configs = found["modality"]

    def named(part: str, keys: Any) -> list[str]:
        return [f"{part}.{key}" if release == "n1.5" else key for key in keys]

    for part in ("video", "state"):
        assert configs[part]["modality_keys"] == named(part, given["nested"][part])
        steps = next(iter(given["nested"][part].values())).shape[1]
        assert len(configs[part]["delta_indices"]) == steps
    actions = found["get_action"] if release == "n1.5" else found["get_action"][0]
    assert configs["action"]["modality_keys"] == list(actions)
    assert len(configs["action"]["delta_indices"]) == next(iter(actions.values())).shape[-2]
    assert configs["language"]["modality_keys"] == list(given["nested"]["language"])
    assert found["bad"].startswith("RuntimeError: Server error: ")
    assert "unknown" in found["bad"]
    assert found["kill"] == (
        "RuntimeError: Server error: kill: refused, since the server was started without --allow-kill"
    )
    assert found["ping again"] is True
