"""Bad input of the cross-attention alone: a typed error that names the thing, what was given and expected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import saccade

Shape, Dtype, Input = saccade.ShapeError, saccade.DtypeError, saccade.InputError


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
