"""Checkpoints that do not fit their config or are damaged: an error that lists what is wrong."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file, save_file

import saccade
from saccade.checkpoints import read_tensors
from tests.helpers.released import load_released

TINY = load_released("n15_tiny")
HEAD = saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)
CONTEXT = HEAD.encode(TINY.backbone_features)
FEATURES, STATE, NOISE = TINY.backbone_features, TINY.state, TINY.noise


def test_paths_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="source: no such file"):
        saccade.ActionHead.from_pretrained(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match="config: no such file"):
        saccade.ActionHead.from_pretrained(TINY.path)
    with pytest.raises(FileNotFoundError, match="config: no such file"):
        saccade.ActionHead.from_pretrained(TINY.path, config=tmp_path / "config.json")
    with pytest.raises(saccade.CheckpointError, match=r"at least one \.safetensors"):
        saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)


REQUIRED = [
    "action_dim",
    "action_horizon",
    "max_state_dim",
    "num_inference_timesteps",
    "diffusion_model_cfg",
    "vl_self_attention_cfg",
]


@pytest.mark.parametrize("key", REQUIRED)
def test_a_config_that_lacks_a_key(key: str) -> None:
    config = {name: value for name, value in TINY.config.items() if name != key}
    with pytest.raises(saccade.CheckpointError, match=f"{key} is missing"):
        saccade.ActionHead.from_pretrained(TINY.path, config=config)


@pytest.mark.parametrize(
    ("message", "change"),
    [
        ("num_target_vision_tokens is -1, expected a whole number", {"num_target_vision_tokens": -1}),
        ("action_dim is 5.5, expected a whole number", {"action_dim": 5.5}),
        ('use_vlln is "yes", expected true or false', {"use_vlln": "yes"}),
        ("input_embedding_dim is 40, but .* is 32", {"input_embedding_dim": 40}),
        ("hidden_size is 21|output_dim is 20", {"hidden_size": 21}),
        ("action_horizon is 17, more than the 16 rows", {"action_horizon": 17}),
        ("hidden_size is 9999999999, expected", {"hidden_size": 9999999999}),
        ("num_inference_timesteps is 1001", {"num_inference_timesteps": 1001}),
        ("use_alternate_vl_dit is true", {"use_alternate_vl_dit": True}),
        ("diffusion_model_cfg: expected an object", {"diffusion_model_cfg": 3}),
        ("norm_eps is 0.5", {"diffusion_model_cfg": TINY.config["diffusion_model_cfg"] | {"norm_eps": 0.5}}),
    ],
)
def test_a_config_that_cannot_be(message: str, change: dict[str, Any]) -> None:
    with pytest.raises(saccade.CheckpointError, match=message):
        saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config | change)


def test_configs_that_are_not_json(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    for text in ("", "{", "[1]", '"x"', '{"action_head_cfg": 3}'):
        path.write_text(text)
        with pytest.raises(saccade.CheckpointError, match="config: "):
            saccade.ActionHead.from_pretrained(TINY.path, config=path)
    with pytest.raises(saccade.CheckpointError, match="config: "):
        saccade.ActionHead.from_pretrained(TINY.path, config={"a": object()})


def rewritten(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of the tiny checkpoint, its tensors changed."""
    tensors = dict(load_file(TINY.path))
    change(tensors)
    save_file(tensors, path)
    return path


def test_all_that_is_wrong_with_the_tensors_is_listed(tmp_path: Path) -> None:
    def change(tensors: dict[str, Any]) -> None:
        del tensors["action_head.vlln.weight"]
        del tensors["action_head.model.proj_out_1.bias"]
        tensors["action_head.surprise"] = np.zeros(1, np.float32)
        tensors["action_head.vlln.bias"] = np.zeros(3, np.float32)
        tensors["action_head.model.proj_out_2.bias"] = np.zeros(20, np.int64)
        tensors["backbone.anything"] = np.zeros(1, np.float32)

    path = rewritten(tmp_path / "model.safetensors", change)
    with pytest.raises(saccade.CheckpointError) as caught:
        saccade.ActionHead.from_pretrained(path, config=TINY.config)
    message = str(caught.value)
    assert message.startswith("source: 5 tensors do not fit the config:")
    for part in (
        "vlln.weight is missing, expected (24,)",
        "proj_out_1.bias is missing, expected (64,)",
        "action_head.surprise is unknown",
        "vlln.bias has shape (3,), expected (24,)",
        "proj_out_2.bias is I64, expected F32, BF16 or F16",
    ):
        assert part in message
    assert "backbone" not in message


