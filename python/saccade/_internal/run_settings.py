"""The settings of a run that resumes: results of others are never mixed in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from saccade._internal.files import write_json
from saccade._internal.json import dumps
from saccade._internal.small_files import read_json
from saccade.errors import InputError


def begin(file: Path, settings: Mapping[str, Any], directory: Path) -> None:
    """Writes the settings of a run, or checks that an earlier one had the same.

    Args:
        file: Where they are.
        settings: JSON values.
        directory: What to delete or to replace by another, for messages.

    Raises:
        InputError: The earlier run had others, which are listed, or the file is damaged.
        OSError: It cannot be written.
    """
    now = json.loads(dumps(settings))
    if not file.is_file():
        write_json(file, now)
        return
    before = read_json(file, InputError)
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if names:
        raise InputError(
            f"{directory}: has results with other settings ({', '.join(names)} changed): "
            "choose another directory, or delete this one"
        )
