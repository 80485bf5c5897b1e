"""Seeded random heads and inputs of the released sizes or others, for tests and benchmarks."""

import copy
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from saccade.config import HeadConfig
from saccade.reference.head import ActionHead

N1_CONFIG: Mapping[str, Any] = {
    "action_dim": 32,
    "action_horizon": 16,
    "add_pos_embed": True,
    "backbone_embedding_dim": 1536,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_action_dim": 32,
    "max_num_embodiments": 32,
    "max_seq_len": 1024,
    "max_state_dim": 64,
    "model_dtype": "float32",
    "noise_beta_alpha": 1.5,
    "noise_beta_beta": 1.0,
    "noise_s": 0.999,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "tune_diffusion_model": True,
    "tune_projector": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "cross_attention_dim": None,
        "dropout": 0.2,
        "final_dropout": True,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 32,
        "num_layers": 16,
        "output_dim": 1024,
        "positional_embeddings": None,
    },
}
"""Config of the head of nvidia/GR00T-N1-2B. It has neither future tokens nor VL self-attention, and its
vision-language tokens are as wide as the rows. Width of the state, number of embodiments and steps are not
confirmed."""

N15_CONFIG: Mapping[str, Any] = {
    **N1_CONFIG,
    "backbone_embedding_dim": 2048,
    "num_target_vision_tokens": 32,
    "use_vlln": True,
    "diffusion_model_cfg": {**N1_CONFIG["diffusion_model_cfg"], "cross_attention_dim": 2048},
    "vl_self_attention_cfg": {
        "attention_head_dim": 64,
        "dropout": 0.2,
        "final_dropout": True,
        "num_attention_heads": 32,
        "num_layers": 4,
        "positional_embeddings": None,
    },
}
"""Config of the head of nvidia/GR00T-N1.5-3B, including the two class defaults that the file omits."""

N17_CONFIG: Mapping[str, Any] = {
    "model_type": "Gr00tN1d7",
    "action_horizon": 40,
    "add_pos_embed": True,
    "attend_text_every_n_blocks": 2,
    "backbone_embedding_dim": 2048,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_action_dim": 132,
    "max_num_embodiments": 32,
    "max_seq_len": 1024,
    "max_state_dim": 132,
    "model_dtype": "bfloat16",
    "noise_beta_alpha": 1.5,
    "noise_beta_beta": 1.0,
    "noise_s": 0.999,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "state_dropout_prob": 0.2,
    "state_history_length": 1,
    "tune_diffusion_model": True,
    "tune_projector": True,
    "tune_vlln": True,
    "use_alternate_vl_dit": True,
    "use_vlln": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "dropout": 0.2,
        "final_dropout": True,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 32,
        "num_layers": 32,
        "output_dim": 1024,
        "positional_embeddings": None,
    },
    "vl_self_attention_cfg": N15_CONFIG["vl_self_attention_cfg"],
}
"""The keys about the head in the config of nvidia/GR00T-N1.7-3B, which has no `action_head_cfg`."""

N16_CONFIG: Mapping[str, Any] = {
    **{
        key: value
        for key, value in N17_CONFIG.items()
        if key not in ("state_history_length", "vl_self_attention_cfg")
    },
    "model_type": "Gr00tN1d6",
    "action_horizon": 50,
    "max_action_dim": 128,
    "max_state_dim": 128,
    "state_dropout_prob": 0.0,
}
"""The same for nvidia/GR00T-N1.6-3B, which has no VL self-attention."""

FORK_CONFIG: Mapping[str, Any] = {
    **N15_CONFIG,
    "action_arm_dim": 14,
    "action_claw_dim": 2,
    "action_dim": 16,
    "max_action_dim": 16,
    "pretrained_action_dim": 32,
    "use_learnable_loss_weights": True,
    "use_multi_action_heads": True,
}
"""The N1.5 head of the humanoid_groot fork, with one decoder for the arms and one for the claws."""

SPLIT_ARMS_CONFIG: Mapping[str, Any] = {
    **FORK_CONFIG,
    "action_arm_dim": 18,
    "action_dim": 20,
    "action_left_arm_dim": 9,
    "action_right_arm_dim": 9,
    "max_action_dim": 20,
    "split_arm_heads": True,
    "use_cross_attention_arms": False,
    "use_shared_arm_features": False,
}
"""The same fork with a decoder for each arm."""

