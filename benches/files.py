"""Writes results and pages. A program that is interrupted leaves the earlier file or the new one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from saccade._internal.files import write_atomically


def write_text(path: Path, text: str) -> None:
    """Writes a text in UTF-8.

    Raises:
        OSError: The file cannot be written.
    """
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_record(path: Path, values: Any) -> None:
    """Writes JSON as the committed records have it: indented by one space, with a final newline.

    Raises:
        OSError: The file cannot be written.
    """
    write_text(path, json.dumps(values, indent=1) + "\n")
