"""A Ray cluster of two nodes on this machine: a process and a node die in the middle, and nothing is lost.

The extra `ray` is not part of `make test`. `make test-ray` installs it in its own environment and runs this
file. With `SACCADE_RAY=1` it fails instead of skipping if Ray is missing.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import saccade
from saccade._internal.environment import arithmetic
from saccade.cli import main, recorded
from saccade.errors import InputError
from saccade.evaluation.source import weights_hash
from saccade_lab.cli import rollout
from saccade_lab.libero.episodes import Episodes
from saccade_lab.parallel import ALONE, Lost, Workers, each
from saccade_lab.parallel import cluster as cluster_module
from saccade_lab.recordings.spreading import spread
from saccade_lab.sim import demos, graphics
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.run import StudyError, run_cells
from tests.helpers.libero_runs import checkpoint
from tests.helpers.parallel_cases import Reads, Square
from tests.helpers.paths import ROOT
from tests.helpers.recorded_cases import made_up
from tests.helpers.recorded_folder import written

if importlib.util.find_spec("ray") is None and "SACCADE_RAY" not in os.environ:
    pytest.skip("the extra ray is not installed; run make test-ray", allow_module_level=True)

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
os.environ["RAY_DEDUP_LOGS"] = "0"
SEARCHED = (str(ROOT / "python"), str(ROOT / "lab"), str(ROOT))  # by the workers
SETTINGS = {"checkpoint": "abc"}


class TwoNodes:
    """The cluster. Each node has two cores and its own directory for temporary files.

    Args:
        folder: Where these directories are.
        **environment: Variables of all processes of the nodes.
    """

    def __init__(self, folder: Path, **environment: str) -> None:
        from ray.cluster_utils import Cluster

        self.folder, self.environment = folder, environment
        self.cluster = Cluster()
        self.cluster.add_node(**self.options("first"))  # the head, which this process connects to
        self.second = self.cluster.add_node(**self.options("second"))
        self.cluster.wait_for_nodes()
        self.workers = Workers("ray", 4, self.cluster.address)

    def options(self, name: str) -> dict[str, Any]:
        """What a node is started with."""
        (self.folder / name).mkdir()
        environment = {**self.environment, "TMPDIR": str(self.folder / name)}
        return {"num_cpus": 2, "env_vars": environment, "include_dashboard": False}

    def processes(self, name: str) -> list[int]:
        """The processes of a node that work on an item at this moment."""
        node = self.cluster.head_node if name == "first" else self.second
        raylet = node.all_processes["raylet"][0].process.pid
        children = Path(f"/proc/{raylet}/task/{raylet}/children").read_text().split()
        return [pid for pid in map(int, children) if title(pid) == "ray::run_item"]

    def kill_process(self, name: str) -> None:
        """Kills a process of a node in the middle of an item."""
        wait_for(lambda: bool(self.processes(name)))
        os.kill(self.processes(name)[0], signal.SIGKILL)

    def kill_node(self) -> None:
        """Kills the second node with everything that runs on it, in the middle of items."""
        wait_for(lambda: bool(self.processes("second")))
        self.cluster.remove_node(self.second, allow_graceful=False)


def title(pid: int) -> str:
    """What a process calls itself."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0].decode().strip()
    except OSError:
        return ""


def wait_for(condition: Callable[[], bool]) -> None:
    """Waits until something is so."""
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@contextlib.contextmanager
def cluster(folder: Path, **environment: str) -> Iterator[TwoNodes]:
    """A cluster that runs meanwhile; arguments as `TwoNodes`."""
    import ray

    found = TwoNodes(folder, PYTHONPATH=os.pathsep.join(SEARCHED), **environment)
    try:
        yield found
    finally:
        ray.shutdown()
        found.cluster.shutdown()


@pytest.fixture
def nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TwoNodes]:
    """A cluster for one test."""
    monkeypatch.setattr(graphics, "check", lambda: None)
    with cluster(tmp_path) as found:
        yield found


class Deaths:
    """Kills a process when `process` items are done, and a node when `node` are."""

    def __init__(self, nodes: TwoNodes, process: int, node: int) -> None:
        self.nodes, self.process, self.node, self.done = nodes, process, node, 0

    def __call__(self, *_: Any) -> None:
        self.done += 1
        if self.done == self.process:
            self.nodes.kill_process("first")
        if self.done == self.node:
            self.nodes.kill_node()


class Measure:
    """A cell's rows, from a file that is on the machine of the test only, with time to be killed in."""

    def __init__(self, reads: Reads) -> None:
        self.reads = reads

    def __call__(self, cell: Cell) -> Rows:
        number, _, content, _ = self.reads(int(cell.key[1]))
        return [{"number": number, "product": number * content[0]}]


