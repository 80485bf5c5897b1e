"""What the sweeps report: intervals over episodes and over trainings, pictures, tables and sentences."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from saccade.study import figures
from saccade.study.section import Figure, Grid, Section, effect, number, rate
from saccade.study.statistics import CONFIDENCE, Estimate, bootstrap, scaled, tango, wilson
from saccade.study.tables import truths

if TYPE_CHECKING:
    from saccade.study.sweeps import Sweep

PLAIN = "plain"  # the arm of a policy as it is
FEWEST_EPISODES = 10  # for an interval from drawing them


def statement_lines(rows: Iterable[Mapping[Any, Any]]) -> list[str]:
    """A sentence for each supposition."""
    lines = []
    for row in rows:
        least = row.get("detectable", math.nan)
        found = f"a difference of {100 * least:.0f} points" if np.isfinite(least) else "no difference at all"
        lines.append(f"{row['comparison']}: {found}, if {row['supposed']}")
    return lines


def between_runs(first: Sequence[float], second: Sequence[float], episodes: int) -> Estimate:
    """Second less first mean rate of trained policies, with an interval for training them anew.

    Student's t interval over the runs, both sides with the same variance between runs. It is at least what
    the episodes drawn make it, so that runs that happen to agree do not give a narrow interval.

    Args:
        first, second: success rates of the runs.
        episodes: that each rate is of.

    Returns:
        With NaN bounds where a side has one run only, or where the variance is zero.
    """
    value = float(np.mean(second) - np.mean(first))
    if min(len(first), len(second)) < 2:
        return Estimate(value, math.nan, math.nan)
    freedom = len(first) + len(second) - 2
    variance = 0.0
    for rates in (first, second):
        mean = float(np.mean(rates))
        by_episodes = mean * (1 - mean) / episodes
        variance += (len(rates) - 1) / freedom * max(float(np.var(rates, ddof=1)), by_episodes)
    if variance == 0:  # all runs succeeded always, or never
        return Estimate(value, math.nan, math.nan)
    error = math.sqrt(variance * (1 / len(first) + 1 / len(second)))
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, freedom)) * error
    return Estimate(value, max(value - half, -1.0), min(value + half, 1.0))


def same_policies(first: pd.DataFrame, second: pd.DataFrame) -> Estimate:
    """Second less first success of the policies that there are, on the same episodes.

    The mean over a point's runs, episode by episode; see `mean_difference`.
    """
    one, other = (rows.groupby(["task", "seed"])["success"].mean() for rows in (first, second))
    difference = (other - one).dropna()
    return mean_difference(difference.to_numpy(), list(difference.index))


def mean_difference(differences: npt.NDArray[np.float64], episodes: Sequence[Any]) -> Estimate:
    """The mean of differences of success, with an interval from drawing episodes.

    Where few episodes differ, drawing them gives an interval that is too narrow, and none at all where all
    agree. So it also holds Tango's interval for as many pairs with these gains and losses, and there is none
    (NaN) with fewer than `FEWEST_EPISODES`.
    """
    count = len(set(episodes))
    if count < FEWEST_EPISODES:
        return Estimate(float(np.mean(differences)) if count else math.nan, math.nan, math.nan)
    drawn = bootstrap(differences, episodes)
    # An episode counts once, however many policies ran it; so gains and losses may be parts of one.
    by_episode = pd.Series(differences).groupby([str(episode) for episode in episodes]).mean()
    scored = tango(by_episode.clip(lower=0).sum(), -by_episode.clip(upper=0).sum(), count)
    return Estimate(drawn.value, min(drawn.low, scored.low), max(drawn.high, scored.high))


def sweep_section(sweep: Sweep, table: pd.DataFrame) -> Section:
    """A sweep's part of the report."""
    kinds = {kind: rows.dropna(axis=1, how="all") for kind, rows in table.groupby("kind")}
    before = statement_lines(kinds["before"].to_dict("records"))
    summary = [
        "Policies that differ in what is compared and in their training seed only; all of them run the same "
        "episodes. Said before the runs: " + "; ".join(before) + ".",
        "Two intervals stand side by side. 'These policies' is about the policies that were trained, from "
        "the episodes; 'trained anew' is about the point, from its runs (Student's t, with no less variance "
        "than the episodes make). With two runs a point the latter is wide, and it should be: one lucky run "
        "is not a finding.",
    ]
    trained = kinds.get("training", pd.DataFrame())
    unfinished = []
    if "note" in trained:
        in_training = trained[trained["note"].notna()]
        unfinished = [
            f"{name}: not measured, {note}."
            for name, note in zip(in_training["policy"], in_training["note"], strict=True)
        ]
    episodes = kinds.get("episode", pd.DataFrame())
    if episodes.empty:
        return Section(sweep.title, summary, concluded=unfinished or ["Not measured: no episode is done."])
    episodes = episodes.assign(
        success=truths(episodes["success"]).astype(float),
        point=[sweep.label(row) for row in episodes.to_dict("records")],
    )
    whole, partial = whole_runs(episodes[episodes["arm"] == PLAIN])
    if not whole:
        return Section(sweep.title, summary, concluded=partial + unfinished)
    episodes = episodes[episodes["policy"].isin(whole)]
    plain = episodes[episodes["arm"] == PLAIN]
    points = point_order(plain, sweep)
    pictures = [
        Figure(
            "success",
            "Success of every policy, with Wilson's 95 % interval.",
            policy_picture(plain, points),
        )
    ]
    grids = [policy_grid(plain, trained, points), difference_grid(plain, sweep)]
    if (episodes["arm"] != PLAIN).any():
        grids.append(mass_grid(episodes, points))
    if "cost" in kinds:
        grids.append(cost_grid(kinds["cost"], sweep))
    lines = conclusions(plain, sweep) + mass_conclusions(episodes, points) + partial + unfinished
    return Section(sweep.title, summary, pictures, grids, lines, NOT_SHOWN)


