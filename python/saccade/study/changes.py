"""What a table says of arms that were measured on a recording: by how much the chunks change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from saccade.study import figures
from saccade.study.arms import ArmStudy, control_line
from saccade.study.section import Figure, Grid, Section, not_measured, number, too_few
from saccade.study.statistics import Estimate, bootstrap_ratio
from saccade.study.table import Provenance, clusters_of

NO_LOOP = f"Success: {not_measured('a file of features has no closed loop')}."
NOT_SHOWN = (
    "A changed chunk is not a failed task: whether it matters can be seen in closed loop only. The next look "
    "may correct what this chunk got wrong.",
    "Intervals are for observations like those of the file, with one set of weights.",
)


@dataclass(frozen=True)
class ArmChange:
    """What the table says of one arm.

    Attributes:
        observations: So many.
        change: Of the chunk; None if it was not measured.
        ratio: The same over what another noise changes; None where noise was not drawn.
        largest: The largest change of one action.
        note: Why it was not measured.
    """

    observations: int
    change: Estimate | None
    ratio: Estimate | None
    largest: float
    note: str | None


def arm_changes(table: pd.DataFrame, arms: Sequence[str]) -> dict[str, ArmChange]:
    """Of those arms that the table has, in that order."""
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
    title: str,
    labels: Mapping[str, str],
    about: Sequence[str],
    not_shown: Sequence[str],
    table: pd.DataFrame,
    provenance: Provenance,
) -> Section:
    """The section of a study of changes.

    Args:
        study: whose baseline and control the arms are compared with.
        title: of the section.
        labels: of the arms, in their order; those that the table has not are passed over.
        about: paragraphs on the arms.
        not_shown: what the study cannot show besides `NOT_SHOWN`.
        table, provenance: of the study.
    """
    found = arm_changes(table, [arm for arm in labels if arm != study.baseline.name])
    measured = {labels[arm]: one.change for arm, one in found.items() if one.change is not None}
    pictures = []
    if measured:
        picture = figures.estimates(
            list(measured), list(measured.values()), "mean |change of an action|", reference=0.0
        )
        caption = "Change of the chunk on equal observations and noise, with a 95 % bootstrap interval."
        pictures.append(Figure("change", caption, picture))
    rows, concluded = [], []
    for arm, one in found.items():
        if one.change is None:
            rows.append([labels[arm], not_measured(str(one.note)), "", ""])
            concluded.append(f"{labels[arm]}: {not_measured(str(one.note))}.")
            continue
        ratio = "" if one.ratio is None else number(one.ratio, digits=2)
        rows.append([labels[arm], str(one.observations), number(one.change, digits=4), ratio])
        if arm == study.control:
            concluded.append(control_line(labels[arm], one.largest))
            continue
        beside = f", {ratio} times what another noise changes" if ratio else ""
        concluded.append(
            f"{labels[arm]}: actions change by {number(one.change, digits=3)} on average{beside}."
        )
    columns = ("arm", "observations", "change of the chunk", "over another noise's")
    return Section(
        title=f"{title}, from a file of features",
        summary=[
            *summary(table, provenance),
            "Change of the chunk: mean over its actions of |change|, with equal noise in every arm, and "
            "beside it the same over what another noise changes (not known where the file brings its noise).",
            *about,
        ],
        figures=pictures,
        grids=[Grid("By arm, with 95 % intervals.", columns, rows)] if rows else [],
        concluded=[*concluded, NO_LOOP, *cautions(table[table["chunk_change"].notna()], provenance)],
        not_shown=(*not_shown, *NOT_SHOWN),
    )


def summary(table: pd.DataFrame, provenance: Provenance) -> list[str]:
    """On what it was measured."""
    checkpoint, features = provenance.settings["checkpoint"], provenance.settings["features"]
    observations = table["seed"].nunique()
    episodes = f" of {table['episode'].nunique()} episodes" if features["episodes"] is not None else ""
    return [
        f"From a file of features, {features['name']} (SHA-256 {features['sha256'][:12]}): {observations} "
        f"observations{episodes}, {checkpoint['num_vl_tokens']} vision-language tokens each; noise: "
        f"{features['noise']}. Checkpoint {checkpoint['name']} (SHA-256 {checkpoint['sha256'][:12]}), N = "
        f"{checkpoint['num_future_tokens']} future tokens, {checkpoint['num_layers']} blocks, "
        f"{checkpoint['num_steps']} Euler steps. Actions are the head's own, normalised; all of the config's "
        "action dimensions count, also those that a robot leaves unused. Intervals are drawn by "
        f"{'episode' if episodes else 'observation'}.",
    ]


def cautions(table: pd.DataFrame, provenance: Provenance) -> list[str]:
    """What is to be known of the intervals; nothing where nothing was measured."""
    if table.empty:
        return []
    lines = []
    if provenance.settings["features"]["episodes"] is None:
        lines.append(
            "The file does not say of which episode an observation is, so each counts by itself. If several "
            "are of one episode, the intervals are too narrow; an array named episode mends that."
        )
    return lines + too_few(table["episode"].nunique(), "independent observations or episodes")
