"""Downloads files of published repositories with ``huggingface_hub``, the extra ``hub``."""

from __future__ import annotations

import glob
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from saccade._internal import hub_cache
from saccade._internal.extras import SACCADE
from saccade._internal.hub_files import missing_files, wanted

#: Seconds until the Hub must answer which files a repository has.
TIMEOUT = 10.0
#: Answers that mean that the Hub does not work at present, in place of an answer about the repository.
OVERLOADED = 429
SERVER_ERROR = 500
DENIED = (401, 403)
#: What to say of a download that ends too early; ``{}`` is why.
STOPPED = "the download stopped ({}). Call again to continue it: finished files are kept"


@dataclass(eq=False)
class Offline(Exception):
    """The Hub cannot be asked."""

    reason: str
    """Why, as a clause."""
    remedy: str = ""
    """What to do about it, a sentence or empty."""
    is_unexpected: bool = False
    """Whether the connection failed, rather than being switched off or not installed."""


def list_files(name: str, revision: str, argument: str, *, kind: str = "model") -> tuple[str, list[str]]:
    """The commit that a revision is now, and the names of all of its files in ascending order.

    ``kind`` is ``"model"`` or ``"dataset"``.

    Raises:
        Offline: The Hub cannot be asked.
        FileNotFoundError: There is no such repository or revision.
        PermissionError: Access is denied.
    """
    if importlib.util.find_spec("huggingface_hub") is None:
        install = SACCADE.install_command(["hub"], ["huggingface_hub"])
        raise Offline(
            "huggingface_hub, which downloads published checkpoints, is not installed",
            f"Install it with: {install}. ",
        )
    from huggingface_hub import HfApi
    from huggingface_hub.errors import OfflineModeIsEnabled

    try:
        api = HfApi(library_name="saccade")
        found = api.repo_info(name, repo_type=kind, revision=revision, timeout=TIMEOUT)
        names = [file.rfilename for file in found.siblings or ()]
        commit = str(found.sha)
        return commit, sorted(names or api.list_repo_files(name, repo_type=kind, revision=commit))
    except OfflineModeIsEnabled:
        raise Offline("HF_HUB_OFFLINE is set", "Unset it. ") from None
    except _errors() as error:
        refused = _refusal(error, name, revision, argument)
        if refused is not None:
            raise refused from error
        raise Offline(f"the Hub cannot be reached ({_line(error)})", is_unexpected=True) from error


def download(name: str, commit: str, files: tuple[str, ...], listed: list[str], argument: str) -> Path:
    """Downloads the files that match into the cache, and returns the directory of the commit there.

    Raises:
        FileNotFoundError: The download stopped before its end.
        PermissionError: Access is denied.
        OSError: A file cannot be written.
    """
    from huggingface_hub import snapshot_download

    names = [glob.escape(name) for name in wanted(files, listed)]
    with _errors_of_download(name, commit, argument, STOPPED):
        folder = snapshot_download(name, revision=commit, allow_patterns=names, library_name="saccade")
    missing = missing_files(Path(folder), files, listed)  # it returns what it has if the connection fails
    if missing:
        raise FileNotFoundError(f"{argument}: {name}: {STOPPED.format('it lacks ' + ', '.join(missing))}")
    return Path(folder)


def download_dataset(name: str, revision: str | None, argument: str) -> Path:
    """Downloads a data set as a whole, and returns the directory of its commit in the cache.

    Without a connection, what the cache has of the revision is returned, unless it is known to be incomplete.

    Raises:
        FileNotFoundError: There is no such data set or revision, it cannot be downloaded, or the download is
            incomplete.
        PermissionError: Access is denied.
        OSError: A file cannot be written.
    """
    SACCADE.require("huggingface_hub")
    from huggingface_hub import snapshot_download

    revision = commit = revision or "main"
    unfinished = f"no such path{neighbour(name)}, and it cannot be downloaded ({{}})"
    # If the Hub refuses, so does `snapshot_download`, except for what is in the cache.
    with suppress(Offline, FileNotFoundError, PermissionError):
        commit, listed = list_files(name, revision, argument, kind="dataset")
        # Before the download, which may be interrupted.
        hub_cache.write_listing(hub_cache.snapshot_of(name, commit, "dataset"), listed)
        hub_cache.write_revision(name, revision, commit, "dataset")
        unfinished = STOPPED
    with _errors_of_download(name, revision, argument, unfinished):
        found = snapshot_download(name, repo_type="dataset", revision=commit, library_name="saccade")
    folder = Path(found)
    missing = [file for file in hub_cache.read_listing(folder) or () if not (folder / file).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{argument}: {name}: the download is incomplete: {folder} lacks {missing[0]}"
            + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
            + ". Call again with a connection to continue it: finished files are kept"
        )
    return folder


@contextmanager
def _errors_of_download(name: str, revision: str, argument: str, unfinished: str) -> Iterator[None]:
    """Raises what the callers document in place of what ``huggingface_hub`` raises.

    ``unfinished`` is what to say if the Hub gave no answer about the repository; ``{}`` in it is why.
    """
    try:
        yield
    except _errors() as error:
        refused = _refusal(error, name, revision, argument)
        if refused is not None:
            raise refused from error
        if isinstance(error, OSError) and error.errno is not None and not isinstance(error, ConnectionError):
            raise  # a full disk, or a cache that cannot be written
        raise FileNotFoundError(f"{argument}: {name}: {unfinished.format(_line(error))}") from error


def _errors() -> tuple[type[BaseException], ...]:
    """What ``huggingface_hub`` raises: its 1.x uses httpx, whose errors are not OSErrors, before requests."""
    from huggingface_hub.errors import HfHubHTTPError

    if importlib.util.find_spec("httpx") is None:
        return OSError, HfHubHTTPError
    from httpx import TransportError

    return OSError, HfHubHTTPError, TransportError


def _refusal(error: BaseException | None, name: str, revision: str, argument: str) -> OSError | None:
    """The error for an answer about the repository; None if the Hub gave no such answer."""
    from huggingface_hub.errors import (
        GatedRepoError,
        HfHubHTTPError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    while not isinstance(error, HfHubHTTPError) or error.response is None:
        if error is None:
            return None
        error = error.__cause__
    what = f"{argument}: {name}"
    if isinstance(error, RevisionNotFoundError):
        return FileNotFoundError(f"{what}: the repository has no revision {revision}")
    if isinstance(error, GatedRepoError):
        return PermissionError(
            f"{what}: the Hub denies access: accept the conditions on the page of the repository, then log "
            "in with: hf auth login"
        )
    if isinstance(error, RepositoryNotFoundError):
        return FileNotFoundError(
            f"{what}: no such path{neighbour(name)}, and no such repository on the Hub, unless it is "
            "private: then log in with: hf auth login"
        )
    status = error.response.status_code
    if status >= SERVER_ERROR or status == OVERLOADED:
        return None
    if status in DENIED:
        return PermissionError(f"{what}: the Hub denies access ({_line(error)})")
    return FileNotFoundError(f"{what}: the Hub refuses the request ({_line(error)})")


def neighbour(name: str) -> str:
    """What to say if a folder has the name of the owner: the id may be a mistyped path."""
    owner, _, model = name.partition("/")
    return f" (there is a folder {owner}, without {model} in it)" if Path(owner).is_dir() else ""


def _line(error: BaseException) -> str:
    """The first line of an error's message."""
    text = str(error.__cause__ or error).strip() or type(error).__name__
    return text.splitlines()[0]
