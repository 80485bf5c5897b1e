"""Heads made of tensors in memory: the bits of a loaded head, and what is refused."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

import saccade
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import arrays, same, save
from tests.helpers.reference_cases import small_config

CONFIG = small_config(num_heads=2, head_dim=33, context_dim=62, hidden_dim=51, num_layers=3)
WEIGHT = "model.transformer_blocks.0.attn1.to_q.weight"
BIAS = "model.proj_out_2.bias"


def weights(dtype: torch.dtype = torch.float32, config: Mapping[str, Any] = CONFIG) -> dict[str, Tensor]:
    """A head's state dict; every second tensor stays float32, as published checkpoints mix types."""
    tensors = random_head(dict(config), 1, dtype=torch.float32).state_dict()
    return {name: t.to(dtype) if index % 2 else t for index, (name, t) in enumerate(tensors.items())}


def loaded(tensors: dict[str, Tensor], folder: Path, **options: Any) -> saccade.ActionHead:
    """The head that `load` makes of a file of these tensors."""
    save_file({name: t.contiguous() for name, t in tensors.items()}, folder / "model.safetensors")
    return saccade.ActionHead.from_pretrained(folder / "model.safetensors", config=CONFIG, **options)


def made(tensors: Mapping[str, Any], **options: Any) -> saccade.ActionHead:
    return saccade.ActionHead.from_tensors(tensors, config=CONFIG, **options)


def actions(head: saccade.ActionHead, embodiment_id: int = 1) -> Any:
    inputs = arrays(random_inputs(head.config, 2, batch=2, num_vl_tokens=9))
    return head(**{**inputs, "embodiment_id": embodiment_id})


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
def test_the_bits_of_a_loaded_head(isa: str, dtype: torch.dtype, precision: str, tmp_path: Path) -> None:
    tensors = weights(dtype)
    from_file, from_memory = (
        loaded(tensors, tmp_path, precision=precision),
        made(tensors, precision=precision),
    )
    assert same(actions(from_file), actions(from_memory))
    assert from_memory.nbytes == from_file.nbytes
    assert from_memory.config == from_file.config
    assert from_memory.embodiment_ids == (0, 1, 2)


def test_numpy_arrays_of_any_strides_and_byte_order(tmp_path: Path) -> None:
    tensors = weights(torch.float16)
    expected = actions(loaded(tensors, tmp_path))

    def strided(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        wide = np.zeros((*array.shape, 2), array.dtype)[..., 1]
        wide[...] = array
        return wide

    given = {name: tensor.numpy() for name, tensor in tensors.items()}
    forms: list[Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]] = [
        strided,
        np.asfortranarray,
        lambda array: array.astype(array.dtype.newbyteorder(">")),
        lambda array: array[::-1].copy()[::-1],
    ]
    for form in forms:
        assert same(actions(made({name: form(array) for name, array in given.items()})), expected)
    for array in given.values():
        array.flags.writeable = False
    assert same(actions(made(given)), expected)


def test_parameters_and_transposed_tensors(tmp_path: Path) -> None:
    tensors = weights(torch.bfloat16)
    expected = actions(loaded(tensors, tmp_path))
    given = {
        name: torch.nn.Parameter(t.t().contiguous().t() if t.ndim == 2 else t) for name, t in tensors.items()
    }
    assert not given[WEIGHT].is_contiguous()
    assert same(actions(made(given)), expected)


def test_one_embodiment(tmp_path: Path) -> None:
    tensors = weights()
    one = made(tensors, embodiment_ids=[2], num_threads=1)
    assert one.embodiment_ids == (2,)
    assert one.num_threads == 1
    assert one.nbytes < made(tensors).nbytes
    assert same(actions(one, 2), actions(loaded(tensors, tmp_path), 2))
    with pytest.raises(saccade.InputError, match="embodiment"):
        actions(one, 1)


def test_other_embodiments_are_not_touched() -> None:
    """Pages of memory that were never touched are not there: a large table stays as good as empty."""
    config = {**CONFIG, "max_num_embodiments": 512}
    tensors: dict[str, Any] = dict(weights(config={**CONFIG, "max_num_embodiments": 1}))
    nbytes = 0
    for name, tensor in tensors.items():
        if name.startswith(("state_encoder", "action_encoder", "action_decoder")):
            # From the system, page by page.
            table = np.zeros((512, *tensor.shape[1:]), np.float32)
            table[511] = tensor[0].numpy()
            tensors[name], nbytes = table, nbytes + table.nbytes
    assert nbytes > 4e7
    before = resident_bytes()
    head = saccade.ActionHead.from_tensors(tensors, config=config, embodiment_ids=[511])
    assert head.embodiment_ids == (511,)
    assert resident_bytes() - before < nbytes / 4


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_nothing_of_the_callers_memory_is_kept() -> None:
    tensors = weights(torch.bfloat16)
    head = made(tensors)
    expected = actions(head)
    for tensor in tensors.values():
        tensor.fill_(torch.nan)
    assert same(actions(head), expected)


