"""lerobot's N1.5 model, of lerobot 0.4.4, with the weights of a checkpoint, without the rest of lerobot.

lerobot asks the Hub for the sizes of its backbone, and needs FlashAttention, which only runs on a GPU. Here
the sizes are those of the checkpoint, and the attention is torch's SDPA. All else is lerobot's code.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import io
import json
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from transformers.modeling_utils import no_init_weights

from benches.backbone.setup import sizes_of
from benches.peers.policy_inputs import Given
from saccade_lab.reference import lerobot_backbone, lerobot_head

GROOT = "lerobot.policies.groot"


def build(source: Path, tensors: dict[str, Tensor], compute_dtype: torch.dtype) -> Any:
    """A `GR00TN15` in evaluation mode.

    Args:
        source: a checkpoint of N1.5.
        tensors: its weights, which become those of the model without a copy.
        compute_dtype: that the model casts its inputs to.
    """
    config = json.loads((source / "config.json").read_text())
    groot, eagle = modules()
    # Nothing is initialised, since the weights replace all.
    with (
        contextlib.redirect_stdout(io.StringIO()),
        mock.patch.object(groot, "ensure_eagle_cache_ready", lambda *_: None),
        mock.patch.object(groot.AutoConfig, "from_pretrained", lambda *_, **__: None),
        mock.patch.object(
            groot.AutoModel, "from_config", lambda *_, **__: lerobot_backbone.eagle(eagle, sizes_of(source))
        ),
        no_init_weights(),
    ):
        model: Any = groot.GR00TN15(
            groot.GR00TN15Config(
                backbone_cfg={
                    key: value for key, value in config["backbone_cfg"].items() if key != "eagle_config"
                },
                action_head_cfg=config["action_head_cfg"],
                action_horizon=config["action_horizon"],
                action_dim=config["action_dim"],
                compute_dtype=str(compute_dtype).removeprefix("torch."),
            ),
            local_model_path="",
        )
        # As its from_pretrained does; autocast keeps a cast weight only if it may be trained.
        model.backbone.set_trainable_parameters(tune_visual=False, tune_llm=False)
        model.action_head.set_trainable_parameters(tune_projector=True, tune_diffusion_model=True)
    names = model.state_dict().keys()
    language: Any = model.backbone.eagle_model.language_model
    missing = model.load_state_dict(
        {name: tensor for name, tensor in tensors.items() if name in names}, strict=False, assign=True
    ).missing_keys
    language.lm_head.weight = language.model.embed_tokens.weight  # tied
    unread = [name for name in missing if "lm_head" not in name and ".vision_model.head." not in name]
    if unread:
        raise ValueError(f"{source}: these tensors of lerobot's model are missing: {', '.join(unread)}")
    return model.eval()


def inputs_of(one: Given) -> dict[str, Tensor]:
    """What lerobot's processor hands to the policy."""
    ids = torch.from_numpy(one.ids)
    return {
        "eagle_pixel_values": torch.from_numpy(one.pixels),
        "eagle_input_ids": ids,
        "eagle_attention_mask": torch.ones_like(ids),
        "eagle_image_sizes": torch.tensor([one.pixels.shape[2:]] * len(one.pixels)),
        "state": torch.from_numpy(one.state).reshape(1, 1, -1),
        "embodiment_id": torch.tensor([one.embodiment_id]),
    }


@functools.cache
def modules() -> tuple[Any, Any]:
    """lerobot's modules of the model and of its Eagle model, imported without lerobot's packages and with
    stand-ins for what is not installed.
    """
    spec = importlib.util.find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError("lerobot is not installed")
    constants: Any = ModuleType("lerobot.utils.constants")
    constants.ACTION, constants.HF_LEROBOT_HOME = "action", Path()
    peft: Any = ModuleType("peft")
    peft.LoraConfig = peft.get_peft_model = None  # for fine-tuning
    tree: Any = ModuleType("tree")
    tree.map_structure = map_values
    stubs = {stub.__name__: stub for stub in (constants, peft, tree)}
    for stub in stubs.values():
        stub.__spec__ = ModuleSpec(stub.__name__, None)  # diffusers asks for it
    root = Path(spec.submodule_search_locations[0])
    with lerobot_head.empty_packages(root), lerobot_head.replaced_modules(stubs):
        groot = importlib.import_module(f"{GROOT}.groot_n1")
        return groot, importlib.import_module(f"{GROOT}.eagle2_hg_model.modeling_eagle2_5_vl")


def map_values(function: Callable[[Any], Any], mapping: Any) -> Any:
    """dm-tree's `map_structure` for a flat mapping."""
    return type(mapping)({key: function(value) for key, value in mapping.items()})
