"""Fixtures made by the released code, small configs and small helpers that several test files share."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import safe_open
from torch import Tensor

DATA = Path(__file__).parent / "data"
FIXTURES = ("n15_tiny", "n15_single_view", "n15_bf16")


@dataclass(frozen=True)
class Fixture:
    """Inputs of one fixture file, and what the released code returned for them."""

    path: Path
    config: dict[str, Any]
    inputs: dict[str, Tensor]  # keyword arguments of ActionHead.forward
    vl_embs: Tensor
    actions_f32: Tensor
    actions_f64: Tensor

    @property
    def float32_error(self) -> float:
        """How far the released code in float32 is from itself in float64."""
        return float((self.actions_f32.double() - self.actions_f64).abs().max())


def load_fixture(name: str) -> Fixture:
    path = DATA / f"{name}.safetensors"
    with safe_open(path, framework="pt") as file:
        config = json.loads(file.metadata()["config"])
        tensors = {key: file.get_tensor(key) for key in file.keys() if key.startswith("_")}  # noqa: SIM118
    return Fixture(
        path=path,
        config=config,
        inputs={key.removeprefix("_in."): t for key, t in tensors.items() if key.startswith("_in.")},
        vl_embs=tensors["_out.vl_embs"],
        actions_f32=tensors["_out.f32"],
        actions_f64=tensors["_out.f64"],
    )


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


def relative_error(given: Tensor, expected: Tensor) -> float:
    """Largest |given - expected| / max(1, |expected|); nan if anything is nan."""
    given, expected = given.double(), expected.double()
    assert given.shape == expected.shape
    return float(((given - expected).abs() / expected.abs().clamp(min=1.0)).max())