NOT_SHOWN = (
    "Intervals hold for each comparison by itself: of twenty comparisons of equal policies one is expected "
    "to exclude zero.",
    "Policies this small, trained this shortly on these tasks, are not the released model: a number of "
    "tokens that does not matter here may matter there.",
    "The validation loss is of single velocities on the demonstrations' observations. It need not rank "
    "policies as closed loop does.",
    "The control of equal mass changes trained policies after the fact. A policy trained with another mass "
    "might use it.",
)


def point_order(plain: pd.DataFrame, sweep: Sweep) -> list[str]:
    """The points' labels in the order of their values."""
    return list(dict.fromkeys(plain.sort_values(list(sweep.varied))["point"]))


def policies_of(rows: pd.DataFrame) -> list[str]:
    """By training seed."""
    return list(dict.fromkeys(rows.sort_values("training_seed")["policy"]))


def wilson_of(rows: pd.DataFrame) -> Estimate:
    """The success rate of one policy's episodes."""
    return wilson(int(rows["success"].sum()), len(rows))


def run_rates(rows: pd.DataFrame) -> list[float]:
    """The success rate of each of a point's runs."""
    return [float(rows.loc[rows["policy"] == name, "success"].mean()) for name in policies_of(rows)]


def policy_picture(plain: pd.DataFrame, points: Sequence[str]) -> Any:
    """Success of every policy."""
    labels, values = [], []
    for point in points:
        of_point = plain[plain["point"] == point]
        for name in policies_of(of_point):
            rows = of_point[of_point["policy"] == name]
            labels.append(f"{point}, seed {int(rows['training_seed'].iloc[0])}")
            values.append(wilson_of(rows))
    return figures.estimates(labels, values, "success rate")


def policy_grid(plain: pd.DataFrame, trained: pd.DataFrame, points: Sequence[str]) -> Grid:
    """Every policy: validation loss, success over all and by task."""
    tasks = list(dict.fromkeys(plain["task"]))
    losses = dict(zip(trained["policy"], trained["validation_loss"], strict=True))
    lines = []
    for point in points:
        of_point = plain[plain["point"] == point]
        for name in policies_of(of_point):
            rows = of_point[of_point["policy"] == name]
            by_task = [rows.loc[rows["task"] == task, "success"] for task in tasks]
            counts = [f"{int(found.sum())}/{len(found)}" for found in by_task]
            seed = str(int(rows["training_seed"].iloc[0]))
            lines.append([point, seed, f"{losses[name]:.3f}", rate(wilson_of(rows)), *counts])
    columns = ("policy", "training seed", "validation loss", "success, %", *tasks)
    return Grid("Every policy: success with Wilson's 95 % interval, then by task.", columns, lines)


def compared(plain: pd.DataFrame, sweep: Sweep) -> list[tuple[str, str]]:
    """Pairs of points that differ in one respect."""
    values = plain.drop_duplicates("point").sort_values(list(sweep.varied))
    points = [(str(row["point"]), [row[name] for name in sweep.varied]) for row in values.to_dict("records")]
    return [
        (first, second)
        for (first, one), (second, other) in itertools.combinations(points, 2)
        if sum(a != b for a, b in zip(one, other, strict=True)) == 1
    ]


