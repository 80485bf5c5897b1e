"""Converted checkpoints: what stays to the bit, what is rounded, and that nothing is half written."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import saccade
from saccade import cli
from saccade.checkpoints import convert, quantize, resize
from saccade.checkpoints.comparison import action_changes
from saccade.errors import CheckpointError, InputError
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers import layouts
from tests.helpers.engine_cases import arrays, same

PER_EMBODIMENT = re.compile(r".*(state_encoder|action_encoder|action_(\w+_)?decoder)\..*\.[Wb]")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return layouts.write(tmp_path / "source", "nvidia")


def tensors_of(folder: Path) -> dict[str, Tensor]:
    """All tensors of the weights' files."""
    files = [file for file in folder.glob("*.safetensors") if not file.name.startswith("policy_")]
    return {name: tensor for file in sorted(files) for name, tensor in load_file(file).items()}


def others_of(folder: Path) -> dict[str, bytes]:
    """All files but the weights and their index, by path."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and not file.name.startswith("model")
    }


def equal(first: dict[str, Tensor], second: dict[str, Tensor]) -> bool:
    """Whether two checkpoints hold the same bits under the same names."""
    return first.keys() == second.keys() and all(
        first[name].dtype == second[name].dtype
        and torch.equal(first[name].reshape(-1).view(torch.uint8), second[name].reshape(-1).view(torch.uint8))
        for name in first
    )


def actions(folder: Path, embodiment_id: int = 3, **options: Any) -> Any:
    head = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[embodiment_id], **options)
    inputs = arrays(random_inputs(head.config, 2, batch=1, num_vl_tokens=9))
    return head(**{**inputs, "embodiment_id": embodiment_id})


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
@pytest.mark.parametrize("max_shard_bytes", [None, 3_000_000])
def test_nothing_changes_unasked(layout: str, max_shard_bytes: int | None, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "source", layout)
    report = convert(source, tmp_path / "out", max_shard_bytes=max_shard_bytes)
    assert equal(tensors_of(source), tensors_of(tmp_path / "out"))
    assert others_of(source) == others_of(tmp_path / "out")
    assert sorted(map(str, report.carried)) == sorted(others_of(source).keys() - {"config.json"})
    assert (report.num_converted, report.num_rounded, report.num_dropped) == (0, 0, 0)
    assert same(actions(source), actions(tmp_path / "out"))
    if max_shard_bytes is not None:
        assert len(report.files) > 1
        assert all(file.stat().st_size < 1.1 * max_shard_bytes for file in report.files)


@pytest.mark.parametrize("files", [1, 3])
def test_one_file_stays_one_and_several_stay_below_the_usual_size(files: int, tmp_path: Path) -> None:
    """lerobot reads one file, model.safetensors; a checkpoint of several comes together below 5 GB."""
    source = layouts.write(tmp_path / "source", "nvidia" if files == 1 else "nvidia-sharded")
    assert convert(source, tmp_path / "out").files == (tmp_path / "out" / "model.safetensors",)


def test_back_and_forth_is_the_same_file(source: Path, tmp_path: Path) -> None:
    convert(source, tmp_path / "shards", max_shard_bytes=1_000_000)
    index = json.loads((tmp_path / "shards" / "model.safetensors.index.json").read_text())
    assert index["metadata"]["total_size"] == sum(t.nbytes for t in tensors_of(source).values())
    convert(tmp_path / "shards", tmp_path / "one")
    assert equal(tensors_of(source), tensors_of(tmp_path / "one"))


@pytest.mark.parametrize("name", ["float32", "bfloat16", "float16"])
def test_types(name: str, source: Path, tmp_path: Path) -> None:
    dtype = getattr(torch, name)
    report = convert(source, tmp_path / "out", dtype=name)
    before, after = tensors_of(source), tensors_of(tmp_path / "out")
    expected = {key: t.to(dtype) for key, t in before.items()}
    assert equal(after, expected)
    errors = {key: (after[key].double() - before[key].double()).abs() for key in before}
    assert report.largest_error == max(float(error.max()) for error in errors.values())
    assert report.num_rounded == sum(int((error > 0).sum()) for error in errors.values())
    assert report.num_converted == sum(t.dtype != dtype for t in before.values())
    if name == "float32":
        assert report.num_rounded == 0
        assert same(actions(source), actions(tmp_path / "out"))
    else:
        assert report.largest_error_in is not None
        assert float(errors[report.largest_error_in].max()) == report.largest_error
        assert 2**-12 < report.largest_relative_error <= 1


def test_there_and_back_through_a_wider_type(tmp_path: Path) -> None:
    """bfloat16 in float32 and back is what it was."""
    source = layouts.write(tmp_path / "source", "nvidia")
    convert(source, tmp_path / "half", dtype="bfloat16")
    convert(tmp_path / "half", tmp_path / "single", dtype="float32")
    report = convert(tmp_path / "single", tmp_path / "again", dtype="bfloat16")
    assert report.num_rounded == 0
    assert equal(tensors_of(tmp_path / "half"), tensors_of(tmp_path / "again"))


@pytest.mark.parametrize(("value", "dtype"), [(70000.0, "float16"), (3.4e38, "bfloat16")])
def test_what_a_type_cannot_hold_is_refused(value: float, dtype: str, source: Path, tmp_path: Path) -> None:
    tensors = tensors_of(source)
    tensors["action_head.vlln.weight"] = tensors["action_head.vlln.weight"].float()
    tensors["action_head.vlln.weight"][3] = value
    save_file(tensors, source / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"vlln\.weight holds .*, more than B?F16 can"):
        convert(source, tmp_path / "out", dtype=dtype)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_infinity_and_nan_stay(source: Path, tmp_path: Path) -> None:
    tensors = tensors_of(source)
    tensors["backbone.x"] = torch.tensor([torch.inf, -torch.inf, torch.nan, 1.0])
    save_file(tensors, source / "model.safetensors")
    convert(source, tmp_path / "out", dtype="float16")
    assert str(tensors_of(tmp_path / "out")["backbone.x"].tolist()) == "[inf, -inf, nan, 1.0]"


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_fewer_embodiments_in_another_type(layout: str, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "source", layout)
    for dtype in ("bfloat16", "float32"):
        report = convert(
            source, tmp_path / dtype, embodiment_ids=[2, 10], dtype=dtype, max_shard_bytes=2_000_000
        )
        assert report.embodiment_ids == (2, 10)
        converted = tensors_of(tmp_path / dtype)
        for name, tensor in tensors_of(source).items():
            expected = tensor.to(getattr(torch, dtype))
            if PER_EMBODIMENT.fullmatch(name):
                expected[[index for index in range(32) if index not in (2, 10)]] = 0
            assert torch.equal(converted[name], expected), name


def test_embodiments_keep_their_numbers(source: Path, tmp_path: Path) -> None:
    report = convert(source, tmp_path / "out", embodiment_ids=[31, 3, 3], dtype=None)
    assert report.embodiment_ids == (3, 31)
    before, after = tensors_of(source), tensors_of(tmp_path / "out")
    assert before.keys() == after.keys()
    zeroed = 0
    for name, tensor in before.items():
        expected = tensor.clone()
        if PER_EMBODIMENT.fullmatch(name):
            others = [index for index in range(32) if index not in (3, 31)]
            expected[others] = 0
            zeroed += expected[others].nbytes
        assert torch.equal(after[name], expected)
    assert report.zeroed_bytes == zeroed > 0
    assert report.bytes_after == report.bytes_before
    # The zeros take no room where the file system has holes.
    taken = (tmp_path / "out" / "model.safetensors").stat().st_blocks * 512
    assert taken <= report.bytes_after
    for embodiment_id in (3, 31):
        assert same(actions(source, embodiment_id), actions(tmp_path / "out", embodiment_id))
    assert saccade.ActionHead.from_pretrained(tmp_path / "out").embodiment_ids == (3, 31)
    with pytest.raises(InputError, match="expected some of 3, 31, which alone are in this checkpoint, got 5"):
        saccade.ActionHead.from_pretrained(tmp_path / "out", embodiment_ids=[3, 5])
    # A copy of the copy knows it too.
    convert(tmp_path / "out", tmp_path / "half", dtype="bfloat16", max_shard_bytes=2_000_000)
    quantize(tmp_path / "half", tmp_path / "int8")
    resize(tmp_path / "int8", tmp_path / "more", num_future_tokens=40)
    assert saccade.ActionHead.from_pretrained(tmp_path / "more").embodiment_ids == (3, 31)
    moved = action_changes(tmp_path / "int8", tmp_path / "more", num_observations=1, num_vl_tokens=5)
    assert moved.in_saccade.largest < 1e-5
    convert(tmp_path / "more", tmp_path / "one", embodiment_ids=[31])
    assert saccade.ActionHead.from_pretrained(tmp_path / "one").embodiment_ids == (31,)
    with pytest.raises(InputError, match="expected some of 31"):
        convert(tmp_path / "one", tmp_path / "none", embodiment_ids=[3])
    with pytest.raises(InputError, match="embodiment_ids: expected ids from 0 to 31, got 32"):
        convert(source, tmp_path / "more", embodiment_ids=[32])
    with pytest.raises(InputError, match="embodiment_ids: expected at least one"):
        convert(source, tmp_path / "more", embodiment_ids=[])


@pytest.mark.parametrize("note", ["", "3;5", "3,32", "3,-1", "9" * 30])
def test_a_note_of_embodiments_that_is_none(note: str, source: Path) -> None:
    save_file(tensors_of(source), source / "model.safetensors", {"saccade_embodiment_ids": note})
    with pytest.raises((CheckpointError, InputError), match="embodiment_ids"):
        saccade.ActionHead.from_pretrained(source)


def test_embodiments_in_another_type(source: Path, tmp_path: Path) -> None:
    convert(source, tmp_path / "both", embodiment_ids=[5], dtype="bfloat16", max_shard_bytes=500_000)
    convert(source, tmp_path / "first", embodiment_ids=[5])
    convert(tmp_path / "first", tmp_path / "then", dtype="bfloat16")
    assert equal(tensors_of(tmp_path / "both"), tensors_of(tmp_path / "then"))


def test_head_only(source: Path, tmp_path: Path) -> None:
    report = convert(source, tmp_path / "out", head_only=True)
    assert report.num_dropped == 2
    assert all(name.startswith("action_head.") for name in tensors_of(tmp_path / "out"))
    assert same(actions(source), actions(tmp_path / "out"))


@pytest.mark.parametrize(("to", "dtype"), [("int8", torch.int8), ("int4", torch.uint8)])
def test_quantised_weights_keep_their_scales(
    source: Path, to: str, dtype: torch.dtype, tmp_path: Path
) -> None:
    quantize(source, tmp_path / to, to=to)
    convert(tmp_path / to, tmp_path / "out", dtype="bfloat16")
    before, after = tensors_of(tmp_path / to), tensors_of(tmp_path / "out")
    integers = [name for name, t in before.items() if t.dtype == dtype]
    assert integers
    for name in integers:
        for kept in (name, f"{name}_scale"):
            assert after[kept].dtype == before[kept].dtype
            assert torch.equal(after[kept], before[kept])
    assert actions(tmp_path / "out", precision=to).shape == (1, 16, 8)


def test_the_files_say_where_they_come_from(source: Path, tmp_path: Path) -> None:
    convert(source, tmp_path / "out")
    with safe_open(tmp_path / "out" / "model.safetensors", "pt") as file:
        assert file.metadata().keys() == {"format", "saccade", "source_sha256"}


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


@pytest.mark.parametrize("wrong", [{"dtype": "float64"}, {"max_shard_bytes": 0}, {"embodiment_ids": [-1]}])
def test_options_out_of_range(wrong: dict[str, Any], source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        convert(source, tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()


def test_sources_that_do_not_fit(source: Path, tmp_path: Path) -> None:
    tensors = tensors_of(source)
    del tensors["action_head.vlln.weight"]
    tensors["action_head.extra"] = torch.zeros(1)
    save_file(tensors, source / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"(?s)vlln\.weight is missing.*extra is unknown"):
        convert(source, tmp_path / "out")
    with pytest.raises(FileNotFoundError):
        convert(tmp_path / "nowhere", tmp_path / "out")


def test_the_command(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out")
    (source / "optimizer.pt").write_text("")
    options = ["--dtype", "bfloat16", "--embodiment-ids", "3,31", "--max-shard-size", "2MB"]
    assert cli.main(["convert", str(source), "--out", out, *options]) == 0
    printed = capsys.readouterr().out
    for part in (
        "kept embodiments 3, 31",
        "numbers: largest error",
        "not copied: optimizer.pt",
        "other file",
    ):
        assert part in printed
    assert cli.main(["convert", str(source), "--out", out, "--force", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["files"] == [str(tmp_path / "out" / "model.safetensors")]
    assert report["left"] == ["optimizer.pt"]
    for bad in (["--max-shard-size", "big"], ["--max-shard-size", "0GB"], []):
        assert cli.main(["convert", str(source), "--out", out, *bad]) == cli.EXIT_BAD_INPUT
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert np.asarray(actions(tmp_path / "out")).shape == (1, 16, 8)
