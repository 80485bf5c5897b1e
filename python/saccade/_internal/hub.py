"""Paths of checkpoints: local ones, and those of repositories on the Hugging Face Hub.

Every function and command that accepts a checkpoint resolves it here. :mod:`saccade._internal.hub_download`
downloads, :mod:`saccade._internal.hub_cache` reads the local cache.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from saccade._internal import hub_cache
from saccade._internal.hub_download import Offline, download, list_files, neighbour
from saccade._internal.hub_files import POLICY, absent_files, missing_files
from saccade._internal.warning import warn
from saccade.errors import InputError

#: ``owner/name``, optionally followed by ``@`` and a branch, tag or commit.
PUBLISHED = re.compile(
    r"(?![^@]*(--|\.\.))(?P<id>[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@(?P<revision>[\w./-]+))?", re.ASCII
)
#: A branch, tag or commit. Names with ``..`` are none in git.
REVISION = re.compile(r"(?!.*\.\.)[\w.-]+(/[\w.-]+)*", re.ASCII)
COMMIT = re.compile(r"[0-9a-f]{40}")
DEFAULT_REVISION = "main"


@dataclass(frozen=True)
class Location(os.PathLike[str]):
    """Where the files of a checkpoint are. As an argument it is the path, which is known to be complete."""

    path: Path
    """A file or a directory. For an id, the directory of one commit in the local cache."""
    id: str | None = None
    """The id of a published repository; None for a local path."""
    commit: str | None = None
    """The commit that ``revision`` named when it was resolved; None for a local path."""

    @property
    def published(self) -> str | None:
        """Id and commit, ``owner/name@commit``; None for a local path."""
        return None if self.id is None else f"{self.id}@{self.commit}"

    def __fspath__(self) -> str:
        return os.fspath(self.path)


def resolve(
    id_or_path: str | os.PathLike[str],
    revision: str | None = None,
    *,
    files: tuple[str, ...] = POLICY,
    argument: str = "id_or_path",
) -> Path:
    """The path of a checkpoint, which is downloaded if it is the id of a published one.

    Args:
        id_or_path: A path, or an id such as ``nvidia/GR00T-N1.5-3B`` or ``nvidia/GR00T-N1.5-3B@main``. An
            existing path takes precedence. An id has exactly one slash; ``./model`` and ``/x/y`` are paths.
        revision: A branch, tag or commit of the id. Default: ``main``.
        files: Patterns of the files that are needed, one of the groups of
            :mod:`saccade._internal.hub_files`. Only these are downloaded.
        argument: Name of the argument, for messages.

    Returns:
        For an id, the directory of its revision in the cache of ``huggingface_hub`` (environment variables
        ``HF_HOME`` and ``HF_HUB_CACHE``). A path is returned unchanged, whether it exists or not.

    Raises:
        InputError: ``id_or_path`` is not a path, or ``revision`` is not a revision or is given with a path.
        FileNotFoundError: The id or revision does not exist, or its files are not in the cache and cannot be
            downloaded. The message says what to do.
        PermissionError: The Hub denies access to the repository.

    Example:
        >>> resolve("policy.safetensors").name
        'policy.safetensors'
    """
    return locate(id_or_path, revision, files=files, argument=argument).path


def locate(
    id_or_path: str | os.PathLike[str],
    revision: str | None = None,
    *,
    files: tuple[str, ...] = POLICY,
    argument: str = "id_or_path",
) -> Location:
    """As :func:`resolve`, with the id and the commit that the path belongs to."""
    if isinstance(id_or_path, Location):
        return id_or_path
    text = _text(id_or_path, argument)
    if revision is not None:
        _check_revision(revision)
    published = parse(text)
    if published is None:
        if revision is not None:
            raise InputError(f"revision: expected None with a path, got {revision!r} with {text}")
        _check_cached_folder(Path(text), files, argument)
        return Location(Path(text))
    name, own_revision = published
    if revision is not None and own_revision is not None:
        raise InputError(f"revision: expected None with {text}, which names one, got {revision!r}")
    if own_revision is not None:
        _check_revision(own_revision)
    return locate_published(name, revision or own_revision, files=files, argument=argument)


def parse(text: str) -> tuple[str, str | None] | None:
    """The id and revision that ``text`` names; None if it is a path.

    Whatever exists on this machine is a path, and so is whatever does not have the form of an id.
    """
    published = PUBLISHED.fullmatch(text)
    if published is None or text.endswith((".safetensors", ".json")):
        return None
    # Path.exists raises OSError if a name is too long.
    if os.path.exists(text):  # noqa: PTH110
        return None
    return published["id"], published["revision"]


def locate_published(
    name: str, revision: str | None = None, *, files: tuple[str, ...] = POLICY, argument: str = "id_or_path"
) -> Location:
    """As :func:`locate` for an id, whatever exists under this name on this machine.

    A revision that is a commit is taken from the cache without asking the Hub if all of its files are there.
    Otherwise the Hub is asked which commit and which files the revision has, and missing files are
    downloaded. Without a connection the commit that the cache has for the revision is used.
    """
    revision = revision or DEFAULT_REVISION
    if COMMIT.fullmatch(revision):
        folder = hub_cache.folder_of(name, revision)
        listed = None if folder is None else hub_cache.read_listing(folder)
        if folder is not None and listed is not None and not missing_files(folder, files, listed):
            return Location(folder, name, revision)
    try:
        commit, listed = list_files(name, revision, argument)
    except Offline as offline:
        return _from_cache(name, revision, files, argument, offline)
    absent = absent_files(files, listed)
    if absent:
        raise FileNotFoundError(
            f"{argument}: {_shown(name, revision)}: the repository has no {', '.join(absent)}"
        )
    folder = hub_cache.folder_of(name, commit)
    if folder is None or missing_files(folder, files, listed):
        folder = download(name, commit, files, listed, argument)
    hub_cache.write_listing(folder, listed)
    hub_cache.write_revision(name, revision, commit)
    return Location(folder, name, commit)


def commit_of(path: Path) -> str | None:
    """The commit of the repository whose folder in the cache ``path`` is; None for other paths."""
    return path.name if path.parent.name == "snapshots" and COMMIT.fullmatch(path.name) else None


def _from_cache(
    name: str, revision: str, files: tuple[str, ...], argument: str, offline: Offline
) -> Location:
    """The commit that the cache has for a revision, if it has all files that are needed."""
    shown = _shown(name, revision)
    start = f"{argument}: {shown}: no such path{neighbour(name)}, {offline.reason}, and "
    command = f"hf download {name}" + ("" if revision == DEFAULT_REVISION else f" --revision {revision}")
    remedy = f"{offline.remedy}Download it with: {command}. Or pass the path of a directory"
    folder = hub_cache.folder_of(name, revision)
    if folder is None:
        raise FileNotFoundError(f"{start}it is not in the cache {hub_cache.cache()}. {remedy}")
    listed = hub_cache.read_listing(folder)
    missing = missing_files(folder, files, listed)
    if missing:
        raise FileNotFoundError(
            f"{start}the cache contains only a part of it ({folder} lacks {', '.join(missing)}). {remedy}"
        )
    if listed is None:
        warn(
            f"{shown}: {folder} was not downloaded by saccade, and {offline.reason}: it is not known whether "
            "all files of the repository are there. A missing processor or statistics file changes results"
        )
    if offline.is_unexpected:
        warn(f"{shown}: {offline.reason}: using {folder.name} from the cache, which may not be the newest")
    return Location(folder, name, folder.name)


def _check_cached_folder(path: Path, files: tuple[str, ...], argument: str) -> None:
    """Checks a path that is the folder of a commit in the cache, where files may be missing."""
    listed = hub_cache.read_listing(path) if commit_of(path) else None
    missing = [] if listed is None else missing_files(path, files, listed)
    if missing:
        raise FileNotFoundError(
            f"{argument}: {path} is a part of a published repository and lacks {', '.join(missing)}: pass "
            "the id of the repository, so that they are downloaded"
        )


def _check_revision(revision: object) -> None:
    if not isinstance(revision, str) or REVISION.fullmatch(revision) is None:
        raise InputError(f"revision: expected a branch, tag or commit, got {revision!r}")


def _text(id_or_path: object, argument: str) -> str:
    try:
        text = os.fspath(id_or_path)  # type: ignore[call-overload]
    except TypeError:
        text = None
    if not isinstance(text, str):
        raise InputError(f"{argument}: expected a path or an id, got {type(id_or_path).__name__}")
    if "\0" in text:
        raise InputError(f"{argument}: expected a path without null characters, got {text!r}")
    return text


def _shown(name: str, revision: str) -> str:
    return name if revision == DEFAULT_REVISION else f"{name}@{revision}"
