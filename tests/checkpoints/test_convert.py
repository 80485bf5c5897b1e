"""Converted checkpoints: what stays to the bit, what is rounded, and which embodiments are kept."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

import saccade
from saccade import cli
from saccade.checkpoints import convert, quantize, resize
from saccade.checkpoints.comparison import action_changes
from saccade.errors import CheckpointError, InputError
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers import layouts
from tests.helpers.checkpoint_files import equal, others_of, tensors_of
from tests.helpers.engine_cases import arrays, same

PER_EMBODIMENT = re.compile(r".*(state_encoder|action_encoder|action_(\w+_)?decoder)\..*\.[Wb]")


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
