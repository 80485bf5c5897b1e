"""lerobot's own GR00T models, small and whole: the released backbone and head with random weights.

Their backbones' constructors take sizes from the Hub; here small ones replace these. In lerobot's own
environments the model is imported as usual. In the test environment, which lacks lerobot's dependencies,
:func:`import_n15` imports it without lerobot's packages.
"""

# Calls of torch modules are untyped, and lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call, attr-defined"

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn
from transformers import Qwen3Config, Qwen3ForCausalLM, SiglipVisionConfig, SiglipVisionModel

from saccade_lab.reference import lerobot_head
from saccade_lab.reference.random_weights import random_tensor, small_config
from tests.helpers.upstream_backbones import eagle_module

#: Sizes of the small backbones. A view has 16 tokens in N1.5 and 6 in N1.7.
WIDTH = 128
IMAGE_SIZE, PATCH = 16, 4
VOCABULARY, IMAGE_TOKEN, VIDEO_TOKEN, VISION_START, VISION_END = 64, 60, 61, 62, 63
GRID = (1, 4, 6)
TEXT = {
    "hidden_size": WIDTH,
    "intermediate_size": 96,
    "num_hidden_layers": 4,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
    "head_dim": 24,
    "vocab_size": VOCABULARY,
    "rms_norm_eps": 1e-6,
    "rope_theta": 1e4,
    "attention_dropout": 0.0,
    "tie_word_embeddings": True,
}
VISION_N15 = {
    "hidden_size": 48,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": IMAGE_SIZE,
    "patch_size": PATCH,
    "model_type": "siglip_vision_model",
}
VISION_N17 = {
    "hidden_size": 48,
    "intermediate_size": 64,
    "depth": 3,
    "num_heads": 2,
    "patch_size": PATCH,
    "temporal_patch_size": 2,
    "spatial_merge_size": 2,
    "out_hidden_size": WIDTH,
    "num_position_embeddings": 64,
    "deepstack_visual_indexes": [0, 1],
}


def import_n15() -> ModuleType:
    """lerobot 0.4.4's module of `GR00TN15`, without lerobot's packages and without dm-tree."""
    name = "lerobot.policies.groot.groot_n1"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.find_spec("lerobot")
    assert spec is not None
    assert spec.submodule_search_locations
    lerobot_head.import_head()
    constants: Any = ModuleType("lerobot.utils.constants")
    constants.ACTION, constants.HF_LEROBOT_HOME = "action", Path()
    with (
        lerobot_head.empty_packages(Path(spec.submodule_search_locations[0])),
        mock.patch.dict(sys.modules),
    ):
        sys.modules[constants.__name__] = constants
        module = importlib.import_module(name)

    def map_structure(function: Callable[[Any], Any], batch: Any) -> Any:
        return type(batch)(data={key: function(value) for key, value in batch.items()})

    module.tree = SimpleNamespace(map_structure=map_structure)
    return module


