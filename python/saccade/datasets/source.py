"""The folder of a data set, which is downloaded if it is the id of a published one."""

from __future__ import annotations

import os
from pathlib import Path

from saccade._internal import hub
from saccade._internal.hub_download import download_dataset
from saccade.errors import InputError


def folder_of(path_or_id: str | os.PathLike[str], revision: str | None = None) -> Path:
    """The folder of a data set.

    Args:
        path_or_id: A path, or an id such as ``lerobot/pusht`` or ``lerobot/pusht@main``.
        revision: A branch, tag or commit of the id.

    Raises:
        InputError: ``path_or_id`` is neither, or ``revision`` is given with a path.
        FileNotFoundError: The id or revision does not exist, or cannot be downloaded.
        PermissionError: The Hub denies access.
    """
    try:
        text = os.fspath(path_or_id)
    except TypeError:
        text = None
    if not isinstance(text, str) or "\0" in text:
        raise InputError(f"path_or_id: expected a path or an id, got {path_or_id!r:.60}")
    published = hub.parse(text)
    if published is None:
        if revision is not None:
            raise InputError(f"revision: expected None with a path, got {revision!r} with {text}")
        return Path(text)
    name, own = published
    if own is not None and revision is not None:
        raise InputError(f"revision: expected None with {text}, which names one, got {revision!r}")
    return download_dataset(name, revision or own, "path_or_id")
