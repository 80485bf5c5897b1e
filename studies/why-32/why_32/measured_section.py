"""The report's part on what is measured, not judged: measures, single tokens, patching, probes, latencies.

A number is a mean over the training seeds of a recipe, with the interval of `sign_flip`. A seed without the
number is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade_lab.study import figures
from saccade_lab.study.questions.patching_section import ALL, GROUPS
from saccade_lab.study.section import Figure, Grid, Prose, number
from saccade_lab.study.sign_flip import sign_flip
from saccade_lab.study.statistics import Estimate
from saccade_lab.study.table import truths
from why_32 import report
from why_32.contrasts import CORE
from why_32.measured import FIRST_EPISODES
from why_32.measures import MEASURES, NAMES
from why_32.patching import PATCHING
from why_32.probes import DIMENSIONS, PROBES
from why_32.results import ordered
from why_32.specialise import KEPT, LEARNED, LOST, RANDOM, SIZES, SPECIALISE, WEIGHTS
from why_32.times import TIMES, UNTRAINED

#: By recipe: a number with learned tokens, with random ones, and the difference; None where no seed has it.
Compared: TypeAlias = Mapping[str, tuple[Estimate | None, Estimate | None, Estimate | None]]
COMPARED = ("learned", "random", "learned minus random")
#: The two numbers of a set of tokens, and their labels.
PARTS = {"explained": "share explained", "ratio": "ratio"}


def of_measured(table: pd.DataFrame, place: int) -> tuple[list[Figure], list[Grid], dict[str, str]]:
    """The figure and the tables, as far as something is measured, and `Answered.above`.

    Args:
        table: Table of the study.
        place: Number of the first table.
    """
    prose = report.prose("answer_measured")
    pictures: list[Figure] = []
    above: dict[str, str] = {}
    grids: list[Grid] = []
    rows = table[table["kind"] == MEASURES]
    if len(rows):
        grids.append(measure_grid(prose.line("caption_measures", place), ordered(rows)))
    rows = table[table["kind"] == SPECIALISE]
    if len(rows):
        rows, first = ordered(rows), place + len(grids)
        maps = compared(rows[rows["weight"] == KEPT], "overlap")
        picture = overlap_picture(maps)
        pictures.append(Figure("overlap", prose.line("caption_picture"), picture))
        above["overlap"] = f"Table {first}"
        learned = rows[rows["tokens"] == LEARNED]
        grids += [
            overlap_grid(prose.line("caption_overlap", first), maps),
            removal_grid(prose.line("caption_removal", first + 1), rows),
            sum_grid(prose.line("caption_sums", first + 2), learned, sum_note(prose, learned)),
        ]
    rows = table[table["kind"] == PATCHING]
    if len(rows):
        grids.append(patching_grid(prose.line("caption_patching", place + len(grids)), ordered(rows)))
    rows = table[table["kind"] == PROBES]
    if len(rows):
        caption = prose.line("caption_probes", place + len(grids), FIRST_EPISODES, DIMENSIONS)
        grids.append(probe_grid(caption, ordered(rows)))
    rows = table[table["kind"] == TIMES]
    if len(rows):
        cpu = str(rows["cpu"].iloc[0])
        grids.append(time_grid(prose.line("caption_times", place + len(grids), cpu), ordered(rows)))
    return pictures, grids, above


def mean(values: pd.Series) -> Estimate | None:
    """The mean over policies; None if none has a value."""
    known = values.dropna()
    return sign_flip(known.tolist()).difference if len(known) else None


def shown(estimate: Estimate | None, digits: int = 2) -> str:
    """An estimate for a table; nothing for None."""
    return "" if estimate is None else number(estimate, digits=digits)


def recipes_of(rows: pd.DataFrame) -> list[str]:
    """The recipes of rows, in their order."""
    return list(dict.fromkeys(rows["recipe"].astype(str)))


def measure_grid(caption: str, rows: pd.DataFrame) -> Grid:
    """The measures of `measures.NAMES`: a row for each recipe."""
    lines = []
    for recipe in recipes_of(rows):
        some = rows[rows["recipe"] == recipe]
        lines.append([recipe, str(len(some)), *(shown(mean(some[name]), 3) for name in NAMES)])
    return Grid(caption, ("recipe", "policies", *NAMES.values()), lines)


def compared(rows: pd.DataFrame, column: str) -> Compared:
    """A column of `SPECIALISE`, of one weight."""
    found = {}
    for recipe in recipes_of(rows):
        by_kind = rows[rows["recipe"] == recipe].pivot(index="policy", columns="tokens", values=column)
        learned, random = by_kind[LEARNED], by_kind[RANDOM]
        found[recipe] = (mean(learned), mean(random), mean(learned - random))
    return found


def overlap_picture(maps: Compared) -> Picture:
    """The difference between learned and random tokens for each recipe."""
    differences = {recipe: of_recipe[-1] for recipe, of_recipe in maps.items()}
    known = {recipe: one for recipe, one in differences.items() if one is not None}
    label = "overlap of maps, learned minus random tokens"
    return figures.estimates(list(known), list(known.values()), label, reference=0.0, colour="black")


def overlap_grid(caption: str, maps: Compared) -> Grid:
    """The overlap of maps: a row for each recipe."""
    lines = [[recipe, *(shown(one, 3) for one in found)] for recipe, found in maps.items()]
    return Grid(caption, ("recipe", *COMPARED), lines)


def removal_grid(caption: str, rows: pd.DataFrame) -> Grid:
    """What a missing token changes: a row for each recipe and weight."""
    of_weight = {weight: rows[rows["weight"] == weight] for weight in WEIGHTS}
    numbers = {weight: compared(some, "effective_tokens") for weight, some in of_weight.items()}
    largest = {weight: compared(some, "largest_share") for weight, some in of_weight.items()}
    lines = [
        [
            recipe,
            weight,
            *(shown(one, 1) for one in numbers[weight][recipe]),
            shown(largest[weight][recipe][0], 3),
        ]
        for recipe in recipes_of(rows)
        for weight in WEIGHTS
    ]
    return Grid(caption, ("recipe", "weight", *COMPARED, "largest effect, of that of all"), lines)


def sum_note(prose: Prose, rows: pd.DataFrame) -> str:
    """What `sum_grid` shows of the core's policies with most tokens; nothing if they are not measured.

    Args:
        prose: The template.
        rows: Those of learned tokens.
    """
    recipe = list(CORE)[-1]
    some = rows[(rows["recipe"] == recipe) & (rows["weight"] == LOST)]
    numbers = {f"{name}_{size}": mean(some[f"{name}_{size}"]) for size in ("half", "all") for name in PARTS}
    return "" if None in numbers.values() else prose.line("sums", CORE[recipe], **numbers)


def sum_grid(caption: str, rows: pd.DataFrame, note: str) -> Grid:
    """Whether the changes by learned tokens add up: a row for each recipe and weight."""
    names = {f"{size}: {label}": f"{name}_{size}" for size in SIZES for name, label in PARTS.items()}
    lines = []
    for recipe in recipes_of(rows):
        for weight in WEIGHTS:
            some = rows[(rows["recipe"] == recipe) & (rows["weight"] == weight)]
            lines.append([recipe, weight, *(shown(mean(some[name])) for name in names.values())])
    return Grid(caption, ("recipe", "weight", *names), lines, note)


def patching_grid(caption: str, rows: pd.DataFrame) -> Grid:
    """How far the chunks move towards the donors': a row for each recipe, a column for each group of rows."""
    together = rows[rows["block"] == ALL]
    lines = []
    for recipe in recipes_of(together):
        of_recipe = together[together["recipe"] == recipe].groupby("group")["share"]
        lines.append([recipe, *(shown(mean(of_recipe.get_group(group))) for group in GROUPS)])
    return Grid(caption, ("recipe", *GROUPS), lines)


