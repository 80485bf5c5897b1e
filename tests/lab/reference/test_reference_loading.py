"""The torch reference reads checkpoints: layouts, prefixes, shards, configs and quantised weights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

import saccade
from saccade.errors import CheckpointError
from saccade_lab.reference import ActionHead, TimeDistribution
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers import layouts
from tests.helpers.reference_cases import relative_error, small_config


def write_checkpoint(
    folder: Path, prefix: str, *, shards: int = 1, drop: str = "", extra: str = ""
) -> ActionHead:
    config = small_config()
    head = random_head(config, seed=1)
    tensors = {f"{prefix}{name}": tensor for name, tensor in head.state_dict().items() if name != drop}
    if extra:
        tensors[extra] = torch.zeros(2)
    tensors["backbone.weight"] = torch.zeros(3)
    if prefix == "":
        del tensors["backbone.weight"]
    names = sorted(tensors)
    for shard in range(shards):
        kept = {name: tensors[name].contiguous() for name in names[shard::shards]}
        save_file(kept, folder / f"model-{shard + 1:05}-of-{shards:05}.safetensors")
    (folder / "config.json").write_text(json.dumps({"action_head_cfg": config}))
    return head


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_load_reads_every_layout(tmp_path: Path, layout: str) -> None:
    layouts.write(tmp_path / layout, layout)
    head, rust = (
        ActionHead.from_pretrained(tmp_path / layout),
        saccade.ActionHead.from_pretrained(tmp_path / layout),
    )
    assert head.config == rust.config
    inputs: dict[str, Any] = random_inputs(head.config, 1, batch=1, num_vl_tokens=6)
    with torch.no_grad():
        assert relative_error(rust(**inputs), head.double()(**inputs)) <= 1e-5


@pytest.mark.parametrize("shards", [1, 3])
@pytest.mark.parametrize("prefix", ["action_head.", "_groot_model.action_head.", ""])
def test_load_finds_prefixes_and_shards(tmp_path: Path, prefix: str, shards: int) -> None:
    written = write_checkpoint(tmp_path, prefix, shards=shards)
    loaded = ActionHead.from_pretrained(tmp_path, dtype=torch.float64)
    assert loaded.config == written.config
    for name, tensor in written.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor.double())


def test_load_takes_the_config_given(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, "action_head.")
    (tmp_path / "config.json").rename(tmp_path / "elsewhere.json")
    file = tmp_path / "model-00001-of-00001.safetensors"
    with pytest.raises(FileNotFoundError, match="config"):
        ActionHead.from_pretrained(file)
    assert ActionHead.from_pretrained(file, config=tmp_path / "elsewhere.json").config.num_layers == 4
    assert ActionHead.from_pretrained(file, config=small_config(num_steps=9)).config.num_steps == 9


def test_load_reads_the_training_times_of_the_config(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, "action_head.")
    config = small_config() | {"noise_beta_alpha": 2.5, "noise_beta_beta": 4.0, "noise_s": 0.5}
    head = ActionHead.from_pretrained(tmp_path, config=config)
    assert head.time_distribution == TimeDistribution(alpha=2.5, beta=4.0, scale=0.5)


def test_load_lists_all_that_is_wrong(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, "action_head.", drop="vlln.bias", extra="action_head.mystery")
    with pytest.raises(saccade.CheckpointError) as caught:
        ActionHead.from_pretrained(tmp_path)
    for part in ("vlln.bias: missing", "mystery: unknown"):
        assert part in str(caught.value)
    with pytest.raises(saccade.CheckpointError, match=r"future_tokens\.weight is \(4, 12\)"):
        ActionHead.from_pretrained(tmp_path, config=small_config(num_future_tokens=9))
    with pytest.raises(FileNotFoundError):
        ActionHead.from_pretrained(tmp_path / "nothing")


@pytest.mark.parametrize("bits", [8, 4])
def test_load_reads_quantised_weights_as_what_they_stand_for(bits: int, tmp_path: Path) -> None:
    config = small_config()
    tensors = {
        f"action_head.{name}": tensor.contiguous()
        for name, tensor in random_head(config, 0).state_dict().items()
    }
    name = "action_head.model.transformer_blocks.0.attn1.to_k.weight"
    most = 2 ** (bits - 1) - 1
    integers = torch.randint(-most, most + 1, tensors[name].shape, dtype=torch.int8)
    stored = integers
    if bits == 4:  # two in a byte, the first one in its low half
        low, high = (integers[:, first::2].to(torch.uint8) % 16 for first in (0, 1))
        stored = low + 16 * torch.nn.functional.pad(high, (0, low.shape[1] - high.shape[1]))
    scales = torch.rand(len(integers))
    quantised = {**tensors, name: stored, f"{name}_scale": scales}

    def load(tensors: dict[str, torch.Tensor]) -> ActionHead:
        save_file(tensors, tmp_path / "model.safetensors")
        return ActionHead.from_pretrained(tmp_path, config=config, dtype=torch.float64)

    expected = load(tensors).state_dict()
    expected[name.removeprefix("action_head.")] = integers.double() * scales.double()[:, None]
    found = load(quantised).state_dict()
    assert all(torch.equal(found[key], value) for key, value in expected.items())
    for broken in (
        {**tensors, name: stored},
        {**tensors, f"{name}_scale": scales},
        {**quantised, f"{name}_scale": scales[1:]},
    ):
        with pytest.raises(
            CheckpointError, match=r"to_k\.weight: expected an int8 or int4 matrix with scales"
        ):
            load(broken)
