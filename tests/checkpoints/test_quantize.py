"""Checkpoints quantised to int8 and int4: what is written, that it loads with equal bits, what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import saccade
from saccade import _saccade, cli
from saccade.checkpoints import quantize, read_tensors
from saccade.errors import CheckpointError, InputError
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import arrays, save
from tests.helpers.reference_cases import small_config

# Odd sizes; the width of the feed-forward makes sums of several hundred products.
CONFIG = small_config(num_heads=2, head_dim=33, context_dim=63, vl_num_heads=3, hidden_dim=51, num_layers=3)
BLOCK_WEIGHT = re.compile(
    r"action_head\.(model|vl_self_attention)\.transformer_blocks\.\d+\.(attn1|ff)\..*weight"
)
SCALE = "action_head.model.transformer_blocks.0.attn1.to_q.weight_scale"
WEIGHT = SCALE.removesuffix("_scale")
ODD_WEIGHT = WEIGHT.replace("to_q", "to_k")  # of 63 inputs


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A checkpoint with a tensor outside the head."""
    folder = tmp_path / "source"
    folder.mkdir()
    save(folder, random_head(CONFIG, 1), CONFIG)
    tensors = load_file(folder / "model.safetensors")
    tensors["backbone.layer.weight"] = torch.arange(6, dtype=torch.float16).reshape(2, 3)
    tensors["backbone.count"] = torch.tensor(7)
    save_file(tensors, folder / "model.safetensors")
    return folder


@pytest.fixture
def quantized(source: Path, tmp_path: Path) -> Path:
    quantize(source, tmp_path / "int8")
    return tmp_path / "int8"


@pytest.fixture
def int4(source: Path, tmp_path: Path) -> Path:
    quantize(source, tmp_path / "int4", to="int4")
    return tmp_path / "int4"


