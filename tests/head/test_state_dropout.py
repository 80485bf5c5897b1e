"""GR00T-H's `dropout_prob_by_embodiment`: the states of embodiments above 0.999 have no effect."""

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import saccade
from saccade.checkpoints import convert, quantize, resize
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers import layouts
from tests.helpers.engine_cases import TOLERANCE, arrays, same, save
from tests.helpers.reference_cases import relative_error, small_config, variant_config

TENSOR, KEY = "dropout_prob_by_embodiment", "state_dropout_prob_per_embodiment"

#: By embodiment of the small heads: the state of the second one alone has no effect.
PROBABILITIES = (0.0, 1.0, 0.5)
DROPPED, KEPT, SOMETIMES = 1, 0, 2


def write(
    folder: Path,
    kind: str = "n1.7",
    probabilities: Sequence[float] = PROBABILITIES,
    dtype: torch.dtype = torch.float32,
    **config: Any,
) -> Path:
    """A small head with the tensor."""
    whole = (small_config() if kind == "n1.5" else variant_config(kind)) | config
    save(folder, random_head(whole, 3), whole)
    add(folder, torch.tensor(probabilities).to(dtype))
    return folder


def add(folder: Path, probabilities: torch.Tensor, prefix: str = "action_head.") -> None:
    path = folder / "model.safetensors"
    save_file(load_file(path) | {prefix + TENSOR: probabilities}, path, {"format": "pt"})


def two_states(head: Any, embodiment_id: Any, *, batch: int = 1) -> tuple[Any, Any]:
    """The actions of two different states, all else equal."""
    inputs = random_inputs(head.config, 5, batch=batch, num_vl_tokens=6) | {"embodiment_id": embodiment_id}
    others = {**inputs, "state": inputs["state"] + 1.0}
    if isinstance(head, Reference):
        with torch.no_grad():
            return head(**inputs), head(**others)
    return tuple(
        head(**{name: np.asarray(value) for name, value in given.items()}) for given in (inputs, others)
    )


@pytest.mark.parametrize("kind", ["n1.5", "n1.6", "n1.7"])
@pytest.mark.parametrize("load", [saccade.ActionHead.from_pretrained, Reference.from_pretrained])
def test_only_a_state_that_was_always_dropped_has_no_effect(kind: str, load: Any, tmp_path: Path) -> None:
    head = load(write(tmp_path, kind))
    assert same(*two_states(head, DROPPED))
    for embodiment in (KEPT, SOMETIMES):
        assert not same(*two_states(head, embodiment))


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
def test_it_is_a_state_of_zeros(precision: str, isa: str, tmp_path: Path) -> None:
    head = saccade.ActionHead.from_pretrained(write(tmp_path), precision=precision)
    inputs = arrays(random_inputs(head.config, 5, batch=3, num_vl_tokens=6))
    inputs["embodiment_id"] = np.array([KEPT, DROPPED, SOMETIMES])
    add(tmp_path, torch.zeros(3))
    plain = saccade.ActionHead.from_pretrained(tmp_path, precision=precision)
    zeroed = inputs["state"].copy()
    zeroed[1] = 0.0
    expected = plain(**{**inputs, "state": zeroed})
    assert same(head(**inputs), expected)
    assert not same(plain(**inputs), expected)


def test_sample_velocity_and_trace_agree_with_the_reference(tmp_path: Path) -> None:
    config = variant_config("n1.7") | {"state_history_length": 2}
    write(tmp_path, state_history_length=2)
    head, reference = (
        saccade.ActionHead.from_pretrained(tmp_path),
        Reference.from_pretrained(tmp_path, dtype=torch.float64),
    )
    inputs = random_inputs(saccade.HeadConfig.from_dict(config), 5, batch=3, num_vl_tokens=6)
    inputs["embodiment_id"] = torch.tensor([DROPPED, KEPT, DROPPED])
    given = arrays(inputs)
    masks = {name: given[name] for name in ("attention_mask", "image_mask")}
    context = head.encode(given["backbone_features"], **masks)
    call = (context, given["state"], given["embodiment_id"])
    torch_call = (reference.encode(inputs["backbone_features"]), inputs["state"], inputs["embodiment_id"])
    with torch.no_grad():
        expected = reference(**inputs)
        velocity = reference.velocity(*torch_call, inputs["noise"], 250, **masks)
    trace = head.trace(*call, noise=given["noise"])
    assert relative_error(trace.actions, expected) <= TOLERANCE
    assert same(trace.actions, head.sample(*call, noise=given["noise"]))
    assert relative_error(head.velocity(*call, given["noise"], 250), velocity) <= TOLERANCE


