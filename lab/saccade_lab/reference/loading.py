"""Reads checkpoints for the reference head, in every layout that the Rust head reads."""

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from saccade.checkpoints.description import Description, describe
from saccade.errors import CheckpointError

# The name of an int8 or int4 weight with this suffix is that of its scales, one for each row.
SCALE_SUFFIX = "_scale"


def described(
    source: str | PathLike[str], config: Mapping[str, Any] | str | PathLike[str] | None = None
) -> Description:
    """As ``saccade.checkpoints.describe``, but the config may also be in the metadata of a single file."""
    path = Path(source)
    if config is None and path.is_file() and not (path.parent / "config.json").is_file():
        with safe_open(path, framework="pt") as opened:
            inside = (opened.metadata() or {}).get("config")
        config = None if inside is None else json.loads(inside)
    return describe(source, config)


def tensor_names(checkpoint: Description) -> list[str]:
    """The names of the head's tensors without their prefix."""
    prefix = checkpoint.prefix
    names = [tensor.name for tensor in checkpoint.tensors]
    return [name.removeprefix(prefix) for name in names if name.startswith(prefix)]


def int4_values(pairs: Tensor) -> Tensor:
    """The int8 integers `(rows, 2 * width)` of `pairs (rows, width)` uint8: the low four bits come first."""
    nibbles = torch.stack((pairs & 15, pairs >> 4), dim=-1).flatten(1).to(torch.int8)
    return (nibbles ^ 8) - 8


def read_tensors(
    checkpoint: Description, expected: Mapping[str, torch.Size], dtype: torch.dtype
) -> dict[str, Tensor]:
    """Reads the head's tensors in ``dtype``, by their names without prefix.

    int8 and int4 weights are multiplied by their scales.

    Raises:
        CheckpointError: Tensors are missing, unknown inside the prefix, or of the wrong shape. The message
            lists all of them.
    """
    prefix = checkpoint.prefix
    tensors, scales, problems = {}, {}, []
    integers = set()
    for file in checkpoint.files:
        with safe_open(file.path, framework="pt") as opened:
            for full_name in opened.keys():  # noqa: SIM118 (the handle of safetensors is not a dict)
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
                stored = opened.get_slice(full_name)
                shape, wanted = tuple(stored.get_shape()), tuple(expected[name])
                is_int4 = stored.get_dtype() == "U8" and len(wanted) == 2
                if is_int4:  # two weights of a row in a byte
                    wanted = (wanted[0], (wanted[1] + 1) // 2)
                if shape != wanted:
                    problems.append(f"{name}: shape {shape}, expected {wanted}")
                    continue
                tensor = opened.get_tensor(full_name)
                if is_int4:
                    tensor = int4_values(tensor)[:, : expected[name][1]]
                if tensor.dtype == torch.int8:
                    integers.add(name)
                tensors[name] = tensor.to(dtype)
    for name in integers | scales.keys():
        scale, rows = scales.get(name), tuple(expected[name][:1])
        if name in integers and scale is not None and tuple(scale.shape) == rows and tensors[name].ndim == 2:
            tensors[name] *= scale.to(dtype)[:, None]
        else:
            problems.append(
                f"{name}: expected an int8 or int4 matrix with scales {name}{SCALE_SUFFIX} {rows}, or neither"
            )
    for name, shape in expected.items():
        if shape.numel() == 0:  # an empty table of future tokens need not be stored
            tensors.setdefault(name, torch.empty(shape, dtype=dtype))
    absent = expected.keys() - tensors.keys() - {problem.split(":")[0] for problem in problems}
    problems += [f"{name}: missing" for name in sorted(absent)]
    if problems:
        listed = "; ".join(sorted(problems))
        raise CheckpointError(f"{checkpoint.source}: {len(problems)} tensors do not fit the config: {listed}")
    return tensors
