"""Configs and small helpers for tests with the torch reference."""

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

# Small tensors gain nothing from threads, and on a busy machine every barrier between them stalls.
torch.set_num_threads(1)


def small_config(
    *,
    num_layers: int = 4,
    num_heads: int = 3,
    head_dim: int = 4,
    interleave: bool = True,
    context_dim: int = 10,
    vl_num_layers: int = 1,
    vl_num_heads: int = 2,
    use_vlln: bool = True,
    num_future_tokens: int = 4,
    action_horizon: int = 5,
    action_dim: int = 3,
    state_dim: int = 6,
    hidden_dim: int = 14,
    num_embodiments: int = 3,
    num_steps: int = 3,
    add_pos_embed: bool = True,
) -> dict[str, Any]:
    """A head's config in the released key names; every size differs, so that a mix-up shows."""
    return {
        "action_dim": action_dim,
        "action_horizon": action_horizon,
        "add_pos_embed": add_pos_embed,
        "backbone_embedding_dim": context_dim,
        "hidden_size": hidden_dim,
        "input_embedding_dim": num_heads * head_dim,
        "max_action_dim": action_dim,
        "max_num_embodiments": num_embodiments,
        "max_seq_len": action_horizon + 2,
        "max_state_dim": state_dim,
        "model_dtype": "float32",
        "noise_beta_alpha": 1.5,
        "noise_beta_beta": 1.0,
        "noise_s": 0.999,
        "num_inference_timesteps": num_steps,
        "num_target_vision_tokens": num_future_tokens,
        "num_timestep_buckets": 1000,
        "tune_diffusion_model": True,
        "tune_projector": True,
        "use_vlln": use_vlln,
        "diffusion_model_cfg": {
            "attention_head_dim": head_dim,
            "cross_attention_dim": context_dim,
            "dropout": 0.2,
            "final_dropout": True,
            "interleave_self_attention": interleave,
            "norm_type": "ada_norm",
            "num_attention_heads": num_heads,
            "num_layers": num_layers,
            "output_dim": hidden_dim,
            "positional_embeddings": None,
        },
        "vl_self_attention_cfg": {
            "attention_head_dim": context_dim // vl_num_heads,
            "dropout": 0.2,
            "final_dropout": True,
            "num_attention_heads": vl_num_heads,
            "num_layers": vl_num_layers,
            "positional_embeddings": None,
        },
    }


def relative_error(given: ArrayLike, expected: ArrayLike) -> float:
    """Largest |given - expected| / max(1, |expected|); nan if anything is nan."""
    given, expected = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    assert given.shape == expected.shape
    return float((np.abs(given - expected) / np.maximum(1.0, np.abs(expected))).max())
