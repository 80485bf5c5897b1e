"""`saccade study n-runtime`: a policy's number of future tokens changed at run time, without training.

Some of the learned tokens, tokens merged with those like them, tokens repeated: in closed loop on equal
seeds, with and without the weight in the softmax that the learned number of tokens would have.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.cluster.hierarchy import fcluster, linkage

from saccade.errors import InputError
from saccade.intervention import Intervention
from saccade.sim.policy import Float32Array
from saccade.study import figures
from saccade.study.arguments import UNLIMITED, numbers
from saccade.study.arms import NO_TOKENS, control_line
from saccade.study.cells import Cell, OnDone, run_cells
from saccade.study.closed_loop import ArmWork
from saccade.study.features import (
    Changes,
    Recording,
    change_section,
    from_file,
    head_and_observations,
    recording_of,
)
from saccade.study.loaded import describe_checkpoint
from saccade.study.observations import Rollouts, add_rollout_arguments, rollouts_of
from saccade.study.section import Figure, Grid, Section, effect, not_measured, number, rate
from saccade.study.statistics import Estimate, bootstrap, paired_difference, scaled, wilson
from saccade.study.tables import Provenance, truths

STUDY = "n-runtime"
BASELINE = "as learned"
TWICE, TWICE_EQUAL = "every token twice", "every token twice, equal mass"
ARMS_ARE = (
    "Drawn: others in every episode. Merged: by the cosine between learned tokens; each counts as many "
    "times as it stands for. Equal mass: the keys together weigh in the softmax as much as all learned "
    "tokens would."
)

EPILOG = """\
Arms, for each number K of --sizes: K of the tokens, drawn anew for every episode; the same with the mass of
all (their keys count N / K times); tokens merged to K with those like them, each counting as many times as
it stands for. And every token twice, with twice the mass, and with the same (which must change nothing).

examples:
  saccade study n-runtime --out out/study
  saccade study n-runtime --checkpoint out/policy --sizes 1,4,16 --episodes 20 --out out/study
  saccade study n-runtime --checkpoint checkpoint/ --features looks.npz --out out/study
"""


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        rollouts: The episodes of every arm.
        sizes: Numbers of tokens to go down to; empty if the policy has no tokens.
    """

    rollouts: Rollouts
    sizes: tuple[int, ...]


@dataclass(frozen=True)
class FileSettings:
    """What to run on a file of features; attributes as in `Settings`."""

    recording: Recording
    sizes: tuple[int, ...]


def arms_of(sizes: Sequence[int]) -> list[str]:
    """The arms, by name."""
    down = [arm for size in sizes for arm in (f"{size} drawn", f"{size} drawn, equal mass", f"{size} merged")]
    return [BASELINE, *down, TWICE, TWICE_EQUAL]


def resized(arm: str, tokens: Float32Array, rng: np.random.Generator) -> Intervention | None:
    """What an arm does.

    Args:
        arm: of `arms_of`.
        tokens: the learned ones, `(N, width)`.
        rng: draws tokens.
    """
    count = len(tokens)
    if arm == BASELINE:
        return None
    if arm == TWICE:
        return Intervention(future_tokens=np.repeat(tokens, 2, axis=0))
    if arm == TWICE_EQUAL:
        return Intervention(future_tokens=np.repeat(tokens, 2, axis=0), key_bias={"future": -np.log(2)})
    size = int(arm.split()[0])
    if arm.endswith("merged"):
        merged, counts = merge(tokens, size)
        return Intervention(future_tokens=merged, key_bias={"future": np.log(counts)})
    drawn = tokens[np.sort(rng.choice(count, size, replace=False))]
    if arm.endswith("equal mass"):
        return Intervention(future_tokens=drawn, key_bias={"future": np.log(count / size)})
    return Intervention(future_tokens=drawn)


def merge(tokens: Float32Array, size: int) -> tuple[Float32Array, Float32Array]:
    """Tokens merged to at most `size`, those in the most similar directions first.

    Equal tokens are merged without loss: copies of a token are one token with the logarithm of their number
    on its key. Others become their mean, which is an approximation.

    Returns:
        `(size, width)`, and `(size,)` how many tokens each stands for.
    """
    if size >= len(tokens):
        return tokens, np.ones(len(tokens), np.float32)
    groups = fcluster(linkage(tokens, "average", metric="cosine"), size, "maxclust")
    names, counts = np.unique(groups, return_counts=True)
    merged = np.stack([tokens[groups == name].mean(axis=0) for name in names])
    return merged, counts.astype(np.float32)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    add_rollout_arguments(parser, episodes=15)
    parser.add_argument(
        "--sizes", metavar="NUMBER,...", help="numbers of tokens to go down to (default: N/8, N/4 and N/2)"
    )


def settings(args: argparse.Namespace) -> Settings | FileSettings:
    """The settings, checked."""
    if args.features is not None:
        recording = recording_of(args)
        head, _ = head_and_observations(recording)
        return FileSettings(recording, sizes_of(args, head.config.num_future_tokens))
    rollouts = rollouts_of(args)
    return Settings(
        rollouts, sizes_of(args, int(describe_checkpoint(rollouts.checkpoint)["num_future_tokens"]))
    )