def build(released: ModuleType, kind: str, *, attention: str = "sdpa") -> Any:
    """lerobot's model, whole, small, with random weights, in evaluation mode.

    Args:
        released: lerobot's module with the model.
        kind: `"n1.5"` or `"n1.7"`.
        attention: which implementation the language model uses.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        model = (build_n15 if kind == "n1.5" else build_n17)(released, attention)
    return fill(model).eval()


def build_n15(released: ModuleType, attention: str) -> Any:
    module = eagle_module()
    sys.modules.setdefault(module.__name__, module)  # transformers 5 looks a model's module up
    config = module.Eagle25VLConfig(
        vision_config=VISION_N15,
        text_config={**TEXT, "architectures": ["Qwen3ForCausalLM"]},
        select_layer=-1,
        image_token_index=IMAGE_TOKEN,
        use_pixel_shuffle=False,
        mlp_connector_layers=1,
        _attn_implementation="eager",
    )
    eagle = module.Eagle25VLForConditionalGeneration(
        config,
        SiglipVisionModel(SiglipVisionConfig(**VISION_N15, attn_implementation="sdpa")),
        Qwen3ForCausalLM(Qwen3Config(**TEXT, attn_implementation=attention)),
    )
    head_config = small_config("n1.5")
    whole = released.GR00TN15Config(
        backbone_cfg={"select_layer": 2, "project_to_dim": None, "tune_visual": True},
        action_head_cfg=head_config,
        action_horizon=head_config["action_horizon"],
        action_dim=head_config["action_dim"],
        compute_dtype="float32",
    )
    with (
        mock.patch.object(released, "ensure_eagle_cache_ready", lambda *_: None),
        mock.patch.object(released, "AutoConfig", mock.Mock()),
        mock.patch.object(released, "AutoModel", mock.Mock(from_config=lambda *_, **__: eagle)),
    ):
        return released.GR00TN15(whole, local_model_path="")


def build_n17(released: ModuleType, attention: str) -> Any:
    scaling = {"mrope_interleaved": True, "mrope_section": [4, 4, 4], "rope_type": "default"}
    config = released.Qwen3VLConfig(
        text_config={**TEXT, "rope_scaling": scaling},
        vision_config=VISION_N17,
        image_token_id=IMAGE_TOKEN,
        video_token_id=VIDEO_TOKEN,
        vision_start_token_id=VISION_START,
        vision_end_token_id=VISION_END,
        tie_word_embeddings=True,
    )
    config._attn_implementation = attention
    whole = released.GR00TN17Config(**{**small_config("n1.7"), "select_layer": 3})
    with mock.patch.object(released, "_cosmos_reason2_qwen3_vl_config", lambda: config):
        return released.GR00TN17(whole, load_backbone_weights=False)


def fill(module: nn.Module, seed: int = 0) -> nn.Module:
    """Gives every parameter random values of a useful size."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            drawn = random_tensor(name, parameter.shape, generator)
            # A convolution's kernel has more than two axes.
            is_kernel = parameter.ndim > 3 and name.startswith("backbone")
            parameter.copy_(drawn / parameter[0, 0].numel() ** 0.5 if is_kernel else drawn)
    return module


def observations(kind: str, head: Any, *, batch: int, views: int = 1) -> dict[str, Tensor]:
    """What lerobot's processors give the policy: left-padded prompts with their views, state, embodiment."""
    generator = torch.Generator().manual_seed(batch)
    tokens = 16 if kind == "n1.5" else GRID[1] * GRID[2] // 4
    views_of = [VISION_START, *[IMAGE_TOKEN] * tokens, VISION_END] * views
    length = len(views_of) + 6 + 2 * (batch - 1)
    ids = torch.zeros(batch, length, dtype=torch.int64)
    attended = torch.zeros(batch, length, dtype=torch.int64)
    for row in range(batch):
        words = torch.randint(1, IMAGE_TOKEN, (6 + 2 * (batch - 1) - 2 * row,), generator=generator).tolist()
        prompt = [*words[:2], *views_of, *words[2:]]
        ids[row, length - len(prompt) :] = torch.tensor(prompt)
        attended[row, length - len(prompt) :] = 1
    inputs = {"input_ids": ids, "attention_mask": attended}
    if kind == "n1.5":
        shape = (batch * views, 3, IMAGE_SIZE, IMAGE_SIZE)
        inputs["pixel_values"] = torch.randn(shape, generator=generator)
        inputs["image_sizes"] = torch.full((batch * views, 2), IMAGE_SIZE)
        inputs = {f"eagle_{name}": value for name, value in inputs.items()}
    else:
        patches = batch * views * GRID[1] * GRID[2]
        inputs["pixel_values"] = torch.randn(patches, 3 * 2 * PATCH**2, generator=generator)
        inputs["image_grid_thw"] = torch.tensor([GRID] * (batch * views))
    state = torch.randn(batch, 1, head.config.max_state_dim, generator=generator)
    return {**inputs, "state": state, "embodiment_id": torch.arange(batch) % 3}
