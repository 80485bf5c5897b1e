"""`saccade libero` without its simulator: what it writes, how it goes on, and what it refuses."""

from __future__ import annotations

import importlib.util
import json
import pickle
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from saccade import cli
from saccade_lab.cli.libero import prepare
from saccade_lab.libero import episodes, packages, suites
from saccade_lab.libero.policy import LiberoPolicy
from saccade_lab.parallel import Workers
from saccade_lab.parallel.files import located, relocated
from saccade_lab.sim import graphics
from tests.helpers.libero_runs import DATA_CONFIG, StandIn, checkpoint

Run = Callable[..., dict[str, Any]]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[StandIn]:
    """The environments that the command makes: stand-ins, of which task 0 succeeds after 9 steps."""
    found: list[StandIn] = []

    def environment_for(policy: LiberoPolicy, suite: str, task: int) -> StandIn:
        found.append(StandIn(policy.protocol, 9 if task == 0 else None))
        return found[-1]

    def find_task(suite: str, task: int) -> SimpleNamespace:
        return SimpleNamespace(instruction=f"do {task} of {suite}")

    monkeypatch.setattr("saccade_lab.cli.libero.require", lambda command: None)
    monkeypatch.setattr(packages, "require", lambda: None)
    monkeypatch.setattr(graphics, "check", lambda: None)
    monkeypatch.setattr(suites, "find_task", find_task)
    monkeypatch.setattr(episodes, "environment_for", environment_for)
    return found


@pytest.fixture
def run(made: list[StandIn], tmp_path: Path) -> Run:
    """Runs the command, and returns the results."""

    def command(*options: str, status: int = 0) -> dict[str, Any]:
        words = ["libero", str(checkpoint("n1.7")), "--out", str(tmp_path / "out"), *options]
        assert cli.main(words) == status
        record: dict[str, Any] = json.loads((tmp_path / "out" / "results.json").read_text())
        return record

    return command


