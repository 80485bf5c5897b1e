"""`saccade libero` without its simulator: what it writes, how it goes on, and what it refuses."""

from __future__ import annotations

import importlib.util
import json
import pickle
import shutil
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from saccade import cli
from saccade._internal import hub, tokenizers
from saccade.errors import InputError
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
    monkeypatch.setattr(suites, "initial_states", lambda task: range(50))
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
    assert record["tasks"] == [
        {
            "suite": "libero_object",
            "task": 0,
            "instruction": "do 0 of libero_object",
            "official_states": None,
        }
    ]
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
    (tmp_path / "out/libero").mkdir(parents=True)
    session.results.write(tmp_path / "out/libero", session.about)
    assert not prepare(args, Workers()).results.episodes
    (tmp_path / "mine.json").write_text((tmp_path / "mine.json").read_text() + "\n")
    with pytest.raises(InputError, match=r"another run: other options\.data_config\. Choose"):
        prepare(args, Workers())


def test_another_published_tokenizer_is_another_run(
    made: list[StandIn], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A checkpoint without a tokenizer, for which that of its release is read."""
    bare = shutil.copytree(checkpoint("n1.7"), tmp_path / "policy")
    words = tmp_path / "words" / "tokenizer.json"
    words.parent.mkdir()
    (bare / "tokenizer.json").rename(words)
    location = hub.Location(words.parent, "somebody/words", "a" * 40)
    monkeypatch.setattr(tokenizers, "locate_published", lambda *rest, **more: location)
    command = ["libero", str(bare), "--out", str(tmp_path / "out"), "--tasks", "0", "--trials"]
    assert [cli.main([*command, trials]) for trials in ("1", "2")] == [0, 0]
    assert sum(len(one.starts) for one in made) == 2
    words.write_text(words.read_text() + "\n")
    assert cli.main([*command, "2"]) == 2
    assert "has episodes of another run: other options.tokenizer. " in capsys.readouterr().err


def test_trials_beyond_the_official_states(
    run: Run, made: list[StandIn], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suites, "initial_states", lambda task: range(2))
    record = run("--tasks", "0", "--trials", "3", "--protocol", "lerobot", "--same-noise")
    remark = "libero_object 0 has 2 official states: 1 episodes repeat one"
    assert [one[: len(remark)] for one in record["remarks"][1:]] == [remark]
    printed = capsys.readouterr().out
    assert remark in printed
    assert "all episodes with the same noise" in printed


def test_n15_ends_with_the_official_states(
    made: list[StandIn], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["libero", str(checkpoint("n1.5")), "--data-config", DATA_CONFIG, "--out", str(out)]
    assert cli.main([*words, "--tasks", "1", "--trials", "51"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--trials: given 51, expected at most 50: the program of isaac-n15 ends with the last" in line
    assert "libero_object 1" in line
    assert not out.exists()
    assert not made


class Film:
    """A video file without a codec."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        self.path = path

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *error: object) -> None:
        self.path.write_bytes(b"video")

    def append(self, picture: object) -> None:
        """Forgets it."""


def test_a_video_changes_nothing_else(
    run: Run,
    made: list[StandIn],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(episodes, "VideoWriter", Film)
    out = tmp_path / "out"
    first = run("--tasks", "0", "--trials", "1")
    picture = (out / "pictures" / "libero_object-0-0.png").read_bytes()
    (out / "results.json").unlink()
    assert run("--tasks", "0", "--trials", "1", "--video")["episodes"] == first["episodes"]
    assert (out / "pictures" / "libero_object-0-0.png").read_bytes() == picture
    assert "none" not in capsys.readouterr().out.partition("\nvideos ")[2]
    (out / "videos" / "libero_object-0-0.mp4").unlink()
    run("--tasks", "0", "--trials", "2", "--video")
    assert "(1 of 2 episodes have none: they ran without --video)" in capsys.readouterr().out
    assert [path.name for path in (out / "videos").iterdir()] == ["libero_object-0-1.mp4"]


def test_a_renamed_folder_goes_on_and_a_published_one_is_named(
    made: list[StandIn], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    for name in ("one", "other"):
        shutil.copytree(checkpoint("n1.7"), tmp_path / name)
    words = ["--tasks", "0", "--trials", "1", "--out", str(out)]
    assert cli.main(["libero", str(tmp_path / "one"), *words]) == 0
    assert cli.main(["libero", str(tmp_path / "other"), *words]) == 0
    assert len(made) == 1
    location = hub.Location(tmp_path / "one", "somebody/policy", "a" * 40)
    monkeypatch.setattr(hub, "locate_published", lambda *rest, **more: location)
    assert cli.main(["libero", "somebody/policy", *words]) == 0
    found = json.loads((out / "results.json").read_text())["checkpoint"]
    assert (found["name"], found["commit"]) == ("somebody/policy", "a" * 40)


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
