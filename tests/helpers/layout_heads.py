"""Small heads of every published layout: their configs, and the names, shapes and values of their tensors.

Names, shapes and keys are those of the published files, sizes are not: two heads of the published 48 in the
diffusion transformer, two of 64 in the VL self-attention, four blocks. Tensors are listed here and not taken
from saccade, so that a name or a shape that saccade gets wrong shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from saccade_lab.reference.random_weights import random_tensor

# Small tensors gain nothing from threads, and on a busy machine every barrier between them stalls.
torch.set_num_threads(1)

Config = dict[str, Any]
Shapes = dict[str, tuple[int, ...]]

NUM_EMBODIMENTS = 32


def n15_head() -> Config:
    """The head's config of NVIDIA's GR00T N1.5, small."""
    return {
        "action_dim": 8,
        "action_horizon": 16,
        "add_pos_embed": True,
        "backbone_embedding_dim": 128,
        "diffusion_model_cfg": dit() | {"cross_attention_dim": 128},
        "hidden_size": 40,
        "input_embedding_dim": 96,
        "max_action_dim": 8,
        "max_state_dim": 12,
        "model_dtype": "float32",
        "noise_beta_alpha": 1.5,
        "noise_beta_beta": 1.0,
        "noise_s": 0.999,
        "num_inference_timesteps": 4,
        "num_target_vision_tokens": 32,
        "num_timestep_buckets": 1000,
        "tune_diffusion_model": True,
        "tune_projector": True,
        "use_vlln": True,
        "vl_self_attention_cfg": vl_self_attention(),
    }


def dit() -> Config:
    """The config of the diffusion transformer that all versions share."""
    return {
        "attention_head_dim": 48,
        "dropout": 0.2,
        "final_dropout": True,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 2,
        "num_layers": 4,
        "output_dim": 40,
        "positional_embeddings": None,
    }


def vl_self_attention() -> Config:
    """The config of the VL self-attention."""
    return {
        "attention_head_dim": 64,
        "dropout": 0.2,
        "final_dropout": True,
        "num_attention_heads": 2,
        "num_layers": 2,
        "positional_embeddings": None,
    }


def n1_head() -> Config:
    """GR00T N1: no future tokens, no norm and self-attention of the vision-language tokens, keys from the
    head's own width."""
    config = n15_head()
    for key in ("num_target_vision_tokens", "use_vlln", "vl_self_attention_cfg"):
        del config[key]
    del config["diffusion_model_cfg"]["cross_attention_dim"]
    return config | {"backbone_embedding_dim": 96}


def n17_head() -> Config:
    """GR00T N1.7 in the flat `config.json`."""
    return {
        "action_horizon": 40,
        "add_pos_embed": True,
        "attend_text_every_n_blocks": 2,
        "backbone_embedding_dim": 128,
        "diffusion_model_cfg": dit() | {"num_layers": 8},
        "hidden_size": 40,
        "input_embedding_dim": 96,
        "max_action_dim": 10,
        "max_num_embodiments": NUM_EMBODIMENTS,
        "max_seq_len": 1024,
        "max_state_dim": 12,
        "noise_beta_alpha": 1.5,
        "noise_beta_beta": 1.0,
        "noise_s": 0.999,
        "num_inference_timesteps": 4,
        "num_timestep_buckets": 1000,
        "state_dropout_prob": 0.2,
        "state_history_length": 1,
        "use_alternate_vl_dit": True,
        "use_vl_self_attention": True,
        "use_vlln": True,
        "vl_self_attention_cfg": vl_self_attention(),
    }


def n16_head() -> Config:
    """GR00T N1.6: no VL self-attention, no history of states."""
    config = n17_head()
    for key in ("state_history_length", "use_vl_self_attention", "vl_self_attention_cfg"):
        del config[key]
    return config | {"action_horizon": 50, "state_additive_noise_scale": 0.0}


def head_config(layout: str) -> Config:
    """The head's config of a layout, in released keys, as `config` of `ActionHead.from_pretrained`."""
    heads = {"n1": n1_head, "n16": n16_head, "n17": n17_head, "lerobot-n17": n17_head}
    config = heads.get(layout, n15_head)()
    if layout == "fork":
        config |= {"use_multi_action_heads": True, "action_arm_dim": 4, "action_claw_dim": 2}
        config |= {"action_dim": 6, "pretrained_action_dim": 8, "use_learnable_loss_weights": True}
    if layout == "fork-split":
        config |= {"use_multi_action_heads": True, "split_arm_heads": True, "use_shared_arm_features": False}
        config |= {"action_left_arm_dim": 3, "action_right_arm_dim": 2, "action_arm_dim": 5}
        config |= {"action_claw_dim": 2, "action_dim": 7, "pretrained_action_dim": 8}
        config |= {"use_learnable_loss_weights": False, "num_target_vision_tokens": 64}
    if layout == "saccade":
        config |= {"max_num_embodiments": NUM_EMBODIMENTS, "max_seq_len": 1024}
    model_types = {"n1": "gr00t_n1", "n16": "Gr00tN1d6", "n17": "Gr00tN1d7", "lerobot-n17": "Gr00tN1d7"}
    return {"model_type": model_types.get(layout, "gr00t_n1_5"), **config}


