"""The `saccade` command itself; what a single command does is tested beside that command's parts."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import saccade
from saccade import cli

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = tuple(cli.COMMANDS)


def saccade_command(*args: str, code: str | None = None) -> subprocess.CompletedProcess[str]:
    """Runs `python -m saccade ...`, or Python code that does."""
    start = ["-m", "saccade"] if code is None else ["-c", code]
    return subprocess.run([sys.executable, *start, *args], capture_output=True, text=True, check=False)


def run_fake(monkeypatch: pytest.MonkeyPatch, run: Callable[[argparse.Namespace], int], *args: str) -> int:
    """The status of `saccade parity ARGS`, with that command's work replaced."""

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--number", type=int)

    monkeypatch.setattr(
        cli, "load_command", lambda name: SimpleNamespace(add_arguments=add_arguments, run=run)
    )
    return cli.main(["parity", *args])


def fails(error: BaseException) -> Callable[[argparse.Namespace], int]:
    """A command's work that raises."""

    def run(args: argparse.Namespace) -> int:
        raise error

    return run


def test_help_lists_the_commands_and_imports_none_of_them() -> None:
    code = (
        "import sys; from saccade.cli import main\n"
        "heavy = ('saccade.cli.', 'torch', 'rich', 'mujoco')\n"
        "try: main(['--help'])\n"
        "finally: print('IMPORTED', *[name for name in sys.modules if name.startswith(heavy)])"
    )
    done = saccade_command(code=code)
    listing, _, imported = done.stdout.partition("IMPORTED")
    assert imported.strip() == ""
    for name, help_line in cli.COMMANDS.items():
        assert name in listing
        assert help_line.split()[0] in listing


def test_no_command_prints_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    assert "rollout" in capsys.readouterr().out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"saccade {saccade.__version__}\n"


def test_installed_script_is_the_same_program() -> None:
    script = Path(sys.executable).with_name("saccade")
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"saccade {saccade.__version__}\n"


def test_every_file_is_a_command_and_every_command_a_file() -> None:
    files = (path.stem for path in Path(cli.__file__).parent.glob("*.py"))
    assert {name for name in files if not name.startswith("_")} == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_explains_itself_with_examples(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.COMMANDS[name] == cli.load_command(name).HELP
    with pytest.raises(SystemExit, match="0"):
        cli.main([name, "--help"])
    out = capsys.readouterr().out
    assert "examples:" in out
    assert f"  saccade {name}" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["dance"], "saccade: argument command: invalid choice: 'dance'"),
        (["--dance"], "saccade: unrecognized arguments: --dance"),
        (["parity", "--dance"], "saccade: unrecognized arguments: --dance"),
        (["parity", "--number", "x"], "saccade parity: argument --number: invalid int value: 'x'"),
    ],
)
def test_arguments_that_do_not_parse_are_one_line(
    arguments: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run_fake(monkeypatch, lambda args: 0, *arguments[1:]) if arguments[0] == "parity" else cli.main(
            arguments
        )
    err = capsys.readouterr().err
    assert err.startswith(message)
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            cli.UsageError("--episodes: given 0, expected at least 1"),
            "--episodes: given 0, expected at least 1",
        ),
        (saccade.CheckpointError("2 problems:\n  this\n  that"), "2 problems:; this; that"),
        (FileNotFoundError("config: no such file: a.json"), "config: no such file: a.json"),
        (PermissionError(13, "Permission denied", "/proc/out"), "/proc/out: Permission denied"),
        (
            MemoryError("Unable to allocate 48 GiB"),
            "too large for this machine's memory: Unable to allocate 48 GiB",
        ),
        (MemoryError(), "too large for this machine's memory"),
        (
            ModuleNotFoundError("No module named 'mujoco'", name="mujoco"),
            "mujoco is not installed: pip install 'saccade[sim]'",
        ),
        (
            ModuleNotFoundError("No module named 'rich.progress'", name="rich.progress"),
            "rich is not installed: pip install 'saccade[cli]'",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    error: BaseException, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_fake(monkeypatch, fails(error)) == 2
    assert capsys.readouterr().err == f"saccade: {line}\n"


@pytest.mark.parametrize(
    "error", [RuntimeError("a bug"), ModuleNotFoundError("no x", name="x"), OSError("disk")]
)
def test_a_bug_keeps_its_traceback(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(type(error)):
        run_fake(monkeypatch, fails(error))


def test_ctrl_c_is_status_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_fake(monkeypatch, fails(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "saccade: interrupted\n"


def test_a_commands_status_is_the_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_fake(monkeypatch, lambda args: 1) == 1
    assert run_fake(monkeypatch, lambda args: args.number, "--number", "7") == 7


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = (
        "import sys, types; from saccade import cli\n"
        "command = types.SimpleNamespace(add_arguments=lambda _: None, run=lambda _: print('a line'))\n"
        "cli.load_command = lambda name: command\n"
        "sys.exit(cli.main(['parity']))"
    )
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=write_end, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, "")


def test_missing_extra_is_named_before_anything_else() -> None:
    code = (
        "import sys; sys.modules['rich'] = None; from saccade.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    done = saccade_command("rollout", "--episodes", "1", code=code)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "saccade: rich is not installed: pip install 'saccade[cli]'\n"