CONFIGS: Mapping[str, Mapping[str, Any]] = {
    "n1": N1_CONFIG,
    "n1.5": N15_CONFIG,
    "n1.6": N16_CONFIG,
    "n1.7": N17_CONFIG,
    "fork": FORK_CONFIG,
    "split-arms": SPLIT_ARMS_CONFIG,
}
"""All heads with their published sizes."""


def sized_config(
    kind: str,
    *,
    num_layers: int | None = None,
    vl_num_layers: int | None = None,
    num_embodiments: int | None = None,
) -> dict[str, Any]:
    """A copy of one of `CONFIGS`, optionally with fewer blocks or embodiments to save memory and time."""
    config = copy.deepcopy(dict(CONFIGS[kind]))
    if num_layers is not None:
        config["diffusion_model_cfg"]["num_layers"] = num_layers
    if vl_num_layers is not None and "vl_self_attention_cfg" in config:
        config["vl_self_attention_cfg"]["num_layers"] = vl_num_layers
    if num_embodiments is not None:
        config["max_num_embodiments"] = num_embodiments
    return config


def n15_config(*, num_layers: int = 16, vl_num_layers: int = 4, num_embodiments: int = 32) -> dict[str, Any]:
    """`sized_config("n1.5")`."""
    return sized_config(
        "n1.5", num_layers=num_layers, vl_num_layers=vl_num_layers, num_embodiments=num_embodiments
    )


def small_config(kind: str = "n1.5") -> dict[str, Any]:
    """One of `CONFIGS` with small sizes, so that a test takes milliseconds."""
    # Six blocks with alternate masks: text, image and text again.
    alternate = "use_alternate_vl_dit" in CONFIGS[kind]
    config = sized_config(kind, num_layers=6 if alternate else 4, vl_num_layers=2, num_embodiments=3)
    context_dim = 96 if kind == "n1" else 128
    config |= {"backbone_embedding_dim": context_dim, "hidden_size": 64, "input_embedding_dim": 96}
    config["max_seq_len"] = max(16, config["action_horizon"])
    config["diffusion_model_cfg"] |= {"num_attention_heads": 2, "output_dim": 64}
    if config["diffusion_model_cfg"].get("cross_attention_dim") is not None:
        config["diffusion_model_cfg"]["cross_attention_dim"] = context_dim
    if "vl_self_attention_cfg" in config:
        config["vl_self_attention_cfg"] |= {"num_attention_heads": 2}
    return config