def test_the_pinned_command(
    run: Run, made: list[StandIn], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = run("--suite", "libero_object", "--tasks", "0", "--trials", "2", "--protocol", "isaac-n17")
    assert record["episodes"] == [
        {"suite": "libero_object", "task": 0, "trial": trial, "success": True, "steps": 9} for trial in (0, 1)
    ]
    assert record["protocol"]["name"] == "isaac-n17"
    assert record["protocol"]["max_steps"] == {"libero_object": 720}
    assert record["tasks"] == [{"suite": "libero_object", "task": 0, "instruction": "do 0 of libero_object"}]
    assert [one.starts for one in made] == [[(None, 0, 1, 1), (None, 1, 1, 1)]]
    assert [one.is_closed for one in made] == [True]
    out = tmp_path / "out"
    names = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert names == [
        "index.html",
        "pictures/libero_object-0-0.png",
        "pictures/libero_object-0-1.png",
        "results.json",
    ]
    printed = capsys.readouterr().out
    assert printed.startswith("protocol        isaac-n17, as given")
    assert "-sign(2 g - 1): the program does it with every checkpoint" in printed
    assert "2/2" in printed
    assert "do 0 of libero_object" in printed


def test_a_run_goes_on_and_grows(run: Run, made: list[StandIn]) -> None:
    first = run("--tasks", "0", "--trials", "1")
    assert first["protocol"]["chosen"] == "the checkpoint has the layout of Isaac-GR00T n1.7"
    second = run("--tasks", "0", "--trials", "3")
    assert second["episodes"][:1] == first["episodes"]
    assert second["costs"][:1] == first["costs"]
    assert made[1].starts == [(None, 1, 1, 1), (None, 2, 1, 1)]
    third = run("--suite", "libero_object,libero_spatial_swap", "--tasks", "0", "--trials", "1")
    assert [(one["suite"], one["trial"]) for one in third["episodes"]] == [
        *(("libero_object", trial) for trial in range(3)),
        ("libero_spatial_swap", 0),
    ]
    assert [rate["suite"] for rate in third["summary"]] == ["libero_object"] * 2 + [
        "libero_spatial_swap"
    ] * 2 + [None]
    assert len(made) == 3


def test_the_same_noise_is_that_of_lerobots_seed(run: Run, made: list[StandIn]) -> None:
    record = run("--tasks", "0", "--trials", "2", "--seed", "5", "--same-noise")
    assert record["noise"] == {"seed": 5, "is_common": True}
    one, other = made[0].actions[:9], made[0].actions[9:]
    assert all((a == b).all() for a, b in zip(one, other, strict=True))


def test_ctrl_c_keeps_what_is_done(run: Run, made: list[StandIn], monkeypatch: pytest.MonkeyPatch) -> None:
    usual = StandIn.restart

    def restart(self: StandIn, state: int | None, seed: int | None, **more: int) -> None:
        if seed == 1:
            raise KeyboardInterrupt
        usual(self, state, seed, **more)

    monkeypatch.setattr(StandIn, "restart", restart)
    record = run("--tasks", "0", "--trials", "2", status=cli.EXIT_INTERRUPTED)
    assert [one["trial"] for one in record["episodes"]] == [0]
    monkeypatch.setattr(StandIn, "restart", usual)
    assert [one["trial"] for one in run("--tasks", "0", "--trials", "2")["episodes"]] == [0, 1]


def test_other_machines_find_the_files(
    made: list[StandIn], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bare names of files, which Ray brings to other machines."""
    (tmp_path / "policy").symlink_to(checkpoint("n1.5"))
    config = resources.files("saccade") / "robots" / "released_data_configs.json"
    (tmp_path / "mine.json").write_text(json.dumps(json.loads(config.read_text())[DATA_CONFIG]))
    monkeypatch.chdir(tmp_path)
    words = ["libero", "policy", "--data-config", "mine.json", "--protocol", "isaac-n15"]
    args = cli.build_parser("libero").parse_args(words)
    session = prepare(args, Workers())
    sources, work = located(
        session.episodes, [session.episodes.checkpoint, str(session.episodes.options["data_config"])]
    )
    there = relocated(work, {path: Path("/elsewhere") / source.name for path, source in sources.items()})
    assert Path(there.checkpoint).parent == Path("/elsewhere")
    assert there.options["data_config"] == "/elsewhere/mine.json"
    assert pickle.loads(pickle.dumps(there)) == there
    # A file with other content under the same name is another option.
    before = session.results.settings["options"]
    (tmp_path / "mine.json").write_text((tmp_path / "mine.json").read_text() + "\n")
    assert prepare(args, Workers()).results.settings["options"] != before


def test_json_alone_is_printed(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    record = run("--tasks", "0", "--trials", "1", "--json")
    assert json.loads(capsys.readouterr().out) == record


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--suite", "libero_kitchen"], "suite: given 'libero_kitchen', expected one of libero_spatial"),
        (["--tasks", "10"], "--tasks: given 10, expected 0 to 9"),
        (["--suite", "libero_90,libero_10", "--tasks", "10"], "--tasks: given 10, expected 0 to 9"),
        (["--trials", "0"], "--trials: given 0, expected at least 1"),
        (["--jobs", "0"], "jobs: given 0, expected at least 1"),
        (["--embodiment", "gr1"], "embodiment: expected one of those in"),
    ],
)
def test_what_cannot_be_is_one_line(
    made: list[StandIn], tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    words = ["libero", str(checkpoint("n1.7")), "--out", str(tmp_path / "out"), *options]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()
    assert not made


def test_another_run_is_not_mixed_in(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    run("--tasks", "0", "--trials", "1")
    run("--tasks", "0", "--trials", "2", "--protocol", "lerobot", status=2)
    assert "has episodes of another run: other protocol.name, " in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("libero") is not None, reason="LIBERO is installed")
def test_without_the_packages_one_line_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["libero", str(checkpoint("n1.7")), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("saccade: libero and robosuite are not installed. Install with: ")
    assert not (tmp_path / "out").exists()
