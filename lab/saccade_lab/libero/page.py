"""The page of a run on LIBERO: one file, which needs no network and no simulator to be written."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from saccade._internal.files import write_atomically
from saccade_lab.libero.protocols import described
from saccade_lab.recordings.pictures import data_url

SHOWN = 4  # pictures of a task
PAGE = "index.html"


def write_page(record: Mapping[str, Any], folder: Path) -> None:
    """Writes ``index.html`` beside the result file.

    Args:
        record: Content of the result file.
        folder: Where it is, with ``pictures/``.

    Raises:
        OSError: A file cannot be written.
    """
    told = {(task["suite"], task["task"]): task["instruction"] for task in record["tasks"]}
    rows = []
    for rate in record["summary"]:
        suite, task = rate["suite"], rate["task"]
        own = [one for one in record["episodes"] if (one["suite"], one["task"]) == (suite, task)]
        low, high = rate["interval"]
        rows.append(
            {
                **rate,
                "name": "all suites" if suite is None else suite if task is None else f"{suite} {task}",
                "instruction": told.get((suite, task), ""),
                "percent": 100 * rate["successes"] / max(1, rate["episodes"]),
                "low": 100 * low,
                "high": 100 * high,
                "own": own,
                "pictures": [found for one in own[:SHOWN] if (found := _picture(folder, one)) is not None],
            }
        )
    source = (resources.files("saccade_lab.libero") / "page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    text = environment.from_string(source).render(
        record=record, rows=rows, protocol=described(record["protocol"]), shown=SHOWN
    )
    with write_atomically(folder / PAGE) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _picture(folder: Path, episode: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the first camera saw last in an episode, if its file is there."""
    name = f"{episode['suite']}-{episode['task']}-{episode['trial']}"
    path = folder / "pictures" / f"{name}.png"
    if not path.is_file():
        return None
    return {**episode, "picture": data_url(path.read_bytes())}
