"""Bad input of the head: a typed error that names the thing, what was given and what was expected."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade._internal.arrays import does_not_fit
from tests.helpers.released import load_released
from tests.helpers.tensor_files import read_tensor_file

TINY = load_released("n15_tiny")
HEAD = saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)
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


OTHER_CONTEXT = saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config).encode(FEATURES)


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
        (
            "precision: expected one of 'float32', 'bfloat16', 'int8', 'int4', got 'float8'",
            {"precision": "float8"},
        ),
        ("num_threads: expected at least 1, got 0", {"num_threads": 0}),
        ("num_threads: expected 1 to 1024, got 99999", {"num_threads": 99999}),
        ("num_threads: expected an integer, got 1.5", {"num_threads": 1.5}),
        ("embodiment_ids: expected ids from 0 to 4, got 5", {"embodiment_ids": [0, 5]}),
        ("embodiment_ids: .*got -1", {"embodiment_ids": [-1]}),
        ("embodiment_ids: expected at least one", {"embodiment_ids": np.zeros(0, int)}),
        ("embodiment_ids: expected an integer", {"embodiment_ids": ["gr1"]}),
        ("id_or_path: expected a path or an id, got int", {"id_or_path": 3}),
        ("id_or_path: .*null characters", {"id_or_path": "a\0b"}),
    ],
)
def test_load_options(message: str, options: dict[str, Any]) -> None:
    arguments: dict[str, Any] = {"id_or_path": TINY.path, "config": TINY.config} | options
    with pytest.raises(Input, match=message):
        saccade.ActionHead.from_pretrained(**arguments)


@pytest.mark.parametrize("variable", ["SACCADE_ISA", "SACCADE_NUM_THREADS"])
def test_environment(monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, "none")
    with pytest.raises(Input, match=f"{variable}: expected .*none"):
        saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)
    monkeypatch.setenv(variable, "")
    saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)


@pytest.mark.parametrize("ids", [0, 1.5, object()])
def test_embodiment_ids_are_a_sequence(ids: Any) -> None:
    with pytest.raises(Input, match=r"embodiment_ids: expected a sequence of integers, such as \[0\], got"):
        saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config, embodiment_ids=ids)


@pytest.mark.parametrize("ids", [range(2**30), range(2**62), range(2**70)])
def test_a_long_range_of_embodiment_ids_is_not_written_out(ids: range) -> None:
    with pytest.raises(Input, match="embodiment_ids: expected at most 1048576 integers, got range"):
        saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config, embodiment_ids=ids)


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
        saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config, precision="\udcff")


def test_a_head_of_tensors_cannot_be_pickled() -> None:
    _, stored = read_tensor_file(TINY.path)
    tensors = {name.removeprefix("action_head."): value for name, value in stored.items()}
    tensors = {name: value for name, value in tensors.items() if not name.startswith("_")}
    head = saccade.ActionHead.from_tensors(tensors, config=TINY.config)
    with pytest.raises(Dtype, match=r"use ActionHead\.from_pretrained"):
        pickle.dumps(head)