def test_rows_of_a_batch_are_those_of_single_calls(tmp_path: Path) -> None:
    head = saccade.ActionHead.from_pretrained(write(tmp_path))
    ids = [DROPPED, KEPT, SOMETIMES, DROPPED]
    inputs = arrays(random_inputs(head.config, 5, batch=4, num_vl_tokens=6)) | {"embodiment_id": ids}
    together = head(**inputs)
    for row, embodiment in enumerate(ids):
        one = {name: value[row : row + 1] for name, value in inputs.items()} | {"embodiment_id": embodiment}
        assert same(head(**one), together[row : row + 1])


def test_some_embodiments_from_memory_and_after_pickling(tmp_path: Path) -> None:
    write(tmp_path)
    head = saccade.ActionHead.from_pretrained(tmp_path, embodiment_ids=[DROPPED, SOMETIMES])
    config = json.loads((tmp_path / "config.json").read_text())
    tensors = layouts.read(tmp_path, "action_head.")
    made = saccade.ActionHead.from_tensors(tensors, config=config, embodiment_ids=[DROPPED, SOMETIMES])
    for one in (head, pickle.loads(pickle.dumps(head)), made):
        assert same(*two_states(one, DROPPED))
        assert not same(*two_states(one, SOMETIMES))
        assert same(two_states(one, SOMETIMES)[0], two_states(head, SOMETIMES)[0])


@pytest.mark.parametrize("load", [saccade.ActionHead.from_pretrained, Reference.from_pretrained])
def test_the_limit_is_above_0_999(load: Any, tmp_path: Path) -> None:
    """In float32, as in the released code; bfloat16 has no number between it and 1."""
    above = float(np.nextafter(np.float32(0.999), np.float32(1.0)))
    head = load(write(tmp_path, probabilities=(0.999, above, 2.0)))
    assert not same(*two_states(head, 0))
    assert same(*two_states(head, 1))
    assert same(*two_states(head, 2))
    add(tmp_path, torch.tensor([0.99, 1.0, 0.0], dtype=torch.bfloat16))
    head = load(tmp_path)
    assert not same(*two_states(head, 0))
    assert same(*two_states(head, 1))


@pytest.mark.parametrize("layout", ["n17", "lerobot-n17"])
@pytest.mark.parametrize("load", [saccade.ActionHead.from_pretrained, Reference.from_pretrained])
def test_published_layouts(layout: str, load: Any, tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / layout, layout)
    probabilities = torch.zeros(32)
    probabilities[10] = 1.0
    prefix = "_groot_model.action_head." if layout == "lerobot-n17" else "action_head."
    if layout == "n17":  # in the second shard, which needs no entry in the index's sizes
        path = sorted(folder.glob("model-*.safetensors"))[1]
        save_file(load_file(path) | {prefix + TENSOR: probabilities}, path, {"format": "pt"})
        index = folder / "model.safetensors.index.json"
        listed = json.loads(index.read_text())
        listed["weight_map"][prefix + TENSOR] = path.name
        index.write_text(json.dumps(listed))
    else:
        add(folder, probabilities, prefix)
    head = load(folder)
    assert same(*two_states(head, 10))
    assert not same(*two_states(head, 11))


