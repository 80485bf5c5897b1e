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
    if given is not None:
        return existing(given)
    if small:
        sizes = {
            "backbone": random_checkpoint.small_backbone("n1.5"),
            "head": random_checkpoint.small_head("n1.5"),
        }
        return written(work / "n15-small", **sizes)
    return written(work / "n15")


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