def integers(values: Tensor, width: int) -> Tensor:
    """What int8 `(out, width)` or int4 `(out, width / 2)` stand for, by the format's definition."""
    if values.dtype == torch.int8:
        return values
    pairs = values.to(torch.int16)
    both = torch.stack((pairs % 16, pairs // 16), dim=2).flatten(1)
    both = torch.where(both > 7, both - 16, both)
    assert bool((both[:, width:] == 0).all())
    return both[:, :width].to(torch.int8)


def actions(checkpoint: Path, **options: Any) -> np.ndarray[Any, Any]:
    head = saccade.ActionHead.from_pretrained(checkpoint, **options)
    config = saccade.HeadConfig.from_dict(CONFIG)
    return np.asarray(head(**arrays(random_inputs(config, 2, batch=2, num_vl_tokens=9))))


def tensors_of(folder: Path) -> dict[str, Tensor]:
    return {name: t for file in sorted(folder.glob("*.safetensors")) for name, t in load_file(file).items()}


def rewrite(folder: Path, change: Callable[[dict[str, Tensor]], object]) -> None:
    tensors = tensors_of(folder)
    change(tensors)
    save_file(tensors, folder / "model.safetensors")


def test_weights_are_integers_and_scales_and_all_else_is_as_it_was(source: Path, quantized: Path) -> None:
    before, after = tensors_of(source), tensors_of(quantized)
    expected = set(before)
    for name, weight in before.items():
        if not BLOCK_WEIGHT.fullmatch(name):
            assert after[name].dtype == weight.dtype
            assert torch.equal(after[name], weight)
            continue
        expected.add(f"{name}_scale")
        values, scales = after[name], after[f"{name}_scale"]
        assert (values.dtype, scales.dtype) == (torch.int8, torch.float32)
        assert values.shape == weight.shape
        # In float64: the largest magnitude of a row is 127 steps, and every weight is at its nearest step.
        exact = weight.double().abs().amax(dim=1) / 127
        torch.testing.assert_close(scales.double(), exact, rtol=1e-6, atol=0)
        assert values.min() >= -127
        error = (values.double() * scales.double()[:, None] - weight.double()).abs()
        assert bool((error <= scales.double()[:, None] * (0.5 + 1e-4)).all())
        assert (values.abs().amax(dim=1) == 127).all()
    assert set(after) == expected
    assert (quantized / "config.json").read_text() == (source / "config.json").read_text()


def test_int4_has_two_weights_in_a_byte(source: Path, int4: Path) -> None:
    before, after = tensors_of(source), tensors_of(int4)
    for name, weight in before.items():
        if not BLOCK_WEIGHT.fullmatch(name):
            assert torch.equal(after[name], weight)
            continue
        values, scales = after[name], after[f"{name}_scale"].double()
        assert (values.dtype, values.shape) == (torch.uint8, (len(weight), (weight.shape[1] + 1) // 2))
        steps = integers(values, weight.shape[1]).double()
        assert int(steps.abs().max()) == 7
        # In float64: the nearest step that there is, by a scale whose error is the least.
        scales = scales[:, None]
        ratios = scales * 7 / weight.double().abs().amax(dim=1, keepdim=True) * 12
        torch.testing.assert_close(ratios, ratios.round(), rtol=1e-5, atol=0)
        assert 5 <= ratios.min().round() < ratios.max().round() <= 12
        nearest = (weight.double() / scales).clamp(-7, 7)
        assert bool(((steps - nearest).abs() <= 0.5 + 1e-4).all())
        errors = torch.stack(
            [
                (
                    (weight.double() / (scales * k / ratios)).round().clamp(-7, 7) * scales * k / ratios
                    - weight
                )
                .square()
                .sum(dim=1)
                for k in range(5, 13)
            ]
        )
        found = (steps * scales - weight.double()).square().sum(dim=1)
        assert bool((found <= errors.amin(dim=0) * (1 + 1e-4)).all())
    assert (int4 / "config.json").read_text() == (source / "config.json").read_text()
    size = {folder: (folder / "model.safetensors").stat().st_size for folder in (source, int4)}
    assert size[int4] < size[source]


def test_only_integers_are_quantised_to(source: Path, tmp_path: Path) -> None:
    for given in ("bfloat16", "float32"):
        with pytest.raises(InputError, match=f"to: expected 'int8' or 'int4', got '{given}'"):
            quantize(source, tmp_path / "out", to=given)
    with pytest.raises(InputError, match="expected one of"):
        quantize(source, tmp_path / "out", to="int2")
    assert not (tmp_path / "out").exists()


def test_the_files_say_where_they_come_from(quantized: Path) -> None:
    with safe_open(quantized / "model.safetensors", "pt") as file:
        metadata = file.metadata()
    assert metadata["saccade"] == saccade.__version__
    assert re.fullmatch("[0-9a-f]{64}", metadata["source_sha256"])
    assert metadata["format"] == "pt"


@pytest.mark.parametrize("to", ["int8", "int4"])
def test_files_have_the_bits_of_quantising_at_load(isa: str, to: str, source: Path, tmp_path: Path) -> None:
    quantize(source, tmp_path / to, to=to)
    assert np.array_equal(actions(source, precision=to), actions(tmp_path / to, precision=to))


@pytest.mark.parametrize("to", ["int8", "int4"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_other_precisions_have_what_the_integers_stand_for(
    isa: str, precision: str, to: str, source: Path, tmp_path: Path
) -> None:
    quantized = tmp_path / to
    quantize(source, quantized, to=to)
    widths = {name: t.shape[-1] for name, t in tensors_of(source).items() if t.ndim == 2}
    stands_for = tmp_path / "float"
    stands_for.mkdir()
    tensors = tensors_of(quantized)
    floats = {name: t for name, t in tensors.items() if not name.endswith("_scale")}
    for name in floats:
        if f"{name}_scale" in tensors:
            whole = integers(tensors[name], widths[name]).float()
            floats[name] = whole * tensors[f"{name}_scale"][:, None]
    save_file(floats, stands_for / "model.safetensors")
    (stands_for / "config.json").write_text(json.dumps(CONFIG))
    assert np.array_equal(actions(quantized, precision=precision), actions(stands_for, precision=precision))
    read = read_tensors(quantized, "action_head.")
    name = WEIGHT.removeprefix("action_head.")
    width = floats[WEIGHT].shape[1]
    assert np.array_equal(read[name][:, :width], floats[WEIGHT].numpy())
    assert not read[name][:, width:].any()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_sources_in_half_precision(dtype: torch.dtype, tmp_path: Path) -> None:
    save(tmp_path, random_head(CONFIG, 1), CONFIG, dtype)
    quantize(tmp_path, tmp_path / "int8")
    assert np.array_equal(
        actions(tmp_path / "model.safetensors", precision="int8"),
        actions(tmp_path / "int8", precision="int8"),
    )
    assert tensors_of(tmp_path / "int8")["action_head.model.proj_out_2.weight"].dtype == dtype


def test_large_checkpoints_are_cut_into_files(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "shards"
    rewrite: dict[str, Any] = {
        "source": str(source),
        "out": str(out),
        "config": None,
        "metadata": {},
        "progress": None,
    }
    rewrite |= {
        "head_only": False,
        "keep_backbone": False,
        "rounded": [],
        "force": False,
        "max_shard_bytes": 100_000,
    }
    report = _saccade.quantize(rewrite, "int8")
    files = sorted(out.glob("*.safetensors"))
    assert len(files) > 2
    assert sorted(report["files"]) == files
    assert files[0].name == f"model-00001-of-{len(files):05}.safetensors"
    index = json.loads((out / "model.safetensors.index.json").read_text())
    assert index["weight_map"].keys() == tensors_of(out).keys()
    assert np.array_equal(actions(source, precision="int8"), actions(out, precision="int8"))


def test_head_only(source: Path, tmp_path: Path) -> None:
    report = quantize(source, tmp_path / "int8", head_only=True)
    assert report.num_dropped == 2
    assert all(name.startswith("action_head.") for name in tensors_of(tmp_path / "int8"))


def test_progress_and_stopping(source: Path, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    quantize(source, tmp_path / "int8", progress=lambda *now: calls.append(now))
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)
    assert calls[-1][0] == calls[-1][1]

    def stop(done: int, total: int) -> None:
        if done > total / 2:
            raise RuntimeError("stop here")

    with pytest.raises(RuntimeError, match="stop here"):
        quantize(source, tmp_path / "stopped", progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["int8", "source"]


def test_nothing_is_replaced_unasked(source: Path, quantized: Path) -> None:
    before = (quantized / "model.safetensors").read_bytes()
    with pytest.raises(InputError, match="exists already"):
        quantize(source, quantized)
    assert (quantized / "model.safetensors").read_bytes() == before
    (quantized / "model.safetensors").write_bytes(b"")
    quantize(source, quantized, force=True)
    assert (quantized / "model.safetensors").read_bytes() == before
    assert sorted(path.name for path in quantized.parent.iterdir()) == ["int8", "source"]


def test_a_directory_with_other_files_is_never_replaced(source: Path, quantized: Path) -> None:
    (quantized / "thesis.tex").write_text("the only copy")
    with pytest.raises(InputError, match=r"holds thesis\.tex"):
        quantize(source, quantized, force=True)
    assert (quantized / "thesis.tex").exists()


def test_the_source_is_never_replaced(source: Path) -> None:
    for given in (source, source / "model.safetensors"):
        with pytest.raises(InputError, match="holds the source"):
            quantize(given, source, force=True)
    with pytest.raises(InputError, match="is not a directory"):
        quantize(source, source / "model.safetensors", force=True)


def test_files_that_the_source_links_to_are_never_replaced(source: Path, tmp_path: Path) -> None:
    view = tmp_path / "view"  # like a cache of models: names that link to files elsewhere
    view.mkdir()
    for path in source.iterdir():
        (view / path.name).symlink_to(path.resolve())
    before = (source / "model.safetensors").read_bytes()
    with pytest.raises(InputError, match="holds the source"):
        quantize(view, source, force=True)
    assert (source / "model.safetensors").read_bytes() == before


def test_an_empty_directory_is_taken(source: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    quantize(source, tmp_path / "out")
    assert (tmp_path / "out" / "model.safetensors").exists()


@pytest.mark.parametrize("to", ["int8", "int4"])
def test_a_quantised_source_is_refused(to: str, quantized: Path, int4: Path, tmp_path: Path) -> None:
    for given, dtype in ((quantized, "I8"), (int4, "U8")):
        with pytest.raises(CheckpointError, match=f"quantised already: .* is {dtype}, expected F32"):
            quantize(given, tmp_path / "again", to=to)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(value: float, source: Path, tmp_path: Path) -> None:
    rewrite(source, lambda tensors: tensors[WEIGHT][2].fill_(value))
    with pytest.raises(CheckpointError, match=rf"{re.escape(WEIGHT)} holds NaN or infinity in row 2"):
        quantize(source, tmp_path / "int8")
    assert not (tmp_path / "int8").exists()


@pytest.mark.parametrize("value", [torch.nan, -torch.inf])
@pytest.mark.parametrize("name", ["model.proj_out_2.bias", "state_encoder.layer1.W", "vlln.weight"])
def test_other_weights_that_are_not_finite_are_refused(
    name: str, value: float, source: Path, tmp_path: Path
) -> None:
    rewrite(source, lambda tensors: tensors["action_head." + name].view(-1)[-1].fill_(value))
    with pytest.raises(CheckpointError, match=rf"{re.escape(name)} holds (NaN|-inf), expected finite"):
        quantize(source, tmp_path / "int8")
    assert [path.name for path in tmp_path.iterdir()] == [source.name]


def test_sources_that_are_not_there_or_do_not_fit(source: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        quantize(tmp_path / "nowhere", tmp_path / "int8")
    rewrite(source, lambda tensors: tensors.pop(WEIGHT))
    with pytest.raises(CheckpointError, match="is missing"):
        quantize(source, tmp_path / "int8")


def test_rows_of_zeros(source: Path, tmp_path: Path) -> None:
    rewrite(source, lambda tensors: tensors[WEIGHT][1].fill_(0))
    quantize(source, tmp_path / "int8")
    assert tensors_of(tmp_path / "int8")[SCALE][1] == 0
    assert np.array_equal(actions(source, precision="int8"), actions(tmp_path / "int8", precision="int8"))


HOSTILE: dict[str, tuple[Callable[[dict[str, Tensor]], object], str]] = {
    "missing scale": (lambda t: t.pop(SCALE), "is I8 and .*_scale is missing, expected \\(66,\\)"),
    "scale of a wrong shape": (
        lambda t: t.update({SCALE: t[SCALE][:-1].clone()}),
        r"_scale has shape \(65,\), expected \(66,\)",
    ),
    "scale of two axes": (
        lambda t: t.update({SCALE: t[SCALE][:, None].clone()}),
        r"_scale has shape \(66, 1\), expected \(66,\)",
    ),
    "scale of a wrong type": (lambda t: t.update({SCALE: t[SCALE].half()}), "_scale is F16, expected F32"),
    "scale without int8": (
        lambda t: t.update({WEIGHT: t[WEIGHT].float()}),
        "is there, but .* is F32, expected I8 or U8",
    ),
    "scale without weight": (lambda t: t.pop(WEIGHT), "to_q.weight is missing"),
    "scale of a bias": (
        lambda t: t.update({"action_head.model.proj_out_2.bias_scale": torch.ones(51)}),
        "bias_scale is unknown",
    ),
    "NaN": (lambda t: t[SCALE][3].fill_(torch.nan), "_scale is NaN at index 3, expected finite"),
    "infinity": (lambda t: t[SCALE][65].fill_(torch.inf), "_scale is inf at index 65, expected finite"),
    "negative": (lambda t: t[SCALE][0].fill_(-0.5), "_scale is -0.5 at index 0, expected finite"),
    "zero": (lambda t: t[SCALE][5].fill_(0), "_scale is 0 at index 5, whose row of .* is not zero"),
    "-128": (lambda t: t[WEIGHT][7].fill_(-128), "holds -128, expected -127 to 127"),
    "bytes that are no pairs": (
        lambda t: t.update({WEIGHT: t[WEIGHT].to(torch.uint8)}),
        r"has shape \(66, 66\), expected \(66, 33\)",
    ),
    "int8 where none runs": (
        lambda t: t.update({"action_head.model.proj_out_2.weight": torch.ones(51, 66, dtype=torch.int8)}),
        "proj_out_2.weight is I8, expected F32, BF16 or F16",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_hostile_files(case: str, precision: str, quantized: Path) -> None:
    change, message = HOSTILE[case]
    rewrite(quantized, change)
    with pytest.raises(CheckpointError, match=message):
        actions(quantized, precision=precision)


HOSTILE_INT4: dict[str, tuple[Callable[[dict[str, Tensor]], object], str]] = {
    "missing scale": (lambda t: t.pop(SCALE), "is U8 and .*_scale is missing, expected \\(66,\\)"),
    "a column less": (
        lambda t: t.update({WEIGHT: t[WEIGHT][:, 1:].clone()}),
        r"has shape \(66, 32\), expected \(66, 33\)",
    ),
    "NaN": HOSTILE["NaN"],
    "zero": HOSTILE["zero"],
    "-8 in the low half": (lambda t: t[WEIGHT][7, 3].fill_(0x18), "holds -8 in four bits, expected -7 to 7"),
    "-8 in the high half": (lambda t: t[WEIGHT][7, 3].fill_(0x81), "holds -8 in four bits, expected -7 to 7"),
    "a weight after the last": (
        lambda t: t[ODD_WEIGHT][9, 31].fill_(0x11),
        "to_k.weight: row 9 has 63 weights of four bits, expected zero in the high half of its last byte",
    ),
    "int4 where none runs": (
        lambda t: t.update({"action_head.model.proj_out_2.weight": torch.ones(51, 66, dtype=torch.uint8)}),
        "proj_out_2.weight is U8, expected F32, BF16 or F16",
    ),
}


@pytest.mark.parametrize("case", HOSTILE_INT4)
@pytest.mark.parametrize("precision", ["float32", "int4"])
def test_hostile_files_of_int4(case: str, precision: str, int4: Path) -> None:
    change, message = HOSTILE_INT4[case]
    rewrite(int4, change)
    with pytest.raises(CheckpointError, match=message):
        actions(int4, precision=precision)


def test_int8_and_int4_in_one_file(isa: str, quantized: Path, int4: Path) -> None:
    """A layer is loaded from whatever it is stored as."""
    wide = tensors_of(quantized)
    rewrite(int4, lambda tensors: tensors.update({name: wide[name] for name in (WEIGHT, SCALE)}))
    for precision in ("int8", "int4"):
        assert np.isfinite(actions(int4, precision=precision)).all()


def test_extreme_integers_do_not_overflow(isa: str, quantized: Path) -> None:
    """All weights at their ends: sums of pairs, held in 16 bits by some instruction sets, do not saturate."""

    def extreme(tensors: dict[str, Tensor]) -> None:
        for name, values in tensors.items():
            if values.dtype == torch.int8:
                values.copy_(torch.where(values >= 0, 127, -127))
                tensors[f"{name}_scale"].mul_(0.5)

    rewrite(quantized, extreme)
    int8, float32 = actions(quantized, precision="int8"), actions(quantized)
    assert np.isfinite(int8).all()
    assert np.abs(int8 - float32).max() < 0.2 * np.abs(float32).max()


def test_the_command(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "int8"
    assert cli.main(["quantize", str(source), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["files"] == [str(out / "model.safetensors")]
    assert report["num_quantized"] == sum(t.dtype == torch.int8 for t in tensors_of(out).values())
    assert report["head_bytes_after"] < report["head_bytes_before"]
    assert cli.main(["quantize", str(source), "--out", str(out)]) == cli.EXIT_BAD_INPUT
    assert "exists already" in capsys.readouterr().err
    assert cli.main(["quantize", str(source), "--out", str(out), "--force", "--head-only"]) == 0
    assert "2 left out" in capsys.readouterr().out