@pytest.mark.parametrize("load", [saccade.ActionHead.from_pretrained, Reference.from_pretrained])
@pytest.mark.parametrize(
    ("given", "acts"),
    [({"a_robot": 1.0, "another": 0.5}, True), (None, False), ({}, False), (False, False)],
)
def test_a_config_that_says_that_there_are_none_is_followed(
    given: Any, acts: bool, load: Any, tmp_path: Path
) -> None:
    """The released class reads the tensor only if its config has probabilities."""
    head = load(write(tmp_path, **{KEY: given}))
    assert same(*two_states(head, DROPPED)) == acts


@pytest.mark.parametrize("load", [saccade.ActionHead.from_pretrained, Reference.from_pretrained])
def test_a_config_whose_tensor_is_missing_is_refused(load: Any, tmp_path: Path) -> None:
    config = variant_config("n1.7")
    save(tmp_path, random_head(config, 3), config | {KEY: {"a_robot": 0.5, "another": 1.0}})
    with pytest.raises(saccade.CheckpointError, match=rf"{TENSOR} is missing.*{KEY}.*1\.0"):
        load(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(config | {KEY: {"a_robot": 0.5}}))
    assert not same(*two_states(load(tmp_path), DROPPED))


@pytest.mark.parametrize("load", [saccade.ActionHead.from_pretrained, Reference.from_pretrained])
@pytest.mark.parametrize(
    ("probabilities", "message"),
    [
        ((0.0, float("nan"), 0.0), rf"{TENSOR}: expected finite"),
        ((0.0, 1.0, float("inf")), rf"{TENSOR}: expected finite"),
        ((0.0, 1.0), rf"{TENSOR}.* shape \(2,\), expected \(3,\)"),
        (((0.0, 1.0, 0.0),), rf"{TENSOR}.* shape \(1, 3\), expected \(3,\)"),
    ],
)
def test_a_tensor_that_is_broken(load: Any, probabilities: Any, message: str, tmp_path: Path) -> None:
    write(tmp_path, probabilities=probabilities)
    with pytest.raises(saccade.CheckpointError, match=message):
        load(tmp_path)


def test_a_tensor_of_integers(tmp_path: Path) -> None:
    write(tmp_path, dtype=torch.int64)
    with pytest.raises(saccade.CheckpointError, match=rf"{TENSOR} is I64, expected F32, BF16 or F16"):
        saccade.ActionHead.from_pretrained(tmp_path)


def test_from_tensors_refuses_the_same() -> None:
    config = variant_config("n1.7")
    tensors = dict(random_head(config, 3).state_dict())
    for broken, error in (
        (torch.tensor([0.0, torch.nan, 0.0]), saccade.CheckpointError),
        (torch.zeros(2), saccade.ShapeError),
    ):
        with pytest.raises(error, match=TENSOR):
            saccade.ActionHead.from_tensors({**tensors, TENSOR: broken}, config=config)
    with pytest.raises(saccade.CheckpointError, match=f"{TENSOR} is missing"):
        saccade.ActionHead.from_tensors(tensors, config=config | {KEY: {"a_robot": 1.0}})


def test_a_config_with_something_else_in_its_place(tmp_path: Path) -> None:
    write(tmp_path, state_dropout_prob_per_embodiment=[1.0])
    with pytest.raises(saccade.CheckpointError, match=rf"{KEY} is \[1\.0\], expected a probability for each"):
        saccade.ActionHead.from_pretrained(tmp_path)


@pytest.mark.parametrize("rewrite", ["convert", "resize", "quantize"])
def test_it_survives_a_rewrite(rewrite: str, tmp_path: Path) -> None:
    """0.9985 would be 1 in bfloat16, and act."""
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    write(source, "n1.5", (0.9985, 1.0, 0.5))
    if rewrite == "convert":
        convert(source, out, dtype="bfloat16", embodiment_ids=[0, 1])
    elif rewrite == "resize":
        resize(source, out, num_future_tokens=2)
    else:
        quantize(source, out)
    expected = layouts.read(source, "action_head.")[TENSOR]
    found = layouts.read(out, "action_head.")[TENSOR]
    assert found.dtype == expected.dtype
    assert torch.equal(found, expected)
    head = saccade.ActionHead.from_pretrained(out)
    assert same(*two_states(head, 1))
    assert not same(*two_states(head, 0))
