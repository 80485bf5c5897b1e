"""What a checkpoint on disk holds: its tensors, and the files beside them."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor


def tensors_of(folder: Path) -> dict[str, Tensor]:
    """All tensors of the weights' files."""
    files = [file for file in folder.glob("*.safetensors") if not file.name.startswith("policy_")]
    return {name: tensor for file in sorted(files) for name, tensor in load_file(file).items()}


def others_of(folder: Path) -> dict[str, bytes]:
    """All files but the weights and their index, by path."""
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and not file.name.startswith("model")
    }


def equal(first: dict[str, Tensor], second: dict[str, Tensor]) -> bool:
    """Whether two checkpoints hold the same bits under the same names."""
    return first.keys() == second.keys() and all(
        first[name].dtype == second[name].dtype
        and torch.equal(first[name].reshape(-1).view(torch.uint8), second[name].reshape(-1).view(torch.uint8))
        for name in first
    )
