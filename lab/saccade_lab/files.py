"""Directories of results, and what a record says of the files that it was made from."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from saccade._internal.files import sha256_of
from saccade._internal.hub_files import STATISTICS
from saccade.robots.data_configs import RELEASED


def path_text(path: Path) -> str:
    """A path as text that contains a separator, so that it cannot be taken for a word.

    Example:
        >>> path_text(Path("reach")), path_text(Path("out/reach"))
        ('./reach', 'out/reach')
    """
    return str(path) if os.sep in str(path) else f"{os.curdir}{os.sep}{path}"


def writable_directory(path: Path) -> Path:
    """Creates the directory if it does not exist, and checks that files can be written to it.

    Raises:
        OSError: It cannot be created or written to, or is not a directory.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(errno.ENOTDIR, "exists and is not a directory", str(path)) from None
    probe = path / f".writable.{os.getpid()}"
    probe.touch()
    probe.unlink()
    return path


def checkpoint_identity(checkpoint: Path) -> dict[str, str]:
    """``name`` and ``sha256`` of a checkpoint.

    The hash covers the tensors and what decides how they are used: config, tokenizer, statistics and what an
    observation must contain, where there are such files.
    """
    directory = checkpoint if checkpoint.is_dir() else checkpoint.parent
    tensors = sorted(directory.glob("*.safetensors")) if checkpoint.is_dir() else [checkpoint]
    companions = [
        directory / name
        for name in (
            "config.json",
            "tokenizer.json",
            "experiment_cfg/metadata.json",
            "experiment_cfg/data_config.json",
        )
    ]
    # After the others, so that checkpoints without these files keep the hash that their records have.
    found = {one for pattern in STATISTICS for one in directory.glob(pattern)}
    return {
        "name": checkpoint.resolve().name,
        "sha256": sha256_of(
            *filter(Path.is_file, companions), *tensors, *sorted(found.difference(companions, tensors))
        ),
    }


def overrides(
    data_config: str | None, action_horizon: int | None, processor_options: Mapping[str, Any] | None
) -> dict[str, Any]:
    """What a record says of these options of ``saccade.Policy.from_pretrained``: those that are given.

    A data config is its released name, or the hash of its file.

    Example:
        >>> overrides("so100", None, None)
        {'data_config': 'so100'}
    """
    found: dict[str, Any] = {
        "data_config": data_config,
        "action_horizon": action_horizon,
        "processor_options": None if processor_options is None else dict(processor_options),
    }
    if data_config is not None and data_config not in RELEASED:
        found["data_config"] = {"sha256": sha256_of(Path(data_config))}
    return {name: value for name, value in found.items() if value is not None}


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The names whose values differ. One that is missing counts as None.

    Example:
        >>> changed({"steps": 1, "seed": 0}, {"seed": 0, "width": 8})
        ['steps', 'width']
    """
    return [name for name in {**before, **now} if before.get(name) != now.get(name)]
