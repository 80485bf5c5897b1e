"""The report's section on gradients: the values of its template, its figures and its tables."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade_lab.study import figures
from saccade_lab.study.changes import recorded
from saccade_lab.study.paths import DETOUR, DIRECT, PATHS, READ
from saccade_lab.study.section import Figure, Grid, Prose, Section, number
from saccade_lab.study.statistics import Estimate, bootstrap
from saccade_lab.study.table import Provenance, clusters_of, is_recorded

LABELS = {"actions": "change of the chunk (norm)", "loss": "change of the loss"}


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    settings = provenance.settings
    episodes = {str(kind): len(rows.groupby(["task", "seed"])) for kind, rows in table.groupby("of")}
    paths = table[table["path"].notna()] if "path" in table else table.iloc[:0]
    prose = Prose(
        "gradients",
        recorded=recorded(table, table, provenance) if is_recorded(provenance) else None,
        checkpoint=settings["checkpoint"],
        episodes=episodes.get("actions", 0),
        num_observations=settings.get("num_observations"),
        projections=settings["projections"],
        demonstrations=episodes.get("loss", 0),
        paths=path_estimates(paths) if len(paths) else None,
        inputs=input_shares(table),
    )
    pictures = [
        Figure(
            f"rows-of-{kind}",
            prose.line("caption_rows", kind),
            rows_picture(table[table["of"] == kind], label),
        )
        for kind, label in LABELS.items()
        if kind in episodes
    ]
    if "token" in table:
        pictures.append(Figure("tokens", prose.line("caption_tokens"), token_picture(table)))
    grids = [input_grid(prose, table)] if "input" in table else []
    if not len(paths):
        return prose.section(pictures, grids)
    share = [mean_of(shares_of(paths, path), "share") for path in PATHS]
    picture = figures.estimates(PATHS, share, "share of the derivative", reference=0)
    pictures.insert(0, Figure("paths", prose.line("caption_paths"), picture))
    return prose.section(pictures, [path_grid(prose, paths), cosine_grid(prose, paths), *grids])


def path_estimates(paths: pd.DataFrame) -> dict[str, Estimate]:
    """Shares and lengths of the paths, and the share of all paths through future rows."""
    through = paths[paths["path"].isin((READ, DETOUR)) & paths["share"].notna()]
    sums = through.groupby(["task", "seed"])["share"].sum()  # sorted, as are the clusters
    observed = through.sort_values(["task", "seed"]).drop_duplicates(["task", "seed"])
    return {
        "direct": mean_of(shares_of(paths, DIRECT), "share"),
        "read": mean_of(shares_of(paths, READ), "share"),
        "detour": mean_of(shares_of(paths, DETOUR), "share"),
        "through_future": bootstrap(sums.to_numpy(), clusters_of(observed)),
        "direct_length": mean_of(shares_of(paths, DIRECT), "length"),
        "read_length": mean_of(shares_of(paths, READ), "length"),
    }


def mean_of(table: pd.DataFrame, column: str) -> Estimate:
    """The mean with a bootstrap interval over episodes."""
    return bootstrap(table[column].to_numpy(), clusters_of(table))


def rows_picture(table: pd.DataFrame, label: str) -> Picture:
    """A line over the blocks for each group of rows."""
    groups = table[table["group"].notna() & (table["token"].isna() if "token" in table else True)]
    blocks = sorted(int(block) for block in groups["block"].unique())
    series = {
        str(group): [mean_of(rows[rows["block"] == block], "relative") for block in blocks]
        for group, rows in groups.groupby("group")
    }
    return figures.lines(blocks, series, "after block", label)


def token_picture(table: pd.DataFrame) -> Picture:
    """An estimate for each learned token, the largest first."""
    tokens = table[(table["of"] == "actions") & table["token"].notna()]
    found = {
        int(token): mean_of(tokens[tokens["token"] == token], "relative")
        for token in tokens["token"].unique()
    }
    order = sorted(found, key=lambda token: -found[token].value)
    picture, (axes,) = figures.new_picture()
    for place, token in enumerate(order):
        axes.plot([place, place], [found[token].low, found[token].high], color=figures.COLOURS[0])
        axes.plot([place], [found[token].value], "o", color=figures.COLOURS[0], markersize=4)
    axes.set_xticks(range(len(order)), [str(token) for token in order], fontsize="x-small")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("future token")
    axes.set_ylabel("change of the chunk (norm)")
    return picture


def shares_of(paths: pd.DataFrame, path: str) -> pd.DataFrame:
    """The rows with the length and share of a path."""
    return paths[(paths["path"] == path) & paths["share"].notna()]


def parts_of(table: pd.DataFrame) -> dict[tuple[str, str], pd.DataFrame]:
    """The rows of each part of the backbone's inputs, by kind of input and part; none without pictures."""
    if "input" not in table:
        return {}
    whole = table[table["input"].notna() & table["row"].isna()]
    return {
        (str(kind), str(part)): rows for (kind, part), rows in whole.groupby(["input", "part"], sort=False)
    }


def input_shares(table: pd.DataFrame) -> dict[str, dict[str, Estimate]]:
    """The share of each part, by kind of input: ``tokens`` and ``pixels``."""
    found: dict[str, dict[str, Estimate]] = {}
    for (kind, part), rows in parts_of(table).items():
        found.setdefault(kind, {})[part] = mean_of(rows, "share")
    return found


def input_grid(prose: Prose, table: pd.DataFrame) -> Grid:
    """Norms and shares of the parts of the backbone's inputs."""
    rows = []
    for (kind, part), found in parts_of(table).items():
        relative = number(mean_of(found, "relative"), digits=3) if kind == "tokens" else ""
        norm = number(mean_of(found, "norm"), digits=3)
        rows.append([kind, part, norm, relative, number(mean_of(found, "share"), digits=2)])
    columns = ("by", "part", "norm", "norm times length", "share")
    return Grid(prose.line("caption_inputs"), columns, rows)


def path_grid(prose: Prose, paths: pd.DataFrame) -> Grid:
    """Lengths and shares of the paths, over all and by task."""
    rows = []
    for path in PATHS:
        of_path = shares_of(paths, path)
        by_task = [
            number(mean_of(values, "share"), digits=2) for _, values in of_path.groupby("task", sort=False)
        ]
        rows.append(
            [
                path,
                number(mean_of(of_path, "length"), digits=2),
                number(mean_of(of_path, "share"), digits=2),
                *by_task,
            ]
        )
    tasks = list(dict.fromkeys(paths["task"]))
    return Grid(prose.line("caption_lengths"), ("path", "length", "share", *tasks), rows)


def cosine_grid(prose: Prose, paths: pd.DataFrame) -> Grid:
    """Cosines between paths."""
    pairs = paths[paths["cosine"].notna()]
    rows = [
        [str(one), str(other), number(mean_of(values, "cosine"), digits=2)]
        for (one, other), values in pairs.groupby(["path", "other_path"], sort=False)
    ]
    return Grid(prose.line("caption_cosines"), ("path", "other path", "cosine"), rows)