def test_layouts(tmp_path: Path) -> None:
    expected = HEAD.sample(CONTEXT, STATE, 1, noise=NOISE)
    tensors = {
        name.removeprefix("action_head."): value
        for name, value in load_file(TINY.path).items()
        if name.startswith("action_head.")
    }
    names = sorted(tensors)
    halves = names[::2], names[1::2]
    for prefix in ("", "action_head.", "_groot_model.action_head."):
        for indexed in (False, True):
            directory = tmp_path / f"{prefix}{indexed}"
            directory.mkdir()
            weight_map: dict[str, str] = {}
            for shard, half in zip(("a.safetensors", "b.safetensors"), halves, strict=True):
                save_file({prefix + name: tensors[name] for name in half}, directory / shard)
                weight_map |= {prefix + name: shard for name in half}
            if indexed:
                index = {"metadata": {}, "weight_map": weight_map}
                (directory / "model.safetensors.index.json").write_text(json.dumps(index))
                save_file(
                    {prefix + "stray": np.zeros(1, np.float32)}, directory / "not-in-the-index.safetensors"
                )
            whole = {"model_type": "gr00t_n1_5", "action_head_cfg": TINY.config}
            (directory / "config.json").write_text(json.dumps(whole))
            head = saccade.ActionHead.from_pretrained(directory)
            np.testing.assert_array_equal(head(FEATURES, STATE, 1, noise=NOISE), expected)


@pytest.mark.parametrize(
    ("message", "weight_map"),
    [
        ("expected a file name in the same directory", {"action_head.vlln.weight": "../a.safetensors"}),
        ("expected a file name in the same directory", {"action_head.vlln.weight": "/etc/passwd"}),
        (r"vlln.weight is not in .*a.safetensors", {"action_head.vlln.weight": "a.safetensors"}),
        ("weight_map names no tensor", {}),
        ("invalid type", {"action_head.vlln.weight": 3}),
    ],
)
def test_hostile_indexes(tmp_path: Path, message: str, weight_map: dict[str, Any]) -> None:
    save_file({"action_head.vlln.bias": np.zeros(24, np.float32)}, tmp_path / "a.safetensors")
    (tmp_path / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    with pytest.raises(saccade.CheckpointError, match=message):
        saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)


def test_a_name_in_two_files_outside_the_head_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(TINY.path.read_bytes())
    for name in ("policy_preprocessor_step_3.safetensors", "policy_postprocessor_step_0.safetensors"):
        save_file({"action.min": np.zeros(1, np.float32)}, tmp_path / name)
    saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)


def test_a_single_file_beside_an_index_counts(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(TINY.path.read_bytes())
    expected = saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)(
        FEATURES, STATE, 1, noise=NOISE
    )
    other = {name: np.zeros_like(value) for name, value in load_file(TINY.path).items()}
    save_file(other, tmp_path / "model-00001-of-00001.safetensors")
    weight_map = dict.fromkeys(other, "model-00001-of-00001.safetensors")
    (tmp_path / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    head = saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)
    np.testing.assert_array_equal(head(FEATURES, STATE, 1, noise=NOISE), expected)
    # Without it the index counts.
    (tmp_path / "model.safetensors").unlink()
    head = saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)
    assert not np.array_equal(head(FEATURES, STATE, 1, noise=NOISE), expected)


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda name: f"_orig_mod.{name}",
        lambda name: f"module.{name}",
        lambda name: f"module._orig_mod.{name}",
        lambda name: name.replace("action_head.", "action_head._orig_mod."),
        lambda name: name.replace("model.transformer_blocks.", "model._orig_mod.transformer_blocks."),
        lambda name: name.replace("attn1.", "attn1._orig_mod."),
    ],
)
@pytest.mark.parametrize("indexed", [False, True])
def test_names_of_wrapped_models(wrapped: Callable[[str], str], indexed: bool, tmp_path: Path) -> None:
    expected = saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)(
        FEATURES, STATE, 1, noise=NOISE
    )
    tensors = {wrapped(name): value for name, value in load_file(TINY.path).items()}
    save_file(tensors, tmp_path / ("shard.safetensors" if indexed else "model.safetensors"))
    if indexed:
        weight_map = dict.fromkeys(tensors, "shard.safetensors")
        (tmp_path / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    head = saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)
    np.testing.assert_array_equal(head(FEATURES, STATE, 1, noise=NOISE), expected)


