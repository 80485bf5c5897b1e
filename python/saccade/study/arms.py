"""The arms of the study of cuts: what is changed inside the head, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saccade.intervention import ROW_GROUPS, Intervention

Float32Array = npt.NDArray[np.float32]

NO_TOKENS = "the checkpoint has no future tokens"
ROUNDING = 1e-3  # a change of an action that an exact identity may make


@dataclass(frozen=True)
class Arm:
    """One change that is kept for a whole episode.

    Attributes:
        name: For the command line and the table.
        label: In figures.
        about: What it is and what it asks, for the report.
        intervention: From the learned future tokens `(N, width)` and the episode's random numbers.
        needs_future: Whether it means nothing for a head without future tokens.
    """

    name: str
    label: str
    about: str
    intervention: Callable[[Float32Array, np.random.Generator], Intervention | None]
    needs_future: bool = True

    def why_not(self, num_future_tokens: int) -> str | None:
        """Why it cannot be measured on a head with so many future tokens, or None."""
        if self.needs_future and num_future_tokens == 0:
            return NO_TOKENS
        return None


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


def episode_rng(task: str, seed: int) -> np.random.Generator:
    """What an arm draws in an episode, apart from the noise of the chunks."""
    return np.random.default_rng([seed, *task.encode()])


def control_line(label: str, largest: float) -> str:
    """Whether a control, which may change nothing but rounding, changed an action by more than that."""
    verdict = "as it must be" if largest < ROUNDING else "WHICH IT MUST NOT: do not trust the other arms"
    return f"Control, {label}: the chunk changed by {largest:.1g} at most, {verdict}."
