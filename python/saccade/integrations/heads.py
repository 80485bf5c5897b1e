"""Finds the torch action head in a policy, and checks it without running it.

Heads are recognised by their structure, so that the classes of lerobot, Isaac-GR00T and forks need not be
imported. All have `get_action(backbone_output, action_input)`. Later ones also accept `options`.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from types import MethodType
from typing import TYPE_CHECKING, Any

from saccade.errors import InputError

if TYPE_CHECKING:
    from torch import nn

#: Attributes of every head, in addition to `get_action`.
PARTS = ("state_encoder", "action_encoder", "model", "num_inference_timesteps")

#: Attributes of other objects that contain the module, or another such object.
HOLDERS = ("model", "policy", "_groot_model", "action_head")

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


def find(policy: object) -> nn.Module:
    """The action head in `policy`.

    Args:
        policy: the head itself, a module that contains it, or an object that contains such a module.

    Raises:
        InputError: there is none, or more than one.
    """
    from torch import nn

    held: Any = policy
    for _ in range(len(HOLDERS)):
        if isinstance(held, nn.Module):
            break
        held = next((getattr(held, name) for name in HOLDERS if hasattr(held, name)), None)
    if not isinstance(held, nn.Module):
        raise InputError(
            f"policy: expected a torch module, or an object that contains one as {', '.join(HOLDERS)}; got "
            f"{type(policy).__name__}"
        )
    if hasattr(held, "_orig_mod"):
        raise InputError(
            f"policy: {type(held).__name__} is compiled by torch.compile: accelerate the module that was "
            "compiled"
        )
    found: dict[str, nn.Module] = {
        name or "itself": module for name, module in held.named_modules() if is_head(module)
    }
    if len(found) != 1:
        raise InputError(
            f"policy: expected one GR00T action head in {type(policy).__name__}, a module with get_action, "
            f"{', '.join(PARTS)}; found {', '.join(found) or 'none'}"
        )
    return next(iter(found.values()))


def is_head(module: nn.Module) -> bool:
    """Whether a module has the attributes of an action head."""
    return callable(getattr(module, "get_action", None)) and all(hasattr(module, name) for name in PARTS)


def takes_options(module: nn.Module) -> bool:
    """Whether the head's `get_action` accepts options of real-time chunking."""
    return "options" in inspect.signature(type(module).get_action).parameters  # type: ignore[attr-defined]


def check(module: nn.Module, stand_in: object = None) -> None:
    """Checks that nothing but the head's parameters determines what it computes.

    Args:
        module: the head.
        stand_in: an accepted replacement of its `get_action`.

    Raises:
        InputError: the message lists every problem.
    """
    problems = [
        *in_structure(module, stand_in),
        *in_parameters(module),
        *in_use(list(module.named_modules())),
    ]
    if problems:
        raise InputError(f"{type(module).__name__} cannot be accelerated: {'; '.join(problems)}")


def in_structure(module: nn.Module, stand_in: object) -> Iterator[str]:
    """Problems in a head's code."""
    import torch

    replaced = vars(module).get("get_action")
    # A copy of an accelerated head has the method of its class as an attribute.
    own = isinstance(replaced, MethodType) and replaced.__func__ is type(module).get_action  # type: ignore[attr-defined]
    if replaced is not None and replaced is not stand_in and not own:
        yield (
            f"its get_action has been replaced by {describe(replaced)} (TensorRT? torch.compile?): put back "
            "that of the class"
        )
    allowed = {"self", "backbone_output", "action_input", "options"}
    parameters = set(inspect.signature(type(module).get_action).parameters)  # type: ignore[attr-defined]
    if not parameters <= allowed:
        yield f"its get_action takes {', '.join(sorted(parameters - allowed))}, unlike every known head"
    for name, part in module.named_modules():
        where = name or "the head"
        if isinstance(part, torch.jit.ScriptModule):
            yield f"{where} is compiled by torch.jit: accelerate the head before compiling it"
        elif hasattr(part, "_orig_mod"):
            yield f"{where} is compiled by torch.compile: accelerate the module that was compiled"
    config = getattr(module, "config", None)
    horizons = [getattr(config, "action_horizon", None), getattr(module, "action_horizon", None)]
    if None in horizons or horizons[0] != horizons[1]:
        yield f"config.action_horizon is {horizons[0]}, but action_horizon is {horizons[1]}"


def in_parameters(module: nn.Module) -> Iterator[str]:
    """Problems in a head's weights."""
    import torch

    parameters = dict(module.named_parameters())
    if not parameters:
        yield "it has no parameters"
        return
    devices = {str(parameter.device) for parameter in parameters.values()}
    if len(devices) > 1 or next(iter(devices)).partition(":")[0] not in ("cpu", "cuda"):
        yield f"its parameters are on {', '.join(sorted(devices))}: expected all on the CPU, or on one GPU"
    for name, parameter in parameters.items():
        if type(parameter) is not torch.nn.Parameter:
            yield (
                f"{name} is of {type(parameter).__name__} (quantised? sharded?): accelerate the head with "
                "plain parameters and choose a precision"
            )
            break
        if parameter.dtype not in (torch.float32, torch.bfloat16, torch.float16):
            yield f"{name} is {parameter.dtype}, expected float32, bfloat16 or float16"
            break


def in_use(parts: list[tuple[str, nn.Module]]) -> Iterator[str]:
    """Problems that may be temporary: training mode, hooks and replaced methods.

    `parts` are a head and its submodules, by name.
    """
    replaced = [name or "the head" for name, part in parts if "forward" in vars(part)]
    if replaced:
        yield (
            f"the forward of {shortened(replaced)} has been replaced: put back that of the class, or "
            "restore() the original"
        )
    training = [name or "the head" for name, part in parts if part.training]
    if training:
        yield (
            f"{shortened(training)}: in training mode, which has dropout; call eval(), or restore() the "
            "original during training"
        )
    hooked = [name or "the head" for name, part in parts if part._forward_hooks or part._forward_pre_hooks]
    if hooked:
        yield f"{shortened(hooked)}: forward hooks would not run; remove them, or restore() the original"


def config_of(module: nn.Module) -> dict[str, Any]:
    """The head's config in the released names, as in `config.json`.

    Raises:
        InputError: it contains values that JSON cannot represent.
    """
    config = module.config
    # None and "" mean the same as an absent key. The default of model_type in transformers is "".
    values = {key: getattr(config, key, None) for key in CONFIG_KEYS}
    values = {key: value for key, value in values.items() if value is not None and value != ""}
    try:
        plain: dict[str, Any] = json.loads(json.dumps(values, default=dict))
    except (TypeError, ValueError) as error:
        raise InputError(f"{type(module).__name__}: its config cannot be read: {error}") from None
    return plain


def settings_of(module: nn.Module) -> tuple[Any, ...]:
    """Settings of a head that determine what it computes and that a user may change."""
    config = module.config
    own = [getattr(module, name, None) for name in ("action_horizon", "num_timestep_buckets")]
    names = ("action_horizon", "add_pos_embed", "use_alternate_vl_dit")
    return (*own, *(getattr(config, name, None) for name in names))


def describe(function: object) -> str:
    """The name of a function for a message."""
    return getattr(function, "__qualname__", None) or type(function).__name__


def shortened(names: list[str]) -> str:
    """The first three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
