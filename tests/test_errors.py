"""Bad input: a typed error that names the thing, what was given and what was expected."""

from __future__ import annotations

import json
import os
import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from released import load_released
from safetensors.numpy import load_file, save_file

import saccade
from saccade._arrays import does_not_fit
from saccade.checkpoints import read_tensors

TINY = load_released("n15_tiny")
HEAD = saccade.ActionHead.load(TINY.path, config=TINY.config)
CONTEXT = HEAD.encode(TINY.backbone_features)
FEATURES, STATE, NOISE = TINY.backbone_features, TINY.state, TINY.noise
NAN, INFINITY = np.full((2, 11, 24), np.nan), np.full((2, 11, 24), np.inf)

Shape, Dtype, Input = saccade.ShapeError, saccade.DtypeError, saccade.InputError


def test_errors_are_also_the_built_in_ones() -> None:
    for error in (Shape, Input, saccade.CheckpointError):
        assert issubclass(error, saccade.SaccadeError)
        assert issubclass(error, ValueError)
    assert issubclass(Dtype, saccade.SaccadeError)
    assert issubclass(Dtype, TypeError)


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (Shape, r"backbone_features: expected .*24.*, got \(11, 24\)", {"backbone_features": FEATURES[0]}),
        (Shape, r"backbone_features: .*got \(2, 11, 23\)", {"backbone_features": FEATURES[..., :23]}),
        (Shape, r"backbone_features: .*got \(0, 11, 24\)", {"backbone_features": FEATURES[:0]}),
        (Shape, r"backbone_features: .*got \(2, 0, 24\)", {"backbone_features": FEATURES[:, :0]}),
        (Shape, r"backbone_features: expected an array", {"backbone_features": [[1.0], [1.0, 2.0]]}),
        (Shape, r"backbone_features: .*got \(\)", {"backbone_features": 1.0}),
        (
            Dtype,
            "backbone_features: expected floating point.*int64",
            {"backbone_features": FEATURES.astype(int)},
        ),
        (Dtype, "backbone_features: .*bool", {"backbone_features": FEATURES > 0}),
        (Dtype, "backbone_features: .*complex", {"backbone_features": FEATURES.astype(complex)}),
        (Dtype, "backbone_features: .*object", {"backbone_features": None}),
        (Dtype, "backbone_features: .*torch.int64", {"backbone_features": torch.ones(2, 11, 24).long()}),
        (Dtype, "backbone_features: .*meta", {"backbone_features": torch.ones(2, 11, 24, device="meta")}),
        (Input, r"backbone_features: expected finite values, got NaN", {"backbone_features": NAN}),
        (Input, r"backbone_features: .*inf at index \(0, 0, 0\)", {"backbone_features": INFINITY}),
        (Input, r"backbone_features: .*inf", {"backbone_features": FEATURES.astype(np.float64) * 1e300}),
        (Shape, r"attention_mask: .*\(2, 11\), got \(11,\)", {"attention_mask": np.ones(11, bool)}),
        (Dtype, "attention_mask: expected booleans, got int64", {"attention_mask": np.ones((2, 11), int)}),
        (Input, "attention_mask: .*drop_vl", {"attention_mask": np.zeros((2, 11), bool)}),
        (Shape, "image_mask: ", {"image_mask": np.ones((2, 12), bool)}),
        (Shape, "drop_vl: ", {"drop_vl": np.ones((1, 11), bool)}),
        (Dtype, "drop_vl: expected booleans, got float32", {"drop_vl": np.ones((2, 11), np.float32)}),
    ],
)
def test_encode(error: type[Exception], message: str, options: dict[str, Any]) -> None:
    with pytest.raises(error, match=message):
        HEAD.encode(**{"backbone_features": FEATURES} | options)


def read_only() -> Any:
    array = np.zeros((2, 6, 5), np.float32)
    array.flags.writeable = False
    return array