def sizes_of(args: argparse.Namespace, count: int) -> tuple[int, ...]:
    """The numbers of tokens to go down to from `count`; none if there are no tokens."""
    if count == 0:
        return ()
    if args.sizes is None:
        return tuple(sorted({count // 8, count // 4, count // 2} - {0}))
    sizes = numbers("--sizes", args.sizes, UNLIMITED)
    if not all(1 <= size < count for size in sizes):
        raise InputError(
            f"sizes: given {args.sizes}, expected 1 to {count - 1}; the policy has {count} tokens"
        )
    return sizes


def run(settings: Settings | FileSettings, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
    """A cell is an episode of one arm; those of one episode lie side by side, for they share what it saw."""
    if isinstance(settings, FileSettings):
        arms = arms_of(settings.sizes)
        CHANGES.run(settings.recording, arms, out, backend=backend, jobs=jobs, on_done=on_done)
        return
    rollouts = settings.rollouts
    described = describe_checkpoint(rollouts.checkpoint)
    arms = arms_of(settings.sizes) if described["num_future_tokens"] else [TWICE]
    run_cells(
        STUDY,
        [Cell((*episode, arm)) for episode in rollouts.episodes for arm in arms],
        ArmWork(rollouts.checkpoint, "rust", resized, why_not),
        out,
        settings={"checkpoint": described},
        backend=backend,
        jobs=jobs,
        on_done=on_done,
    )


def why_not(arm: str, num_future_tokens: int) -> str | None:
    """Why an arm cannot be measured on a head with so many tokens, or None."""
    return None if num_future_tokens or arm == BASELINE else NO_TOKENS


CHANGES = Changes(STUDY, BASELINE, TWICE_EQUAL, resized, why_not)


@dataclass(frozen=True)
class Result:
    """What the table says of one arm."""

    rate: Estimate
    successes: str
    difference: Estimate
    change: Estimate
    largest: float


def results_of(table: pd.DataFrame) -> dict[str, Result]:
    """Every arm but the baseline, compared with it on the same episodes."""
    by_arm = {str(arm): rows.set_index(["task", "seed"]) for arm, rows in table.groupby("arm", sort=False)}
    baseline = truths(by_arm[BASELINE]["success"])
    found = {}
    for arm, rows in by_arm.items():
        success = truths(rows["success"])
        shared = success.index.intersection(baseline.index)
        if arm != BASELINE and len(shared):
            found[arm] = Result(
                wilson(int(success.sum()), len(success)),
                f"{int(success.sum())}/{len(success)}",
                paired_difference(success[shared].tolist(), baseline[shared].tolist()).difference,
                bootstrap(rows["chunk_change"].to_numpy(), list(rows.index)),
                float(rows["chunk_change_max"].max()),
            )
    return found


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    title = "Number of future tokens changed without training"
    if from_file(provenance):
        names = {arm: arm for arm in sorted(dict.fromkeys(table["arm"]), key=arm_order)}
        return change_section(CHANGES, title, names, (ARMS_ARE,), NOT_SHOWN, table, provenance)
    if table["note"].notna().any() or not (table["arm"] == BASELINE).any():
        return Section(title, concluded=[f"{not_measured(NO_TOKENS).capitalize()}."])
    checkpoint = provenance.settings["checkpoint"]
    baseline = truths(table[table["arm"] == BASELINE]["success"])
    whole = wilson(int(baseline.sum()), len(baseline))
    results = dict(sorted(results_of(table).items(), key=lambda item: arm_order(item[0])))
    summary = [
        f"{checkpoint['name']}, N = {checkpoint['num_future_tokens']}, {len(baseline)} episodes an arm on "
        f"equal seeds and noise; as learned it succeeds in {rate(whole)} %. The change of the chunk is "
        f"measured on what the unchanged policy saw. {ARMS_ARE}",
    ]
    pictures = []
    if results:
        labels = list(results)
        pictures = [
            Figure(
                "difference",
                "Difference of success to the policy as it is, with Tango's 95 % interval.",
                figures.estimates(
                    labels, [scaled(one.difference) for one in results.values()], "points", reference=0.0
                ),
            ),
            Figure(
                "change",
                "Mean change of an action of the chunk, with a 95 % bootstrap interval over episodes.",
                figures.estimates(
                    labels, [one.change for one in results.values()], "mean |change of an action|"
                ),
            ),
        ]
    grid = Grid(
        "By arm, with 95 % intervals; the difference is paired by episode.",
        ("arm", "successes", "success, %", "difference, points", "change of the chunk"),
        [
            [
                arm,
                one.successes,
                rate(one.rate),
                number(scaled(one.difference), digits=1),
                number(one.change, digits=4),
            ]
            for arm, one in results.items()
        ],
    )
    return Section(title, summary, pictures, [grid], conclusions(results), NOT_SHOWN)


NOT_SHOWN = (
    "Intervals hold for each arm by itself: of twenty arms without an effect one is expected to exclude "
    "zero.",
    "A policy trained with another number of tokens would have learned other tokens; the study n trains "
    "them.",
    "With fewer tokens the later blocks meet rows that they never met in training. A loss need not mean "
    "that the missing tokens knew something.",
)


def arm_order(arm: str) -> tuple[bool, int, str]:
    """Fewer tokens first, repeated ones last."""
    size = arm.split()[0]
    return (not size.isdigit(), int(size) if size.isdigit() else 0, arm)


def conclusions(results: Mapping[str, Result]) -> list[str]:
    """What the intervals allow to be said."""
    lines = []
    for arm, one in results.items():
        if arm == TWICE_EQUAL:
            lines.append(control_line(arm, one.largest))
        else:
            lines.append(f"{arm}: {effect('success', one.difference)}.")
    return lines