def test_a_study_that_loses_a_process_and_a_node_has_the_table_of_one_process(
    nodes: TwoNodes, tmp_path: Path
) -> None:
    (tmp_path / "weights.bin").write_bytes(b"\7")
    cells = [Cell(("square", number)) for number in range(40)]
    work = Measure(Reads(str(tmp_path / "weights.bin"), hold=0.2))
    one = run_cells("demo", cells, Measure(Reads(work.reads.path)), tmp_path / "one", settings=SETTINGS)
    dies = Deaths(nodes, 3, 12)
    two = run_cells(
        "demo", cells, work, tmp_path / "two", settings=SETTINGS, workers=nodes.workers, on_done=dies
    )
    pd.testing.assert_frame_equal(one, two)
    assert (tmp_path / "one" / "demo.csv").read_bytes() == (tmp_path / "two" / "demo.csv").read_bytes()
    assert json.loads((tmp_path / "two" / "demo.json").read_text())["failed"] == []


def test_a_rollout_that_loses_a_process_and_a_node_has_the_episodes_of_one_process(
    nodes: TwoNodes, tmp_path: Path
) -> None:
    from saccade_lab.sim.episodes import Episodes as Simulated

    outcomes = []
    for name, workers in (("one", ALONE), ("two", nodes.workers)):
        (tmp_path / name).mkdir()
        episodes = Simulated(str(DEMO_CHECKPOINT), num_threads=1)
        session = rollout.Session(
            episodes, ["reach", "button-press-topdown"], range(5), workers, tmp_path / name
        )
        session.run((lambda rolled: None) if workers is ALONE else Deaths(nodes, 1, 3))
        assert session.lost == []
        outcomes.append(json.loads((tmp_path / name / "results.json").read_text())["episodes"])
    for episode in (*outcomes[0], *outcomes[1]):
        assert episode.pop("milliseconds")["sample"] > 0  # differs from run to run
    assert outcomes[0] == outcomes[1]
    assert len(outcomes[0]) == 10


def test_demonstrations_are_those_of_one_process(nodes: TwoNodes, tmp_path: Path) -> None:
    settings = demos.RecordingSettings(image_size=16, frame_stride=8)
    recorded = []
    for name, workers in (("one", ALONE), ("two", nodes.workers)):
        out = tmp_path / name
        demos.record_tasks({"reach": 3, "two-goals": 3}, out, settings, lambda task: None, workers)
        files = sorted(path for path in out.rglob("*") if path.is_file())
        recorded.append({str(path.relative_to(out)): path.read_bytes() for path in files})
    assert recorded[0] == recorded[1]
    assert len(recorded[0]) == 8


def test_files_are_brought_to_each_node_once(nodes: TwoNodes, tmp_path: Path) -> None:
    policy = tmp_path / "policy"
    policy.mkdir()
    (policy / "weights.bin").write_bytes(bytes(1 << 20))
    work = Reads(str(policy), hold=0.05)
    found = [result for _, result in each(work, range(24), nodes.workers, [str(policy)])]
    places = set()
    for result in found:
        assert not isinstance(result, Lost)
        _, path, content, folder = result
        assert content == bytes(1 << 20)
        places.add((path, folder))
    assert {Path(folder).name for _, folder in places} == {"first", "second"}
    assert len(places) == 2
    for path, folder in sorted(places):
        assert Path(path).name == "policy"
        cache = Path(folder) / f"saccade-{os.getuid()}"
        assert Path(path).is_relative_to(cache)
        assert len([entry for entry in cache.iterdir() if entry.is_dir()]) == 1


def test_items_that_kill_their_process_are_given_up_and_errors_are_raised(
    nodes: TwoNodes, tmp_path: Path
) -> None:
    work = Square(tmp_path / "log", dies_once=(2,), dies=(3,))
    found = dict(each(work, range(6), nodes.workers))
    lost = found.pop(3)
    assert isinstance(lost, Lost)
    assert "died in each of 4 attempts" in lost.reason
    assert found == {number: number**2 for number in range(6) if number != 3}
    with pytest.raises(ValueError, match="cannot square 1"):
        list(each(Square(tmp_path / "log", fails=(1,)), [1], nodes.workers))
    with pytest.raises(InputError, match="a machine of at least 64 cores, got 2, 2"):
        list(each(work, [1], Workers("ray", 1, nodes.cluster.address, num_threads=64)))
    with pytest.raises(StudyError, match=r"1 of 1 cells failed: square 1: .* 4 attempts"):
        run_cells("demo", [Cell(("square", 1))], Dies(), tmp_path, settings={}, workers=nodes.workers)


def test_items_that_run_out_of_memory_are_given_up_too(tmp_path: Path) -> None:
    # Ray's own monitor ends every item, since more than no memory is in use.
    monitor = {"RAY_memory_usage_threshold": "0.0", "RAY_memory_monitor_refresh_ms": "100"}
    work = Square(tmp_path / "log", holds=60.0)
    with cluster(tmp_path, **monitor) as starved:
        found = dict(each(work, range(3), starved.workers))
    assert sorted(found) == [0, 1, 2]
    for lost in found.values():
        assert isinstance(lost, Lost)
        assert "died in each of 4 attempts: " in lost.reason
        assert "memory" in lost.reason