OTHER_CONTEXT = saccade.ActionHead.load(TINY.path, config=TINY.config).encode(FEATURES)


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (Input, r"context: .*another head", {"context": OTHER_CONTEXT}),
        (Input, "context: expected what encode returns, got ndarray", {"context": FEATURES}),
        (Shape, r"state: .*\(2, 7\).*normalise.*got \(2, 6\)", {"state": STATE[:, 0, :6]}),
        (Shape, r"state: .*got \(2, 2, 7\)", {"state": np.repeat(STATE, 2, axis=1)}),
        (Shape, r"state: .*got \(1, 1, 7\)", {"state": STATE[:1]}),
        (Dtype, "state: .*int64", {"state": STATE.astype(int)}),
        (Input, "state: .*NaN", {"state": STATE * np.nan}),
        (Input, "embodiment_id: expected 0 to 4, got 5", {"embodiment_id": 5}),
        (Input, "embodiment_id: expected 0 to 4, got -1", {"embodiment_id": -1}),
        (Input, "embodiment_id: expected an integer.*got 1.0", {"embodiment_id": 1.0}),
        (Input, "embodiment_id: expected an integer.*got True", {"embodiment_id": True}),
        (Input, "embodiment_id: expected an integer.*got 'gr1'", {"embodiment_id": "gr1"}),
        (Input, "embodiment_id: ", {"embodiment_id": None}),
        (Input, "embodiment_id: ", {"embodiment_id": 2**70}),
        (Input, "embodiment_id: .*18446744073709551615", {"embodiment_id": np.uint64(2**64 - 1)}),
        (Shape, r"embodiment_id: .*\(2,\), got \(3,\)", {"embodiment_id": [0, 1, 2]}),
        (Shape, r"embodiment_id: .*\(2,\), got \(2, 1\)", {"embodiment_id": [[0], [1]]}),
        (Input, "embodiment_id: ", {"embodiment_id": []}),
        (Shape, r"noise: .*\(2, 6, 5\), got \(2, 5, 5\)", {"noise": NOISE[:, :5]}),
        (Shape, r"noise: .*\(2, 3, 6, 5\), got \(2, 6, 5\)", {"num_samples": 3}),
        (Dtype, "noise: ", {"noise": np.ones((2, 6, 5), np.int32)}),
        (Input, "noise: .*inf", {"noise": np.full((2, 6, 5), np.inf)}),
        (Input, "noise, seed: expected at most one", {"seed": 1}),
        (Input, "seed: .*'x'", {"noise": None, "seed": "x"}),
        (Input, "seed: .*-1", {"noise": None, "seed": -1}),
        (Input, "num_steps: expected at least 1, got 0", {"num_steps": 0}),
        (Input, "num_steps: .*got -3", {"num_steps": -3}),
        (Input, r"num_steps: expected 1 to 1000.*got 1001", {"num_steps": 1001}),
        (Input, "num_steps: expected an integer, got 4.0", {"num_steps": 4.0}),
        (Input, "num_steps: ", {"num_steps": 2**64}),
        (Input, "num_samples: expected at least 1, got 0", {"num_samples": 0}),
        (Input, "num_samples: expected an integer, got True", {"num_samples": True}),
        (MemoryError, r"GB\) does not fit in memory", {"num_samples": 2**61, "noise": None}),
        (Input, "num_steps: expected a number below", {"num_steps": 2**70}),
        (Input, "embodiment_id: ", {"embodiment_id": [[0], [0, 1]]}),
        (Shape, r"out: expected \(2, 6, 5\), got \(2, 6, 4\)", {"out": np.empty((2, 6, 4), np.float32)}),
        (Dtype, "out: expected float32, got float64", {"out": np.empty((2, 6, 5))}),
        (Dtype, "out: expected a float32 array, got list", {"out": [1.0]}),
        (Input, "out: expected a writable", {"out": read_only()}),
        (Input, "out: .*C-contiguous", {"out": np.empty((6, 2, 5), np.float32).transpose(1, 0, 2)}),
        (Input, "out: .*gradient", {"out": torch.zeros(2, 6, 5, requires_grad=True)}),
    ],
)
def test_sample(error: type[Exception], message: str, options: dict[str, Any]) -> None:
    arguments: dict[str, Any] = {"context": CONTEXT, "state": STATE, "embodiment_id": 1, "noise": NOISE}
    arguments |= options
    with np.errstate(all="ignore"), pytest.raises(error, match=message):
        HEAD.sample(**arguments)


