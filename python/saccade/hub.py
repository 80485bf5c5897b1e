"""Ids of published checkpoints: found where ``huggingface_hub`` keeps what was downloaded.

The one place in which a source that a user gives becomes a path; every function and command that takes one
comes here.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from saccade.errors import InputError

#: ``owner/name``, and after an ``@`` a branch, a tag or a commit.
PUBLISHED = re.compile(r"(?P<id>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@(?P<revision>[\w./-]+))?")


def resolve(source: str | os.PathLike[str]) -> Path:
    """The path of a checkpoint.

    Args:
        source: A path; or, if there is no such path, the id of a published checkpoint such as
            ``nvidia/GR00T-N1.5-3B``, ``@`` and a revision behind it or not. Its files are those in the local
            cache of ``huggingface_hub`` (``HF_HOME`` and ``HF_HUB_CACHE`` say where that is).

    Returns:
        An id's folder; everything else as it is given, whether it is there or not.

    Raises:
        InputError: ``source`` is no path.
        FileNotFoundError: it has the form of an id, and neither the path nor the id's files are there. The
            message says which command downloads them.

    Example:
        >>> resolve("policy.safetensors").name
        'policy.safetensors'
    """
    try:
        text = os.fspath(source)
    except TypeError:
        text = None
    if not isinstance(text, str):
        raise InputError(f"source: expected a path, got {type(source).__name__}")
    if "\0" in text:
        raise InputError("source: expected a path, got one with a null character")
    path = Path(text)
    published = PUBLISHED.fullmatch(text)
    if published is None or text.endswith((".safetensors", ".json")):
        return path
    if os.path.exists(path):  # noqa: PTH110 (of a name that is too long Path.exists raises OSError)
        return path
    return _snapshot(published["id"], published["revision"])


def _snapshot(name: str, revision: str | None) -> Path:
    """The folder of the cache in which this revision's files are."""
    download = f"hf download {name}" + ("" if revision is None else f" --revision {revision}")
    start = f"source: {name}{'' if revision is None else '@' + revision}: no such path, and "
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise FileNotFoundError(
            f"{start}huggingface_hub, which keeps published checkpoints, is not installed: "
            f"pip install huggingface_hub, then {download}"
        ) from None
    try:
        folder = Path(snapshot_download(name, revision=revision, local_files_only=True))
    except (FileNotFoundError, ValueError):  # it is not there; it is no id
        from huggingface_hub.constants import HF_HUB_CACHE

        raise FileNotFoundError(
            f"{start}not in the cache {HF_HUB_CACHE}; nothing is downloaded here, but by: {download}"
        ) from None
    missing = _missing(folder)
    if missing:
        raise FileNotFoundError(
            f"{start}the cache has only a part of it ({folder} lacks {', '.join(missing)}): {download}"
        )
    return folder


def _missing(folder: Path) -> list[str]:
    """Files that a loader needs and a download of some files only did not bring."""
    missing = [] if (folder / "config.json").exists() else ["config.json"]
    indexes = sorted(folder.glob("*.safetensors.index.json"))
    if not indexes:
        return missing if any(folder.glob("*.safetensors")) else [*missing, "*.safetensors"]
    try:
        shards = set(json.loads(indexes[0].read_text(encoding="utf-8"))["weight_map"].values())
        return missing + sorted(shard for shard in shards if not (folder / shard).exists())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return missing  # what is wrong with an index, its reader says