def differences(plain: pd.DataFrame, sweep: Sweep) -> list[tuple[str, str, Estimate, Estimate]]:
    """Pairs of points, and how the second differs: these policies, and trained anew."""
    found = []
    for first, second in compared(plain, sweep):
        one, other = plain[plain["point"] == first], plain[plain["point"] == second]
        episodes = len(one) // len(policies_of(one))
        anew = between_runs(run_rates(one), run_rates(other), episodes)
        found.append((first, second, same_policies(one, other), anew))
    return found


def difference_grid(plain: pd.DataFrame, sweep: Sweep) -> Grid:
    """Differences between points, in percentage points of success."""
    lines = [
        [second, first, number(scaled(these), digits=0), number(scaled(anew), digits=0)]
        for first, second, these, anew in differences(plain, sweep)
    ]
    return Grid(
        "Difference of success, percentage points, with 95 % intervals.",
        ("policies", "less", "these policies", "trained anew"),
        lines,
    )


def mass_differences(episodes: pd.DataFrame, points: Sequence[str]) -> list[tuple[str, str, Estimate]]:
    """For each point and control of equal mass, how success differs from the same policies as they are."""
    keys = ["policy", "task", "seed"]
    found = []
    for point in points:
        of_point = episodes[episodes["point"] == point]
        plain = of_point[of_point["arm"] == PLAIN].set_index(keys)["success"]
        for arm in sorted(set(of_point["arm"]) - {PLAIN}):
            weighed = of_point[of_point["arm"] == arm].set_index(keys)["success"]
            change = (weighed - plain).dropna()
            drawn = [(task, seed) for _, task, seed in change.index]
            found.append((point, str(arm), mean_difference(change.to_numpy(), drawn)))
    return found


def mass_grid(episodes: pd.DataFrame, points: Sequence[str]) -> Grid:
    """The controls of equal mass."""
    lines = [
        [point, arm, number(scaled(one), digits=0)] for point, arm, one in mass_differences(episodes, points)
    ]
    return Grid(
        "Control: the future keys together weigh in the softmax as so many tokens would. Difference of "
        "success to the same policies as they are, percentage points, with 95 % intervals over episodes.",
        ("policies", "future keys with the", "difference"),
        lines,
    )


def cost_grid(cost: pd.DataFrame, sweep: Sweep) -> Grid:
    """Latency and memory."""
    lines = []
    for row in cost.sort_values(list(sweep.varied)).to_dict("records"):
        ratios = [
            number(
                Estimate(row[f"{part}_ratio"], row[f"{part}_ratio_low"], row[f"{part}_ratio_high"]), digits=2
            )
            for part in ("encode", "sample")
        ]
        lines.append(
            [
                sweep.label(row),
                f"{row['encode_ms']:.2f}",
                ratios[0],
                f"{row['sample_ms']:.2f}",
                ratios[1],
                f"{row['head_bytes'] / 1e6:.2f}",
                f"{row['context_bytes'] / 1e3:.1f}",
            ]
        )
    return Grid(
        "What the head costs on one thread, median of interleaved rounds; ratios to the first, "
        "with 95 % intervals.",
        ("policies", "encode, ms", "ratio", "sample, ms", "ratio", "weights, MB", "context, kB"),
        lines,
    )


def conclusions(plain: pd.DataFrame, sweep: Sweep) -> list[str]:
    """What the intervals allow to be said of every pair of points that differ in one respect."""
    found = differences(plain, sweep)
    if not found:
        points = ", ".join(point_order(plain, sweep))
        return [f"Only {points} was measured: nothing to compare."]
    lines = []
    for first, second, these, anew in found:
        runs = [len(policies_of(plain[plain["point"] == point])) for point in (first, second)]
        trained = (
            f"trained anew: no interval, with {runs[0]} and {runs[1]} runs"
            if math.isnan(anew.low)
            else f"trained anew ({runs[0]} and {runs[1]} runs): {effect('success', anew)}"
        )
        lines.append(f"{second} against {first}. These policies: {effect('success', these)}; {trained}.")
    return lines


def whole_runs(plain: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Policies that ran every episode that any of them ran, and a line for each of those that did not."""
    ran = {
        str(name): set(zip(rows["task"], rows["seed"], strict=True))
        for name, rows in plain.groupby("policy", sort=False)
    }
    every = set().union(*ran.values())
    whole = [name for name, episodes in ran.items() if episodes == every]
    partial = [
        f"{name}: left out, {len(episodes)} of {len(every)} episodes are done."
        for name, episodes in ran.items()
        if episodes != every
    ]
    return whole, partial


def mass_conclusions(episodes: pd.DataFrame, points: Sequence[str]) -> list[str]:
    """What the control of equal mass says."""
    return [
        f"{point}, future keys with the {arm}: {effect('success', one)}."
        for point, arm, one in mass_differences(episodes, points)
    ]
