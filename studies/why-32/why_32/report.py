"""The report of the study, from its table alone: Markdown and the figures that it shows."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from saccade._internal.files import write_atomically
from saccade.errors import InputError
from saccade_lab.study.page import SavedPicture
from saccade_lab.study.report import draw
from saccade_lab.study.section import Grid, Prose, Section, templates
from saccade_lab.study.table import Provenance

PACKAGE = "why_32"


@dataclass(frozen=True)
class Answered(Section):
    """A section that begins with an answer.

    Attributes:
        answer: Sentences that the section begins with, before its figures.
        commands: Commands that compute the section again.
        reproduction: Paragraphs below these commands: what a repetition needs.
        comparisons: Sentences on comparisons that the answer only counts, and on those not measured.
        above: Names of figures, and the heading of the table that each is drawn above. The others come before
            all tables.
    """

    answer: Sequence[str] = ()
    commands: Sequence[str] = ()
    reproduction: Sequence[str] = ()
    comparisons: Sequence[str] = ()
    above: Mapping[str, str] = field(default_factory=dict)


def prose(name: str, **values: Any) -> Prose:
    """The text of a template of this study."""
    return Prose(name, package=PACKAGE, **values)


def require_commits(table: pd.DataFrame, *, allow_changed: Collection[str]) -> None:
    """Refuses a table with rows that were measured with uncommitted changes.

    Args:
        table: The table of the study.
        allow_changed: Stages whose rows may be; the README says what had changed. A backbone and its
            recording belong to no stage and have the name of the recording.

    Raises:
        InputError: Rows of another stage are.
    """
    changed = table[table["saccade"].astype(str).str.endswith(".changed")]
    stages = set(changed["stage"].fillna(changed["recording"])) - set(allow_changed)
    if stages:
        raise InputError(
            f"measured with uncommitted changes: {', '.join(sorted(map(str, stages)))}; expected at most "
            f"{', '.join(allow_changed) or 'none'}"
        )


def heading(grid: Grid) -> str:
    """What a table is referred to by: "Table 3" if its caption begins with "Table 3. ", else nothing."""
    found = re.match(r"(Table \d+)\. ", grid.caption)
    return found[1] if found else ""


def write_report(section: Answered, provenance: Provenance, directory: Path) -> Path:
    """Writes `report.md` and `figures/*.png`.

    Args:
        section: What `Answer.summarise` says of the table.
        provenance: Of the table.
        directory: Where they are written.

    Returns:
        The path of the Markdown.
    """
    pictures: dict[str, list[SavedPicture]] = defaultdict(list)
    for figure in section.figures:
        saved = draw(directory, f"{provenance.study}-{figure.name}", figure)
        pictures[section.above.get(figure.name, "")].append(saved)
    template = templates(PACKAGE).get_template("report.md.jinja")
    text = template.render(section=section, provenance=provenance, pictures=pictures, heading=heading)
    path = directory / "report.md"
    with write_atomically(path) as temporary:
        temporary.write_text(re.sub(r"\n{3,}", "\n\n", text).strip() + "\n", encoding="utf-8")
    return path
