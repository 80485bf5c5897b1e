"""What a table shows about arms that were measured on a recording: by how much the chunks change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from saccade_lab.study import figures
from saccade_lab.study.arms import ROUNDING, ArmStudy
from saccade_lab.study.section import Figure, Grid, Prose, Section, not_measured, number
from saccade_lab.study.statistics import Estimate, bootstrap_ratio
from saccade_lab.study.table import Provenance, clusters_of


@dataclass(frozen=True)
class ArmChange:
    """What the table shows about one arm.

    Attributes:
        observations: Number of observations.
        change: Mean absolute change of an action; None if it was not measured.
        ratio: ``change`` divided by the change that another noise makes; None where noise was not drawn.
        largest: The largest change of one action.
        note: Why it was not measured.
    """

    observations: int
    change: Estimate | None
    ratio: Estimate | None
    largest: float
    note: str | None


def arm_changes(table: pd.DataFrame, arms: Sequence[str]) -> dict[str, ArmChange]:
    """The arms that are in the table, in the given order."""
    found = {}
    for arm in arms:
        rows = table[table["arm"] == arm]
        measured = rows[rows["chunk_change"].notna()]
        if not len(rows):
            continue
        if not len(measured):
            found[arm] = ArmChange(0, None, None, np.nan, str(rows["note"].iloc[0]))
            continue
        clusters, values = clusters_of(measured), measured["chunk_change"].to_numpy(dtype=float)
        scale = measured["noise_change"].to_numpy(dtype=float)
        found[arm] = ArmChange(
            len(measured),
            bootstrap_ratio(values, np.ones_like(values), clusters),
            None if np.isnan(scale).any() or not scale.any() else bootstrap_ratio(values, scale, clusters),
            float(measured["chunk_change_max"].max()),
            None,
        )
    return found


def change_section(
    study: type[ArmStudy],
    prose: Prose,
    labels: Mapping[str, str],
    table: pd.DataFrame,
    provenance: Provenance,
) -> Section:
    """The section of a study of arms on a recording.

    Args:
        study: Its baseline is compared with the other arms, and its control must change nothing.
        prose: Text of the study: ``recorded_title``, ``about`` and ``not_shown_of_arms``.
        labels: Labels of the arms, in their order. Arms that are not in the table are skipped.
        table, provenance: Table of the study and its provenance.
    """
    found = arm_changes(table, [arm for arm in labels if arm != study.baseline.name])
    text = Prose(
        "changes",
        heading=prose.line("recorded_title"),
        about=prose.paragraphs("about"),
        not_shown_of_arms=prose.points("not_shown_of_arms"),
        arms=[
            {"label": labels[arm], "is_control": arm == study.control, **vars(one)}
            for arm, one in found.items()
        ],
        recorded=recorded(table, table[table["chunk_change"].notna()], provenance),
        rounding=ROUNDING,
    )
    measured = {labels[arm]: one.change for arm, one in found.items() if one.change is not None}
    pictures = []
    if measured:
        picture = figures.estimates(
            list(measured), list(measured.values()), "mean |change of an action|", reference=0.0
        )
        pictures.append(Figure("change", text.line("caption_change"), picture))
    rows = []
    for arm, one in found.items():
        if one.change is None:
            rows.append([labels[arm], not_measured(str(one.note)), "", ""])
        else:
            ratio = "" if one.ratio is None else number(one.ratio, digits=2)
            rows.append([labels[arm], str(one.observations), number(one.change, digits=4), ratio])
    columns = ("arm", "observations", "change of the chunk", "relative to another noise")
    return text.section(pictures, [Grid(text.line("caption_arms"), columns, rows)] if rows else [])


def recorded(table: pd.DataFrame, measured: pd.DataFrame, provenance: Provenance) -> dict[str, Any]:
    """What the template ``recording`` says of a recording.

    Args:
        table, provenance: Table of the study and its provenance.
        measured: The rows that intervals are computed from.
    """
    settings = provenance.settings
    has_pictures = "frames" in settings
    given = settings["frames" if has_pictures else "features"]
    known = given["episodes"] is not None
    return {
        "has_pictures": has_pictures,
        "given": given,
        "checkpoint": settings["checkpoint"],
        "observations": table["seed"].nunique(),
        "episodes": table["episode"].nunique() if known else None,
        "clusters": measured["episode"].nunique() if len(measured) else 0,
    }
