"""Finds the torch backbone in a policy, by structure, and calls it: those of N1.5 and N1.7.

Both have `forward(vl_input)`, which takes what the policy's own processors prepare. In N1.5, names of inputs
begin with `eagle_`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from saccade.backbone.config import BackboneConfig
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError
from saccade.integrations import modules

#: What messages call it.
NOUN = "backbone"

#: Inputs of N1.7 that are not views: videos, and positions that are derived from the ids otherwise.
UNREAD = ("pixel_values_videos", "video_grid_thw", "position_ids")

#: Keys of the released configs that determine how a backbone computes.
VISION_KEYS = (
    "deepstack_visual_indexes",
    "depth",
    "hidden_act",
    "hidden_size",
    "image_size",
    "in_channels",
    "intermediate_size",
    "layer_norm_eps",
    "num_attention_heads",
    "num_channels",
    "num_heads",
    "num_hidden_layers",
    "num_position_embeddings",
    "patch_size",
    "spatial_merge_size",
    "temporal_patch_size",
)
TEXT_KEYS = (
    "attention_bias",
    "head_dim",
    "hidden_act",
    "hidden_size",
    "intermediate_size",
    "num_attention_heads",
    "num_key_value_heads",
    "rms_norm_eps",
    "use_sliding_window",
    "vocab_size",
)
EAGLE_KEYS = (
    "downsample_ratio",
    "image_token_index",
    "mlp_connector_layers",
    "select_layer",
    "use_pixel_shuffle",
)


#: What is searched for, as a message names it.
WANTED = (
    "backbone of GR00T N1.5 (a module with eagle_model and eagle_linear) or N1.7 (a module whose model has "
    "model.visual and model.language_model)"
)


def is_wanted(module: nn.Module) -> bool:
    """Whether a module has the parts of a backbone."""
    return is_n15(module) or is_n17(module)


def is_n15(module: nn.Module) -> bool:
    """Whether a module has the parts of N1.5's backbone."""
    inner = getattr(module, "eagle_model", None)
    parts = ("vision_model", "language_model", "mlp1")
    return hasattr(module, "eagle_linear") and all(hasattr(inner, name) for name in parts)


def is_n17(module: nn.Module) -> bool:
    """Whether a module has the parts of N1.7's backbone."""
    inner = getattr(getattr(module, "model", None), "model", None)
    return hasattr(module, "prepare_input") and all(
        hasattr(inner, name) for name in ("visual", "language_model")
    )


def problems(module: nn.Module, stand_in: object) -> Iterator[str]:
    """What besides a backbone's parameters determines its results; `stand_in` may replace `forward`."""
    parts = list(module.named_modules())
    yield from modules.in_code(module, NOUN)
    yield from modules.in_parameters(module, NOUN)
    yield from modules.training(parts, NOUN)
    yield from modules.replaced_or_hooked(parts[1:], NOUN)
    replaced = vars(module).get("forward")
    if replaced is not stand_in and not modules.is_own(module, "forward"):
        yield f"its forward has been replaced by {modules.describe(replaced)}: put back that of the class"
    layers = len(language_model(module).layers)
    if is_n15(module) and module.select_layer not in (layers, -1):
        yield f"its select_layer is {module.select_layer}, expected its number of layers, {layers}"


def language_model(module: nn.Module) -> Any:
    """The decoder of the language model."""
    inner: Any = module
    return inner.eagle_model.language_model.model if is_n15(module) else inner.model.model.language_model


def is_padded_as_released(module: nn.Module) -> bool:
    """Whether padding is computed with torch's scaled dot product attention. Others differ in those rows."""
    return getattr(language_model(module).config, "_attn_implementation", None) == "sdpa"


def config_of(module: nn.Module) -> dict[str, Any]:
    """The backbone's config, as :meth:`saccade.Backbone.from_tensors` takes it."""
    inner: Any = module
    language = language_model(module)
    config = inner.eagle_model.config if is_n15(module) else inner.model.config
    values: dict[str, Any] = {
        "vision_config": chosen(config.vision_config, VISION_KEYS),
        "text_config": {**chosen(language.config, TEXT_KEYS), **rotary(language.config)},
        "select_layer": len(language.layers),
    }
    if is_n15(module):
        values["kind"] = "n1.5 backbone"
        values["eagle"] = chosen(inner.eagle_model, EAGLE_KEYS)
        values["project_to_dim"] = getattr(inner.eagle_linear, "out_features", None)
    else:
        values["kind"] = "n1.7 backbone"
        values["token_ids"] = {"image_token_id": config.image_token_id}
    return modules.plain(values, module)


def chosen(config: object, keys: tuple[str, ...]) -> dict[str, Any]:
    """The attributes of a config that are there."""
    values = {key: getattr(config, key, None) for key in keys}
    return {key: value for key, value in values.items() if value is not None}


