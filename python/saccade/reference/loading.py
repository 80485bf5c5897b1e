"""Reads checkpoints for the reference: config, prefix, shards, and every disagreement in one message."""

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from saccade.config import read_json
from saccade.errors import CheckpointError

PREFIXES = ("action_head.", "_groot_model.action_head.", "")

# Added to the name of an int8 weight: the scales of its rows.
SCALE_SUFFIX = "_scale"


def tensor_files(source: str | PathLike[str]) -> list[Path]:
    """The `.safetensors` files of a directory, or the one file itself."""
    path = Path(source)
    if path.is_file():
        return [path]
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    files = sorted(path.glob("*.safetensors"))
    if not files:
        raise CheckpointError(f"{path}: expected at least one .safetensors file")
    return files


def read_config(
    source: str | PathLike[str], config: Mapping[str, Any] | str | PathLike[str] | None = None
) -> Mapping[str, Any]:
    """The config given, or the one that lies beside or inside the checkpoint."""
    if isinstance(config, Mapping):
        return config
    if config is not None:
        return parse(Path(config))
    path = Path(source)
    beside = (path if path.is_dir() else path.parent) / "config.json"
    if beside.is_file():
        return parse(beside)
    for file in tensor_files(source):
        with safe_open(file, framework="pt") as opened:
            metadata = opened.metadata() or {}
        if "config" in metadata:
            return dict(json.loads(metadata["config"]))
    raise CheckpointError(f"{path}: no config.json beside it; give config=")


def parse(path: Path) -> Mapping[str, Any]:
    """The JSON object of a config file."""
    return dict(json.loads(read_json(path)))


def tensor_places(source: str | PathLike[str]) -> tuple[dict[str, Path], str]:
    """The file that each tensor is in, by its full name, and the head's prefix."""
    place = {}
    for file in tensor_files(source):
        with safe_open(file, framework="pt") as opened:
            place.update(dict.fromkeys(opened.keys(), file))
    return place, next(prefix for prefix in PREFIXES if any(name.startswith(prefix) for name in [*place, ""]))


def tensor_names(source: str | PathLike[str]) -> list[str]:
    """The names of the head's tensors, without their prefix."""
    place, prefix = tensor_places(source)
    return [name.removeprefix(prefix) for name in place if name.startswith(prefix)]


def read_tensors(
    source: str | PathLike[str], expected: Mapping[str, torch.Size], dtype: torch.dtype
) -> dict[str, Tensor]:
    """The head's tensors without their prefix, in `dtype`; int8 weights as what they stand for, the integers
    of each row times its scale.

    Raises:
        CheckpointError: listing all that is missing, unknown inside the prefix, or of another shape.
    """
    place, prefix = tensor_places(source)
    tensors, scales, problems = {}, {}, []
    integers = set()
    for file in sorted(set(place.values())):
        with safe_open(file, framework="pt") as opened:
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
        raise CheckpointError(f"{source}: {len(problems)} tensors do not fit the config: {listed}")
    return tensors
