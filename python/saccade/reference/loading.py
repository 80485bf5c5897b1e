"""Reads checkpoints for the reference: every layout that the Rust head reads."""

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from saccade import checkpoints
from saccade.errors import CheckpointError

# Added to the name of an int8 weight: the scales of its rows.
SCALE_SUFFIX = "_scale"


def described(
    source: str | PathLike[str], config: Mapping[str, Any] | str | PathLike[str] | None = None
) -> dict[str, Any]:
    """What `saccade.checkpoints.describe` says; the config may also be in the metadata of a single file."""
    path = Path(source)
    if config is None and path.is_file() and not (path.parent / "config.json").is_file():
        with safe_open(path, framework="pt") as opened:
            inside = (opened.metadata() or {}).get("config")
        config = None if inside is None else json.loads(inside)
    return checkpoints.describe(source, config)


def tensor_names(checkpoint: Mapping[str, Any]) -> list[str]:
    """The names of the head's tensors in what was `described`, without their prefix."""
    prefix = checkpoint["prefix"]
    names = [tensor["name"] for tensor in checkpoint["tensors"]]
    return [name.removeprefix(prefix) for name in names if name.startswith(prefix)]


def read_tensors(
    checkpoint: Mapping[str, Any], expected: Mapping[str, torch.Size], dtype: torch.dtype
) -> dict[str, Tensor]:
    """The head's tensors without their prefix, in `dtype`; int8 weights as what they stand for, the integers
    of each row times its scale.

    Raises:
        CheckpointError: listing all that is missing, unknown inside the prefix, or of another shape.
    """
    prefix = checkpoint["prefix"]
    tensors, scales, problems = {}, {}, []
    integers = set()
    for file in checkpoint["files"]:
        with safe_open(file["path"], framework="pt") as opened:
            for full_name in opened.keys():  # noqa: SIM118  (a safetensors handle is no dict)
                name = full_name.removeprefix(prefix)
                if not full_name.startswith(prefix):
                    continue
                scaled = name.removesuffix(SCALE_SUFFIX)
                if scaled != name and scaled in expected:
                    scales[scaled] = opened.get_tensor(full_name)
                    continue
                if name not in expected:
                    problems.append(f"{name}: unknown")
                    continue
                shape = tuple(opened.get_slice(full_name).get_shape())
                if shape != tuple(expected[name]):
                    problems.append(f"{name}: shape {shape}, expected {tuple(expected[name])}")
                    continue
                tensor = opened.get_tensor(full_name)
                if tensor.dtype == torch.int8:
                    integers.add(name)
                tensors[name] = tensor.to(dtype)
    for name in integers | scales.keys():
        scale, rows = scales.get(name), tuple(expected[name][:1])
        if name in integers and scale is not None and tuple(scale.shape) == rows and tensors[name].ndim == 2:
            tensors[name] *= scale.to(dtype)[:, None]
        else:
            problems.append(f"{name}: expected an int8 matrix beside {name}{SCALE_SUFFIX} {rows}, or neither")
    for name, shape in expected.items():
        if shape.numel() == 0:  # no future tokens: their empty table need not be stored
            tensors.setdefault(name, torch.empty(shape, dtype=dtype))
    absent = expected.keys() - tensors.keys() - {problem.split(":")[0] for problem in problems}
    problems += [f"{name}: missing" for name in sorted(absent)]
    if problems:
        listed = "; ".join(sorted(problems))
        source = checkpoint["source"]
        raise CheckpointError(f"{source}: {len(problems)} tensors do not fit the config: {listed}")
    return tensors
