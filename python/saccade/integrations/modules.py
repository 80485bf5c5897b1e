"""Finds torch modules in a policy and checks them without running them: for heads and for backbones."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from types import MethodType
from typing import Any

import torch
from torch import nn

from saccade.errors import InputError

#: Attributes of other objects that contain the module, or another such object.
HOLDERS = ("model", "policy", "_groot_model", "action_head")

#: Modules of transformers with functions that record hidden states.
RECORDERS = ("transformers.utils.generic", "transformers.utils.output_capturing")


def find(policy: object, is_wanted: Callable[[nn.Module], bool], wanted: str) -> nn.Module:
    """The only module in `policy` that is wanted, which messages call `wanted`.

    `policy` is the module itself, a module that contains it, or an object that contains such a module.
    """
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
        name or "itself": module for name, module in held.named_modules() if is_wanted(module)
    }
    if len(found) != 1:
        raise InputError(
            f"policy: expected one {wanted} in {type(policy).__name__}; found {', '.join(found) or 'none'}"
        )
    return next(iter(found.values()))


def is_own(module: nn.Module, method: str) -> bool:
    """Whether the method is that of the class. Copies and transformers set it as an attribute."""
    replaced = vars(module).get(method)
    of_class = getattr(type(module), method)
    is_bound = isinstance(replaced, MethodType) and replaced.__func__ is of_class
    return replaced is None or records(replaced) or (is_bound and replaced.__self__ is module)


def records(function: object) -> bool:
    """Whether it is one of the functions with which transformers records hidden states.

    Version 4.57 has them in the place of `forward` while a model runs, maybe in another thread. Version 5
    leaves them as hooks.
    """
    return getattr(function, "__globals__", {}).get("__name__") in RECORDERS


def in_code(module: nn.Module, noun: str) -> Iterator[str]:
    """Problems in the code of a module's parts: compiled ones."""
    for name, part in module.named_modules():
        where = name or f"the {noun}"
        if isinstance(part, torch.jit.ScriptModule):
            yield f"{where} is compiled by torch.jit: accelerate the {noun} before compiling it"
        elif hasattr(part, "_orig_mod"):
            yield f"{where} is compiled by torch.compile: accelerate the module that was compiled"


def in_parameters(module: nn.Module, noun: str) -> Iterator[str]:
    """Problems in a module's weights."""
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
                f"{name} is of {type(parameter).__name__} (quantised? sharded?): accelerate the {noun} with "
                "plain parameters and choose a precision"
            )
            break
        if parameter.dtype not in (torch.float32, torch.bfloat16, torch.float16):
            yield f"{name} is {parameter.dtype}, expected float32, bfloat16 or float16"
            break


def training(parts: list[tuple[str, nn.Module]], noun: str) -> Iterator[str]:
    """That parts of a module, given by name, are in training mode."""
    if names := named(parts, noun, lambda part: part.training):
        yield (
            f"{names}: in training mode, which has dropout; call eval(), or restore() the original during "
            "training"
        )


def replaced_or_hooked(parts: list[tuple[str, nn.Module]], noun: str) -> Iterator[str]:
    """Replaced methods and forward hooks of parts of a module, given by name."""
    if names := named(parts, noun, lambda part: not is_own(part, "forward")):
        yield (
            f"the forward of {names} has been replaced: put back that of the class, or restore() the original"
        )
    if names := named(parts, noun, is_hooked):
        yield f"{names}: forward hooks would not run; remove them, or restore() the original"


def named(parts: list[tuple[str, nn.Module]], noun: str, is_wanted: Callable[[nn.Module], bool]) -> str:
    """The first three parts that are wanted, and how many more there are; empty if there are none."""
    names = [name or f"the {noun}" for name, part in parts if is_wanted(part)]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def is_hooked(module: nn.Module) -> bool:
    """Whether a module has forward hooks, besides those with which transformers records hidden states."""
    hooks = (*module._forward_hooks.values(), *module._forward_pre_hooks.values())
    return not all(map(records, hooks))


def plain(values: dict[str, Any], module: nn.Module) -> dict[str, Any]:
    """Values of a module's config as JSON represents them; `InputError` if it cannot."""
    try:
        held: dict[str, Any] = json.loads(json.dumps(values, default=dict))
    except (TypeError, ValueError) as error:
        raise InputError(f"{type(module).__name__}: its config cannot be read: {error}") from None
    return held


def describe(function: object) -> str:
    """The name of a function for a message."""
    return getattr(function, "__qualname__", None) or type(function).__name__
