"""Places where nothing can be written: disks that fill up, names that are none, what changes meanwhile.

Whatever writes a checkpoint says what is wrong, once, replaces nothing that it was not told to replace, and
leaves nothing behind.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import saccade
from tests.helpers import hostile_cases
from tests.helpers.hostile_cases import TINY, WRITERS, Meddler, limited, names, refused
from tests.helpers.paths import ROOT
from tests.helpers.systems import linux, posix

# Fixtures.
good, no_hang = hostile_cases.good, hostile_cases.no_hang


@pytest.mark.parametrize("entry", WRITERS)
def test_a_disk_that_is_full(entry: str, good: Path) -> None:
    with limited("RLIMIT_FSIZE", 50_000):
        refused(lambda: WRITERS[entry](good, good.parent / "out"), "out: .* cannot be written")
    assert names(good.parent) == {"good"}


@linux
@pytest.mark.parametrize("entry", WRITERS)
def test_a_file_system_that_is_full(entry: str, good: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting is not permitted here")
    try:
        refused(lambda: WRITERS[entry](good, disk / "out"), "out: .* cannot be written: No space left")
        assert names(disk) == set()
        subprocess.run([*mount[:4], "remount,ro", str(disk)], check=True)
        refused(lambda: WRITERS[entry](good, disk / "out"), "out: .* cannot be written: Read-only")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@posix
@pytest.mark.parametrize("entry", WRITERS)
@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("", "out: "),
        ("/", "out: "),
        ("..", "out: "),
        ("a\0b", "out: "),
        ("x" * 300, "out: .* File name too long"),
        pytest.param("/proc/out", "out: .* cannot be written", marks=linux),
        ("good/config.json", "out: .* is not a directory"),
        ("good/config.json/out", "out: "),
        ("good", "out: .* holds the source"),
        ("good/../good/.", "out: "),
        ("dangling", "out: "),
        ("itself", "out: "),
    ],
)
def test_outputs_that_are_none(
    entry: str, out: str, message: str, good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "itself").symlink_to("itself")
    monkeypatch.chdir(tmp_path)
    before = {path.name: path.read_bytes() for path in good.iterdir()}
    refused(lambda: WRITERS[entry](good, Path(out), force=True), message)
    assert {path.name: path.read_bytes() for path in good.iterdir()} == before
    assert names(tmp_path) == {"good", "dangling", "itself"}


@posix
@pytest.mark.parametrize("entry", WRITERS)
def test_behind_a_link_what_it_leads_to_is_replaced(entry: str, good: Path, tmp_path: Path) -> None:
    other, out = tmp_path / "other", tmp_path / "out"
    shutil.copytree(good, other)
    out.symlink_to(other)
    refused(lambda: WRITERS[entry](good, out), "exists already")
    assert (other / "model.safetensors").read_bytes() == TINY.path.read_bytes()
    WRITERS[entry](good, out, force=True)
    assert out.is_symlink()
    assert (other / "model.safetensors").read_bytes() != TINY.path.read_bytes()
    saccade.ActionHead.from_pretrained(out)
    assert names(tmp_path) == {"good", "other", "out"}


@pytest.mark.parametrize("entry", WRITERS)
@pytest.mark.parametrize("force", [False, True])
def test_what_appears_under_the_name_meanwhile_is_not_replaced(
    entry: str, force: bool, good: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"

    def appear() -> None:
        out.mkdir()
        (out / "thesis.tex").write_text("the only copy")

    refused(
        lambda: WRITERS[entry](good, out, force=force, progress=Meddler(appear)),
        "out: .*(thesis.tex|not empty)",
    )
    assert (out / "thesis.tex").read_text() == "the only copy"
    assert names(tmp_path) == {"good", "out"}
    assert names(out) == {"thesis.tex"}


@pytest.mark.parametrize("entry", WRITERS)
def test_a_checkpoint_that_appears_meanwhile_is_replaced_only_by_force(
    entry: str, good: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    refused(
        lambda: WRITERS[entry](good, out, progress=Meddler(lambda: shutil.copytree(good, out))),
        "exists already|not empty",
    )
    assert (out / "model.safetensors").read_bytes() == TINY.path.read_bytes()
    assert names(tmp_path) == {"good", "out"}


@pytest.mark.parametrize("entry", WRITERS)
@pytest.mark.parametrize("change", ["shrinks", "grows", "is written to"])
def test_a_source_that_changes_while_it_is_read(entry: str, change: str, good: Path, tmp_path: Path) -> None:
    path = good / "model.safetensors"

    def meddle() -> None:
        if change == "shrinks":
            os.truncate(path, path.stat().st_size // 2)
        elif change == "grows":
            with path.open("ab") as file:
                file.write(b"more")
        else:
            with path.open("r+b") as file:
                file.seek(-4, os.SEEK_END)
                file.write(b"\xff\xff\xff\xff")
            os.utime(path, ns=(0, path.stat().st_mtime_ns + 10**9))

    refused(
        lambda: WRITERS[entry](good, tmp_path / "out", progress=Meddler(meddle)),
        "cannot be read from .*model.safetensors: (failed to fill whole buffer|it changed while it was read)",
    )
    assert names(tmp_path) == {"good"}


@posix  # Windows keeps a file that is open
@pytest.mark.parametrize("entry", WRITERS)
def test_a_source_that_vanishes_is_still_there_for_who_opened_it(
    entry: str, good: Path, tmp_path: Path
) -> None:
    expected = tmp_path / "expected"
    WRITERS[entry](good, expected)
    path = good / "model.safetensors"
    WRITERS[entry](good, tmp_path / "out", progress=Meddler(path.unlink))
    assert (tmp_path / "out" / path.name).read_bytes() == (expected / path.name).read_bytes()


@posix  # Windows keeps a folder whose files are open
@pytest.mark.parametrize("entry", WRITERS)
def test_a_folder_that_vanishes_while_it_is_written(entry: str, good: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()
    refused(
        lambda: WRITERS[entry](good, work / "out", progress=Meddler(lambda: shutil.rmtree(work))),
        "out: .* cannot be written",
    )
    assert names(tmp_path) == {"good"}


@pytest.mark.parametrize("entry", WRITERS)
def test_a_folder_in_the_source_is_written_and_changes_nothing_there(entry: str, good: Path) -> None:
    WRITERS[entry](good, good / "out")
    assert names(good) == {"config.json", "model.safetensors", "out"}
    assert (good / "model.safetensors").read_bytes() == TINY.path.read_bytes()
    saccade.ActionHead.from_pretrained(good)
    saccade.ActionHead.from_pretrained(good / "out")


@posix
@pytest.mark.parametrize("entry", WRITERS)
def test_a_killed_writer_leaves_no_checkpoint(entry: str, good: Path, tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; sys.path.insert(0, os.environ['ROOT']);"
        "from tests.helpers import hostile_cases as t; from pathlib import Path;"
        "kill = lambda: os.kill(os.getpid(), signal.SIGKILL);"
        "t.WRITERS[sys.argv[1]](Path('good'), Path('out'), progress=t.Meddler(kill))"
    )
    environment = os.environ | {"ROOT": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code, entry], cwd=tmp_path, env=environment, capture_output=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    (left,) = names(tmp_path) - {"good"}
    assert left.startswith(".out.")
    WRITERS[entry](good, tmp_path / "out")
    saccade.ActionHead.from_pretrained(tmp_path / "out")
