"""What the table of the study of fast modes says: which tasks count, what a mode costs, and the frontier."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade.study import features, figures
from saccade.study.features import NO_LOOP, from_file
from saccade.study.section import (
    Figure,
    Grid,
    Section,
    effect,
    number,
    rate,
    too_few,
)
from saccade.study.statistics import (
    CONFIDENCE,
    LOSS_THAT_MATTERS,
    Estimate,
    PairedDifference,
    bootstrap_ratio,
    holm,
    p_of_loss,
    paired_difference,
    scaled,
    wilson,
)
from saccade.study.tables import Provenance, truths

BASELINE, ONE_STEP = "float32-euler-4", "float32-euler-1"
TITLE = "Fast modes: actions, success and time"
SIZES = {"n1.5": "N1.5's size, random weights", "own": "this checkpoint"}  # the first that was timed counts
COLUMNS = ("task", "seed", "mode", "index", "value", "success", "looks")  # that are asked for of any part
NO_LOSS, SMALL_LOSS, LOSS, OPEN = "less than 5 points", "a loss, less than 5 points", "a loss", "open"

NOT_SHOWN = (
    "Which mode a policy bears depends on the policy: how many answers it has to choose between, how its "
    "weights are spread, how much its task forgives. A mode that wins here can lose elsewhere.",
    "The error of a chunk counts a chunk that takes the other of two good ways as badly wrong, and a small "
    "shift that misses a grasp as nearly right. Only the closed loop tells them apart.",
)
NOT_SHOWN_OF_LOOP = (
    "Times at N1.5's size are of random weights, and success is of a small policy. That the two go together "
    "for N1.5 itself is an assumption; `saccade study fast --features` measures the actions of a checkpoint, "
    "not its success.",
    "Intervals are for these tasks and layouts like these, with one set of weights.",
)


@dataclass(frozen=True)
class Timed:
    """Milliseconds of a chunk at one size: medians, and the quartiles of the whole."""

    encode: float
    sample: float
    chunk: Estimate


@dataclass(frozen=True)
class ModeResult:
    """What the table says of one mode; None where it was not measured.

    Attributes:
        name: Of the mode.
        change: Of the chunk, from the baseline's.
        ratio: The same over what another noise changes.
        error: Of the chunk, from what many steps lead to.
        successes, episodes: On the tasks that count.
        pairs: Compared with the baseline there.
        p_loss: Of "it loses as much as matters", corrected by Holm; None for those that show what counts.
        p_value: McNemar's, corrected likewise.
        times: By size.
    """

    name: str
    change: Estimate | None = None
    ratio: Estimate | None = None
    error: Estimate | None = None
    successes: int = 0
    episodes: int = 0
    pairs: PairedDifference | None = None
    p_loss: float | None = None
    p_value: float | None = None
    times: Mapping[str, Timed] | None = None

    @property
    def rate(self) -> Estimate:
        """Success on the tasks that count."""
        return wilson(self.successes, self.episodes)

    @property
    def verdict(self) -> str | None:
        """What is certain of its loss; None if it was not judged."""
        if self.p_loss is None or self.p_value is None or self.pairs is None:
            return None
        lost = self.p_value < 1 - CONFIDENCE and self.pairs.difference.value < 0
        if self.p_loss < (1 - CONFIDENCE) / 2:
            return SMALL_LOSS if lost else NO_LOSS
        return LOSS if lost else OPEN


def separations(table: pd.DataFrame) -> dict[str, PairedDifference]:
    """One Euler step against four, for each task that has both."""
    found = {}
    for task, rows in part(table, "episodes").groupby("task", sort=False):
        pairs = paired(rows, ONE_STEP)
        if pairs is not None:
            found[str(task)] = pairs
    return found


def counts(separation: PairedDifference) -> bool:
    """Whether one step measurably fails on a task: the interval lies below a loss that matters."""
    return separation.difference.high < -LOSS_THAT_MATTERS


def part(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """The rows of one part of the study, with its columns even if it was not measured."""
    rows = table[table["part"] == name]
    return rows.reindex(columns=list(dict.fromkeys((*table.columns, *COLUMNS)))) if rows.empty else rows


def paired(episodes: pd.DataFrame, mode: str) -> PairedDifference | None:
    """A mode against the baseline on the episodes that both have."""
    by_mode = {
        name: truths(rows.set_index(["task", "seed"])["success"])
        for name, rows in episodes[episodes["mode"].isin((mode, BASELINE))].groupby("mode")
    }
    if len(by_mode) < 2:
        return None
    shared = by_mode[mode].index.intersection(by_mode[BASELINE].index)
    if not len(shared):
        return None
    return paired_difference(by_mode[mode].loc[shared].tolist(), by_mode[BASELINE].loc[shared].tolist())


def results_of(table: pd.DataFrame) -> dict[str, ModeResult]:
    """Of each mode in the table, precisions and steps in order."""
    episodes = part(table, "episodes")
    counted = episodes[
        episodes["task"].isin([task for task, one in separations(table).items() if counts(one)])
    ]
    chunks, times = part(table, "chunks"), part(table, "time")
    found = {}
    for name in sorted(
        {str(mode) for one in (episodes, chunks, times) for mode in one["mode"]}, key=in_order
    ):
        success = truths(counted.loc[counted["mode"] == name, "success"])
        found[name] = ModeResult(
            name,
            *chunk_estimates(chunks[chunks["mode"] == name]),
            successes=int(success.sum()),
            episodes=len(success),
            pairs=paired(counted, name) if name != BASELINE else None,
            times={str(row["task"]): timed(row) for _, row in times[times["mode"] == name].iterrows()},
        )
    judged = {name: one.pairs for name, one in found.items() if one.pairs is not None and name != ONE_STEP}
    of_loss = holm([p_of_loss(pairs, LOSS_THAT_MATTERS) for pairs in judged.values()])
    of_difference = holm([pairs.p_value for pairs in judged.values()])
    for name, p_loss, p_value in zip(judged, of_loss, of_difference, strict=True):
        found[name] = replace(found[name], p_loss=p_loss, p_value=p_value)
    return found


def in_order(name: str) -> tuple[int, list[tuple[bool, float, str]]]:
    """Precisions in their order, then words, numbers by size."""
    first, *rest = name.split("-")
    precisions = ["float32", "bfloat16", "int8"]
    return precisions.index(first), [
        (not word.isdigit(), float(word) if word.isdigit() else 0.0, word) for word in rest
    ]


def chunk_estimates(rows: pd.DataFrame) -> tuple[Estimate | None, Estimate | None, Estimate | None]:
    """Change, ratio and error of a mode's chunks, drawn by episode; the ratio only where noise was drawn."""
    if rows.empty:
        return None, None, None
    clusters = features.clusters_of(rows)
    looks = rows["looks"].to_numpy(dtype=float)

    def mean(column: str, over: str | None = None) -> Estimate:
        whole = looks if over is None else looks * rows[over].to_numpy(dtype=float)
        return bootstrap_ratio(looks * rows[column].to_numpy(dtype=float), whole, clusters)

    ratio = None if rows["noise_change"].isna().any() else mean("chunk_change", "noise_change")
    return mean("chunk_change"), ratio, mean("chunk_error")