def head_shapes(config: Mapping[str, Any]) -> Shapes:
    """Name and shape of each tensor of the head that the released code builds from this config."""
    width, hidden, context = (
        config[key] for key in ("input_embedding_dim", "hidden_size", "backbone_embedding_dim")
    )
    embodiments = config.get("max_num_embodiments", 32)
    actions = config.get("pretrained_action_dim", config["max_action_dim"])
    state = config["max_state_dim"] * config.get("state_history_length", 1)
    shapes: Shapes = {}

    def category(name: str, inputs: int, outputs: int) -> None:
        shapes[f"{name}.W"] = (embodiments, inputs, outputs)
        shapes[f"{name}.b"] = (embodiments, outputs)

    def linear(name: str, inputs: int, outputs: int) -> None:
        shapes[f"{name}.weight"] = (outputs, inputs)
        shapes[f"{name}.bias"] = (outputs,)

    def norm(name: str) -> None:
        shapes[f"{name}.weight"] = (context,)
        shapes[f"{name}.bias"] = (context,)

    def attention(name: str, inner: int, keys: int) -> None:
        linear(f"{name}.to_q", inner, inner)
        linear(f"{name}.to_k", keys, inner)
        linear(f"{name}.to_v", keys, inner)
        linear(f"{name}.to_out.0", inner, inner)

    def feed_forward(name: str, inner: int) -> None:
        linear(f"{name}.net.0.proj", inner, 4 * inner)
        linear(f"{name}.net.2", 4 * inner, inner)

    category("state_encoder.layer1", state, hidden)
    category("state_encoder.layer2", hidden, width)
    category("action_encoder.W1", actions, width)
    category("action_encoder.W2", 2 * width, width)
    category("action_encoder.W3", width, width)
    for name, outputs in decoders(config).items():
        category(f"{name}.layer1", hidden, hidden)
        category(f"{name}.layer2", hidden, outputs)
    if config.get("use_learnable_loss_weights"):
        shapes["task_log_sigma.arm"] = shapes["task_log_sigma.claw"] = ()
    if config.get("num_target_vision_tokens") is not None:
        shapes["future_tokens.weight"] = (config["num_target_vision_tokens"], width)
    if config.get("use_vlln"):
        norm("vlln")
    for block in range((config.get("vl_self_attention_cfg") or {}).get("num_layers", 0)):
        name = f"vl_self_attention.transformer_blocks.{block}"
        norm(f"{name}.norm1")
        attention(f"{name}.attn1", context, context)
        norm(f"{name}.norm3")
        feed_forward(f"{name}.ff", context)
    shapes["position_embedding.weight"] = (config.get("max_seq_len", 1024), width)
    linear("model.timestep_encoder.timestep_embedder.linear_1", 256, width)
    linear("model.timestep_encoder.timestep_embedder.linear_2", width, width)
    for block in range(config["diffusion_model_cfg"]["num_layers"]):
        name = f"model.transformer_blocks.{block}"
        linear(f"{name}.norm1.linear", width, 2 * width)
        attention(f"{name}.attn1", width, width if block % 2 else context)
        feed_forward(f"{name}.ff", width)
    linear("model.proj_out_1", width, 2 * width)
    linear("model.proj_out_2", width, hidden)
    return shapes


def decoders(config: Mapping[str, Any]) -> dict[str, int]:
    """Module and width of each action decoder, in the order in which their actions are concatenated."""
    if not config.get("use_multi_action_heads"):
        return {"action_decoder": config["max_action_dim"]}
    if config.get("split_arm_heads"):
        arms = {f"action_{side}_arm_decoder": config[f"action_{side}_arm_dim"] for side in ("left", "right")}
    else:
        arms = {"action_arm_decoder": config["action_arm_dim"]}
    return {**arms, "action_claw_decoder": config["action_claw_dim"]}


def initial_tensor(name: str, shape: Sequence[int], generator: torch.Generator) -> Tensor:
    """One tensor as the released constructors leave it, before any training."""
    if name.endswith(".W"):
        return 0.02 * torch.randn(tuple(shape), generator=generator)
    if name in ("future_tokens.weight", "position_embedding.weight"):
        return 0.02 * torch.randn(tuple(shape), generator=generator)
    if name.endswith(".b") or name.startswith("task_log_sigma"):
        return torch.zeros(tuple(shape))
    if name.startswith("vlln") or (".norm1." in name and "linear" not in name) or ".norm3." in name:
        return torch.ones(tuple(shape)) if name.endswith("weight") else torch.zeros(tuple(shape))
    # nn.Linear draws weight and bias from +-1 / sqrt(inputs); the inputs of a bias are its weight's.
    inputs = shape[1] if len(shape) == 2 else bias_inputs(name, shape[0])
    bound = 1 / math.sqrt(inputs)
    return (2 * torch.rand(tuple(shape), generator=generator) - 1) * bound


def bias_inputs(name: str, outputs: int) -> int:
    """Inputs of the linear layer that a bias belongs to, where all of them are equally wide; the shape of its
    weight where they are not is not needed for a distribution that looks right."""
    if ".ff.net.0" in name:
        return outputs // 4
    if ".ff.net.2" in name:
        return outputs * 4
    return 256 if "linear_1" in name else outputs


def head_tensors(
    config: Mapping[str, Any],
    *,
    seed: int = 0,
    trained: Sequence[int] | None = None,
    fresh: bool = False,
) -> dict[str, Tensor]:
    """A head's tensors in float32.

    Args:
        config: from `head_config`.
        seed: of all of them.
        trained: embodiments whose layers are not as initialised; default all.
        fresh: leave every tensor as the released constructors initialise it.
    """
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, shape in head_shapes(config).items():
        initial = initial_tensor(name, shape, generator)
        if fresh or name.startswith("task_log_sigma"):
            tensors[name] = initial
            continue
        tensors[name] = random_tensor(name, torch.Size(shape), generator)
        if trained is not None and name.endswith((".W", ".b")):
            initial[list(trained)] = tensors[name][list(trained)]
            tensors[name] = initial
    return tensors
