"""Small checkpoints in every published layout: NVIDIA, lerobot, Isaac fine-tunes, forks and saccade.

Their files are those of `layout_files`, and the heads in them those of `layout_heads`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from tests.helpers.layout_files import (
    write_flat,
    write_isaac,
    write_json,
    write_lerobot,
    write_lerobot_n17,
    write_nvidia,
    write_saccade,
)
from tests.helpers.layout_heads import Config, head_config, head_tensors

#: What `write` knows.
LAYOUTS = (
    "nvidia",  # one file
    "nvidia-sharded",  # three, and an index
    "isaac",  # a fine-tune by Isaac-GR00T's script: two shards
    "lerobot",  # lerobot up to 0.5.1
    "fork",  # arm and claw decoders
    "fork-split",  # left arm, right arm and claw
    "saccade",  # the head alone
    "n1",
    "n16",
    "n17",
    "lerobot-n17",  # lerobot after 0.5.1
)


def write(
    folder: Path,
    layout: str,
    *,
    seed: int = 0,
    config: Mapping[str, Any] | None = None,
    trained: Sequence[int] | None = None,
    fresh: bool = False,
    tensors: Mapping[str, Tensor] | None = None,
) -> Path:
    """Writes a checkpoint.

    Args:
        folder: where; made if it is not there.
        layout: one of `LAYOUTS`.
        seed: of all tensors.
        config: the head's config in released keys; default `head_config(layout)`.
        trained: as in `head_tensors`.
        fresh: as in `head_tensors`.
        tensors: the head's, instead of random ones.

    Returns:
        `folder`.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout: expected one of {', '.join(LAYOUTS)}, got {layout}")
    config = copy.deepcopy(dict(head_config(layout) if config is None else config))
    folder.mkdir(parents=True, exist_ok=True)
    if tensors is None:
        tensors = head_tensors(config, seed=seed, trained=trained, fresh=fresh)
    head = dict(tensors)
    if layout != "saccade":
        # Mixed types within the head, as in published files.
        for name in head:
            if name.startswith("vl_self_attention.") or (layout.endswith("n17") and "W" in name):
                head[name] = head[name].bfloat16()
    writers: dict[str, Callable[[Path, Config, dict[str, Tensor], int], None]] = {
        "nvidia": write_nvidia,
        "nvidia-sharded": write_nvidia,
        "isaac": write_isaac,
        "lerobot": write_lerobot,
        "fork": write_lerobot,
        "fork-split": write_lerobot,
        "saccade": write_saccade,
        "n1": write_nvidia,
        "n16": write_flat,
        "n17": write_flat,
        "lerobot-n17": write_lerobot_n17,
    }
    shards = {"nvidia-sharded": 3, "isaac": 2, "n16": 2, "n17": 2}.get(layout, 1)
    writers[layout](folder, config, head, seed)
    if shards > 1:
        split(folder, shards)
    return folder


def read(folder: Path, prefix: str) -> dict[str, Tensor]:
    """The tensors of a checkpoint whose names begin with `prefix`, in the types that they are stored in."""
    from safetensors.torch import load_file

    return {
        name.removeprefix(prefix): tensor
        for file in sorted(folder.glob("*.safetensors"))
        for name, tensor in load_file(file).items()
        if name.startswith(prefix)
    }


def split(folder: Path, shards: int) -> None:
    """Cuts `model.safetensors` into shards with an index, as transformers does."""
    tensors = read(folder, "")
    (folder / "model.safetensors").unlink()
    names = list(tensors)
    weight_map: dict[str, str] = {}
    for shard in range(shards):
        file = f"model-{shard + 1:05}-of-{shards:05}.safetensors"
        part = names[shard * len(names) // shards : (shard + 1) * len(names) // shards]
        save_file({name: tensors[name] for name in part}, folder / file, {"format": "pt"})
        weight_map |= dict.fromkeys(part, file)
    total = sum(tensor.nbytes for tensor in tensors.values())
    write_json(
        folder / "model.safetensors.index.json",
        {"metadata": {"total_size": total}, "weight_map": dict(sorted(weight_map.items()))},
    )
