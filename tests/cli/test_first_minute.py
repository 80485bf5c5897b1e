"""What a new user tries first: `saccade demo`, `saccade info`, `saccade --help`, in any terminal."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import saccade
from saccade import cli
from saccade._internal.environment import caches, quota
from saccade.checkpoints.demo_frames import moments
from saccade.cli import drawing

ESCAPE = re.compile(r"\x1b\[[\d;]*m")

#: Runs the command where only NumPy can be imported besides the standard library.
NUMPY_ALONE = """
import importlib.abc, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in {"numpy", "saccade", *sys.stdlib_module_names}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Refuse())
from saccade.cli import main
sys.exit(main(sys.argv[1:]))
"""


class Terminal(io.StringIO):
    """A stream that is a terminal, in an encoding."""

    def __init__(self, encoding: str = "utf-8", terminal: bool = True) -> None:
        super().__init__()
        self._encoding, self._terminal = encoding, terminal

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._encoding

    def isatty(self) -> bool:
        return self._terminal


def run(*words: str, code: str | None = None, **variables: str) -> subprocess.CompletedProcess[str]:
    start = ["-m", "saccade"] if code is None else ["-c", code]
    return subprocess.run(
        [sys.executable, *start, *words],
        capture_output=True,
        check=False,
        encoding="utf-8",
        env={**os.environ, "PYTHONIOENCODING": "utf-8", **variables},
    )


def test_the_help_fits_a_screen() -> None:
    lines = cli.build_parser().format_help().splitlines()
    assert len(lines) <= 23  # and the next prompt
    assert max(map(len, lines)) <= 80
    listed = [name for group in cli.GROUPS.values() for name in group]
    assert sorted(listed) == sorted([*cli.COMMANDS, *cli.LAB_COMMANDS])
    assert [line.split()[0] for line in lines[2:] if line[0] != " "] == list(cli.GROUPS)


@pytest.mark.parametrize("command", ["demo", "info", "act"])
def test_numpy_is_enough(command: str) -> None:
    words = [str(saccade.demo_checkpoint())] if command == "act" else []
    done = run(command, *words, code=NUMPY_ALONE)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_the_demo_shows_what_the_policy_answers(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--task", "drawer-open"]) == 0
    out = capsys.readouterr().out
    moment = moments()["drawer-open"]
    policy = saccade.Policy.from_pretrained(saccade.demo_checkpoint())
    chunk = policy.act(moment.observation(), seed=0)
    actions = np.concatenate([chunk["hand"][0], chunk["gripper"][0]], axis=-1)
    shown = re.findall(r"^(?:hand [xyz]|gripper) +\S+ +(\S+) +(\S+) +(\S+) +(\S+) +(\S+)$", out, re.MULTILINE)
    assert [list(map(float, row[:4])) for row in shown] == np.round(
        actions[[0, 5, 10, 15]].T.astype(np.float64), 2
    ).tolist()
    assert [row[4] for row in shown] == [drawing.bars(row) for row in moment.actions.T.tolist()]
    assert f'drawer-open: "{moment.instruction}"' in out
    assert all(name in out for name in moment.images)
    assert not ESCAPE.search(out)  # pytest's capture is no terminal


def test_other_words_give_other_actions_without_the_expert(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["demo"])
    own = capsys.readouterr().out
    assert cli.main(["demo", "--instruction", "reach the green ball"]) == 0
    other = capsys.readouterr().out
    assert "recorded expert" in own
    assert "recorded expert" not in other
    assert [line[24:56] for line in own.splitlines() if line.startswith("hand")] != [
        line[24:56] for line in other.splitlines() if line.startswith("hand")
    ]


def test_the_words_that_are_shown_are_those_that_were_given(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--instruction", ""]) == 0
    assert capsys.readouterr().out.startswith('push: ""\n')


def test_a_narrow_terminal_shows_less(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for columns, expert, values in ((74, True, True), (73, False, True), (55, False, False)):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert cli.main(["demo"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines[:-2])) <= columns
        assert any("recorded expert" in line for line in lines) == expert
        assert any("step 15" in line for line in lines) == values


def test_an_unknown_task_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "--task", "fly"]) == 2
    err = capsys.readouterr().err
    assert "--task: unknown name 'fly', expected one of reach, push, drawer-open" in err


@pytest.mark.parametrize("encoding", ["utf-8", "ascii", "cp1252", "cp437"])
def test_the_demo_writes_in_any_encoding(encoding: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "saccade", "demo"],
        capture_output=True,
        check=True,
        env={**os.environ, "PYTHONIOENCODING": encoding},
    )
    text = done.stdout.decode(encoding)
    assert "?" not in text
    assert max(map(len, text.splitlines())) <= 80
    assert ("▁" in text) == (encoding == "utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
@pytest.mark.parametrize(
    ("variables", "sequence"),
    [
        ({"TERM": "xterm-256color", "COLORTERM": "truecolor"}, r"\x1b\[38;2;\d+;\d+;\d+;48;2;\d+;\d+;\d+m▀"),
        ({"TERM": "xterm-256color", "COLORTERM": ""}, r"\x1b\[38;5;\d+;48;5;\d+m▀"),
        ({"TERM": "dumb", "COLORTERM": ""}, None),
        ({"TERM": "xterm-256color", "COLORTERM": "truecolor", "NO_COLOR": "1"}, None),
    ],
)
def test_the_demo_fits_a_terminal_of_80_columns(variables: dict[str, str], sequence: str | None) -> None:
    import pty

    main_end, its_end = pty.openpty()
    environment = {**os.environ, "COLUMNS": "80", "LINES": "24", "PYTHONIOENCODING": "utf-8"}
    environment.pop("NO_COLOR", None)
    child = subprocess.Popen(
        [sys.executable, "-m", "saccade", "demo"], stdout=its_end, env={**environment, **variables}
    )
    os.close(its_end)
    said = b""
    while True:
        try:
            block = os.read(main_end, 1 << 16)
        except OSError:  # what Linux answers when the other end is closed
            break
        if not block:
            break
        said += block
    os.close(main_end)
    assert child.wait() == 0
    text = said.decode().replace("\r\n", "\n")
    lines = ESCAPE.sub("", text).splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) <= 23
    assert bool(sequence and re.search(sequence, text)) == (sequence is not None)
    assert bool(ESCAPE.search(text)) == (sequence is not None)


def test_what_decides_about_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLORTERM", "24bit")
    assert drawing.colours_of(Terminal()) == "true"
    assert drawing.colours_of(Terminal(terminal=False)) == "none"
    assert drawing.colours_of(Terminal("cp1252")) == "none"
    monkeypatch.setenv("COLORTERM", "")
    assert drawing.colours_of(Terminal()) == "256"
    monkeypatch.setenv("TERM", "unknown")
    assert drawing.colours_of(Terminal()) == "none"
    monkeypatch.delenv("TERM")
    assert drawing.colours_of(Terminal()) == "none"
    monkeypatch.setattr(sys, "platform", "win32")
    for understands, found in ((True, "true"), (False, "none")):
        monkeypatch.setattr(drawing, "_understands_escapes", lambda understands=understands: understands)
        assert drawing.colours_of(Terminal()) == found
    monkeypatch.setenv("NO_COLOR", "1")
    assert drawing.colours_of(Terminal()) == "none"


def test_a_picture_has_the_colours_of_the_image() -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[:2, :, 0], image[2:, :, 2] = 255, 200
    (line,) = drawing.picture(image, 3, "true")
    assert line == "\x1b[38;2;255;0;0;48;2;0;0;200m▀" * 3 + drawing.RESET
    (line,) = drawing.picture(image, 3, "256")
    assert line == "\x1b[38;5;196;48;5;20m▀" * 3 + drawing.RESET
    grey = np.repeat(np.array([[0, 255], [0, 255]], np.uint8)[..., None], 3, axis=-1)
    assert drawing.picture(grey, 2, "none") == [" @"]


def test_a_shrunk_image_keeps_its_mean() -> None:
    image = np.random.default_rng(0).integers(0, 256, (68, 68, 3), np.uint8)
    small = drawing.shrink(image, 26, 13)
    assert small.shape == (26, 13, 3)
    assert abs(small.mean() - image.mean()) < 0.5
    np.testing.assert_array_equal(drawing.shrink(image, 68, 68), image)


def test_the_recorded_moments_are_what_the_policy_needs() -> None:
    policy = saccade.Policy.from_pretrained(saccade.demo_checkpoint())
    found = moments()
    assert list(found) == ["reach", "push", "drawer-open", "button-press-topdown", "window-open"]
    for moment in found.values():
        assert set(moment.images) == {camera.name for camera in policy.requirements.cameras or ()}
        assert moment.actions.shape == (policy.head.config.action_horizon, 4)
        # Real images, not one colour, and an expert that moves.
        assert min(image.std() for image in moment.images.values()) > 10
        assert np.abs(moment.actions).max() > 0.1


def test_info_is_what_show_config_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["info", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == saccade.show_config("dicts")
    assert cli.main(["info"]) == 0
    lines = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    config = saccade.show_config("dicts")
    assert list(lines) == list(config)
    assert lines["saccade"] == saccade.__version__
    library = Path(saccade._saccade.__file__).read_bytes()
    assert lines["library"] == hashlib.sha256(library).hexdigest()[:12]
    assert config["processors"] >= 1
    assert not [line for line in lines.values() if str(Path.home()) in line]


def test_caches_that_hold_data_are_listed(tmp_path: Path) -> None:
    for index, (level, kind, size) in enumerate(
        [("1", "Data", "48K"), ("1", "Instruction", "32K"), ("2", "Unified", "2048K"), ("3", "Unified", "")]
    ):
        folder = tmp_path / f"index{index}"
        folder.mkdir()
        for name, value in (("level", level), ("type", kind), ("size", size)):
            if value:  # some systems leave a file out
                (folder / name).write_text(f"{value}\n")
    assert caches(tmp_path) == ["L1 48K", "L2 2048K"]
    assert caches(tmp_path / "missing") == []


@pytest.mark.parametrize(
    ("files", "found"),
    [
        ({"proc/self/cgroup": "0::/a/b", "sys/fs/cgroup/a/b/cpu.max": "max 100000"}, None),
        (
            {
                "proc/self/cgroup": "0::/a/b",
                "sys/fs/cgroup/a/b/cpu.max": "max 100000",
                "sys/fs/cgroup/a/cpu.max": "150000 100000",
                "sys/fs/cgroup/cpu.max": "800000 100000",
            },
            "1.5",
        ),
        (
            {
                "proc/self/cgroup": "5:memory:/x\n4:cpu,cpuacct:/x",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "200000",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000",
                "sys/fs/cgroup/cpu/x/cpu.cfs_quota_us": "-1",
                "sys/fs/cgroup/cpu/x/cpu.cfs_period_us": "100000",
            },
            "2",
        ),
        ({}, None),
    ],
)
def test_the_tightest_quota_is_found(files: dict[str, str], found: str | None, tmp_path: Path) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"{text}\n")
    assert quota(tmp_path) == found
