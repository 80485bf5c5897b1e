"""The local cache of ``huggingface_hub``: where a commit is, and which files its repository has."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from pathlib import Path

from saccade._internal.files import write_atomically

#: The folder in a cached repository for the lists of files of its commits. ``huggingface_hub`` does not
#: record which files a commit has, so that a partial download looks like a complete one.
LISTINGS = "saccade"


def cache() -> Path:
    """The directory in which ``huggingface_hub`` keeps published repositories."""
    constants = sys.modules.get("huggingface_hub.constants")
    if constants is None:
        given = os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE")
    else:
        given = constants.HF_HUB_CACHE
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("HF_HOME") or f"{base}/huggingface"
    return Path(given or f"{home}/hub").expanduser()


def folder_of(name: str, revision: str) -> Path | None:
    """The directory of a branch, tag or commit in the cache, whichever of its files it has; None for none."""
    repository = _repository(name)
    try:
        commit = (repository / "refs" / revision).read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        commit = revision
    folder = repository / "snapshots" / commit
    return folder if folder.is_dir() else None


def snapshot_of(name: str, commit: str, kind: str) -> Path:
    """The directory of a commit of a ``"model"`` or ``"dataset"``, whether the cache has it or not."""
    return _repository(name, kind) / "snapshots" / commit


def write_revision(name: str, revision: str, commit: str, kind: str = "model") -> None:
    """Records which commit a revision was when it was downloaded, as ``huggingface_hub`` does."""
    if revision != commit:
        _write(_repository(name, kind) / "refs" / revision, commit)


def read_listing(folder: Path) -> list[str] | None:
    """The names of all files of a commit, whether they were downloaded or not; None if not known."""
    try:
        names = json.loads(_listing(folder).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return names if isinstance(names, list) and all(isinstance(name, str) for name in names) else None


def write_listing(folder: Path, names: list[str]) -> None:
    """Records the names of all files of a commit."""
    if read_listing(folder) != names:
        _write(_listing(folder), json.dumps(names))


def _write(path: Path, text: str) -> None:
    with suppress(OSError):  # a cache that cannot be written, such as a shared one
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def _listing(folder: Path) -> Path:
    return folder.parent.parent / LISTINGS / f"{folder.name}.json"


def _repository(name: str, kind: str = "model") -> Path:
    return cache() / f"{kind}s--{name.replace('/', '--')}"
