"""Pages of docs that a program writes from its measurements."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benches.files import write_record, write_text
from benches.peers.results import rounded


class UncommittedError(SystemExit):
    """A record was measured with uncommitted changes, so that nobody else can measure it again."""


def require_commit(measured: Any, record: Path) -> None:
    """Refuses measurements of a tree with uncommitted changes.

    Args:
        measured: JSON value with a `commit` in each description of a machine, as `git describe --dirty`
            prints it,
            or a version of `saccade` as tables of studies name it.
        record: Its file, for the message.

    Raises:
        UncommittedError: One of them ends with `-dirty` or `.changed`.
    """
    for commit in _commits(measured):
        if commit.endswith(("-dirty", ".changed")):
            raise UncommittedError(
                f"{record}: measured at {commit}, with uncommitted changes; commit them and measure again"
            )


def _commits(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, each in value.items():
            if key in ("commit", "saccade"):
                yield str(each)
            else:
                yield from _commits(each)
    elif isinstance(value, list):
        for each in value:
            yield from _commits(each)


def report(
    measured: Path, kept: Path, page: Path, document: Callable[[Any], str], *, program: str, write: bool
) -> int:
    """Prints what was measured, or writes it to a page and keeps the measurements.

    Args:
        measured: JSON file of the measurements.
        kept: The committed ones, which are used if there are no others.
        page: Page of docs.
        document: Markdown from measurements.
        program: What measures, for the message that there are none.
        write: Whether to write page and `kept`.

    Returns:
        The exit status.

    Raises:
        SystemExit: Nothing is measured yet.
        UncommittedError: `write`, and the measurements are of a tree with uncommitted changes.
    """
    measured = measured if measured.exists() else kept
    if not measured.exists():
        raise SystemExit(f"{program}: nothing measured yet; run python -m {program}")
    results = json.loads(measured.read_text())
    text = document(results)
    if not write:
        print(text)
        return 0
    require_commit(results, measured)
    write_record(kept, rounded(results))
    write_text(page, text)
    print(page)
    return 0