def test_out_is_untouched_by_a_refused_call() -> None:
    out = np.full((2, 6, 5), 7, np.float32)
    with pytest.raises(Shape):
        HEAD.sample(CONTEXT, STATE[:, :, :6], 1, noise=NOISE, out=out)
    assert (out == 7).all()


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (Input, "timestep: expected a bucket from 0 to 999, got 1000", {"timestep": 1000}),
        (Input, "timestep: .*got -1", {"timestep": [0, -1]}),
        (Input, "timestep: expected an integer.*0.5", {"timestep": 0.5}),
        (Shape, r"timestep: .*\(2,\), got \(1,\)", {"timestep": [0]}),
        (Shape, "actions: ", {"actions": NOISE[0]}),
        (Input, "actions: ", {"actions": NOISE * np.nan}),
        (Shape, "state: ", {"state": STATE[0]}),
    ],
)
def test_velocity(error: type[Exception], message: str, options: dict[str, Any]) -> None:
    arguments: dict[str, Any] = {"state": STATE, "embodiment_id": 1, "actions": NOISE, "timestep": 0}
    with pytest.raises(error, match=message):
        HEAD.velocity(CONTEXT, **arguments | options)


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("precision: expected one of 'float32', 'bfloat16', 'int8', got 'float8'", {"precision": "float8"}),
        ("num_threads: expected at least 1, got 0", {"num_threads": 0}),
        ("num_threads: expected 1 to 1024, got 99999", {"num_threads": 99999}),
        ("num_threads: expected an integer, got 1.5", {"num_threads": 1.5}),
        ("embodiment_ids: expected ids from 0 to 4, got 5", {"embodiment_ids": [0, 5]}),
        ("embodiment_ids: .*got -1", {"embodiment_ids": [-1]}),
        ("embodiment_ids: expected at least one", {"embodiment_ids": np.zeros(0, int)}),
        ("embodiment_ids: expected an integer", {"embodiment_ids": ["gr1"]}),
        ("source: expected a path, got int", {"source": 3}),
        ("source: .*null characters", {"source": "a\0b"}),
    ],
)
def test_load_options(message: str, options: dict[str, Any]) -> None:
    arguments: dict[str, Any] = {"source": TINY.path, "config": TINY.config} | options
    with pytest.raises(Input, match=message):
        saccade.ActionHead.load(**arguments)


@pytest.mark.parametrize("variable", ["SACCADE_ISA", "SACCADE_NUM_THREADS"])
def test_environment(monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, "none")
    with pytest.raises(Input, match=f"{variable}: expected .*none"):
        saccade.ActionHead.load(TINY.path, config=TINY.config)
    monkeypatch.setenv(variable, "")
    saccade.ActionHead.load(TINY.path, config=TINY.config)


def test_paths_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="source: no such file"):
        saccade.ActionHead.load(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match="config: no such file"):
        saccade.ActionHead.load(TINY.path)
    with pytest.raises(FileNotFoundError, match="config: no such file"):
        saccade.ActionHead.load(TINY.path, config=tmp_path / "config.json")
    with pytest.raises(saccade.CheckpointError, match=r"at least one \.safetensors"):
        saccade.ActionHead.load(tmp_path, config=TINY.config)


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
        saccade.ActionHead.load(TINY.path, config=config)


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
        saccade.ActionHead.load(TINY.path, config=TINY.config | change)