def whole_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a checkpoint's `config.json` that describes the head.

    N1.6 and N1.7 have one flat object. In earlier versions the head has an object of its own.
    """
    if "model_type" in config:
        return dict(config)
    model_type = "gr00t_n1_5" if "num_target_vision_tokens" in config else "gr00t_n1"
    return {"model_type": model_type, "action_head_cfg": dict(config)}


def unused_parameters(config: Mapping[str, Any]) -> list[str]:
    """Parameters that the released code creates from a config, but that inference does not use."""
    names = []
    if config.get("use_multi_action_heads") and config.get("use_learnable_loss_weights"):
        arms = ["left_arm", "right_arm"] if config.get("split_arm_heads") else ["arm"]
        names += [f"task_log_sigma.{part}" for part in [*arms, "claw"]]
    if config.get("model_type") == "Gr00tN1d6" and config.get("state_dropout_prob", 0.0) > 0:
        names.append("mask_token")
    return names


def random_head(config: Mapping[str, Any], seed: int, *, dtype: torch.dtype = torch.float32) -> ActionHead:
    """A head with random tensors only, so that a missing or transposed one shows in the result."""
    with torch.device("meta"):
        head = ActionHead(HeadConfig.from_dict(config), unused=unused_parameters(config))
    generator = torch.Generator().manual_seed(seed)
    shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
    tensors = {name: random_tensor(name, shape, generator).to(dtype) for name, shape in shapes.items()}
    head.load_state_dict(tensors, assign=True)
    return head


def write_checkpoint(
    folder: Path,
    config: Mapping[str, Any],
    seed: int,
    *,
    dtype: torch.dtype = torch.float32,
    through: torch.dtype = torch.float32,
    shard_bytes: int = 2**28,
) -> None:
    """Writes the tensors of `random_head(config, seed)` as a checkpoint in the published layout.

    Args:
        folder: the directory of `config.json` and `model-*.safetensors`.
        config: the config of the head in the released names.
        seed: seed of the weights.
        dtype: dtype of the stored tensors.
        through: dtype that they are rounded to first, so that files in two dtypes can have equal values.
        shard_bytes: a shard is complete when it reaches this size.
    """
    with torch.device("meta"):
        head = ActionHead(HeadConfig.from_dict(config), unused=unused_parameters(config))
    shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
    generator = torch.Generator().manual_seed(seed)
    shard: dict[str, Tensor] = {}
    num_shards, held = 0, 0
    for index, (name, shape) in enumerate(shapes.items(), start=1):
        shard[f"action_head.{name}"] = random_tensor(name, shape, generator).to(through).to(dtype)
        held += shard[f"action_head.{name}"].nbytes
        if held >= shard_bytes or index == len(shapes):
            num_shards += 1
            save_file(shard, folder / f"model-{num_shards:05}.safetensors")
            shard, held = {}, 0
    (folder / "config.json").write_text(json.dumps(whole_config(config), indent=1))


def random_tensor(name: str, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """One tensor of `random_head` in float32, scaled so that activations stay of order one.

    Args:
        name: name in the checkpoint, which distinguishes weights, biases, norms and tables.
        shape: shape of the tensor.
        generator: advances.
    """
    drawn = torch.randn(shape, generator=generator)
    if name.endswith((".bias", ".b")) or not shape:
        return 0.1 * drawn
    if name.endswith(".W"):
        return drawn / math.sqrt(shape[1])  # (category, in, out)
    if name in ("future_tokens.weight", "position_embedding.weight"):
        return 0.5 * drawn
    if len(shape) == 1:
        return 1.0 + 0.1 * drawn  # a LayerNorm's scale
    return drawn / math.sqrt(shape[1])  # (out, in)


def random_inputs(config: HeadConfig, seed: int, *, batch: int, num_vl_tokens: int) -> dict[str, Tensor]:
    """Standard normal inputs, one random embodiment per row, and masks if the head needs them.

    Args:
        config: config of the head.
        seed: seed of all inputs.
        batch: number of observations.
        num_vl_tokens: T_vl.

    Returns:
        Arguments of `ActionHead.forward`: `backbone_features`, `state`, `noise` in float32, `embodiment_id`
        long. With alternate masks also those of `random_masks`.
    """
    generator = torch.Generator().manual_seed(seed)
    inputs = {
        "backbone_features": torch.randn(batch, num_vl_tokens, config.context_dim, generator=generator),
        "state": torch.randn(batch, config.state_history, config.state_dim, generator=generator),
        "noise": torch.randn(batch, config.action_horizon, config.encoder_action_dim, generator=generator),
        "embodiment_id": torch.randint(config.num_embodiments, (batch,), generator=generator),
    }
    if config.mask_mode == "alternate":
        inputs |= random_masks(generator, batch=batch, num_vl_tokens=num_vl_tokens)
    return inputs


def random_masks(generator: torch.Generator, *, batch: int, num_vl_tokens: int) -> dict[str, Tensor]:
    """Padding on the left and a sequence of image tokens, of different lengths in every row.

    Args:
        generator: advances.
        batch: number of observations.
        num_vl_tokens: T_vl, at least 2, since each row has an attended text and an attended image token.

    Returns:
        `attention_mask` and `image_mask`, bool `(batch, T_vl)`.
    """

    def draw(high: int) -> int:
        return int(torch.randint(high, (), generator=generator))

    attended = torch.ones(batch, num_vl_tokens, dtype=torch.bool)
    image = torch.zeros(batch, num_vl_tokens, dtype=torch.bool)
    for row in range(batch):
        length = num_vl_tokens - draw(num_vl_tokens // 2)  # of what is not padding
        num_images = 1 + draw(length - 1)
        first = num_vl_tokens - length + draw(length - num_images + 1)
        attended[row, : num_vl_tokens - length] = False
        image[row, first : first + num_images] = True
    return {"attention_mask": attended, "image_mask": image}
