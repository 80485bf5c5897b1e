"""`saccade study n-runtime`: a policy's number of future tokens changed at run time, without training.

Some of the learned tokens, tokens merged with those like them, tokens repeated: in closed loop on equal
episodes, with and without the weight in the softmax that the learned number of tokens would have.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd

from saccade import _saccade
from saccade.cli.arguments import add_list, add_rollout_arguments
from saccade.errors import InputError
from saccade.intervention import Intervention
from saccade.study import figures
from saccade.study.arms import NO_TOKENS, Arm, ArmStudy, control_line
from saccade.study.cell import Cell
from saccade.study.changes import change_section
from saccade.study.section import Figure, Grid, Section, effect, not_measured, number, rate
from saccade.study.source import Float32Array, source_of
from saccade.study.statistics import Estimate, bootstrap, paired_difference, scaled, wilson
from saccade.study.table import Provenance, from_file, truths

BASELINE = "as learned"
TWICE, TWICE_EQUAL = "every token twice", "every token twice, equal mass"
ARMS_ARE = (
    "Drawn: a random choice of the learned tokens, another one in every episode. Merged: as `saccade resize` "
    "merges them, by their directions; each merged token counts as often as the tokens that it replaces. "
    "Equal mass: the keys together weigh in the softmax as much as all learned tokens would."
)

EPILOG = """\
Arms, for each number K of --num-future-tokens: K of the tokens, drawn at random for every episode; the same
with the mass of all (their keys count N / K times); tokens merged to K as `saccade resize` merges them. And
every token twice, with twice the mass, and with the same mass (which must change nothing).

examples:
  saccade study n-runtime --out out/study
  saccade study n-runtime --checkpoint out/policy --num-future-tokens 1 4 16 --episodes 20 --out out/study
  saccade study n-runtime --checkpoint checkpoint/ --features looks.npz --out out/study
"""


@dataclass(frozen=True)
class Resized(ArmStudy):
    """What actions and success lose with another number of future tokens at run time.

    Attributes:
        source, arms, metrics: See `ArmStudy`; `arms_of` makes the arms.
    """

    name: ClassVar[str] = "n-runtime"
    baseline: ClassVar[Arm] = Arm(BASELINE, needs_future=False)
    control: ClassVar[str] = TWICE_EQUAL

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See `Study`."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=15)
        add_list(
            parser,
            "--num-future-tokens",
            item=int,
            metavar="N",
            minimum=1,
            help="numbers of tokens to go down to (default: N/8, N/4 and N/2 of the checkpoint's N)",
        )

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Resized:
        """See `Study`."""
        source = source_of(args)
        return cls(source, arms_of(sizes_of(args.num_future_tokens, source.config.num_future_tokens)))

    def cells(self) -> Sequence[Cell]:
        """See `ArmStudy`. A policy without tokens is not run: one cell for each episode says so."""
        if self.source.closed_loop and not self.source.config.num_future_tokens:
            return [Cell((*unit, TWICE)) for unit in self.source.units]
        return super().cells()

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See `Study`."""
        return section(table, provenance)


def sizes_of(given: Sequence[int] | None, count: int) -> tuple[int, ...]:
    """The numbers of tokens to go down to from `count`, in increasing order; none if there are no tokens.

    Raises:
        InputError: one of those given is not below `count`.
    """
    if count == 0:
        return ()
    if given is None:
        return tuple(sorted({count // 8, count // 4, count // 2} - {0}))
    if max(given) >= count:
        shown = ", ".join(map(str, given))
        raise InputError(
            f"--num-future-tokens: given {shown}, expected 1 to {count - 1}; the checkpoint has {count}"
        )
    return tuple(sorted(given))


def arms_of(sizes: Sequence[int]) -> tuple[Arm, ...]:
    """The arms that go down to each size, and those with every token twice."""
    return (
        *(arm for size in sizes for arm in (drawn(size), drawn(size, equal_mass=True), merged(size))),
        Arm(TWICE, intervention=lambda tokens, rng: repeated(tokens)),
        Arm(TWICE_EQUAL, intervention=lambda tokens, rng: repeated(tokens, -np.log(2))),
    )


def drawn(size: int, *, equal_mass: bool = False) -> Arm:
    """`size` of the tokens, others in every episode; with `equal_mass` their keys weigh as much as all."""

    def intervention(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
        chosen = tokens[np.sort(rng.choice(len(tokens), size, replace=False))]
        bias = {"future": np.log(len(tokens) / size)} if equal_mass else None
        return Intervention(future_tokens=chosen, key_bias=bias)

    return Arm(f"{size} drawn, equal mass" if equal_mass else f"{size} drawn", intervention=intervention)


def merged(size: int) -> Arm:
    """Tokens merged to `size` as `saccade resize` does it."""
    return Arm(
        f"{size} merged",
        intervention=lambda tokens, rng: merge(tokens, size),
        settings={"rule": "resize"},  # tables of earlier versions have another rule under the same name
    )


def merge(tokens: Float32Array, size: int) -> Intervention:
    """Tokens `(N, width)` merged to `size`, with a bias on their keys that keeps the mass in the softmax."""
    rows, _, key_bias = _saccade.merge_future_tokens(tokens, size)
    bias = None if key_bias is None else {"future": np.array(key_bias, np.float32)}
    return Intervention(future_tokens=rows, key_bias=bias)


def repeated(tokens: Float32Array, bias: float | None = None) -> Intervention:
    """Every token twice, with a bias on the keys."""
    return Intervention(
        future_tokens=np.repeat(tokens, 2, axis=0), key_bias=None if bias is None else {"future": bias}
    )


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
        return change_section(Resized, title, names, (ARMS_ARE,), NOT_SHOWN, table, provenance)
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