def test_names_that_become_the_same(tmp_path: Path) -> None:
    def change(tensors: dict[str, Any]) -> None:
        tensors["module.action_head._orig_mod.vlln.bias"] = tensors["action_head.vlln.bias"]

    path = rewritten(tmp_path / "model.safetensors", change)
    message = (
        r"action_head.vlln.bias and module.action_head._orig_mod.vlln.bias|module.* and action_head.vlln.bias"
    )
    with pytest.raises(saccade.CheckpointError, match=f"({message}) are the same tensor"):
        saccade.ActionHead.from_pretrained(path, config=TINY.config)


def test_a_tensor_in_two_files(tmp_path: Path) -> None:
    for name in ("a.safetensors", "b.safetensors"):
        save_file({"action_head.vlln.bias": np.zeros(24, np.float32)}, tmp_path / name)
    with pytest.raises(saccade.CheckpointError, match=r"vlln.bias is in two files, .*a.safetensors"):
        saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)


def safetensors(header: str | bytes, data: bytes = b"", size: int | None = None) -> bytes:
    text = header.encode() if isinstance(header, str) else header
    return struct.pack("<Q", len(text) if size is None else size) + text + data


def tensor(begin: int, end: int, shape: list[int], dtype: str = "F32") -> str:
    return json.dumps({"dtype": dtype, "shape": shape, "data_offsets": [begin, end]})


HOSTILE = {
    "empty": b"",
    "seven bytes": b"1234567",
    "header longer than the file": safetensors("{}", size=10**6),
    "header of 2^63 bytes": safetensors("{}", size=2**63),
    "not JSON": safetensors("hello"),
    "not an object": safetensors("[1, 2]"),
    "not UTF-8": safetensors(b'{"\xff": 1}'),
    "tensor that is no object": safetensors('{"a": 3}'),
    "unknown dtype": safetensors('{"a": {"dtype": "X9", "shape": [1], "data_offsets": [0, 4]}}', b"1234"),
    "negative shape": safetensors('{"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}', b"1234"),
    "shape that overflows": safetensors(f'{{"a": {tensor(0, 4, [2**62, 2**62])}}}', b"1234"),
    "offsets beyond the file": safetensors(f'{{"a": {tensor(0, 400, [100])}}}', b"1234"),
    "offsets turned round": safetensors(f'{{"a": {tensor(4, 0, [1])}}}', b"1234"),
    "offsets that overlap": safetensors(
        f'{{"a": {tensor(0, 8, [2])}, "b": {tensor(4, 12, [2])}}}', b"x" * 12
    ),
    "a hole": safetensors(f'{{"a": {tensor(0, 4, [1])}, "b": {tensor(8, 12, [1])}}}', b"x" * 12),
    "size unlike the shape": safetensors(f'{{"a": {tensor(0, 4, [2])}}}', b"1234"),
    "trailing bytes": safetensors(f'{{"a": {tensor(0, 4, [1])}}}', b"12345"),
    "a name twice": safetensors(f'{{"a": {tensor(0, 4, [1])}, "a": {tensor(0, 4, [1])}}}', b"1234"),
    "nested deeply": safetensors("[" * 100_000),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(HOSTILE[name])
    for read in (
        lambda: read_tensors(path),
        lambda: saccade.ActionHead.from_pretrained(path, config=TINY.config),
    ):
        with pytest.raises(saccade.CheckpointError, match=r"source: .*model\.safetensors"):
            read()


@given(data=st.data())
def test_a_damaged_file_is_an_error_or_the_same_head(data: st.DataObject, tmp_path_factory: Any) -> None:
    original = TINY.path.read_bytes()
    header = struct.unpack("<Q", original[:8])[0] + 8
    damaged = bytearray(original)
    if data.draw(st.booleans(), label="truncate"):
        del damaged[data.draw(st.integers(0, len(original) - 1)) :]
    else:
        damaged[data.draw(st.integers(0, header - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.safetensors"
    path.write_bytes(damaged)
    try:
        head = saccade.ActionHead.from_pretrained(path, config=TINY.config)
    except saccade.CheckpointError:
        return
    assert head.config == HEAD.config


def test_things_that_are_not_regular_files(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").mkdir()
    with pytest.raises(saccade.CheckpointError, match="not a regular file"):
        saccade.ActionHead.from_pretrained(tmp_path, config=TINY.config)
    with pytest.raises(saccade.CheckpointError, match="not a regular file"):
        saccade.ActionHead.from_pretrained(os.devnull, config=TINY.config)


def test_a_file_that_shrinks_after_it_was_opened_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(TINY.path.read_bytes()[:-1000])
    with pytest.raises(saccade.CheckpointError, match="truncated"):
        saccade.ActionHead.from_pretrained(path, config=TINY.config)
