"""The `saccade` command on streams and disks that refuse: another encoding, closed, full, read-only."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saccade._internal import json as _json
from saccade._internal.files import write_atomically, write_json
from saccade.cli import main, output
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from tests.helpers.systems import IS_ROOT

INSPECT = [sys.executable, "-m", "saccade", "inspect", str(DEMO_CHECKPOINT)]
#: Prints what no ASCII stream can take, through rich and without.
PRINTS = """
import sys, types
from saccade import cli
from saccade.cli import output
def run(args):
    print("18–32 × é “told” \\udcff")
    output.console().print("R² → 0.3")
    return 0
cli.load_command = lambda name: types.SimpleNamespace(add_arguments=lambda parser: None, run=run)
sys.exit(cli.main(["parity"]))
"""


def run(*command: str, stdout: Any = subprocess.PIPE, **options: Any) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=False, check=False, **options)


@pytest.mark.parametrize(
    ("encoding", "expected"),
    [
        ("ascii", b'18-32 x e "told" ?\nR2 -> 0.3\n'),
        ("latin-1", b'18-32 \xd7 \xe9 "told" ?\nR\xb2 -> 0.3\n'),
        ("utf-8", "18–32 × é “told” ?\nR² → 0.3\n".encode()),
    ],
)
def test_text_degrades_to_what_the_encoding_has(encoding: str, expected: bytes) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = run(sys.executable, "-c", PRINTS, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, expected, b"")


def test_a_reader_that_goes_away_is_no_error_for_tables_either() -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = run(*INSPECT, stdout=write_end)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize("arguments", [[], ["--json"]])
def test_a_full_disk_behind_the_output_is_one_line(arguments: list[str]) -> None:
    with Path("/dev/full").open("wb") as full:
        done = run(*INSPECT, *arguments, stdout=full)
    assert done.returncode == 2
    assert done.stderr.endswith(b"No space left on device\n")
    assert done.stderr.count(b"\n") == 1


def test_a_closed_output_is_one_line() -> None:
    done = run("sh", "-c", 'exec "$@" >&-', "sh", *INSPECT)
    assert (done.returncode, done.stderr) == (2, b"saccade: standard output is closed\n")


def test_closed_errors_are_no_error() -> None:
    done = run("sh", "-c", 'exec "$@" 2>&-', "sh", *INSPECT)
    assert done.returncode == 0
    assert b"future tokens" in done.stdout


@pytest.mark.skipif(not IS_ROOT, reason="only root mounts")
@pytest.mark.parametrize("options", ["size=8k", "ro"])
def test_disks_that_refuse_are_one_line(options: str, tmp_path: Path) -> None:
    disk, recording = tmp_path / "disk", str(tmp_path / "demos")
    disk.mkdir()
    mount = f'mount -t tmpfs -o {options} tmpfs {disk} || exit 77; exec "$@"'
    sizes = ["--image-size", "16", "--frame-stride", "8"]
    assert main(["demos", "--out", recording, "--tasks", "reach", "--episodes", "1", *sizes]) == 0
    tiny = ["--training-steps", "1", "--batch-size", "2", "--width", "16", "--num-layers", "2"]
    for command in (
        ["attention", "--blocks", "0", "--steps", "0", "--cell", "4"],
        ["demos", "--tasks", "reach", "--episodes", "1"],
        ["resize", str(DEMO_CHECKPOINT), "--num-future-tokens", "64"],
        ["rollout", "--tasks", "button-press-topdown", "--episodes", "1", "--video"],
        ["train", "--demos", recording, "--patch-size", "8", *tiny],
    ):
        shell = ["unshare", "--mount", "sh", "-c", mount, "sh", sys.executable, "-m", "saccade"]
        done = run(*shell, *command, "--out", str(disk / "out"))
        if done.returncode == 77 or b"unshare" in done.stderr:
            pytest.skip("mounting is not allowed here")
        reasons = (b"Read-only",) if options == "ro" else (b"No space left on device", b"disk full")
        assert done.returncode == 2, done.stderr
        assert any(reason in done.stderr for reason in reasons)
        assert str(disk).encode() in done.stderr
        assert done.stderr.count(b"\n") == 1


def test_a_failed_write_names_the_file_and_leaves_none(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"

    def write() -> None:
        with write_atomically(path) as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"No space left.*table\.csv") as caught:
        write()
    assert caught.value.filename == str(path)
    assert not list(tmp_path.iterdir())


def strict(text: str) -> Any:
    """JSON as other programs read it."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_json_has_null_for_what_is_not_finite(tmp_path: Path) -> None:
    value = {
        "a": [1.5, float("nan")],
        "b": {"c": float("-inf")},
        "d": np.float64("inf"),
        "e": (1, "NaN", None),
    }
    expected = {"a": [1.5, None], "b": {"c": None}, "d": None, "e": [1, "NaN", None]}
    assert strict(_json.dumps(value)) == expected
    write_json(tmp_path / "file.json", value)
    assert strict((tmp_path / "file.json").read_text()) == expected
    assert _json.dumps({"a": 0.1, "é": [1]}, indent=2) == json.dumps({"a": 0.1, "é": [1]}, indent=2)


def test_parity_prints_json_where_a_difference_is_not_a_number(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from saccade_lab.cli import parity

    nan = parity.Deviation(float("nan"), float("nan"))
    monkeypatch.setattr(parity.Deviation, "between", lambda given, expected: nan)
    assert main(["parity", "--num-vl-tokens", "3", "--num-steps", "1", "--json"]) == 1
    assert strict(capsys.readouterr().out)["results"][0]["actions"] == {"max_abs": None, "max_rel": None}


def test_progress_in_a_log_is_at_most_a_line_a_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also without rich."""
    now = 0.0
    monkeypatch.setattr("saccade.cli.output.time.monotonic", lambda: now)

    def work() -> str:
        nonlocal now
        with output.progress_bar("reading", 3_000_000, in_bytes=True) as update:
            for later, total, description in (
                (59, None, None),
                (2, None, None),
                (59, 4_000_000, "weights"),
                (1, None, None),
            ):
                now += later
                update(2_000_000, total=total, description=description)
        written = capsys.readouterr()
        assert written.out == ""
        return written.err

    expected = "reading: 2 MB of 3 MB\nweights: 2 MB of 4 MB\n"
    assert work() == expected
    monkeypatch.setitem(sys.modules, "rich.progress", None)
    assert work() == expected
