"""Finds the torch action head in a policy, and checks it without running it.

Heads are recognised by their structure, so that the classes of lerobot, Isaac-GR00T and forks need not be
imported. All have `get_action(backbone_output, action_input)`. Later ones also accept `options`.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

from torch import nn

from saccade.integrations import modules

#: Attributes of every head, in addition to `get_action`.
PARTS = ("state_encoder", "action_encoder", "model", "num_inference_timesteps")

#: What messages call it.
NOUN = "head"

#: Keys of a head's config that determine how it computes, in the released names. Some are class defaults.
CONFIG_KEYS = (
    "action_arm_dim",
    "action_claw_dim",
    "action_dim",
    "action_horizon",
    "action_left_arm_dim",
    "action_right_arm_dim",
    "add_pos_embed",
    "attend_text_every_n_blocks",
    "backbone_embedding_dim",
    "diffusion_model_cfg",
    "hidden_size",
    "input_embedding_dim",
    "max_action_dim",
    "max_num_embodiments",
    "max_seq_len",
    "max_state_dim",
    "model_type",
    "num_inference_timesteps",
    "num_target_vision_tokens",
    "num_timestep_buckets",
    "pretrained_action_dim",
    "split_arm_heads",
    "state_history_length",
    "use_alternate_vl_dit",
    "use_multi_action_heads",
    "use_vlln",
    "vl_self_attention_cfg",
)


#: What is searched for, as a message names it.
WANTED = f"GR00T action head, a module with get_action, {', '.join(PARTS)},"


def is_wanted(module: nn.Module) -> bool:
    """Whether a module has the attributes of an action head."""
    return callable(getattr(module, "get_action", None)) and all(hasattr(module, name) for name in PARTS)


def takes_options(module: nn.Module) -> bool:
    """Whether the head's `get_action` accepts options of real-time chunking."""
    return "options" in inspect.signature(type(module).get_action).parameters  # type: ignore[attr-defined]


def problems(module: nn.Module, stand_in: object) -> Iterator[str]:
    """What besides a head's parameters determines its results; `stand_in` may replace `get_action`."""
    replaced = vars(module).get("get_action")
    if replaced is not stand_in and not modules.is_own(module, "get_action"):
        yield (
            f"its get_action has been replaced by {modules.describe(replaced)} (TensorRT? torch.compile?): "
            "put back that of the class"
        )
    allowed = {"self", "backbone_output", "action_input", "options"}
    parameters = set(inspect.signature(type(module).get_action).parameters)  # type: ignore[attr-defined]
    if not parameters <= allowed:
        yield f"its get_action takes {', '.join(sorted(parameters - allowed))}, unlike every known head"
    yield from modules.in_code(module, NOUN)
    config = getattr(module, "config", None)
    horizons = [getattr(config, "action_horizon", None), getattr(module, "action_horizon", None)]
    if None in horizons or horizons[0] != horizons[1]:
        yield f"config.action_horizon is {horizons[0]}, but action_horizon is {horizons[1]}"
    yield from modules.in_parameters(module, NOUN)
    yield from in_use(list(module.named_modules()))


def in_use(parts: list[tuple[str, nn.Module]]) -> Iterator[str]:
    """Problems of a head and its submodules that may be temporary: training mode, hooks, replaced methods."""
    yield from modules.training(parts, NOUN)
    yield from modules.replaced_or_hooked(parts, NOUN)


def config_of(module: nn.Module) -> dict[str, Any]:
    """The head's config in the released names, as in `config.json`."""
    config = module.config
    # None and "" mean the same as an absent key. The default of model_type in transformers is "".
    values = {key: getattr(config, key, None) for key in CONFIG_KEYS}
    values = {key: value for key, value in values.items() if value is not None and value != ""}
    return modules.plain(values, module)


def settings_of(module: nn.Module) -> tuple[Any, ...]:
    """Settings of a head that determine what it computes and that a user may change."""
    config = module.config
    own = [getattr(module, name, None) for name in ("action_horizon", "num_timestep_buckets")]
    names = ("action_horizon", "add_pos_embed", "use_alternate_vl_dit")
    return (*own, *(getattr(config, name, None) for name in names))
