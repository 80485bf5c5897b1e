"""What can be measured of a policy without judging it: cheap numbers that might predict a cut's effect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from saccade_lab.study.cell import Rows
from saccade_lab.study.linear_probes import Frames
from saccade_lab.study.paths import DIRECT
from saccade_lab.study.questions.cuts import ARMS as CUTS
from saccade_lab.study.source import episode_rng
from why_32.probes import frames_of_means, r2_of_positions

if TYPE_CHECKING:
    from saccade.head.head import ActionHead
    from saccade_lab.study.simulator import Recorded, Simulator

#: The stage that measures them, for trained policies with tokens.
MEASURES = "measures"
#: The arm whose effect on success they may predict.
CUT = "future-unread"
#: What is measured, and its label.
NAMES = {
    "chunk_change": "change of the chunk by the cut",
    "attention_mass": "attention of action rows to future rows",
    "gradient_share": "share of the gradient through future rows",
    "probe_r2": "R2 of probes of future rows",
}
MEAN_ROW = ("future", "mean")  # what `probe_r2` is of; a single token has no mean and no number
OBSERVATIONS = 3  # of each episode, for gradients
PROJECTIONS = 8  # of the actions, for gradients


def measure(checkpoint: str, tasks: Sequence[str], seeds: range) -> Rows:
    """The measures of a policy with future tokens, each a mean over episodes of the unchanged policy.

    Args:
        checkpoint: Directory of the policy.
        tasks, seeds: The episodes.

    Returns:
        One row, with the columns `NAMES`. `chunk_change` is the mean absolute change of an action when state
        and action rows do not see the future rows. `attention_mass` is the probability of the future rows for
        the action rows, over blocks with self-attention, their heads and the Euler steps. `gradient_share` is
        the share of the derivative of the actions by the vision-language tokens that passes future rows.
        `probe_r2` is the share of the variance within a task, of the positions of object and goal, that a
        linear probe finds in the mean of the future rows, over blocks; None with fewer episodes than folds,
        or with a single token.
    """
    from saccade_lab.study.simulator import Simulator

    source = Simulator(checkpoint, tuple(tasks), seeds)
    head = source.head()
    changes, masses, through, frames, numbers = [], [], [], list[Frames](), []
    for number, task in enumerate(tasks):
        for seed in seeds:
            recorded = source.recorded(task, seed)
            change = CUTS[CUT].intervention(head.future_tokens, episode_rng(task, seed))
            plain, cut = (source.actions(recorded.observation, one) for one in (None, change))
            changes.append(float(np.abs(cut - plain).mean()))
            masses.append(attention_mass(head, recorded))
            through.append(gradient_share(source, task, seed))
            frames.append(frames_of_means(head, recorded, ("future",)))
            numbers.append(number)
    means = [float(np.mean(values)) for values in (changes, masses, through)]
    probed = [
        r2 for (rows, _, tokens), r2 in r2_of_positions(frames, numbers).items() if (rows, tokens) == MEAN_ROW
    ]
    found: list[float | None] = [*means, float(np.mean(probed)) if probed else None]
    return [dict(zip(NAMES, found, strict=True))]


def attention_mass(head: ActionHead, recorded: Recorded) -> float:
    """The probability that action rows give to future rows in an episode."""
    masses = []
    for observation in recorded.observation.rows():
        trace = observation.trace(head, observation.encode(head), record=("attention",))
        future, action = trace.rows["future"], trace.rows["action"]
        for (_, block), probabilities in trace.attention.items():
            if head.config.interleave_self_attention and block % 2 == 1:
                masses.append(float(np.asarray(probabilities)[0, :, action, future].sum(axis=-1).mean()))
    return float(np.mean(masses))


def gradient_share(source: Simulator, task: str, seed: int) -> float:
    """The share of the gradient that passes future rows in an episode."""
    from saccade_lab.study.questions.gradients import Gradients

    rows = Gradients(source, PROJECTIONS, OBSERVATIONS).of_actions(task, seed)
    (direct,) = [float(row["share"]) for row in rows if row.get("path") == DIRECT and "share" in row]
    return 1.0 - direct