def test_configs_that_are_not_json(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    for text in ("", "{", "[1]", '"x"', '{"action_head_cfg": 3}'):
        path.write_text(text)
        with pytest.raises(saccade.CheckpointError, match="config: "):
            saccade.ActionHead.load(TINY.path, config=path)
    with pytest.raises(saccade.CheckpointError, match="config: "):
        saccade.ActionHead.load(TINY.path, config={"a": object()})


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
        saccade.ActionHead.load(path, config=TINY.config)
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
            head = saccade.ActionHead.load(directory)
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
        saccade.ActionHead.load(tmp_path, config=TINY.config)


def test_a_name_in_two_files_outside_the_head_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").write_bytes(TINY.path.read_bytes())
    for name in ("policy_preprocessor_step_3.safetensors", "policy_postprocessor_step_0.safetensors"):
        save_file({"action.min": np.zeros(1, np.float32)}, tmp_path / name)
    saccade.ActionHead.load(tmp_path, config=TINY.config)


def test_a_tensor_in_two_files(tmp_path: Path) -> None:
    for name in ("a.safetensors", "b.safetensors"):
        save_file({"action_head.vlln.bias": np.zeros(24, np.float32)}, tmp_path / name)
    with pytest.raises(saccade.CheckpointError, match=r"vlln.bias is in two files, .*a.safetensors"):
        saccade.ActionHead.load(tmp_path, config=TINY.config)


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
    for read in (lambda: read_tensors(path), lambda: saccade.ActionHead.load(path, config=TINY.config)):
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
        head = saccade.ActionHead.load(path, config=TINY.config)
    except saccade.CheckpointError:
        return
    assert head.config == HEAD.config


def test_things_that_are_not_regular_files(tmp_path: Path) -> None:
    (tmp_path / "model.safetensors").mkdir()
    with pytest.raises(saccade.CheckpointError, match="not a regular file"):
        saccade.ActionHead.load(tmp_path, config=TINY.config)
    with pytest.raises(saccade.CheckpointError, match="not a regular file"):
        saccade.ActionHead.load(os.devnull, config=TINY.config)


def test_a_file_that_shrinks_after_it_was_opened_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(TINY.path.read_bytes()[:-1000])
    with pytest.raises(saccade.CheckpointError, match="truncated"):
        saccade.ActionHead.load(path, config=TINY.config)


def cross_tensors() -> dict[str, Any]:
    tensors = {
        "to_q.weight": (12, 12),
        "to_k.weight": (12, 5),
        "to_v.weight": (12, 5),
        "to_out.0.weight": (12, 12),
    }
    biases = dict.fromkeys(("to_q.bias", "to_k.bias", "to_v.bias", "to_out.0.bias"), (12,))
    return {name: np.ones(shape, np.float32) for name, shape in (tensors | biases).items()}


ATTENTION = saccade.CrossAttention(cross_tensors(), 3)
KEYS_VALUES = ATTENTION.project(np.ones((2, 4, 5), np.float32))


@pytest.mark.parametrize(
    ("error", "message", "tensors", "num_heads"),
    [
        (
            saccade.CheckpointError,
            r"to_q.bias is missing, expected \(12,\)\n  x is unknown",
            {"to_q.bias": None, "x": np.ones(1)},
            3,
        ),
        (saccade.CheckpointError, r"to_v.weight has shape \(12, 6\)", {"to_v.weight": np.ones((12, 6))}, 3),
        (saccade.CheckpointError, "to_q.weight is missing", {"to_q.weight": None}, 3),
        (saccade.CheckpointError, r"to_q.weight has shape \(\)", {"to_q.weight": np.ones(())}, 3),
        (Dtype, r"tensors\['to_q.bias'\]: ", {"to_q.bias": np.ones(12, int)}, 3),
        (Input, r"tensors\['to_q.bias'\]: expected finite", {"to_q.bias": np.full(12, np.nan)}, 3),
        (Input, "num_heads: expected a divisor of the width 12, got 5", {}, 5),
        (Input, "num_heads: expected at least 1, got 0", {}, 0),
    ],
)
def test_cross_attention(error: type[Exception], message: str, tensors: Any, num_heads: int) -> None:
    changed = {name: value for name, value in (cross_tensors() | tensors).items() if value is not None}
    with pytest.raises(error, match=message):
        saccade.CrossAttention(changed, num_heads)


@pytest.mark.parametrize(
    ("error", "message", "options"),
    [
        (
            Shape,
            r"hidden_states: .*\(batch, rows, 12\).*got \(2, 3, 11\)",
            {"hidden_states": np.ones((2, 3, 11))},
        ),
        (Shape, "hidden_states: expected the batch of kv, 2, got 1", {"hidden_states": np.ones((1, 3, 12))}),
        (Shape, "hidden_states: ", {"hidden_states": np.ones((2, 0, 12))}),
        (Dtype, "hidden_states: ", {"hidden_states": np.ones((2, 3, 12), int)}),
        (Input, "hidden_states: ", {"hidden_states": np.full((2, 3, 12), np.inf)}),
        (Input, "kv: expected what project returns, got ndarray", {"kv": np.ones((2, 4, 5))}),
        (Shape, r"key_mask: .*\(2, 4\), got \(4,\)", {"key_mask": np.ones(4, bool)}),
        (Dtype, "key_mask: ", {"key_mask": np.ones((2, 4))}),
        (Shape, "key_bias: ", {"key_bias": np.ones((2, 5))}),
        (Input, "key_bias: .*NaN", {"key_bias": np.full((2, 4), np.nan)}),
        (Input, "key_bias: .*inf", {"key_bias": np.full((2, 4), np.inf)}),
        (Shape, "out: ", {"out": np.ones((2, 3, 13), np.float32)}),
    ],
)
def test_cross_attention_calls(error: type[Exception], message: str, options: dict[str, Any]) -> None:
    arguments: dict[str, Any] = {"hidden_states": np.ones((2, 3, 12), np.float32), "kv": KEYS_VALUES}
    arguments |= options
    with pytest.raises(error, match=message):
        ATTENTION(**arguments)


def test_keys_and_values_of_another_layer() -> None:
    other = saccade.CrossAttention(cross_tensors(), 4)
    with pytest.raises(Input, match="kv: expected keys and values of 4 heads and width 12, got 3 and 12"):
        other(np.ones((2, 3, 12), np.float32), KEYS_VALUES)


@pytest.mark.parametrize("ids", [0, 1.5, object()])
def test_embodiment_ids_are_a_sequence(ids: Any) -> None:
    with pytest.raises(Input, match=r"embodiment_ids: expected a sequence of integers, such as \[0\], got"):
        saccade.ActionHead.load(TINY.path, config=TINY.config, embodiment_ids=ids)


@pytest.mark.parametrize("ids", [range(2**30), range(2**62), range(2**70)])
def test_a_long_range_of_embodiment_ids_is_not_written_out(ids: range) -> None:
    with pytest.raises(Input, match="embodiment_ids: expected at most 1048576 integers, got range"):
        saccade.ActionHead.load(TINY.path, config=TINY.config, embodiment_ids=ids)


def test_a_small_result_that_does_not_fit_is_not_said_to_have_no_size() -> None:
    assert (
        str(does_not_fit("noise", (20000, 16, 4)))
        == "noise of shape (20000, 16, 4) (5.1 MB) does not fit in memory"
    )
    assert (
        str(does_not_fit("noise", (2**40, 4)))
        == f"noise of shape ({2**40}, 4) (17,592.2 GB) does not fit in memory"
    )


def test_names_that_are_not_valid_unicode() -> None:
    tensors = {"\udcff": np.zeros(3, np.float32)}
    with pytest.raises(Input, match="tensors: expected valid Unicode"):
        saccade.ActionHead.from_tensors(tensors, config=TINY.config)
    with pytest.raises(Input, match="tensors: expected valid Unicode"):
        saccade.CrossAttention(tensors, 2)
    with pytest.raises(Input, match="precision: expected valid Unicode"):
        saccade.ActionHead.load(TINY.path, config=TINY.config, precision="\udcff")


def test_a_head_of_tensors_cannot_be_pickled() -> None:
    tensors = {name.removeprefix("action_head."): value for name, value in load_file(TINY.path).items()}
    tensors = {name: value for name, value in tensors.items() if not name.startswith("_")}
    head = saccade.ActionHead.from_tensors(tensors, config=TINY.config)
    with pytest.raises(Dtype, match=r"use ActionHead\.load"):
        pickle.dumps(head)
