"""Reads the tensors and the config of a backbone from a checkpoint."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from saccade.errors import CheckpointError
from saccade_lab.backbone_sizes import BackboneSizes

#: Prefixes of the names of a backbone's tensors, in checkpoints by NVIDIA and by lerobot.
PREFIXES = ("backbone.", "_groot_model.backbone.")


@dataclass(frozen=True)
class Checkpoint:
    """The files of a checkpoint and the sizes of its backbone."""

    source: Path
    files: list[Path]
    sizes: BackboneSizes

    @classmethod
    def open(cls, path: Path, config: Mapping[str, Any] | str | PathLike[str] | None) -> Checkpoint:
        """As :meth:`saccade_lab.reference.Backbone.from_pretrained`."""
        files = sorted(path.glob("*.safetensors")) if path.is_dir() else [path]
        if not files or not files[0].is_file():
            raise FileNotFoundError(f"{path}: no such file or directory with .safetensors files")
        if config is None:
            config = (path if path.is_dir() else path.parent) / "config.json"
            if not config.is_file() and len(files) == 1:
                with safe_open(files[0], framework="pt") as opened:
                    config = json.loads((opened.metadata() or {}).get("about", "null"))
        if config is None:
            raise CheckpointError(f"{path}: no config.json, and no config in its metadata")
        values = (
            config if isinstance(config, Mapping) else json.loads(Path(config).read_text(encoding="utf-8"))
        )
        return cls(path, files, BackboneSizes.from_config(values))

    def read(self, expected: Mapping[str, torch.Size], dtype: torch.dtype) -> dict[str, Tensor]:
        """The backbone's tensors in ``dtype``, by their names below ``backbone.``.

        Raises:
            CheckpointError: Tensors are missing, unknown or of the wrong shape. The message lists all.
        """
        tensors: dict[str, Tensor] = {}
        twin: Tensor | None = None
        problems = []
        for file in self.files:
            with safe_open(file, framework="pt") as opened:
                for full_name in opened.keys():  # noqa: SIM118 (the handle of safetensors is not a dict)
                    prefix = next((prefix for prefix in PREFIXES if full_name.startswith(prefix)), None)
                    if prefix is None:
                        continue
                    name = full_name.removeprefix(prefix)
                    if name.endswith(".lm_head.weight"):
                        twin = opened.get_tensor(full_name)
                    elif name in expected:
                        tensors[name] = opened.get_tensor(full_name).to(dtype)
                    elif not is_unread(name, self.sizes):
                        problems.append(f"{name}: unknown")
        table = next(name for name in expected if name.endswith("embed_tokens.weight"))
        if table not in tensors and twin is not None:  # tied: a checkpoint may hold either
            tensors[table] = twin.to(dtype)
        for name, tensor in tensors.items():
            if tensor.shape != expected[name]:
                problems.append(f"{name}: shape {tuple(tensor.shape)}, expected {tuple(expected[name])}")
        problems += [f"{name}: missing" for name in expected.keys() - tensors.keys()]
        if problems:
            listed = "; ".join(sorted(problems))
            raise CheckpointError(f"{self.source}: {len(problems)} tensors do not fit the config: {listed}")
        return tensors


def is_unread(name: str, sizes: BackboneSizes) -> bool:
    """Whether a tensor below ``backbone.`` is known and not read.

    That are those of ``backbone_tensors.unread_tensor_shapes``, a twin of the embedding table, and layers
    that are not computed.
    """
    if name.endswith("lm_head.weight") or ".vision_model.head." in name:
        return True
    if sizes.version == "n1.7" and name == "model.model.language_model.norm.weight":
        return True
    _, found, rest = name.partition(".language_model.")
    layer = rest.removeprefix("model.").removeprefix("layers.").split(".")[0]
    return bool(found) and layer.isdecimal() and int(layer) >= sizes.num_layers
