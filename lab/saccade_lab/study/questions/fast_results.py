"""What the table of the study of fast modes shows: which tasks count, what a mode costs, and the frontier."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import pandas as pd

from saccade._internal.arrays import PRECISIONS
from saccade_lab.study.statistics import (
    CONFIDENCE,
    LOSS_THAT_MATTERS,
    Estimate,
    PairedDifference,
    Verdict,
    bootstrap_ratio,
    holm,
    p_of_loss,
    paired_difference,
    verdict,
    wilson,
)
from saccade_lab.study.table import clusters_of, truths

BASELINE, ONE_STEP = "float32-euler-4", "float32-euler-1"
SIZES = {"n1.5": "N1.5's size, random weights", "own": "this checkpoint"}  # the first that was timed counts
# Those that are read from any part.
COLUMNS = ("task", "seed", "mode", "index", "value", "success", "num_observations")


@dataclass(frozen=True)
class Timed:
    """Milliseconds of a chunk at one size: medians, and the quartiles of the whole."""

    encode: float
    sample: float
    chunk: Estimate


@dataclass(frozen=True)
class ModeResult:
    """What the table shows for one mode; None where it was not measured.

    Attributes:
        name: Name of the mode.
        change: Mean absolute difference of an action from the baseline's.
        ratio: ``change`` divided by the difference that another noise makes.
        error: Mean absolute difference of an action from many small steps.
        successes, episodes: On the tasks that count.
        pairs: The comparison with the baseline on these tasks.
        p_loss: P value of a loss of ``LOSS_THAT_MATTERS``, corrected by Holm; None for modes without a
            verdict. p_value: P value of McNemar's test, corrected by Holm; None for modes without a verdict.
            times: Times by size.
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
    def judged(self) -> bool:
        """Whether there is a verdict on it."""
        return self.pairs is not None and self.p_loss is not None

    @property
    def verdict(self) -> Verdict | None:
        """From the interval of its difference in success; None if it is not judged."""
        return verdict(self.pairs.difference) if self.pairs is not None and self.judged else None

    @property
    def excludes_loss(self) -> bool:
        """Whether a loss of ``LOSS_THAT_MATTERS`` is excluded after Holm's correction."""
        return self.p_loss is not None and self.p_loss < (1 - CONFIDENCE) / 2

    @property
    def significant(self) -> bool:
        """Whether the verdict, unless it is undecided, holds after Holm's correction."""
        if self.verdict == "no worse":
            return self.excludes_loss
        return (
            self.verdict in ("better", "worse") and self.p_value is not None and self.p_value < 1 - CONFIDENCE
        )


def separations(table: pd.DataFrame) -> dict[str, PairedDifference]:
    """One Euler step compared with four, for each task that has both."""
    found = {}
    for task, rows in part(table, "episodes").groupby("task", sort=False):
        pairs = paired(rows, ONE_STEP)
        if pairs is not None:
            found[str(task)] = pairs
    return found


def counts(separation: PairedDifference) -> bool:
    """Whether one step measurably fails on a task: the whole interval is below a loss that matters."""
    return separation.difference.high < -LOSS_THAT_MATTERS


def part(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """The rows of one part of the study; without rows it still has its columns."""
    rows = table[table["part"] == name]
    return rows.reindex(columns=list(dict.fromkeys((*table.columns, *COLUMNS)))) if rows.empty else rows


def paired(episodes: pd.DataFrame, mode: str) -> PairedDifference | None:
    """A mode compared with the baseline on the episodes that both ran."""
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
    """The results of each mode in the table, ordered by precision and steps."""
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
    """A key for sorting: precisions in their order, numbers by size."""
    first, *rest = name.split("-")
    return PRECISIONS.index(first), [
        (not word.isdigit(), float(word) if word.isdigit() else 0.0, word) for word in rest
    ]


def chunk_estimates(rows: pd.DataFrame) -> tuple[Estimate | None, Estimate | None, Estimate | None]:
    """Change, ratio and error of a mode's chunks, with intervals over episodes."""
    if rows.empty:
        return None, None, None
    clusters = clusters_of(rows)
    counts = rows["num_observations"].to_numpy(dtype=float)

    def mean(column: str, over: str | None = None) -> Estimate:
        whole = counts if over is None else counts * rows[over].to_numpy(dtype=float)
        return bootstrap_ratio(counts * rows[column].to_numpy(dtype=float), whole, clusters)

    ratio = None if rows["noise_change"].isna().any() else mean("chunk_change", "noise_change")
    return mean("chunk_change"), ratio, mean("chunk_error")


def timed(row: pd.Series) -> Timed:
    """A row of times."""
    chunk = Estimate(*(float(row[name]) for name in ("chunk_ms", "chunk_ms_low", "chunk_ms_high")))
    return Timed(float(row["encode_ms"]), float(row["sample_ms"]), chunk)


def timed_sizes(results: Mapping[str, ModeResult]) -> list[str]:
    """Sizes at which a mode was timed; the first one counts."""
    return [size for size in SIZES if any(one.times and size in one.times for one in results.values())]


def frontier(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Names of the points that no other point dominates, ordered by time.

    A point is dominated if another one is at least as fast and at least as good, and differs from it.

    Args:
        points: A time and a gain for each name.

    Example:
        >>> frontier({"slow": (4.0, 0.9), "fast": (1.0, 0.8), "slow and worse": (3.0, 0.7)})
        ['fast', 'slow']
    """

    def dominated(name: str) -> bool:
        spent, gain = points[name]
        return any(
            other[0] <= spent and other[1] >= gain and other != (spent, gain) for other in points.values()
        )

    return sorted((name for name in points if not dominated(name)), key=lambda name: points[name])


def by_time(results: Mapping[str, ModeResult]) -> dict[str, tuple[float, float]]:
    """Time and success of each mode that has both, at the size that counts."""
    sizes = timed_sizes(results)
    if not sizes:
        return {}
    return {
        name: (one.times[sizes[0]].chunk.value, one.rate.value)
        for name, one in results.items()
        if one.times and sizes[0] in one.times and one.episodes
    }


def recommended(results: Mapping[str, ModeResult]) -> list[str]:
    """The fastest mode of each precision that is not worse and excludes a loss, also after Holm's correction.

    Success rates of these modes differ by chance only, so the time decides. The baseline is one of them.
    """
    spent = {
        name: time
        for name, (time, _) in by_time(results).items()
        if name == BASELINE
        or (results[name].verdict in ("better", "no worse") and results[name].excludes_loss)
    }
    fastest: dict[str, str] = {}
    for name in sorted(spent, key=spent.__getitem__):
        fastest.setdefault(name.partition("-")[0], name)
    return list(fastest.values())
