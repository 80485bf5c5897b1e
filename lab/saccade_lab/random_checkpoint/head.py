"""A random action head without a backbone, of a published size or a small one, for timing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.files import write_json
from saccade_lab.published import sized_config, small_config, whole_config
from saccade_lab.random_checkpoint.tensors import Tensor, write_file

#: The sizes of :func:`config_of_size`.
SIZES = ("n1.5", "n1.6", "n1.7", "small")


def config_of_size(size: str) -> dict[str, Any]:
    """The config of a head with one embodiment; further ones cost memory but no time.

    Args:
        size: One of :data:`SIZES`. ``"small"`` is N1.5's structure, but fast enough for tests.
    """
    if size == "small":
        return small_config("n1.5") | {"max_num_embodiments": 1}
    return sized_config(size, num_embodiments=1)


def write_head(folder: Path, config: Mapping[str, Any], *, seed: int = 0, dtype: str = "BF16") -> None:
    """Writes ``config.json`` and ``model.safetensors``: in bfloat16 1.5 GB at N1.5's size.

    Args:
        folder: An existing directory.
        config: Config of the head in the released keys.
        seed: Seed of all tensors.
        dtype: ``"BF16"`` or ``"F32"``.

    Raises:
        CheckpointError: The config is not one of a head.
        OSError: A file cannot be written.
    """
    whole = whole_config(config)
    shapes = _saccade.tensor_shapes(json.dumps(whole))
    tensors = [Tensor(f"action_head.{name}", tuple(shape), dtype) for name, shape in shapes]
    write_json(folder / "config.json", whole)
    write_file(folder / "model.safetensors", tensors, seed)
