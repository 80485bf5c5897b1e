"""Whole checkpoints that are quantised, converted and resized still act, and keep what is not touched."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from saccade import ActionHead, CheckpointError, Policy, cli
from saccade.checkpoints import convert, quantize, resize
from tests.helpers import layouts, whole_checkpoints
from tests.helpers.whole_checkpoints import EMBODIMENT, whole

PREFIXES = {"lerobot": "_groot_model.backbone.", "lerobot-n17": "_groot_model.backbone."}
#: A weight of a block of each part of a backbone, by layout.
BLOCKS = {
    "isaac": ("eagle_model.vision_model.vision_model.encoder.layers.1.mlp.fc2",
              "eagle_model.language_model.model.layers.2.mlp.down_proj"),
    "n16": ("model.vision_model.vision_model.encoder.layers.0.self_attn.q_proj",
            "model.language_model.model.layers.0.self_attn.o_proj"),
    "n17": ("model.model.visual.blocks.3.attn.qkv", "model.model.language_model.layers.1.mlp.gate_proj"),
}  # fmt: skip
BLOCKS |= {"nvidia": BLOCKS["isaac"], "lerobot": BLOCKS["isaac"], "lerobot-n17": BLOCKS["n17"]}


def act(folder: Path, precision: str = "float32") -> dict[str, Any]:
    policy = Policy.from_pretrained(folder, embodiment=EMBODIMENT, precision=precision)
    actions: dict[str, Any] = policy.act(policy.example_observation(seed=1), seed=2)
    return actions


def same(found: dict[str, Any], expected: dict[str, Any]) -> bool:
    return all(np.array_equal(found[key], expected[key]) for key in expected)


def backbone(folder: Path, layout: str) -> dict[str, torch.Tensor]:
    return layouts.read(folder, PREFIXES.get(layout, "backbone."))


def sidecars(folder: Path) -> dict[str, bytes]:
    """The contents of all files but weights and `config.json`."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith("model") and path.name != "config.json"
    }


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_quantize_stores_the_blocks_of_backbone_and_head(layout: str, tmp_path: Path) -> None:
    source, out = whole(layout), tmp_path / "int8"
    report = quantize(source, out)
    assert report.backbone_copied is None
    assert 0 < report.num_quantized_backbone < report.num_quantized
    tensors, before = backbone(out, layout), backbone(source, layout)
    added = set(tensors) - set(before)
    assert len(added) == report.num_quantized_backbone
    assert all(name.endswith(".weight_scale") for name in added)
    for block in BLOCKS[layout]:
        weight, scale = tensors[f"{block}.weight"], tensors[f"{block}.weight_scale"]
        assert weight.dtype == torch.int8
        # The largest magnitude of each row is 127 times its scale.
        largest = before[f"{block}.weight"].abs().amax(dim=1)
        assert torch.allclose(127 * scale, largest, rtol=1e-6)
        error = (weight * scale[:, None] - before[f"{block}.weight"]).abs()
        assert bool((error <= scale[:, None] * 0.5001).all())
    untouched = [name for name in before if f"{name}_scale" not in added]
    assert all(torch.equal(tensors[name], before[name]) for name in untouched)
    assert report.backbone_bytes_after == sum(tensor.nbytes for tensor in tensors.values())
    assert sidecars(out) == sidecars(source)
    assert json.loads((out / "config.json").read_text()) == json.loads((source / "config.json").read_text())
    assert same(act(out, "int8"), act(source, "int8"))
    exact, dequantised = act(source), act(out)
    assert all(np.allclose(dequantised[key], exact[key], atol=0.3) for key in exact)
    with pytest.raises(CheckpointError, match="quantised already"):
        quantize(out, tmp_path / "again")


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_quantize_to_int4(layout: str, tmp_path: Path) -> None:
    source, out = whole(layout), tmp_path / "int4"
    report = quantize(source, out, to="int4")
    tensors, before = backbone(out, layout), backbone(source, layout)
    for block in BLOCKS[layout]:
        weight, width = tensors[f"{block}.weight"], before[f"{block}.weight"].shape[1]
        assert (weight.dtype, weight.shape[1]) == (torch.uint8, (width + 1) // 2)
    (table,) = (name for name, tensor in tensors.items() if tensor.dtype == torch.int8)
    assert table.endswith(("embed_tokens.weight", "lm_head.weight"))  # tied in lerobot's
    scale = before[table].float().abs().amax(dim=1) / 127
    assert torch.allclose(tensors[f"{table}_scale"], scale, rtol=1e-6)
    assert (tensors[table] * scale[:, None] - before[table]).abs().max() <= 0.5001 * scale.max()
    added = [name for name in tensors if name not in before]
    assert report.num_quantized_backbone == len(added)
    assert report.backbone_bytes_after == sum(tensor.nbytes for tensor in tensors.values())
    assert sidecars(out) == sidecars(source)
    for precision in ("int4", "int8"):
        policy = Policy.from_pretrained(out, embodiment=EMBODIMENT, precision=precision)
        assert str(policy.head).count(f"precision={precision}") == 1
    assert same(act(out, "int4"), act(source, "int4"))


def test_int4_with_embeddings_as_they_were_has_the_same_bits(tmp_path: Path) -> None:
    """The first checkpoints in int4 had them so."""
    source, out = whole("isaac"), tmp_path / "int4"
    quantize(source, out, to="int4")
    tensors = layouts.read(out, "")
    (table,) = (name for name in tensors if name.endswith("embed_tokens.weight"))
    del tensors[f"{table}_scale"]
    tensors[table] = layouts.read(source, "")[table]
    save_file(tensors, out / "model.safetensors")
    assert same(act(out, "int4"), act(source, "int4"))


def test_a_checkpoint_of_which_only_embeddings_are_int8(tmp_path: Path) -> None:
    """One that other programs may write: it is loaded, and not quantised again."""
    source, out, mixed = whole("isaac"), tmp_path / "int4", tmp_path / "mixed"
    quantize(source, out, to="int4")
    stored, tensors = layouts.read(out, ""), layouts.read(source, "")
    (table,) = (name for name in tensors if name.endswith("embed_tokens.weight"))
    tensors |= {name: stored[name] for name in (table, f"{table}_scale")}
    shutil.copytree(source, mixed)
    for path in mixed.glob("*.safetensors*"):
        path.unlink()
    save_file(tensors, mixed / "model.safetensors")
    assert same(act(mixed, "int8"), act(source, "int8"))
    for to in ("int8", "int4"):
        with pytest.raises(CheckpointError, match=r"quantised already: .*embed_tokens"):
            quantize(mixed, tmp_path / "again", to=to)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_embeddings_in_int8_are_what_the_integers_represent(precision: str, tmp_path: Path) -> None:
    source, out = whole("isaac"), tmp_path / "int4"
    quantize(source, out, to="int4")
    tensors = layouts.read(out, "")
    (table,) = (name for name in tensors if name.endswith("embed_tokens.weight"))
    tensors[table] = tensors[table] * tensors.pop(f"{table}_scale")[:, None]
    widened = shutil.copytree(out, tmp_path / "widened")
    save_file(tensors, widened / "model.safetensors")
    assert same(act(out, precision), act(widened, precision))


def test_quantize_may_keep_the_backbone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = whole("isaac"), tmp_path / "int8"
    assert cli.main(["quantize", str(source), "--out", str(out), "--keep-backbone"]) == 0
    assert "outside the head were copied as they are: as requested" in capsys.readouterr().out
    tensors, before = backbone(out, "isaac"), backbone(source, "isaac")
    assert set(tensors) == set(before)
    assert all(torch.equal(tensors[name], before[name]) for name in before)
    assert cli.main(["quantize", str(source), "--out", str(out), "--force"]) == 0
    assert "the backbone has" in capsys.readouterr().out
    assert cli.main(["quantize", str(source), "--out", str(out), "--force", "--head-only", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["num_dropped"], report["num_quantized_backbone"]) == (len(before), 0)
    with pytest.raises(CheckpointError, match="an action head without a backbone"):
        Policy.from_pretrained(out)


def test_a_backbone_of_an_unknown_kind_is_copied(tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "source", "isaac")
    report = quantize(source, tmp_path / "out")
    assert report.num_quantized_backbone == report.backbone_bytes_before == 0
    assert report.backbone_copied is not None
    assert "is missing" in report.backbone_copied
    before, after = backbone(source, "isaac"), backbone(tmp_path / "out", "isaac")
    assert all(torch.equal(after[name], before[name]) for name in before)


@pytest.mark.parametrize("layout", ["isaac", "n17", "lerobot"])
def test_a_backbone_alone_is_named(layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "backbone"
    shutil.copytree(whole(layout), source, ignore=shutil.ignore_patterns("model*"))
    prefix = PREFIXES.get(layout, "backbone.")
    save_file(
        {prefix + name: one for name, one in backbone(whole(layout), layout).items()},
        source / "model.safetensors",
    )
    out = ["--out", str(tmp_path / "out")]
    for command in (
        ["inspect"],
        ["quantize", *out],
        ["convert", *out],
        ["resize", *out, "--num-future-tokens", "3"],
    ):
        assert cli.main([command[0], str(source), *command[1:]]) == 2
        error = capsys.readouterr().err
        assert "there is no action head among the" in error
        assert "this is a backbone alone" in error
    with pytest.raises(CheckpointError, match="a backbone alone"):
        ActionHead.from_pretrained(source)


@pytest.mark.parametrize("layout", ["isaac", "lerobot", "n16", "n17"])
def test_convert_keeps_what_acts(layout: str, tmp_path: Path) -> None:
    source = whole(layout)
    policy = Policy.from_pretrained(source, embodiment=EMBODIMENT)
    convert(source, tmp_path / "one", embodiment_ids=[policy.embodiment_id], max_shard_bytes=2_000_000)
    assert len(list((tmp_path / "one").glob("model-*.safetensors"))) > 2
    assert same(act(tmp_path / "one"), act(source))
    assert sidecars(tmp_path / "one") == sidecars(source)
    convert(source, tmp_path / "bf16", dtype="bfloat16")
    assert all(tensor.dtype == torch.bfloat16 for tensor in backbone(tmp_path / "bf16", layout).values())
    exact, found = act(source), act(tmp_path / "bf16")
    assert all(np.allclose(found[key], exact[key], atol=0.1) for key in exact)


@pytest.mark.parametrize("layout", ["nvidia", "lerobot"])
def test_resize_keeps_the_backbone(layout: str, tmp_path: Path) -> None:
    source, out = whole(layout), tmp_path / "64"
    resize(source, out, num_future_tokens=64)
    before, after = backbone(source, layout), backbone(out, layout)
    assert set(after) == set(before)
    assert all(torch.equal(after[name], before[name]) for name in before)
    kept = sidecars(out)
    kept.pop("saccade.json", None)
    assert kept == sidecars(source)
    exact, found = act(source), act(out)
    assert all(np.allclose(found[key], exact[key], atol=1e-4) for key in exact)
