"""Directories of results, and what a record says of the files that it was made from."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from saccade._internal.files import sha256_of
from saccade._internal.hub_files import STATISTICS
from saccade.evaluation.source import contents_hash, option_files
from saccade.robots.data_configs import RELEASED

#: Files whose hash is that of a checkpoint, besides the tensors.
COMPANIONS = (
    *("config.json", "tokenizer.json"),
    *("experiment_cfg/metadata.json", "experiment_cfg/data_config.json"),
)
#: The statistics that N1.5 has.
OF_N15 = ("config.json", "metadata.json", "experiment_cfg/*.json")
#: Files of N1.6, N1.7 and lerobot that say how observations and actions are converted.
CONVERSIONS = (
    *(name for name in STATISTICS if name.endswith(".json") and name not in OF_N15),
    *("preprocessor_config.json", "processor/*.json"),
)


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
    """``name`` and ``sha256`` of a checkpoint, and ``robot_sha256`` of one of N1.6, N1.7 or lerobot.

    The first hash covers the tensors, and the config, tokenizer and statistics that a policy of N1.5 has. The
    second covers the files of the others that say how observations and actions are converted.
    """
    directory = checkpoint if checkpoint.is_dir() else checkpoint.parent
    tensors = sorted(directory.glob("*.safetensors")) if checkpoint.is_dir() else [checkpoint]
    companions = [directory / name for name in COMPANIONS]
    found = {
        "name": checkpoint.resolve().name,
        "sha256": sha256_of(*filter(Path.is_file, companions), *tensors),
    }
    if any(path.is_file() for pattern in CONVERSIONS for path in directory.glob(pattern)):
        found["robot_sha256"] = contents_hash(directory, CONVERSIONS)
    return found


def data_config_text(given: str | None) -> str | None:
    """A data config as text: a released name as it is, a path with a separator."""
    return given if given is None or given in RELEASED else path_text(Path(given))


def loading_identity(checkpoint: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """What a record says of how a policy was loaded: which tokenizer, data config, horizon and processor.

    Only what the checkpoint does not say is there. Files are hashes.

    Args:
        checkpoint: Path of the checkpoint.
        options: Of ``saccade.Policy.from_pretrained``.

    Example:
        >>> from saccade import demo_checkpoint
        >>> loading_identity(demo_checkpoint(), {"data_config": "so100", "action_horizon": None})
        {'data_config': 'so100'}
    """
    found: dict[str, Any] = {
        name: {"sha256": digest} for name, digest in option_files(checkpoint, options).items()
    }
    for name in ("data_config", "action_horizon", "processor_options"):
        if options.get(name) is not None:
            found.setdefault(name, options[name])
    return found


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The names whose values differ. One that is missing counts as None.

    Example:
        >>> changed({"steps": 1, "seed": 0}, {"seed": 0, "width": 8})
        ['steps', 'width']
    """
    return [name for name in {**before, **now} if before.get(name) != now.get(name)]