def timed(row: pd.Series) -> Timed:
    """A row of times."""
    chunk = Estimate(*(float(row[name]) for name in ("chunk_ms", "chunk_ms_low", "chunk_ms_high")))
    return Timed(float(row["encode_ms"]), float(row["sample_ms"]), chunk)


def timed_sizes(results: Mapping[str, ModeResult]) -> list[str]:
    """Sizes at which anything was timed, the one that counts first."""
    return [size for size in SIZES if any(one.times and size in one.times for one in results.values())]


def frontier(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of what nothing beats, by time: no other is as fast and as good, and better in one of them.

    Args:
        points: by name, a time and a gain.

    Example:
        >>> frontier({"slow": (4.0, 0.9), "fast": (1.0, 0.8), "slow and worse": (3.0, 0.7)})
        ['fast', 'slow']
    """

    def beaten(name: str) -> bool:
        spent, gain = points[name]
        return any(
            other[0] <= spent and other[1] >= gain and other != (spent, gain) for other in points.values()
        )

    return sorted((name for name in points if not beaten(name)), key=lambda name: points[name])


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    results = results_of(table)
    separated = separations(table)
    looped = not from_file(provenance)
    concluded = (
        [*gate_lines(separated), *verdict_lines(results)] if looped else [*chunk_lines(results), NO_LOOP]
    )
    if not looped:
        rows = part(table, "chunks")
        if not rows.empty:
            concluded += features.cautions(rows[rows["mode"] == BASELINE], provenance)
    return Section(
        TITLE if looped else f"{TITLE}, from a file of features",
        summary(table, provenance, results),
        pictures(results),
        [grid for grid in (success_grid(table, results), chunk_grid(results)) if grid is not None],
        concluded,
        (*NOT_SHOWN, *(NOT_SHOWN_OF_LOOP if looped else features.NOT_SHOWN)),
    )


def summary(table: pd.DataFrame, provenance: Provenance, results: Mapping[str, ModeResult]) -> list[str]:
    """What was measured."""
    lines = []
    checkpoint = provenance.settings["checkpoint"]
    chunks, episodes, times = (part(table, name) for name in ("chunks", "episodes", "time"))
    if from_file(provenance):
        if not chunks.empty:
            lines += features.summary(chunks[chunks["mode"] == BASELINE], provenance)
    else:
        lines.append(
            f"Policy {checkpoint['name']} (SHA-256 {checkpoint['sha256'][:12]}), N = "
            f"{checkpoint['num_future_tokens']} future tokens, {checkpoint['num_layers']} blocks."
        )
    lines.append(
        "A mode is precision-integrator-steps, then refresh (state and future rows computed anew at every so "
        "many evaluations) and drop (percent of the vision-language tokens removed, those with the least "
        f"attention). All are compared with {BASELINE}, what the released code does."
    )
    if not chunks.empty:
        looks = int(chunks.loc[chunks["mode"] == BASELINE, "looks"].sum())
        lines.append(
            f"Chunks, on {looks} observations, with equal noise: mean |difference| of an action from the "
            "baseline's, also over what another noise changes, and from what many steps lead to (16 steps of "
            "the midpoint rule, 32 evaluations). 95 % bootstrap intervals over episodes."
        )
    if not episodes.empty:
        lines.append(
            "Success: paired by episode (layout, words and noise), Tango's 95 % interval. A task counts "
            f"if one Euler step loses more than {100 * LOSS_THAT_MATTERS:.0f} points on it for certain. "
            f"A mode loses less than {100 * LOSS_THAT_MATTERS:.0f} points where the interval excludes such a "
            "loss, corrected by Holm for all modes that are judged; so is McNemar's test of a difference."
        )
    for size in timed_sizes(results):
        rows = times[times["task"] == size]
        first = rows.iloc[0]
        lines.append(
            f"Time, {SIZES[size]}: {int(first['num_vl_tokens'])} vision-language tokens, "
            f"{int(first['num_threads'])} thread(s), {first['isa']}; medians of {int(rows['rounds'].min())} "
            "interleaved rounds."
        )
    calibrated = part(table, "calibrate")
    for steps, rows in calibrated[calibrated["task"] == "times"].groupby(calibrated["seed"].astype(str)):
        inner = ", ".join(f"{value:g}" for value in rows.sort_values("index")["value"])
        lines.append(f"Step times found for {steps} steps: 0, {inner}.")
    mass = np.sort(calibrated.loc[calibrated["task"] == "mass", "value"].to_numpy(dtype=float))
    if len(mass):
        held = ", ".join(
            f"{percent} % hold {100 * mass[: len(mass) * percent // 100].sum() / mass.sum():.0f} %"
            for percent in (25, 50, 75)
        )
        lines.append(f"Of the vision-language tokens, those with the least attention: {held} of it.")
    return lines


def gate_lines(separated: Mapping[str, PairedDifference]) -> list[str]:
    """Which tasks count."""
    lines = []
    for task, one in separated.items():
        rates = f"{share(one.both + one.only_first, one)} against {share(one.both + one.only_second, one)} %"
        found = f"one Euler step against four: {rates}, {points(one)}, {one.pairs} pairs"
        lines.append(
            f"{task} counts: {found}."
            if counts(one)
            else f"{task} judges no mode, since one step does not measurably fail on it: {found}."
        )
    if not any(counts(one) for one in separated.values()):
        lines.append(f"No task was shown to tell one step from four ({ONE_STEP}), so no mode is judged.")
    return lines


def share(successes: int, one: PairedDifference) -> str:
    """Of the pairs, in percent."""
    return f"{100 * successes / one.pairs:.0f}"


def points(one: PairedDifference) -> str:
    """A difference with its interval."""
    return f"{number(scaled(one.difference), digits=1)} points"


def verdict_lines(results: Mapping[str, ModeResult]) -> list[str]:
    """What is said of each mode that was judged, and which to take."""
    lines = []
    for name, one in results.items():
        if one.verdict is None or one.pairs is None:
            continue
        said = effect("success", one.pairs.difference)
        if one.verdict == NO_LOSS:
            said = f"loses less than {100 * LOSS_THAT_MATTERS:.0f} points, {points(one.pairs)}"
        elif one.verdict == SMALL_LOSS:
            said = f"{said}, but by less than {100 * LOSS_THAT_MATTERS:.0f} points"
        elif one.verdict == OPEN:
            said = f"open, {points(one.pairs)}"
        lines.append(f"{name}: {said}{saved(results, name)}.")
    judged = [one for one in results.values() if one.verdict is not None and one.pairs is not None]
    if judged:
        lines += too_few(min(one.pairs.pairs for one in judged if one.pairs), "paired episodes")
        best = recommended(results)
        if best:
            lines.append(
                f"The fastest that lose less than {100 * LOSS_THAT_MATTERS:.0f} points: {', '.join(best)}."
            )
    return lines


def saved(results: Mapping[str, ModeResult], name: str) -> str:
    """How long a chunk takes against the baseline's, at each size."""
    parts = []
    for size in timed_sizes(results):
        one, base = (
            found.times.get(size) if found.times else None for found in (results[name], results[BASELINE])
        )
        if one and base:
            parts.append(f"{one.chunk.value / base.chunk.value:.2f} of the time of a chunk ({SIZES[size]})")
    return f"; {', '.join(parts)}" if parts else ""


def chunk_lines(results: Mapping[str, ModeResult]) -> list[str]:
    """What is said without a closed loop."""
    lines = []
    for name, one in results.items():
        if name == BASELINE or one.change is None:
            continue
        beside = f", {number(one.ratio, digits=2)} times what another noise changes" if one.ratio else ""
        lines.append(
            f"{name}: actions change by {number(one.change, digits=4)} on average{beside}"
            f"{saved(results, name)}."
        )
    return lines


def by_time(results: Mapping[str, ModeResult]) -> dict[str, tuple[float, float]]:
    """Time and success of each mode with both, at the size that counts."""
    sizes = timed_sizes(results)
    if not sizes:
        return {}
    return {
        name: (one.times[sizes[0]].chunk.value, one.rate.value)
        for name, one in results.items()
        if one.times and sizes[0] in one.times and one.episodes
    }


def recommended(results: Mapping[str, ModeResult]) -> list[str]:
    """Of each precision the fastest mode that was not found to lose and loses less than what matters.

    Between those the rates differ by chance, so the time decides. The baseline is one of them.
    """
    spent = {
        name: time
        for name, (time, _) in by_time(results).items()
        if results[name].verdict == NO_LOSS or name == BASELINE
    }
    fastest: dict[str, str] = {}
    for name in sorted(spent, key=spent.__getitem__):
        fastest.setdefault(name.partition("-")[0], name)
    return list(fastest.values())


def success_grid(table: pd.DataFrame, results: Mapping[str, ModeResult]) -> Grid | None:
    """Success and time of each mode that ran in closed loop, by task and on those that count."""
    episodes = part(table, "episodes")
    if episodes.empty:
        return None
    tasks = [str(task) for task in dict.fromkeys(episodes["task"])]
    sizes = timed_sizes(results)
    best = frontier(by_time(results))
    rows = []
    for name, one in results.items():
        of_mode = episodes[episodes["mode"] == name]
        if of_mode.empty:
            continue
        by_task = [truths(of_mode.loc[of_mode["task"] == task, "success"]) for task in tasks]
        rows.append(
            [
                name,
                *(f"{int(found.sum())}/{len(found)}" for found in by_task),
                rate(one.rate) if one.episodes else "",
                "" if one.pairs is None else number(scaled(one.pairs.difference), digits=1),
                "" if one.pairs is None else f"{one.pairs.only_second} / {one.pairs.only_first}",
                "" if one.p_loss is None else f"{one.p_loss:.2g}",
                one.verdict or "",
                *(milliseconds(one, size) for size in sizes),
                "yes" if name in best else "",
            ]
        )
    columns = (
        "mode",
        *tasks,
        "success, %",
        "difference, points",
        "lost / won",
        "p of a loss",
        "verdict",
        *(f"ms, {SIZES[size]}" for size in sizes),
        "frontier",
    )
    caption = (
        "Closed loop. Success and difference are of the tasks that count, with 95 % intervals for each mode "
        f"by itself; p of a loss: that it loses {100 * LOSS_THAT_MATTERS:.0f} points or more, corrected "
        "by Holm (below 0.025: it loses less)."
    )
    return Grid(caption, columns, rows)


def milliseconds(one: ModeResult, size: str) -> str:
    """The time of a chunk; encode and sample."""
    found = one.times.get(size) if one.times else None
    return "" if found is None else f"{found.chunk.value:.3g} ({found.encode:.3g} + {found.sample:.3g})"


def chunk_grid(results: Mapping[str, ModeResult]) -> Grid | None:
    """Error of the chunk and time of every mode."""
    sizes = timed_sizes(results)
    rows = [
        [
            name,
            "" if one.change is None else number(one.change, digits=4),
            "" if one.ratio is None else number(one.ratio, digits=2),
            "" if one.error is None else number(one.error, digits=4),
            *(milliseconds(one, size) for size in sizes),
        ]
        for name, one in results.items()
        if one.change is not None or one.times
    ]
    if not rows:
        return None
    columns = (
        "mode",
        f"from {BASELINE}",
        "over another noise's",
        "from many steps",
        *(f"ms, {SIZES[size]}" for size in sizes),
    )
    caption = "Screening: mean |difference| of an action with 95 % intervals, and time (encode + sample)."
    return Grid(caption, columns, rows)


def pictures(results: Mapping[str, ModeResult]) -> list[Figure]:
    """The frontiers, of success and of the chunk's error against time, at each size."""
    found = []
    for size in timed_sizes(results):
        success = {
            name: (one.times[size].chunk, scaled(one.rate))
            for name, one in results.items()
            if one.times and size in one.times and one.episodes
        }
        if success:
            caption = (
                f"Success on the tasks that count against the time of a chunk ({SIZES[size]}), with Wilson's "
                "95 % intervals and quartiles of the time. The line joins the modes that nothing beats."
            )
            picture = scattered(success, "milliseconds a chunk", "success, %")
            found.append(Figure(f"frontier-{size.replace('.', '')}", caption, picture))
    for size in timed_sizes(results)[:1]:
        errors = {
            name: (one.times[size].chunk, one.change)
            for name, one in results.items()
            if one.times and size in one.times and one.change is not None and name != BASELINE
        }
        if errors:
            caption = (
                f"Mean |difference| of an action from {BASELINE} against the time of a chunk ({SIZES[size]})."
            )
            picture = scattered(errors, "milliseconds a chunk", "|difference| of an action", falling=True)
            found.append(Figure("errors", caption, picture))
    return found


def scattered(
    points: Mapping[str, tuple[Estimate, Estimate]], x_label: str, y_label: str, *, falling: bool = False
) -> Picture:
    """Points with whiskers over a logarithmic time, numbered by it; names beside; a line joins the frontier.

    Args:
        points: by name, time and value.
        x_label, y_label: with units.
        falling: small values are good, and the axis is logarithmic too.
    """
    picture, (axes,) = figures.new_picture(height=4.6)
    colours = dict(zip(("float32", "bfloat16", "int8"), figures.COLOURS, strict=False))
    sign = -1 if falling else 1
    best = frontier({name: (x.value, sign * y.value) for name, (x, y) in points.items()})
    axes.plot(
        *zip(*[(points[name][0].value, points[name][1].value) for name in best], strict=True),
        "-",
        color="0.8",
    )
    by_time = sorted(points.items(), key=lambda point: point[1][0].value)
    for rank, (name, (x, y)) in enumerate(by_time, 1):
        precision = name.partition("-")[0]
        whiskers = [[[one.value - one.low], [one.high - one.value]] for one in (x, y)]
        axes.errorbar(
            x.value,
            y.value,
            whiskers[1],
            whiskers[0],
            "o",
            color=colours[precision],
            markersize=4,
            linewidth=1,
        )
        axes.annotate(str(rank), (x.value, y.value), (3, 3), textcoords="offset points", fontsize=7)
        # Names at the points would lie upon each other where modes are alike.
        axes.text(
            1.03,
            1 - rank / (len(by_time) + 1),
            f"{rank}  {name}",
            transform=axes.transAxes,
            fontsize=8,
            color=colours[precision],
            fontweight="bold" if name in best else "normal",
            verticalalignment="center",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.tick_params(axis="x", which="both", labelsize=7)
    if falling:
        axes.set_yscale("log")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    return picture