def test_what_only_training_uses_is_accepted() -> None:
    tensors = weights()
    expected = actions(made(tensors))
    unused = {
        "task_log_sigma.arm": torch.tensor(0.5),
        "task_log_sigma.claw": torch.zeros(1),
        "mask_token": torch.zeros(1, 1, 66),
        "dropout_prob_by_embodiment": torch.zeros(3),
    }
    assert same(actions(made({**tensors, **unused})), expected)
    with pytest.raises(saccade.CheckpointError, match="mask_token is unknown"):
        made({**tensors, "mask_token": torch.zeros(1, 1, 65)})
    with pytest.raises(saccade.CheckpointError, match=r"task_log_sigma\.arm is unknown"):
        made({**tensors, "task_log_sigma.arm": torch.zeros(2)})


def test_a_file_with_what_only_training_uses_is_accepted(tmp_path: Path) -> None:
    tensors = weights()
    expected = actions(made(tensors))
    assert same(actions(loaded({**tensors, "task_log_sigma.arm": torch.tensor(0.5)}, tmp_path)), expected)


def test_types() -> None:
    tensors: dict[Any, Any] = dict(weights())
    wrong: dict[Any, Any] = {
        WEIGHT: tensors[WEIGHT].double(),
        BIAS: tensors[BIAS].numpy().astype(np.int8),
        "model.proj_out_2.weight": tensors["model.proj_out_2.weight"].to("meta"),
        "model.proj_out_1.weight": tensors["model.proj_out_1.weight"].to_sparse(),
        "model.proj_out_1.bias": tensors["model.proj_out_1.bias"].tolist(),
        3: tensors[BIAS],
    }
    with pytest.raises(saccade.DtypeError) as caught:
        made({**tensors, **wrong})
    for line in (
        f"{WEIGHT}: expected float32, bfloat16 or float16, got float64",
        f"{BIAS}: expected float32, bfloat16 or float16, got int8",
        "model.proj_out_2.weight: expected a tensor on the CPU, got one on meta",
        "model.proj_out_1.weight: expected a dense tensor, got one of layout torch.sparse_coo",
        "model.proj_out_1.bias: expected an array, got list",
        "3: expected a name, got int",
    ):
        assert line in str(caught.value)
    with pytest.raises(saccade.DtypeError, match="expected a mapping of names to arrays, got list"):
        made(list(tensors.items()))  # type: ignore[arg-type]


def test_names_and_shapes() -> None:
    tensors = weights()
    with pytest.raises(saccade.ShapeError) as shape:
        made({**tensors, WEIGHT: tensors[WEIGHT][1:], BIAS: tensors[BIAS][None]})
    assert f"{WEIGHT} has shape (65, 66), expected (66, 66)" in str(shape.value)
    assert f"{BIAS} has shape (1, 51), expected (51,)" in str(shape.value)
    bad = {**tensors, WEIGHT: tensors[WEIGHT][1:], "extra": torch.zeros(1)}
    del bad[BIAS]
    with pytest.raises(saccade.CheckpointError) as caught:
        made(bad)
    for line in (
        "3 tensors do not fit the config",
        f"{WEIGHT} has shape (65, 66), expected (66, 66)",
        f"{BIAS} is missing, expected (51,)",
        "extra is unknown",
    ):
        assert line in str(caught.value)
    with pytest.raises(saccade.CheckpointError, match="is missing"):
        made({})


def test_options_and_config() -> None:
    tensors = weights()
    with pytest.raises(saccade.CheckpointError, match="max_state_dim"):
        saccade.ActionHead.from_tensors(
            tensors, config={k: v for k, v in CONFIG.items() if k != "max_state_dim"}
        )
    with pytest.raises(FileNotFoundError):
        saccade.ActionHead.from_tensors(tensors, config="nowhere.json")
    wrong: list[dict[str, Any]] = [
        {"embodiment_ids": [3]},
        {"embodiment_ids": []},
        {"precision": "fp8"},
        {"num_threads": 0},
    ]
    for options in wrong:
        with pytest.raises(saccade.InputError):
            made(tensors, **options)


def test_such_a_head_is_not_pickled(tmp_path: Path) -> None:
    head = made(weights())
    for action in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match=r"from_tensors cannot be pickled .* ActionHead\.from_pretrained"):
            action(head)
    save(tmp_path, random_head(CONFIG, 1), CONFIG)
    from_file = saccade.ActionHead.from_pretrained(tmp_path)
    assert same(actions(pickle.loads(pickle.dumps(from_file))), actions(from_file))
