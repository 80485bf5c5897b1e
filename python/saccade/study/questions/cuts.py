"""`saccade study cuts`: parts of the head cut or replaced, on equal episodes and noise."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from saccade.cli.arguments import add_list, add_rollout_arguments, check_known
from saccade.intervention import ROW_GROUPS, Intervention
from saccade.study import figures
from saccade.study.arms import Arm, ArmStudy, control_line
from saccade.study.changes import change_section
from saccade.study.section import Figure, Grid, Section, effect, not_measured, number, rate, too_few
from saccade.study.source import Float32Array, source_of
from saccade.study.statistics import (
    Estimate,
    PairedDifference,
    bootstrap_ratio,
    detectable_difference,
    holm,
    paired_difference,
    scaled,
    wilson,
)
from saccade.study.table import Provenance, from_file, truths

SHARES = (0.1, 0.25)  # of discordant pairs, for what can be detected

EPILOG = """\
Every arm runs the same episodes: the same layouts, instructions and noise. Success is compared in pairs with
the arm "none", which is always run. The change of the chunk is measured on the observations of "none". With
--features it is measured on the observations of a file, for any checkpoint; success is then unknown.

arms:
{arms}

examples:
  saccade study cuts --episodes 15 --out out/study
  saccade study cuts --arms future-unread future-blind --tasks push --jobs 2 --out out/study
  saccade study cuts --checkpoint checkpoint/ --features looks.npz --out out/study