class Dies:
    """Work that ends its process."""

    def __call__(self, cell: Cell) -> Rows:
        os._exit(9)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("saccade", "0.0.1", r"saccade: expected version 0\.0\.1 on every machine"),
        ("dot_products", ["bf15"], r"instructions: expected .* with dot products bf15 on every machine"),
    ],
)
def test_a_machine_that_computes_other_bits_is_named(
    name: str,
    value: Any,
    message: str,
    nodes: TwoNodes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    expected = {**arithmetic(), name: value}
    monkeypatch.setattr(cluster_module, "arithmetic", lambda: expected)
    with pytest.raises(InputError, match=message):
        list(each(Square(tmp_path / "log"), [1], nodes.workers))


def test_commands_take_an_address(
    nodes: TwoNodes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ray = ["--backend", "ray", "--address", nodes.cluster.address]
    few = ["--tasks", "button-press-topdown", "--episodes", "2"]
    out = ["--out", str(tmp_path / "out")]
    assert main(["rollout", *few, *ray, "--video", "--record", str(tmp_path / "rolled"), *out]) == 0
    rolled = saccade.datasets.open(tmp_path / "rolled")
    assert [rolled.column(episode, "noise_seed")[0, 1] for episode in range(len(rolled))] == [0, 1]
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [episode["seed"] for episode in results["episodes"]] == [0, 1]
    assert results["complete"] is True
    assert results["processes"] == {"backend": "ray", "jobs": -1}
    assert all((tmp_path / "out" / episode["video"]).stat().st_size for episode in results["episodes"])
    assert main(["study", "cuts", *few, "--arms", "none", *ray, *out]) == 0
    assert len(pd.read_csv(tmp_path / "out" / "cuts.csv")) == 2
    assert main(["demos", *few, "--image-size", "16", *ray, *out]) == 0
    assert len(list((tmp_path / "out" / "button-press-topdown").glob("*.npz"))) == 2
    shown = [tmp_path / name for name in ("alone", "on two nodes")]
    for folder, workers in zip(shown, ([], ray), strict=True):
        assert main(["demos", *few, "--image-size", "16", "--record", str(folder), *workers]) == 0
    assert len({saccade.datasets.open(folder).fingerprint() for folder in shown}) == 1
    capsys.readouterr()


@pytest.mark.parametrize("command", ["evaluate", "diagnose"])
def test_recordings_on_the_cluster_give_the_results_of_one_process(
    command: str,
    nodes: TwoNodes,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(recorded, "extension", {"spread": spread}.get)  # pages have tests of their own
    folder, policy = written(made_up((9, 5, 8, 7, 6)), tmp_path / "tiny"), str(DEMO_CHECKPOINT)
    options = ["--num-threads", "1"]
    if command == "evaluate":
        options += ["--stride", "8", "--num-steps", "2", "--against", policy]
    found = []
    for name, workers in (
        ("one", []),
        ("two", ["--backend", "ray", "--address", nodes.cluster.address]),
    ):
        out = tmp_path / name
        assert main([command, policy, str(folder), "--out", str(out), *options, *workers]) == 0
        results = json.loads((out / "results.json").read_text())
        for part in (results, (results.get("against") or {}).get("other", {})):
            part["seconds"] = 0
        found.append(results)
    assert found[0] == found[1]
    assert len(found[0]["episodes"]) == 5
    capsys.readouterr()


@dataclass(frozen=True)
class LoadsLibero:
    """Says where the policy of `saccade libero` was loaded from. LIBERO is in no environment with Ray."""

    episodes: Episodes

    def __call__(self, number: int) -> tuple[str, str, str]:
        time.sleep(0.1)
        assert self.episodes.policy.protocol.name == "isaac-n17"
        path = self.episodes.checkpoint
        return path, weights_hash(path), os.environ["TMPDIR"]


def test_the_policy_of_libero_is_brought_to_each_node(nodes: TwoNodes) -> None:
    path = str(checkpoint("n1.7"))
    work = LoadsLibero(Episodes(path, "auto", {"num_threads": 1}))
    found = [result for _, result in each(work, range(8), nodes.workers, [path])]
    for result in found:
        assert not isinstance(result, Lost)
        place, sha256, folder = result
        assert Path(place).is_relative_to(folder)
        assert sha256 == weights_hash(path)
    assert len({result[2] for result in found if not isinstance(result, Lost)}) == 2


def test_no_cluster_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(graphics, "check", lambda: None)
    address = ["--backend", "ray", "--address", "127.0.0.1:1"]
    assert main(["rollout", "--tasks", "reach", *address, "--out", str(tmp_path)]) == 2
    assert "address: no Ray cluster at 127.0.0.1:1" in capsys.readouterr().err
