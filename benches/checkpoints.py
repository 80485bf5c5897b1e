"""Random whole checkpoints that the programs write once and keep."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from saccade_lab import random_checkpoint


def n15(work: Path, *, small: bool, given: Path | None = None) -> Path:
    """A whole checkpoint of N1.5: the one that was given, or a random one.

    Args:
        work: Folder that keeps random checkpoints, `n15` (4.8 GB) and `n15-small`.
        small: Small sizes, for a quick trial.
        given: Directory of another one. Nothing is written to it.

    Raises:
        SystemExit: There is no checkpoint where one was given.
    """
    return random_policy(work, "n1.5", small=small) if given is None else existing(given)


def random_policy(work: Path, version: str, *, small: bool) -> Path:
    """A whole random checkpoint.

    Args:
        work: Folder that keeps it as `n15`, `n17` or the like, 5 to 6 GB, small ones as `n15-small`.
        version: `"n1.5"` or `"n1.7"`.
        small: Small sizes, for a quick trial.
    """
    name = version.replace(".", "")
    if small:
        sizes = {
            "backbone": random_checkpoint.small_backbone(version),
            "head": random_checkpoint.small_head(version),
        }
        return written(work / f"{name}-small", version=version, **sizes)
    return written(work / name, version=version)


def existing(folder: Path) -> Path:
    """The folder, or `SystemExit` if it is not one of a checkpoint."""
    if not (folder / "config.json").is_file():
        raise SystemExit(f"expected the directory of a checkpoint, got {folder}: it has no config.json")
    return folder


def written(folder: Path, **options: Any) -> Path:
    """A random checkpoint, written if it is not there. One that was interrupted is written anew.

    Args:
        folder: Its directory.
        **options: As `saccade_lab.random_checkpoint.write` takes them.

    Raises:
        SystemExit: The directory contains something else.
    """
    if not (folder / "config.json").is_file():
        if folder.exists() and any(folder.iterdir()):
            raise SystemExit(f"expected a checkpoint or an empty directory, got {folder}")
        part = folder.with_name(f"{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        random_checkpoint.write(part, **options).rename(folder)
    return folder
