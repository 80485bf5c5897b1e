"""Finds published checkpoints in the local cache of ``huggingface_hub``.

Every function and command that accepts a checkpoint resolves it here.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from saccade._internal.extras import pip_install
from saccade.errors import InputError

#: ``owner/name``, optionally followed by ``@`` and a branch, tag or commit.
PUBLISHED = re.compile(r"(?P<id>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@(?P<revision>[\w./-]+))?")


def resolve(id_or_path: str | os.PathLike[str], revision: str | None = None) -> Path:
    """The path of a checkpoint.

    Args:
        id_or_path: A path, or the id of a published checkpoint, such as ``nvidia/GR00T-N1.5-3B`` or
            ``nvidia/GR00T-N1.5-3B@main``. An existing path takes precedence. The files of an id are looked up
            in the local cache of ``huggingface_hub`` (environment variables ``HF_HOME`` and
            ``HF_HUB_CACHE``). Nothing is downloaded.
        revision: A branch, tag or commit of the id. Default: ``main``.

    Returns:
        The directory of an id. A path is returned unchanged, whether it exists or not.

    Raises:
        InputError: ``id_or_path`` is not a path, or ``revision`` is given with a path.
        FileNotFoundError: ``id_or_path`` is an id, but neither the path exists nor are the files of the id
            in the cache. The message contains a command that downloads them.

    Example:
        >>> resolve("policy.safetensors").name
        'policy.safetensors'
    """
    try:
        text = os.fspath(id_or_path)
    except TypeError:
        text = None
    if not isinstance(text, str):
        raise InputError(f"id_or_path: expected a path, got {type(id_or_path).__name__}")
    if "\0" in text:
        raise InputError(f"id_or_path: expected a path without null characters, got {text!r}")
    path = Path(text)
    published = PUBLISHED.fullmatch(text)
    is_file = text.endswith((".safetensors", ".json"))
    # Of a name that is too long Path.exists raises OSError.
    if published is None or is_file or os.path.exists(path):  # noqa: PTH110
        if revision is not None:
            raise InputError(f"revision: expected None with a path, got {revision!r} with {text}")
        return path
    return _snapshot(published["id"], revision or published["revision"])


def cached(name: str, revision: str | None = None) -> Path | None:
    """The directory of a published repository in the local cache, whichever of its files it contains.

    Needs no other package, unlike :func:`resolve`. Nothing is downloaded.

    Args:
        name: An id such as ``Qwen/Qwen3-VL-2B-Instruct``.
        revision: A branch, tag or commit. Default: ``main``.

    Returns:
        None if it is not there.
    """
    repository = cache() / f"models--{name.replace('/', '--')}"
    revision = revision or "main"
    try:
        commit = (repository / "refs" / revision).read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        commit = revision
    folder = repository / "snapshots" / commit
    return folder if folder.is_dir() else None


def cache() -> Path:
    """The directory in which ``huggingface_hub`` keeps published repositories."""
    given = os.environ.get("HF_HUB_CACHE") or os.environ.get("HUGGINGFACE_HUB_CACHE")
    if given:
        return Path(given).expanduser()
    home = os.environ.get("HF_HOME")
    if home:
        return Path(home).expanduser() / "hub"
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "huggingface" / "hub"


def _snapshot(name: str, revision: str | None) -> Path:
    """The directory of a revision in the cache."""
    download = f"hf download {name}" + ("" if revision is None else f" --revision {revision}")
    start = f"id_or_path: {name}{'' if revision is None else '@' + revision}: no such path, and "
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise FileNotFoundError(
            f"{start}huggingface_hub, which downloads published checkpoints, is not installed. Install it "
            f"with: {pip_install('huggingface_hub')}, then run: {download}"
        ) from None
    try:
        folder = Path(snapshot_download(name, revision=revision, local_files_only=True))
    except (FileNotFoundError, ValueError):  # it is not in the cache; it is not an id
        from huggingface_hub.constants import HF_HUB_CACHE

        raise FileNotFoundError(
            f"{start}not in the cache {HF_HUB_CACHE}. Download it with: {download}"
        ) from None
    missing = _missing(folder)
    if missing:
        raise FileNotFoundError(
            f"{start}the cache contains only a part of it ({folder} lacks {', '.join(missing)}). Download "
            f"the rest with: {download}"
        )
    return folder


def _missing(folder: Path) -> list[str]:
    """Required files that a partial download does not contain."""
    if (folder / "adapter_config.json").exists():  # an adapter alone, whose readers say what it lacks
        return []
    missing = [] if (folder / "config.json").exists() else ["config.json"]
    indexes = sorted(folder.glob("*.safetensors.index.json"))
    if not indexes:
        return missing if any(folder.glob("*.safetensors")) else [*missing, "*.safetensors"]
    try:
        shards = set(json.loads(indexes[0].read_text(encoding="utf-8"))["weight_map"].values())
        return missing + sorted(shard for shard in shards if not (folder / shard).exists())
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return missing  # the reader of the index reports what is wrong with it