"""


def cut(*pairs: tuple[str, str]) -> Callable[[Float32Array, np.random.Generator], Intervention]:
    """An intervention of an arm: `(reader, source)` pairs cut in every block."""
    return lambda tokens, rng: Intervention(cut=pairs)


def shuffled(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """The learned tokens in another order."""
    return Intervention(future_tokens=tokens[rng.permutation(len(tokens))])


def averaged(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """As many copies of their mean."""
    return Intervention(future_tokens=np.tile(tokens.mean(axis=0), (len(tokens), 1)))


def zeroed(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """Zeros in their place."""
    return Intervention(future_tokens=np.zeros_like(tokens))


def redrawn(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """Random numbers with the mean and the standard deviation of theirs."""
    drawn = rng.normal(tokens.mean(), tokens.std(), tokens.shape)
    return Intervention(future_tokens=drawn.astype(np.float32))


ALL_ARMS = (
    Arm("none", "nothing changed", "The policy as it is.", lambda tokens, rng: None, needs_future=False),
    Arm(
        "future-unread",
        "{state, action} <- future cut",
        "State and action rows do not see the future rows. This removes every effect of the future tokens, "
        "like N = 0 without training anew.",
        cut(("state", "future"), ("action", "future")),
    ),
    Arm(
        "future-blind",
        "future <- vl cut",
        "The future rows do not see the vision-language tokens: are they a summary of what is seen?",
        cut(("future", "vl")),
    ),
    Arm(
        "future-alone",
        "future <- {state, action} cut",
        "The future rows see neither state nor action rows: are they a scratchpad for them?",
        cut(("future", "state"), ("future", "action")),
    ),
    Arm(
        "action-blind",
        "action <- vl cut",
        "The action rows do not see the vision-language tokens. What is seen reaches them through the future "
        "rows, and also through the state row.",
        cut(("action", "vl")),
        needs_future=False,
    ),
    Arm(
        "rows-blind",
        "{state, action} <- vl cut",
        "Neither state nor action rows see the vision-language tokens: all that is seen must pass through "
        "the future rows.",
        cut(("state", "vl"), ("action", "vl")),
    ),
    Arm(
        "all-blind",
        "{state, future, action} <- vl cut",
        "No row sees the vision-language tokens. A control that must fail: it shows what these tasks are "
        "worth without sight.",
        cut(*((row, "vl") for row in ROW_GROUPS)),
        needs_future=False,
    ),
    Arm(
        "future-shuffled",
        "future tokens shuffled",
        "The learned tokens in another order. A control: they have no positions, so nothing may change but "
        "rounding.",
        shuffled,
    ),
    Arm(
        "future-averaged",
        "future tokens averaged",
        "N copies of the mean of the learned tokens: do they need to differ?",
        averaged,
    ),
    Arm(
        "future-zeroed",
        "future tokens zeroed",
        "Zeros in place of the learned tokens; the rows still read and are read.",
        zeroed,
    ),
    Arm(
        "future-redrawn",
        "future tokens re-drawn",
        "Random tokens with the mean and the standard deviation of the learned ones, others in every "
        "episode: does it matter what was learned?",
        redrawn,
    ),
)
ARMS = {arm.name: arm for arm in ALL_ARMS}
BASELINE = "none"
SHUFFLED = "future-shuffled"


@dataclass(frozen=True)
class Cuts(ArmStudy):
    """What the actions and success lose when parts of the head are cut or replaced.

    Attributes:
        source, arms, metrics: See `ArmStudy`; arms default to all of `ARMS`.
    """

    arms: Sequence[Arm] = ALL_ARMS
    name: ClassVar[str] = "cuts"
    baseline: ClassVar[Arm] = ARMS[BASELINE]
    control: ClassVar[str] = SHUFFLED

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See `Study`."""
        width = max(len(name) for name in ARMS)
        parser.epilog = EPILOG.format(
            arms="\n".join(f"  {arm.name:{width}}  {arm.label}" for arm in ARMS.values())
        )
        add_rollout_arguments(parser, episodes=15)
        add_list(parser, "--arms", help="arms (default: all)")
        parser.add_argument(
            "--engine", choices=("rust", "torch"), help="what computes the action head (default: rust)"
        )

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Cuts:
        """See `Study`."""
        chosen = tuple(args.arms or ARMS)
        check_known("--arms", chosen, ARMS)
        return cls(source_of(args, "engine"), tuple(ARMS[name] for name in chosen))

    def settings(self) -> Mapping[str, Any]:
        """See `Study`."""
        engine = {"engine": self.source.engine_name} if self.source.closed_loop else {}
        return {**super().settings(), **engine}

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See `Study`."""
        return section(table, provenance)


@dataclass(frozen=True)
class ArmResult:
    """What the table says of one arm; `None` or no number where it was not measured.

    Attributes:
        name: Of the arm.
        rate, episodes: Success, over so many.
        pairs: Compared with the unchanged policy.
        change: Of the chunk.
        note: Why it was not measured.
        corrected_p: McNemar's, corrected by Holm for the arms that are compared; the control is not.
    """

    name: str
    rate: Estimate
    episodes: int
    pairs: PairedDifference | None
    change: Estimate | None
    note: str | None
    corrected_p: float | None = None


def arm_results(table: pd.DataFrame) -> list[ArmResult]:
    """One for each arm of the table, in the order of `ARMS`."""
    by_arm = {str(name): rows.set_index(["task", "seed"]) for name, rows in table.groupby("arm")}
    baseline = by_arm.get(BASELINE, pd.DataFrame(columns=["success"]))["success"].dropna()
    results = []
    for name in sorted(by_arm, key=[*ARMS].index):
        rows = by_arm[name]
        measured = rows[rows["success"].notna()]
        note = None if len(measured) else str(rows["note"].iloc[0])
        success = truths(measured["success"])
        shared = success.index.intersection(baseline.index)
        pairs = None
        if name != BASELINE and len(shared):
            pairs = paired_difference(success.loc[shared].tolist(), truths(baseline.loc[shared]).tolist())
        change = None
        if name != BASELINE and len(measured):
            changes = measured["chunk_change"].to_numpy(dtype=float)
            change = bootstrap_ratio(changes, np.ones_like(changes), list(measured.index))
        results.append(
            ArmResult(name, wilson(int(success.sum()), len(success)), len(success), pairs, change, note)
        )
    p_values = {one.name: one.pairs.p_value for one in results if one.pairs and one.name != SHUFFLED}
    corrected = dict(zip(p_values, holm(list(p_values.values())), strict=True))
    return [replace(one, corrected_p=corrected.get(one.name)) for one in results]


NOT_SHOWN_OF_CUTS = (
    "A cut head is one that was never trained. A loss can come from numbers it never met and need "
    "not mean that the information was needed; future-averaged and future-redrawn differ from the "
    "learned tokens in what later blocks meet, too.",
    "No loss after a cut does not mean that the path is unused: the other paths may carry the same. "
    "It says nothing of a policy trained without the path (see the study n).",
)


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """See `Study`."""
    if from_file(provenance):
        labels = {arm.name: arm.label for arm in ARMS.values()}
        about = [f"{arm.label}: {arm.about}" for arm in ARMS.values() if arm.name in set(table["arm"])]
        title = "Cuts: actions with parts of the head cut or replaced"
        return change_section(Cuts, title, labels, about, NOT_SHOWN_OF_CUTS, table, provenance)
    results = arm_results(table)
    measured = [result for result in results if result.episodes]
    compared = [result for result in measured if result.pairs is not None]
    return Section(
        title="Cuts: success in closed loop with parts of the head cut or replaced",
        summary=summary(table, results, provenance),
        figures=pictures(measured, compared),
        grids=[arm_grid(results), task_grid(table, measured)],
        concluded=conclusions(table, results, compared),
        not_shown=(
            *NOT_SHOWN_OF_CUTS,
            "Success is one bit an episode. An arm can move the actions (see the change of the chunk) "
            "without moving success on tasks that forgive it.",
            "Intervals are for these tasks and for layouts like these, with one set of weights; another "
            "training run may use its future tokens otherwise. They hold for each arm by itself: of twenty "
            "arms without an effect one is expected to show one.",
        ),
    )


def summary(table: pd.DataFrame, results: Sequence[ArmResult], provenance: Provenance) -> list[str]:
    """What was run."""
    checkpoint = provenance.settings["checkpoint"]
    tasks = list(dict.fromkeys(table["task"]))
    episodes = max(result.episodes for result in results)
    lines = [
        f"Policy {checkpoint['name']} (SHA-256 {checkpoint['sha256'][:12]}), N = "
        f"{checkpoint['num_future_tokens']} future tokens, {checkpoint['num_layers']} blocks, "
        f"{checkpoint['num_steps']} Euler steps, {provenance.settings['engine']} engine. {episodes} "
        f"episodes an arm over the tasks {', '.join(tasks)}. Every arm has the same layouts, words and "
        "noise, and is compared with the unchanged policy on the same episodes.",
        "Success: Wilson's 95 % interval. Difference of success: Tango's 95 % score interval for paired "
        "proportions, and McNemar's exact test. Change of the chunk: mean over the actions of a chunk of "
        "|change|, actions in [-1, 1], on the observations and with the noise of the unchanged policy's "
        "episodes; 95 % bootstrap interval over episodes.",
    ]
    lines += [f"{ARMS[result.name].label}: {ARMS[result.name].about}" for result in results]
    return lines


def pictures(measured: Sequence[ArmResult], compared: Sequence[ArmResult]) -> list[Figure]:
    """Success, difference and change by arm."""
    found = []
    if measured:
        labels = [ARMS[result.name].label for result in measured]
        picture = figures.estimates(labels, [scaled(result.rate) for result in measured], "success, %")
        found.append(Figure("success", "Success by arm, with Wilson's 95 % interval.", picture))
    if compared:
        labels = [ARMS[result.name].label for result in compared]
        differences = [scaled(result.pairs.difference) for result in compared if result.pairs]
        picture = figures.estimates(
            labels, differences, "difference of success from the unchanged policy, points", reference=0.0
        )
        found.append(
            Figure("difference", "Paired difference of success, with Tango's 95 % interval.", picture)
        )
        changes = [result.change for result in compared if result.change]
        picture = figures.estimates(labels, changes, "mean |change of an action|", reference=0.0)
        caption = "Change of the chunk on equal observations and noise, with a 95 % bootstrap interval."
        found.append(Figure("change", caption, picture))
    return found


def arm_grid(results: Sequence[ArmResult]) -> Grid:
    """All numbers by arm."""
    rows = []
    for result in results:
        cells = [ARMS[result.name].label]
        if result.note is not None:
            cells += [not_measured(result.note)] + [""] * 6
        else:
            pairs = result.pairs
            cells += [
                f"{round(result.rate.value * result.episodes)}/{result.episodes}",
                rate(result.rate),
                "" if pairs is None else number(scaled(pairs.difference), digits=1),
                "" if pairs is None else f"{pairs.only_second} / {pairs.only_first}",
                "" if pairs is None else f"{pairs.p_value:.2g}",
                "" if result.corrected_p is None else f"{result.corrected_p:.2g}",
                "" if result.change is None else number(result.change, digits=4),
            ]
        rows.append(cells)
    columns = (
        "arm",
        "successes",
        "success, %",
        "difference, points",
        "lost / won",
        "p",
        "p corrected",
        "change of the chunk",
    )
    caption = (
        "By arm, with 95 % intervals. Lost and won: episodes in which only the unchanged policy, or only "
        "this arm, succeeded; p: McNemar's exact test, for each arm by itself and corrected for all of them "
        "by Holm."
    )
    return Grid(caption, columns, rows)


def task_grid(table: pd.DataFrame, measured: Sequence[ArmResult]) -> Grid:
    """Successes by arm and task."""
    tasks = list(dict.fromkeys(table["task"]))
    rows = []
    for result in measured:
        of_arm = table[(table["arm"] == result.name) & table["success"].notna()]
        counts = [truths(of_arm.loc[of_arm["task"] == task, "success"]) for task in tasks]
        rows.append([ARMS[result.name].label, *(f"{int(found.sum())}/{len(found)}" for found in counts)])
    return Grid("Successes by arm and task.", ("arm", *tasks), rows)


def conclusions(
    table: pd.DataFrame, results: Sequence[ArmResult], compared: Sequence[ArmResult]
) -> list[str]:
    """What the intervals allow to be said."""
    lines = []
    for result in results:
        label = ARMS[result.name].label
        if result.note is not None:
            lines.append(f"{label}: {not_measured(result.note)}.")
        elif result.name == SHUFFLED:
            changes = table.loc[table["arm"] == SHUFFLED, "chunk_change_max"]
            lines.append(control_line(label, float(changes.max())))
        elif result.pairs is not None and result.change is not None:
            change = number(result.change, digits=3)
            on_success = effect("success", result.pairs.difference) + where_lost(table, result)
            lines.append(f"{label}: {doubt(result)}{on_success}; actions change by {change} on average.")
    if compared:
        pairs = min(result.pairs.pairs for result in compared if result.pairs)
        lines.append(
            f"What {pairs} paired episodes find with 80 % power: {'; '.join(map(found_by(pairs), SHARES))}."
        )
        lines += too_few(pairs, "paired episodes")
    return lines


def found_by(pairs: int) -> Callable[[float], str]:
    """What so many pairs find, for a share of discordant ones."""

    def describe(share: float) -> str:
        value = detectable_difference(pairs, share)
        size = f"{100 * value:.0f} points" if np.isfinite(value) else "no difference at all"
        return f"{size}, if {100 * share:.0f} % of the episodes go otherwise in the other arm"

    return describe


def where_lost(table: pd.DataFrame, result: ArmResult) -> str:
    """Names the task with more than half of the lost episodes, if several are lost and there is one."""
    success = table[table["success"].notna()].set_index(["task", "seed", "arm"])["success"]
    both = truths(success).unstack("arm")[[BASELINE, result.name]].dropna().astype(bool)
    lost = both.index[both[BASELINE] & ~both[result.name]].get_level_values("task").value_counts()
    if len(both.index.unique("task")) < 2 or lost.sum() < 3 or 2 * lost.iloc[0] <= lost.sum():
        return ""
    return f", {lost.iloc[0]} of the {lost.sum()} lost episodes in {lost.index[0]}"


def doubt(result: ArmResult) -> str:
    """What is to be said first where an interval excludes zero and the corrected test does not."""
    assert result.pairs is not None
    difference, p = result.pairs.difference, result.corrected_p
    if p is None or p < 0.05 or difference.low <= 0 <= difference.high:
        return ""
    return f"no finding after correction for the arms compared (Holm, p = {p:.2g}); by itself, "
