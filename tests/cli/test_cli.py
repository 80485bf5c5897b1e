"""The `saccade` command itself. Single commands are tested with the modules that they use."""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

import saccade
from saccade import cli
from saccade._internal.extras import SACCADE
from saccade._internal.flags import UsageError
from saccade_lab.extras import LAB, NEEDS

ROOT = Path(__file__).resolve().parents[2]
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
        "from saccade.cli import COMMANDS\n"
        "heavy = (*(f'saccade.cli.{name}' for name in COMMANDS), 'torch', 'rich', 'mujoco')\n"
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
    package = Path(cli.__file__).parent
    commands = {path.stem for path in package.glob("*.py") if "\ndef run(args: " in path.read_text()}
    assert commands - {"precisions"} == set(COMMANDS)  # what `inspect --precision-check` runs


@pytest.mark.parametrize("name", [*cli.COMMANDS, *cli.LAB_COMMANDS])
def test_the_line_of_help_is_the_commands(name: str) -> None:
    lines = {**cli.COMMANDS, **cli.LAB_COMMANDS}
    assert lines[name] == cli.load_command(name).HELP


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
            UsageError("--episodes: given 0, expected at least 1"),
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
            ModuleNotFoundError("No module named 'rich.progress'", name="rich.progress"),
            f"rich is not installed. Install with: {SACCADE.install_command(['cli'], ['rich'])}",
        ),
        (OSError(errno.EROFS, "Read-only file system", "/ro/out"), "/ro/out: Read-only file system"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "aa"), "aa: File name too long"),
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
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


def test_an_import_that_fails_is_explained_by_the_extras_of_the_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = ModuleNotFoundError("No module named 'pandas'", name="pandas")
    for extras, status in ((LAB, 2), (SACCADE, None)):
        command = SimpleNamespace(add_arguments=lambda parser: None, run=fails(error), EXTRAS=extras)
        monkeypatch.setattr(cli, "load_command", lambda name, command=command: command)
        if status is None:  # saccade itself has no use for pandas: a mistake of the program
            with pytest.raises(ModuleNotFoundError, match="pandas"):
                cli.main(["study"])
        else:
            assert cli.main(["study"]) == status
            assert capsys.readouterr().err.startswith("saccade: pandas is not installed. Install with: ")
    for name in cli.LAB_COMMANDS:
        assert importlib.import_module(f"saccade_lab.cli.{name}").EXTRAS is LAB


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


#: Runs the command where no optional package is installed.
BARE = f"""
import sys
import warnings
for module in {sorted(set().union(*SACCADE.modules.values(), *LAB.modules.values()))}:
    sys.modules[module] = None
from saccade.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("name", [*cli.NEEDS, *NEEDS])
def test_all_that_is_missing_is_named_with_one_command(name: str, tmp_path: Path) -> None:
    arguments = {
        "act --image": ["front.png", "--", "checkpoint"],
        "attention --frames": ["frames"],
        "certify": ["certificate.json"],
        "demos": ["--out", "out"],
        "demos --env": ["libero_object", "--out", "out"],
        "diagnose": ["checkpoint", "recordings", "--out", "out"],
        "evaluate": ["checkpoint", "recordings", "--out", "out"],
        "inspect --precision-check": ["frames", "checkpoint"],
        "libero": ["checkpoint"],
        "quantize --calibrate": ["frames", "checkpoint", "--to", "int4", "--out", "out"],
        "serve": ["checkpoint"],
        "train": ["--demos", str(tmp_path), "--out", "out"],
    }
    (tmp_path / "reach").mkdir()
    (tmp_path / "reach" / "recording.json").write_text("{}")
    arguments |= {"study": ["cuts"], "study report": ["."], "study --features": ["--features", "o.npz"]}
    words = ["study", "cuts"] if name == "study --features" else name.split()
    done = saccade_command(*words, *arguments.get(name, []), code=BARE)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    table, needs = (SACCADE, cli.NEEDS) if name in cli.NEEDS else (LAB, NEEDS)
    extras = {extra for extra, modules in table.modules.items() if set(modules) & set(needs[name])}
    wanted = extras - {included for extra in extras for included in table.includes.get(extra, ())}
    if "[" in done.stderr:  # in a checkout
        assert f"[{','.join(sorted(wanted))}]" in done.stderr
    assert "is not installed" in done.stderr or "are not installed" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["attention", "--task", "fly"], "unknown name 'fly'"),
        (["attention", "--grid", "3x3"], "--grid: only with --features"),
        (["rollout", "--tasks", "reach,fly"], "unknown name 'fly'"),
        (["demos", "--tasks", "fly", "--out", "out"], "unknown name 'fly'"),
        (["train", "--demos", "nowhere", "--out", "out"], "nowhere: no demonstrations found"),
        (["parity", "--checkpoint", "nowhere"], "nowhere"),
    ],
)
def test_arguments_are_checked_before_packages(arguments: list[str], message: str) -> None:
    done = saccade_command(*arguments, code=BARE)
    assert done.returncode == 2
    assert message in done.stderr
    assert "not installed" not in done.stderr


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_commands_on_checkpoints_need_no_package(options: list[str], tmp_path: Path) -> None:
    demo = str(saccade.demo_checkpoint())
    for command in (
        ["inspect", demo],
        ["convert", demo, "--dtype", "float32", "--out", str(tmp_path / "a")],
        ["quantize", demo, "--out", str(tmp_path / "b")],
        ["resize", demo, "--num-future-tokens", "33", "--out", str(tmp_path / "c")],
    ):
        done = saccade_command(*command, *options, code=BARE)
        assert (done.returncode, done.stderr) == (0, ""), command
        if options:
            json.loads(done.stdout)


def test_warnings_are_one_line_without_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def warn(args: argparse.Namespace) -> int:
        warnings.warn("no data config", UserWarning, stacklevel=1)
        return 0

    monkeypatch.setattr("saccade.cli.inspect.run", warn)
    shown: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(
            warnings, "showwarning", lambda *given: shown.append(warnings.formatwarning(*given[:4]))
        )
        assert cli.main(["inspect", "nowhere"]) == 0
    assert shown == ["saccade: warning: no data config\n"]
    assert warnings.formatwarning("x", UserWarning, "file.py", 3).startswith("file.py:3: UserWarning: x")