def probe_grid(caption: str, rows: pd.DataFrame) -> Grid:
    """R² of probes: a row for each recipe and group of rows, a column for each block and for inputs."""
    rows = rows.assign(block=pd.to_numeric(rows["block"]).astype(int))
    blocks = sorted(set(rows["block"]))
    lines = []
    for recipe in recipes_of(rows):
        of_recipe = rows[rows["recipe"] == recipe]
        for group in dict.fromkeys(of_recipe["group"]):
            by_block = of_recipe[of_recipe["group"] == group].groupby("block")["r2"]
            found = {block: mean(values) for block, values in by_block}
            policies = str(of_recipe["policy"].nunique())
            lines.append([recipe, policies, str(group), *(shown(found.get(block)) for block in blocks)])
    names = ["input" if block < 0 else f"block {block}" for block in blocks]
    return Grid(caption, ("recipe", "policies", "rows", *names), lines)


def time_grid(caption: str, rows: pd.DataFrame) -> Grid:
    """What heads cost: a row for each recipe, milliseconds and ratios to the first."""
    untrained = truths(rows[UNTRAINED]) if UNTRAINED in rows else rows["recipe"].map(lambda recipe: False)
    lines = []
    for (_, row), first in zip(rows.iterrows(), untrained, strict=True):
        numbers = ["first" if first else "trained", str(int(row["num_vl_tokens"]))]
        for part in ("encode", "sample"):
            ratio = Estimate(*(float(row[f"{part}_ratio{end}"]) for end in ("", "_low", "_high")))
            numbers += [f"{row[f'{part}_ms']:.3f}", shown(ratio)]
        lines.append([str(row["recipe"]), *numbers])
    columns = ("recipe", "weights", "T_vl", "encode, ms", "ratio", "sample, ms", "ratio")
    return Grid(caption, columns, lines)
