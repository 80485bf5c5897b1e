"""``saccade study n-runtime``: a policy's number of future tokens changed at run time, without training.

Some of the learned tokens, tokens merged with those like them, tokens repeated: in closed loop on equal
episodes, with and without the weight in the softmax that the learned number of tokens would have.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd

import saccade._saccade as _saccade
from saccade._internal.arrays import Float32Array
from saccade._internal.flags import add_list
from saccade.errors import InputError
from saccade.head.intervention import Intervention
from saccade_lab.flags import add_frames, add_rollout_arguments
from saccade_lab.study.arguments import source_of
from saccade_lab.study.arms import Arm, ArmStudy
from saccade_lab.study.cell import Cell
from saccade_lab.study.changes import change_section
from saccade_lab.study.questions.resized_section import BASELINE, TWICE, TWICE_EQUAL, arm_order, section
from saccade_lab.study.section import Prose, Section
from saccade_lab.study.table import Provenance, is_recorded

EPILOG = """\
Arms, for each number K of --num-future-tokens: K of the tokens, drawn at random for every episode; the same
with the mass of all (their keys count N / K times); tokens merged to K as `saccade resize` merges them. And
every token twice, with twice the mass, and with the same mass (which must change nothing).

examples:
  saccade study n-runtime --out out/study
  saccade study n-runtime --checkpoint out/policy --num-future-tokens 1 4 16 --episodes 20 --out out/study
  saccade study n-runtime --checkpoint my-finetune/ --frames table/ --out out/own
  saccade study n-runtime --checkpoint checkpoint/ --features observations.npz --out out/study
"""


@dataclass(frozen=True)
class Resized(ArmStudy):
    """What actions and success lose with another number of future tokens at run time.

    Attributes:
        source, arms, metrics: See ``ArmStudy``; ``arms_of`` makes the arms.
    """

    name: ClassVar[str] = "n-runtime"
    baseline: ClassVar[Arm] = Arm(BASELINE, needs_future=False)
    control: ClassVar[str] = TWICE_EQUAL

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=15)
        add_frames(parser)
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
        """See ``Study``."""
        source = source_of(args)
        return cls(source, arms_of(sizes_of(args.num_future_tokens, source.config.num_future_tokens)))

    def cells(self) -> Sequence[Cell]:
        """See ``ArmStudy``. A policy without tokens is not run: one cell for each episode says so."""
        if self.source.closed_loop and not self.source.config.num_future_tokens:
            return [Cell((*unit, TWICE)) for unit in self.source.units]
        return super().cells()

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        if not is_recorded(provenance):
            return section(table, provenance)
        labels = {arm: arm for arm in sorted(dict.fromkeys(table["arm"]), key=arm_order)}
        return change_section(cls, Prose("resized", arms=list(labels)), labels, table, provenance)


def sizes_of(given: Sequence[int] | None, count: int) -> tuple[int, ...]:
    """The numbers of tokens to go down to from ``count``, in increasing order; none if there are no tokens.

    Raises:
        InputError: One of those given is not below ``count``.
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
    """Tokens ``(N, width)`` merged to ``size``, with a bias on their keys that keeps the softmax's mass."""

    def intervention(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
        chosen = tokens[np.sort(rng.choice(len(tokens), size, replace=False))]
        return with_bias(chosen, np.log(len(tokens) / size) if equal_mass else None)

    return Arm(f"{size} drawn, equal mass" if equal_mass else f"{size} drawn", intervention=intervention)


def merged(size: int) -> Arm:
    """Tokens merged to ``size`` as ``saccade resize`` does it."""
    return Arm(
        f"{size} merged",
        intervention=lambda tokens, rng: merge(tokens, size),
        settings={"rule": "resize"},  # tables of earlier versions have another rule under the same name
    )


def merge(tokens: Float32Array, size: int) -> Intervention:
    """``size`` tokens, others in every episode; with ``equal_mass`` their keys weigh as much as all."""
    rows, _, key_bias = _saccade.merge_future_tokens(tokens, size)
    return with_bias(rows, None if key_bias is None else np.array(key_bias, np.float32))


def repeated(tokens: Float32Array, bias: float | None = None) -> Intervention:
    """Every token twice, with a bias on the keys."""
    return with_bias(np.repeat(tokens, 2, axis=0), bias)


def with_bias(tokens: Float32Array, bias: float | Float32Array | None) -> Intervention:
    """Other future tokens, with a bias on their keys."""
    return Intervention(future_tokens=tokens, key_bias=None if bias is None else {"future": bias})
