"""Pages of docs that a program writes from its measurements."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benches.peers.results import rounded

#: The part of a page that is measured; without these marks, all of it.
MEASURED = re.compile(r"(?<=<!-- measured -->\n).*(?=<!-- end of measured -->)", re.DOTALL)


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
    """
    measured = measured if measured.exists() else kept
    if not measured.exists():
        raise SystemExit(f"{program}: nothing measured yet; run python -m {program}")
    results = json.loads(measured.read_text())
    text = document(results)
    if not write:
        print(text)
        return 0
    if page.exists() and MEASURED.search(before := page.read_text()):
        text = MEASURED.sub(lambda found: f"\n{text}\n", before)
    kept.write_text(json.dumps(rounded(results), indent=1) + "\n")
    page.write_text(text)
    print(page)
    return 0
