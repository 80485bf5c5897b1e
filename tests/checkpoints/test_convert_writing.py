"""Where `convert` writes: files beside the weights, what is replaced, and that nothing is half written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from saccade import cli
from saccade.checkpoints import convert
from saccade.errors import CheckpointError, InputError
from tests.helpers.checkpoint_files import equal, others_of, tensors_of


def test_what_lies_beside_the_weights(source: Path, tmp_path: Path) -> None:
    for name in ("tokenizer.json", "merges.txt", "chat_template.jinja", "README.md", "LICENSE", "a/b/c.yaml"):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(name)
    for name in ("optimizer.pt", "checkpoint-5/config.json", "checkpoint-5/model.safetensors", "loop.exe"):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(name)
    (source / ".git").mkdir()
    (source / ".git" / "config.json").write_text("{}")
    (source / "linked.json").symlink_to(source / "README.md")
    (source / "dangling.json").symlink_to(source / "nowhere")
    (source / "round").symlink_to(source)
    os.mkfifo(source / "pipe.json")
    os.mkfifo(source / "pipe.safetensors.txt")
    report = convert(source, tmp_path / "out")
    assert {str(path) for path in report.carried} == {
        *("tokenizer.json", "merges.txt", "chat_template.jinja", "README.md", "LICENSE", "a/b/c.yaml"),
        *("linked.json", "experiment_cfg/metadata.json"),
    }
    assert {str(path) for path in report.left} == {
        *("optimizer.pt", "checkpoint-5", "loop.exe", "dangling.json", "round", "pipe.json"),
        "pipe.safetensors.txt",
    }
    found = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*")}
    assert found == {
        *map(str, report.carried),
        "a",
        "a/b",
        "experiment_cfg",
        "config.json",
        "model.safetensors",
    }
    assert (tmp_path / "out" / "linked.json").read_text() == "README.md"


def test_a_single_file_brings_its_config_alone(source: Path, tmp_path: Path) -> None:
    report = convert(source / "model.safetensors", tmp_path / "out")
    assert report.carried == ()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.json", "model.safetensors"]


def test_nothing_is_replaced_unasked(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    convert(source, out)
    before = others_of(out)
    with pytest.raises(InputError, match="exists already"):
        convert(source, out)
    convert(source, out, force=True, dtype="bfloat16")
    assert others_of(out) == before
    assert all(t.dtype == torch.bfloat16 for t in tensors_of(out).values())
    for name in ("thesis.tex", "experiment_cfg/notes.json", "policy_preprocessor_step_0.safetensors"):
        (out / name).write_text("the only copy")
        with pytest.raises(InputError, match=f"holds {name}"):
            convert(source, out, force=True)
        (out / name).unlink()
    with pytest.raises(InputError, match="holds the source"):
        convert(source, source, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "source"]


def test_behind_a_link_the_directory_is_replaced(source: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "disk")
    convert(source, tmp_path / "out")
    convert(source, tmp_path / "out", force=True, dtype="float16")
    assert (tmp_path / "out").is_symlink()
    assert (tmp_path / "disk" / "model.safetensors").is_file()


def test_a_link_to_nothing_is_refused(source: Path, tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match=r"out: .* cannot be written"):
        convert(source, tmp_path / "out", force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "source"]


def test_whoever_looks_finds_a_checkpoint(source: Path, tmp_path: Path) -> None:
    """While one takes the place of another, there is always one."""
    out = tmp_path / "out"
    convert(source, out)
    missed, checks, done = 0, 0, threading.Event()

    def check() -> None:
        nonlocal missed, checks
        while not done.is_set():
            missed += not (out / "config.json").exists()
            checks += 1

    watcher = threading.Thread(target=check)
    watcher.start()
    try:
        for _ in range(10):
            convert(source, out, force=True)
    finally:
        done.set()
        watcher.join()
    assert checks > 100
    assert missed == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "source"]


KILLED = """
import sys, time
from saccade.checkpoints import convert
def stop(done, total):
    if done > total / 2:
        print("half", flush=True)
        time.sleep(60)
convert(sys.argv[1], sys.argv[2], dtype="float32", force=True, progress=stop)
"""


@pytest.mark.parametrize("is_there", [False, True])
def test_a_killed_program_leaves_nothing_half_made(is_there: bool, source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if is_there:
        convert(source, out, dtype="float16")
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(source), str(out)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "half\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert out.exists() == is_there
    if is_there:
        assert all(t.dtype == torch.float16 for t in tensors_of(out).values())
    (left,) = [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    # What was left is removed by the next to write there, unless it is so young that somebody may be at it.
    convert(source, out, force=True)
    assert left.exists()
    old = time.time() - 3600
    os.utime(left, (old, old))
    convert(source, out, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "source"]


def test_two_at_once_do_not_take_each_others_files(source: Path, tmp_path: Path) -> None:
    """A directory that somebody writes to is not taken for one that was left, however old it is."""
    out = tmp_path / "out"

    def other(done: int, total: int) -> None:
        if done == total:
            (mine,) = [path for path in tmp_path.iterdir() if path.name.startswith(".")]
            old = time.time() - 3600
            os.utime(mine, (old, old))
            convert(source, out)
            assert mine.exists()

    with pytest.raises(InputError, match="exists already; force replaces it"):
        convert(source, out, progress=other)
    assert equal(tensors_of(source), tensors_of(out))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "source"]


def test_stopping(source: Path, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "out", progress=stop)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_a_full_disk(source: Path, tmp_path: Path) -> None:
    """As a limit of the process on the size of its files, since a test cannot fill a disk."""
    code = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20));"
        "from saccade import cli; sys.exit(cli.main(['convert', *sys.argv[1:]]))"
    )
    arguments = [sys.executable, "-c", code, str(source), "--out", str(tmp_path / "out")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert done.returncode == cli.EXIT_BAD_INPUT
    assert "cannot be written" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["source"]
