"""LoRA adapters: merged as PEFT merges them, and never taken for a model or ignored beside one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import saccade
from saccade import cli
from saccade.checkpoints import convert, quantize
from saccade.checkpoints.inspection import inspect
from saccade.errors import CheckpointError
from tests.helpers import layouts
from tests.helpers.released import load_released

TINY = load_released("n15_tiny")
DATA = Path(__file__).parents[1] / "data" / "adapters"
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"


def base_tensors(dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """The model that `make_adapter_fixtures` adapted."""
    head = {name: value for name, value in load_file(TINY.path).items() if name.startswith("action_head.")}
    return {
        name: value.to(dtype) for name, value in (head | load_file(DATA / "backbone.safetensors")).items()
    }


def write_base(folder: Path, tensors: dict[str, Tensor]) -> Path:
    folder.mkdir()
    save_file(tensors, folder / "model.safetensors")
    whole = {"model_type": "gr00t_n1_5", "action_head_cfg": TINY.config}
    (folder / "config.json").write_text(json.dumps(whole))
    return folder


def copy_adapter(folder: Path, case: str = "float32", **keys: Any) -> Path:
    """The adapter of a case, with other keys in its config."""
    folder.mkdir(exist_ok=True)
    config = json.loads((DATA / case / CONFIG).read_text())
    (folder / CONFIG).write_text(json.dumps(config | keys))
    shutil.copyfile(DATA / case / WEIGHTS, folder / WEIGHTS)
    return folder


@pytest.fixture
def base(tmp_path: Path) -> Path:
    return write_base(tmp_path / "base", base_tensors())


@pytest.mark.parametrize("case", DTYPES)
def test_merged_as_by_peft(case: str, tmp_path: Path) -> None:
    before = base_tensors(DTYPES[case])
    expected = before | load_file(DATA / case / "merged.safetensors")
    base = write_base(tmp_path / "base", before)
    report = convert(base, tmp_path / "out", adapter=copy_adapter(tmp_path / "adapter", case))
    merged = load_file(tmp_path / "out" / "model.safetensors")
    assert merged.keys() == expected.keys()
    for name, value in expected.items():
        assert merged[name].dtype == value.dtype
        if name in load_file(DATA / case / "merged.safetensors"):
            # Another CPU's matrix product may add in another order.
            rtol = 1e-6 if case == "float32" else 0
            torch.testing.assert_close(merged[name], value, rtol=rtol, atol=1e-6)
        else:
            assert torch.equal(merged[name], value)
    replaced = sum("state_encoder" in name for name in expected) if case == "float32" else 0
    assert report.num_replaced == replaced
    assert report.num_merged == len(load_file(DATA / case / "merged.safetensors")) - replaced
    saccade.ActionHead.from_pretrained(tmp_path / "out")


def test_another_dtype_is_as_converting_first(base: Path, tmp_path: Path) -> None:
    adapter = copy_adapter(tmp_path / "adapter")
    convert(base, tmp_path / "once", adapter=adapter, dtype="bfloat16")
    convert(base, tmp_path / "narrow", dtype="bfloat16")
    convert(tmp_path / "narrow", tmp_path / "twice", adapter=adapter)
    once, twice = (load_file(tmp_path / name / "model.safetensors") for name in ("once", "twice"))
    assert once.keys() == twice.keys()
    assert all(torch.equal(once[name], twice[name]) for name in once)


def test_a_part_and_some_embodiments(base: Path, tmp_path: Path) -> None:
    adapter = copy_adapter(tmp_path / "adapter")
    convert(base, tmp_path / "all", adapter=adapter)
    convert(base, tmp_path / "head", adapter=adapter, head_only=True, embodiment_ids=[1])
    whole, head = (load_file(tmp_path / name / "model.safetensors") for name in ("all", "head"))
    assert set(whole) - set(head) == {name for name in whole if name.startswith("backbone.")}
    name = "action_head.state_encoder.layer1.W"
    assert torch.equal(head[name][1], whole[name][1])
    assert not head[name][0].any()


Break = Callable[[Path], object]


def keys(**values: Any) -> Break:
    return lambda folder: copy_adapter(folder, **values)


def tensors(change: Callable[[dict[str, Tensor]], object]) -> Break:
    def apply(folder: Path) -> None:
        found = load_file(folder / WEIGHTS)
        change(found)
        save_file({name: value.contiguous() for name, value in found.items()}, folder / WEIGHTS)

    return apply


Q = "base_model.model.action_head.model.transformer_blocks.0.attn1.to_q"
BROKEN: dict[str, tuple[Break, str]] = {
    "another type": (keys(peft_type="LOHA"), 'peft_type is "LOHA", expected "LORA"'),
    "DoRA": (keys(use_dora=True), "use_dora is true"),
    "bias": (keys(bias="lora_only"), 'bias is "lora_only", expected "none"'),
    "bias of the adapter": (keys(lora_bias=True), "lora_bias is true"),
    "PiSSA": (keys(init_lora_weights="pissa"), 'init_lora_weights is "pissa"'),
    "LoftQ": (keys(init_lora_weights="loftq"), "init_lora_weights"),
    "replicated layers": (keys(layer_replication=[[0, 4]]), "layer_replication"),
    "Megatron": (keys(megatron_config={"a": 1}), "megatron_config"),
    "token indices": (keys(trainable_token_indices=[1]), "trainable_token_indices"),
    "transposed": (keys(fan_in_fan_out=True), "fan_in_fan_out is true"),
    "aLoRA": (keys(alora_invocation_tokens=[1, 2]), "alora_invocation_tokens"),
    "an unknown key": (keys(new_rule={"on": True}), "new_rule"),
    "no rank": (keys(r=None), "r is null, expected a positive integer"),
    "no targets": (keys(target_modules=None), "target_modules is null"),
    "another rank": (keys(r=7), "do not fit each other and rank 7"),
    "a look-ahead": (keys(target_modules="(?!a)"), "target_modules: .* is not a regular expression"),
    "a target too many": (
        keys(target_modules=["to_q", "0.attn1.to_k", "position_embedding", "patch_embedding", "to_w"]),
        "target_modules: to_w fits no tensor of the adapter",
    ),
    "a target too few": (
        keys(target_modules=["to_q", "position_embedding", "patch_embedding"]),
        "transformer_blocks.0.attn1.to_k is not one of target_modules",
    ),
    "a module too many": (
        keys(modules_to_save=["state_encoder", "wheel"]),
        "modules_to_save: wheel fits no tensor of the base",
    ),
    "a module too few": (keys(modules_to_save=None), r"state_encoder.*: expected a lora_A or lora_B"),
    "a module of the base that it lacks": (
        keys(modules_to_save=["state_encoder", "action_encoder"]),
        "action_head.action_encoder.W1.W of modules_to_save is not in the adapter",
    ),
    "half a pair": (
        tensors(lambda all: all.pop(f"{Q}.lora_B.weight")),
        "is there without .*to_q.lora_B.weight",
    ),
    "a tensor of another rule": (
        tensors(lambda all: all.update({f"{Q}.lora_magnitude_vector": torch.ones(4)})),
        "lora_magnitude_vector: expected a lora_A or lora_B",
    ),
    "a name without a base": (
        tensors(lambda all: all.update(a=torch.ones(4))),
        "a: expected a name that begins",
    ),
    "not finite": (
        tensors(lambda all: all[f"{Q}.lora_A.weight"].fill_(float("nan"))),
        "lora_A.weight holds NaN, expected finite",
    ),
    "not there": (lambda folder: (folder / CONFIG).unlink(), "no such file.*adapter_config.json"),
    "without weights": (
        lambda folder: (folder / WEIGHTS).unlink(),
        "no such file.*adapter_model.safetensors",
    ),
    "weights of an old PEFT": (
        lambda folder: (folder / WEIGHTS).rename(folder / "adapter_model.bin"),
        "adapter_model.bin, expected adapter_model.safetensors",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_not_plain_addition_or_does_not_fit_is_refused(name: str, base: Path, tmp_path: Path) -> None:
    change, message = BROKEN[name]
    adapter = copy_adapter(tmp_path / "adapter")
    change(adapter)
    with pytest.raises((CheckpointError, FileNotFoundError), match=message):
        convert(base, tmp_path / "out", adapter=adapter)
    assert not (tmp_path / "out").exists()


def test_an_adapter_of_another_model(base: Path, tmp_path: Path) -> None:
    adapter = copy_adapter(tmp_path / "adapter")
    prefix = "base_model.model."
    found = load_file(adapter / WEIGHTS)
    renamed = {f"{prefix}_groot_model.{name.removeprefix(prefix)}": value for name, value in found.items()}
    save_file(renamed, adapter / WEIGHTS)
    with pytest.raises(CheckpointError, match="the adapter is of a checkpoint in lerobot's layout"):
        convert(base, tmp_path / "out", adapter=adapter)


@pytest.mark.parametrize(("to", "dtype"), [("int8", "I8"), ("int4", "U8")])
def test_a_quantised_base(base: Path, to: str, dtype: str, tmp_path: Path) -> None:
    quantize(base, tmp_path / to, to=to)
    with pytest.raises(CheckpointError, match=f"is {dtype}: expected weights that are not quantised"):
        convert(tmp_path / to, tmp_path / "out", adapter=copy_adapter(tmp_path / "adapter"))


def test_the_adapters_other_files_take_the_place_of_the_bases(base: Path, tmp_path: Path) -> None:
    adapter = copy_adapter(tmp_path / "adapter")
    for folder, text in ((base, "of the base"), (adapter, "of the adapter")):
        (folder / "experiment_cfg").mkdir()
        (folder / "experiment_cfg" / "metadata.json").write_text(json.dumps(text))
    (base / "processor_config.json").write_text("{}")
    (base / "vocab.json").write_text("{}")
    (base / "README.md").write_text("base")
    (adapter / "README.md").write_text("adapter")
    (adapter / "optimizer.pt").write_bytes(b"")
    report = convert(base, tmp_path / "out", adapter=adapter)
    found = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")}
    assert found == {
        "config.json",
        "model.safetensors",
        "vocab.json",
        "README.md",
        "experiment_cfg/metadata.json",
    }
    assert "adapter" in (tmp_path / "out" / "experiment_cfg" / "metadata.json").read_text()
    assert (tmp_path / "out" / "README.md").read_text() == "base"
    assert report.left == (Path("optimizer.pt"),)


def test_lerobots_config_is_the_adapters(tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "source", "lerobot")
    config = json.loads((source / "config.json").read_text())
    name = next(
        name for name in load_file(source / "model.safetensors") if name.endswith("0.attn1.to_q.weight")
    )
    rows, columns = load_file(source / "model.safetensors")[name].shape
    module = f"base_model.model.{name.removesuffix('.weight')}"
    adapter = tmp_path / "adapter"
    adapter.mkdir()
    save_file(
        {
            f"{module}.lora_A.weight": torch.ones(2, columns),
            f"{module}.lora_B.weight": torch.full((rows, 2), 0.5),
        },
        adapter / WEIGHTS,
    )
    about = {"peft_type": "LORA", "r": 2, "lora_alpha": 2, "target_modules": [name.removesuffix(".weight")]}
    (adapter / CONFIG).write_text(json.dumps(about | {"base_model_name_or_path": str(source)}))
    (adapter / "config.json").write_text(json.dumps(config | {"use_peft": True, "n_action_steps": 7}))
    with pytest.raises(
        CheckpointError, match=r"use_peft.*saccade convert .*source --adapter .* --out MERGED"
    ):
        saccade.ActionHead.from_pretrained(adapter)
    convert(source, tmp_path / "out", adapter=adapter)
    written = json.loads((tmp_path / "out" / "config.json").read_text())
    assert written == config | {"use_peft": False, "n_action_steps": 7}
    saccade.ActionHead.from_pretrained(tmp_path / "out")
    # Weights in a folder that lerobot takes for an adapter are not what it computes with.
    shutil.copyfile(source / "model.safetensors", adapter / "model.safetensors")
    with pytest.raises(CheckpointError, match="does not read the weights of a model in it"):
        saccade.ActionHead.from_pretrained(adapter)


#: Everything that opens a checkpoint.
READERS: dict[str, Callable[[Path], object]] = {
    "head": saccade.ActionHead.from_pretrained,
    "backbone": saccade.Backbone.from_pretrained,
    "policy": saccade.Policy.from_pretrained,
    "processor": saccade.Processor.from_pretrained,
    "inspect": lambda source: inspect(source),
    "convert": lambda source: convert(source, source.parent / "out"),
}


@pytest.mark.parametrize("reader", READERS)
def test_an_adapter_is_no_model(reader: str, tmp_path: Path) -> None:
    adapter = copy_adapter(tmp_path / "adapter")
    command = "saccade convert someone/base --adapter .*adapter --out MERGED"
    with pytest.raises(CheckpointError, match=f"a LoRA adapter of someone/base, not a model: .*{command}"):
        READERS[reader](adapter)


@pytest.mark.parametrize("reader", READERS)
def test_an_adapter_beside_a_model_is_not_ignored(reader: str, base: Path, tmp_path: Path) -> None:
    copy_adapter(base)
    message = r"holds a model \(model.safetensors\) and beside it a LoRA adapter .*convert .*remove adapter_"
    with pytest.raises(CheckpointError, match=message):
        READERS[reader](base)
    convert(base, tmp_path / "merged", adapter=base)
    assert not (tmp_path / "merged" / CONFIG).exists()
    saccade.ActionHead.from_pretrained(tmp_path / "merged")


def test_weights_of_an_adapter_as_a_file(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="a LoRA adapter of someone/base, not a model"):
        saccade.ActionHead.from_pretrained(copy_adapter(tmp_path / "adapter") / WEIGHTS)


def test_the_command(base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    adapter = copy_adapter(tmp_path / "adapter")
    arguments = ["convert", str(base), "--adapter", str(adapter), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    assert "replaced 4 tensors" in capsys.readouterr().out
    assert cli.main(["inspect", str(adapter)]) != 0
    assert "a LoRA adapter of someone/base" in capsys.readouterr().err