def rotary(config: Any) -> dict[str, Any]:
    """`rope_theta` and `rope_scaling` of a language model; transformers 5 has both in `rope_parameters`."""
    scaling = getattr(config, "rope_parameters", None) or getattr(config, "rope_scaling", None) or {}
    values = dict(scaling)
    theta = values.pop("rope_theta", None)
    theta = getattr(config, "rope_theta", None) if theta is None else theta
    found = {} if theta is None else {"rope_theta": theta}
    # Without sections, it says that nothing is scaled.
    kind = values.get("rope_type", values.get("type", "default"))
    return found if kind == "default" and "mrope_section" not in values else {**found, "rope_scaling": values}


def settings_of(module: nn.Module) -> tuple[Any, ...]:
    """Settings of a backbone that determine what it computes and that a user may change."""
    inner: Any = module
    padding = is_padded_as_released(module)
    if is_n15(module):
        eagle = inner.eagle_model
        return inner.select_layer, eagle.image_token_index, eagle.select_layer, padding
    return inner.model.config.image_token_id, padding


def inputs_of(module: nn.Module, vl_input: Mapping[str, Any]) -> BackboneInputs:
    """What saccade's backbone takes; inputs and padding that it does not read are an `InputError`."""
    prefix = "eagle_" if is_n15(module) else ""
    known = ("pixel_values", "input_ids", "attention_mask", "image_sizes")
    unread = [
        key
        for key in vl_input
        if (prefix and key.startswith(prefix) and key.removeprefix(prefix) not in known)
        or (not prefix and key in UNREAD)
    ]
    if unread:
        raise InputError(
            f"{', '.join(unread)}: saccade's backbone does not read these: leave them out, or restore() the "
            "original"
        )
    attended = vl_input[f"{prefix}attention_mask"].cpu()
    if not is_padded_as_released(module) and not bool(attended.all()):
        raise InputError(
            f"{prefix}attention_mask: expected no padding, because the language model's attention is not "
            "torch's sdpa, and the rows of padding differ: choose sdpa for the policy, or give prompts of "
            "equal length"
        )
    return BackboneInputs(
        vl_input[f"{prefix}pixel_values"].cpu(),
        vl_input[f"{prefix}input_ids"].cpu(),
        attended,
        None if prefix else vl_input["image_grid_thw"].cpu(),
    )


def results_of(module: nn.Module, vl_input: Mapping[str, Any], features: Tensor) -> dict[str, Tensor]:
    """What the torch backbone returns besides the features, as it makes it of its inputs."""
    if is_n15(module):
        return {"backbone_features": features, "backbone_attention_mask": vl_input["eagle_attention_mask"]}
    inner: Any = module
    return {
        "backbone_features": features,
        "backbone_attention_mask": vl_input["attention_mask"] == 1,
        "image_mask": vl_input["input_ids"] == inner.model.config.image_token_id,
    }


def check_inputs(module: nn.Module, config: BackboneConfig, device: torch.device) -> dict[str, Tensor]:
    """A random view with a few words around it, and one token of padding if that is as released."""
    given = config_of(module)
    generator = torch.Generator().manual_seed(0)
    merge, patch = config.merge, config.patch_size
    if is_n15(module):
        assert config.image_size is not None
        pixels = torch.randn(1, 3, config.image_size, config.image_size, generator=generator, device="cpu")
        tokens = (config.image_size // patch // merge) ** 2
        special = {config.image_token_id}
        before, after = [], []
    else:
        inner: Any = module
        height, width = 2 * merge, 3 * merge
        elements = 3 * given["vision_config"]["temporal_patch_size"] * patch**2
        pixels = torch.randn(height * width, elements, generator=generator, device="cpu")
        tokens = 6
        before = [inner.model.config.vision_start_token_id]
        after = [inner.model.config.vision_end_token_id]
        special = {config.image_token_id, inner.model.config.video_token_id, *before, *after}
    words = [token for token in range(min(config.vocab_size, 64)) if token not in special][:4]
    ids = [*words[:3], *before, *[config.image_token_id] * tokens, *after, words[3]]
    attended = torch.ones(1, len(ids), dtype=torch.int64, device=device)
    attended[0, 0] = 0 if is_padded_as_released(module) else 1
    inputs = {
        "pixel_values": pixels.to(device),
        "input_ids": torch.tensor([ids], device=device),
        "attention_mask": attended,
    }
    if is_n15(module):
        inputs["image_sizes"] = torch.tensor([[config.image_size] * 2], device=device)
        return {f"eagle_{name}": value for name, value in inputs.items()}
    inputs["image_grid_thw"] = torch.tensor([[1, 2 * merge, 3 * merge]], device=device)
    return inputs
