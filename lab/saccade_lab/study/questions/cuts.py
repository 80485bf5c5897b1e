"""``saccade study cuts``: parts of the head cut or replaced, on equal episodes and noise."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from saccade._internal.arrays import Float32Array
from saccade._internal.flags import add_list
from saccade.head.intervention import ROW_GROUPS, Intervention
from saccade_lab.flags import add_frames, add_rollout_arguments, check_known
from saccade_lab.study.arguments import source_of
from saccade_lab.study.arms import Arm, ArmStudy
from saccade_lab.study.changes import change_section
from saccade_lab.study.questions.cuts_section import BASELINE, SHUFFLED, section
from saccade_lab.study.section import Prose, Section
from saccade_lab.study.table import Provenance, is_recorded

EPILOG = """\
Every arm runs the same episodes: the same layouts, instructions and noise. Success is compared in pairs with
the arm "none", which is always run. The change of the chunk is measured on the observations of "none". With
--frames it is measured on pictures, for any whole checkpoint, and with --features on a file of features, for
any checkpoint; success is then unknown.

arms:
{arms}

examples:
  saccade study cuts --episodes 15 --out out/study
  saccade study cuts --arms future-unread future-blind --tasks push --jobs 2 --out out/study
  saccade study cuts --checkpoint my-finetune/ --frames table/ --instruction "take the pear" --out out/own
  saccade study cuts --checkpoint checkpoint/ --features observations.npz --out out/study
"""


def cut(*pairs: tuple[str, str]) -> Callable[[Float32Array, np.random.Generator], Intervention]:
    """An intervention of an arm: ``(reader, source)`` pairs cut in every block."""
    return lambda tokens, rng: Intervention(cut=pairs)


def blind(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """No row sees the vision-language tokens; future rows only if the head has them."""
    return Intervention(cut=[(row, "vl") for row in ROW_GROUPS if row != "future" or len(tokens)])


def shuffled(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """The learned tokens in another order."""
    return Intervention(future_tokens=tokens[rng.permutation(len(tokens))])


def averaged(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """Copies of the mean of the learned tokens."""
    return Intervention(future_tokens=np.tile(tokens.mean(axis=0), (len(tokens), 1)))


def zeroed(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """Zeros instead of the learned tokens."""
    return Intervention(future_tokens=np.zeros_like(tokens))


def redrawn(tokens: Float32Array, rng: np.random.Generator) -> Intervention:
    """Random tokens with the mean and the standard deviation of the learned ones."""
    drawn = rng.normal(tokens.mean(), tokens.std(), tokens.shape)
    return Intervention(future_tokens=drawn.astype(np.float32))


ALL_ARMS = (
    Arm("none", "nothing changed", "The policy as it is.", lambda tokens, rng: None, needs_future=False),
    Arm(
        "future-unread",
        "{state, action} <- future cut",
        "State and action rows do not see the future rows. This removes every effect of the future tokens, "
        "like N = 0 without retraining.",
        cut(("state", "future"), ("action", "future")),
    ),
    Arm(
        "future-blind",
        "future <- vl cut",
        "The future rows do not see the vision-language tokens: do they summarise what the cameras see?",
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
        "The action rows do not see the vision-language tokens. Visual information reaches them through the "
        "future rows, and also through the state row.",
        cut(("action", "vl")),
        needs_future=False,
    ),
    Arm(
        "rows-blind",
        "{state, action} <- vl cut",
        "Neither state nor action rows see the vision-language tokens: all visual information must pass "
        "through the future rows.",
        cut(("state", "vl"), ("action", "vl")),
    ),
    Arm(
        "all-blind",
        "{state, future, action} <- vl cut",
        "No row sees the vision-language tokens. A control that must fail: it shows how well these tasks can "
        "be done without vision.",
        blind,
        needs_future=False,
    ),
    Arm(
        "future-shuffled",
        "future tokens shuffled",
        "The learned tokens in another order. A control: they have no positions, so nothing may change "
        "except rounding.",
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
        "Zeros instead of the learned tokens; the rows still read and are read.",
        zeroed,
    ),
    Arm(
        "future-redrawn",
        "future tokens re-drawn",
        "Random tokens with the mean and the standard deviation of the learned ones, different in every "
        "episode: does it matter what was learned?",
        redrawn,
    ),
)
ARMS = {arm.name: arm for arm in ALL_ARMS}


@dataclass(frozen=True)
class Cuts(ArmStudy):
    """What the actions and success lose when parts of the head are cut or replaced.

    Attributes:
        source, arms, metrics: See ``ArmStudy``; arms default to all of ``ARMS``.
    """

    arms: Sequence[Arm] = ALL_ARMS
    name: ClassVar[str] = "cuts"
    baseline: ClassVar[Arm] = ARMS[BASELINE]
    control: ClassVar[str] = SHUFFLED

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        width = max(len(name) for name in ARMS)
        parser.epilog = EPILOG.format(
            arms="\n".join(f"  {arm.name:{width}}  {arm.label}" for arm in ARMS.values())
        )
        add_rollout_arguments(parser, episodes=15)
        add_frames(parser)
        add_list(parser, "--arms", help="arms (default: all)")
        parser.add_argument(
            "--engine", choices=("rust", "torch"), help="what computes the action head (default: rust)"
        )

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Cuts:
        """See ``Study``."""
        chosen = tuple(args.arms or ARMS)
        check_known("--arms", chosen, ARMS)
        return cls(source_of(args, "engine"), tuple(ARMS[name] for name in chosen))

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        engine = {"engine": self.source.engine_name} if self.source.closed_loop else {}
        return {**super().settings(), **engine}

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        if not is_recorded(provenance):
            return section(arms_in(table), table, provenance)
        arms = arms_in(table)
        labels = {name: arm.label for name, arm in arms.items()}
        return change_section(cls, Prose("cuts", arms=list(arms.values())), labels, table, provenance)


def arms_in(table: pd.DataFrame) -> dict[str, Arm]:
    """The arms of a table: those of ``ARMS`` in their order, then other arms by their names."""
    named = dict.fromkeys(str(name) for name in table["arm"])
    known = {name: arm for name, arm in ARMS.items() if name in named}
    return known | {name: Arm(name) for name in named if name not in ARMS}
