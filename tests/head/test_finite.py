"""Numbers that are not finite: refused in weights, and never given to a robot."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file

import saccade
from tests.helpers.released import Released, load_released

WEIGHTS = (
    ("model.transformer_blocks.1.attn1.to_k.weight", (3, 5)),
    ("model.transformer_blocks.0.norm1.linear.bias", (7,)),
    ("vlln.weight", (2,)),
    ("future_tokens.weight", (1, 4)),
    ("position_embedding.weight", (2, 0)),
    ("state_encoder.layer1.W", (1, 3, 2)),
    ("action_encoder.W2.b", (1, 6)),
    ("action_decoder.layer2.b", (1, 0)),
)


@pytest.fixture(scope="module")
def tiny() -> Released:
    return load_released("n15_tiny")


@pytest.fixture(scope="module")
def head(tiny: Released) -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(tiny.path, config=tiny.config)


def tensors_of(released: Released) -> dict[str, NDArray[np.float32]]:
    prefix = "action_head."
    with safe_open(released.path, framework="np") as file:
        names = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118
        return {name.removeprefix(prefix): file.get_tensor(name) for name in names}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("name", "index"), WEIGHTS)
def test_weights_that_are_not_finite_are_refused(
    tiny: Released, tmp_path: Path, name: str, index: tuple[int, ...], bad: float
) -> None:
    tensors = tensors_of(tiny)
    tensors[name] = tensors[name].copy()
    tensors[name][index] = bad
    shown = re.escape(str(index))
    message = f"{re.escape(name)}: expected finite weights, got .* at index {shown}"
    with pytest.raises(saccade.CheckpointError, match=message):
        saccade.ActionHead.from_tensors(tensors, config=tiny.config)
    save_file(tensors, tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text(json.dumps(tiny.config))
    with pytest.raises(saccade.CheckpointError, match=message):
        saccade.ActionHead.from_pretrained(tmp_path)


def test_weights_of_embodiments_that_are_not_loaded_are_not_looked_at(tiny: Released) -> None:
    tensors = tensors_of(tiny)
    tensors["state_encoder.layer1.W"] = tensors["state_encoder.layer1.W"].copy()
    tensors["state_encoder.layer1.W"][1] = np.nan
    saccade.ActionHead.from_tensors(tensors, config=tiny.config, embodiment_ids=[0, 2])


def huge_decoder(tiny: Released) -> saccade.ActionHead:
    """Finite weights whose outputs are not."""
    tensors = tensors_of(tiny)
    tensors["action_decoder.layer2.b"] = np.full_like(tensors["action_decoder.layer2.b"], 3e38)
    return saccade.ActionHead.from_tensors(tensors, config=tiny.config)


def test_actions_that_are_not_finite_are_an_error(tiny: Released) -> None:
    head = huge_decoder(tiny)
    context = head.encode(tiny.backbone_features)
    noise = np.full_like(tiny.noise, 3e38)
    out = np.full((*noise.shape[:2], head.config.action_dim), 7.0, np.float32)
    arguments: dict[str, Any] = {"noise": noise, "num_steps": 1}
    with pytest.raises(
        saccade.InputError, match=r"actions: the result is not finite, NaN at index \(0, 0, 0\)"
    ):
        head.sample(context, tiny.state, 1, out=out, **arguments)
    np.testing.assert_array_equal(out, 7.0)  # nothing of it was written
    with pytest.raises(saccade.InputError, match="actions: the result is not finite"):
        head.trace(context, tiny.state, 1, **arguments)


def test_inputs_too_large_for_the_arithmetic_are_an_error(head: saccade.ActionHead, tiny: Released) -> None:
    context = head.encode(tiny.backbone_features)
    huge = np.full_like(tiny.state, 3e38)
    with pytest.raises(saccade.InputError, match="not finite"):
        head.sample(context, huge, 1, noise=tiny.noise)
    with pytest.raises(saccade.InputError, match="not finite"):
        head.velocity(context, huge, 1, tiny.noise, 0)
    features = tiny.backbone_features.copy()
    features[..., ::2] = 3e38
    features[..., 1::2] = -3e38
    with pytest.raises(saccade.InputError, match="vl_embs: the result is not finite"):
        head.encode(features)


def test_a_cross_attention_that_is_not_finite_is_an_error() -> None:
    weights = {name: np.full((8, 8), 1e30, np.float32) for name in ("to_q", "to_k", "to_v", "to_out.0")}
    tensors: dict[str, Any] = {f"{name}.weight": weight for name, weight in weights.items()}
    tensors |= {f"{name}.bias": np.zeros(8, np.float32) for name in weights}
    layer = saccade.CrossAttention(tensors, 2)
    keys = layer.project(np.ones((1, 3, 8), np.float32))
    with pytest.raises(saccade.InputError, match="the result is not finite"):
        layer(np.ones((1, 2, 8), np.float32), keys)
