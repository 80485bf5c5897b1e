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


#: What a head may be; "biased" is N1.5 with a bias on the keys of its future tokens.
KINDS = ("n1", "n1.5", "biased", "n1.6", "n1.7", "fork", "split-arms")


def variant_config(
    kind: str,
    *,
    attend_text_every_n_blocks: int = 2,
    state_history: int = 1,
    encoder_action_dim: int | None = None,
    **sizes: Any,
) -> dict[str, Any]:
    """`small_config(**sizes)` as another head, in the keys that its config has.

    Args:
        kind: one of `KINDS`.
        attend_text_every_n_blocks, state_history: of N1.6 and N1.7, and of N1.7.
        encoder_action_dim: of a fork; default two more than it decodes.
        sizes: of `small_config`; a fork has as many decoders as `action_dim` allows.
    """
    config = small_config(**sizes)
    if kind == "n1.5":
        return config
    if kind == "biased":
        bias = [0.7 - 0.5 * index for index in range(config["num_target_vision_tokens"])]
        return config | {"saccade": {"future_key_bias": bias}}
    if kind in ("fork", "split-arms"):
        return config | decoders(kind, config["action_dim"], encoder_action_dim)
    config["model_type"] = {"n1": "gr00t_n1", "n1.6": "Gr00tN1d6", "n1.7": "Gr00tN1d7"}[kind]
    del config["num_target_vision_tokens"]
    if kind == "n1":
        for key in ("use_vlln", "vl_self_attention_cfg"):
            del config[key]
        config["backbone_embedding_dim"] = config["input_embedding_dim"]
        config["diffusion_model_cfg"]["cross_attention_dim"] = None
        return config
    del config["action_dim"]
    del config["diffusion_model_cfg"]["cross_attention_dim"]
    config |= {"use_alternate_vl_dit": True, "attend_text_every_n_blocks": attend_text_every_n_blocks}
    if kind == "n1.6":
        del config["vl_self_attention_cfg"]
        return config
    return config | {"state_history_length": state_history}


def decoders(kind: str, action_dim: int, encoder_action_dim: int | None) -> dict[str, Any]:
    """The keys that a fork's config adds to that of N1.5."""
    encoded = action_dim + 2 if encoder_action_dim is None else encoder_action_dim
    config: dict[str, Any] = {
        "use_multi_action_heads": True,
        "use_learnable_loss_weights": True,
        "pretrained_action_dim": encoded,
        "action_claw_dim": 1,
        "action_arm_dim": action_dim - 1,
    }
    if kind == "split-arms":
        config |= {
            "split_arm_heads": True,
            "use_shared_arm_features": False,
            "use_cross_attention_arms": False,
            "action_left_arm_dim": 1,
            "action_right_arm_dim": action_dim - 2,
        }
    return config


def relative_error(given: ArrayLike, expected: ArrayLike) -> float:
    """Largest |given - expected| / max(1, |expected|); nan if anything is nan."""
    given, expected = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    assert given.shape == expected.shape
    return float((np.abs(given - expected) / np.maximum(1.0, np.abs(expected))).max())
