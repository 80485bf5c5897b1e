"""One head twice: random weights in the Rust head and in the torch reference in float64."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor

import saccade
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head
from tests.helpers.reference_cases import KINDS, small_config, variant_config
from tests.helpers.released import load_released

TOLERANCE = 1e-5
TAME = (
    TOLERANCE / 4
)  # weights are tame if torch's own float32 is this close; others say nothing about the engine


@st.composite
def configs(draw: st.DrawFn) -> dict[str, Any]:
    """Sizes from the smallest up to a little more than a kernel's tile, odd ones among them."""
    num_heads, vl_num_heads = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    # The time embedding of the action encoder is half sines and half cosines, so the width is even.
    # A LayerNorm over two or three values can blow up rounding, so norms are a little wider than that.
    head_dims = [6, 10, 16, 48] if num_heads % 2 else [3, 4, 7, 16, 20]
    vl_head_dims = [7, 8, 64] if vl_num_heads == 1 else [3, 8, 17]
    head_dim, vl_head_dim = draw(st.sampled_from(head_dims)), draw(st.sampled_from(vl_head_dims))
    return small_config(
        num_layers=draw(st.integers(1, 5)),
        num_heads=num_heads,
        head_dim=head_dim,
        interleave=draw(st.booleans()),
        context_dim=vl_num_heads * vl_head_dim,
        vl_num_layers=draw(st.integers(0, 2)),
        vl_num_heads=vl_num_heads,
        use_vlln=draw(st.booleans()),
        num_future_tokens=draw(st.sampled_from([0, 1, 2, 5, 32])),
        action_horizon=draw(st.integers(1, 17)),
        action_dim=draw(st.integers(1, 33)),
        state_dim=draw(st.integers(1, 65)),
        hidden_dim=draw(st.integers(1, 50)),
        num_embodiments=draw(st.integers(1, 4)),
        num_steps=draw(st.integers(1, 6)),
        add_pos_embed=draw(st.booleans()),
    )


@st.composite
def variant_configs(draw: st.DrawFn) -> dict[str, Any]:
    """Heads of every kind, small and of odd sizes."""
    kind = draw(st.sampled_from(KINDS))
    num_heads, vl_num_heads = draw(st.integers(1, 3)), draw(st.integers(1, 2))
    action_dim = draw(st.integers(3, 9))
    return variant_config(
        kind,
        attend_text_every_n_blocks=draw(st.integers(1, 3)),
        state_history=draw(st.integers(1, 3)),
        encoder_action_dim=action_dim + draw(st.integers(0, 5)),
        num_layers=draw(st.integers(1, 9)),
        num_heads=num_heads,
        head_dim=draw(st.sampled_from([6, 10, 16] if num_heads % 2 else [7, 8, 20])),
        context_dim=vl_num_heads * draw(st.sampled_from([7, 17])),
        vl_num_layers=draw(st.integers(0, 2)),
        vl_num_heads=vl_num_heads,
        use_vlln=True if kind == "n1" else draw(st.booleans()),
        num_future_tokens=draw(st.sampled_from([0, 1, 5, 32])),
        action_horizon=draw(st.integers(1, 17)),
        action_dim=action_dim,
        state_dim=draw(st.integers(1, 17)),
        hidden_dim=draw(st.integers(1, 30)),
        num_embodiments=draw(st.integers(1, 4)),
        num_steps=draw(st.integers(1, 4)),
    )


def random_masks(
    config: saccade.HeadConfig, rng: np.random.Generator, batch: int, num_vl_tokens: int
) -> dict[str, Any]:
    """Masks that leave an attended text and an attended image token in every observation, in any places.

    Returns:
        `drop_vl`, `attention_mask` and `image_mask` for a head with alternate masks, else `drop_vl` alone;
        bool `(batch, num_vl_tokens)`.
    """
    shape = (batch, num_vl_tokens)
    drop_vl = rng.random(shape) < 0.2
    if config.mask_mode == "none":
        return {"drop_vl": drop_vl}
    attended, image = rng.random(shape) < 0.7, rng.random(shape) < rng.choice([0.1, 0.5, 0.9])
    for row in range(batch):
        text_token, image_token = rng.choice(num_vl_tokens, 2, replace=False)
        attended[row, [text_token, image_token]] = True
        drop_vl[row, [text_token, image_token]] = False
        image[row, text_token], image[row, image_token] = False, True
    return {"drop_vl": drop_vl, "attention_mask": attended, "image_mask": image}


def save(
    folder: Path, reference: Reference, config: dict[str, Any], dtype: torch.dtype = torch.float32
) -> None:
    """The reference's weights in the published layout."""
    tensors = {f"action_head.{name}": t.to(dtype).contiguous() for name, t in reference.state_dict().items()}
    save_file(tensors, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(config))


def both(
    config: dict[str, Any], seed: int, dtype: torch.dtype = torch.float32
) -> tuple[saccade.ActionHead, Reference]:
    """The same weights, rounded to `dtype`, in the Rust head and in the reference in float64."""
    reference = random_head(config, seed, dtype=dtype).double()
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder), reference, config, dtype)
        return saccade.ActionHead.from_pretrained(folder), reference


def arrays(inputs: dict[str, Tensor]) -> dict[str, Any]:
    return {name: tensor.numpy() for name, tensor in inputs.items()}


def same(first: Any, second: Any) -> bool:
    """Whether two results have the same bits."""
    return bool(np.array_equal(np.asarray(first), np.asarray(second)))


def tiny_head() -> saccade.ActionHead:
    """The released head of a few layers."""
    released = load_released("n15_tiny")
    return saccade.ActionHead.from_pretrained(released.path, config=released.config)


def three_observations(head: saccade.ActionHead) -> dict[str, Any]:
    """A context of three observations, and what a chunk starts from."""
    rng = np.random.default_rng(7)
    config = head.config
    return {
        "context": head.encode(rng.standard_normal((3, 8, config.context_dim), np.float32)),
        "state": rng.standard_normal((3, config.state_dim), np.float32),
        "embodiment_id": [1, 0, 1],
        "noise": rng.standard_normal((3, config.action_horizon, config.encoder_action_dim), np.float32),
    }


def rms(values: NDArray[np.float64]) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
