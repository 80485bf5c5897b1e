"""What to do about a verdict of a diagnosis: chosen by the rule that decided, so that it fits the verdict."""

from __future__ import annotations

import math

from saccade.diagnosis import Verdict
from saccade.diagnosis.verdicts import DEAF, FEWEST_EPISODES, Rule

#: What to do about an input that is ignored or barely used, by the beginning of its name.
LITTLE = {
    "instruction": "Record every task in every scene, so that the scene does not tell the task; have several "
    "tasks, and several wordings of each. If the episodes have one instruction only, nothing teaches the "
    "policy to listen. A shared scene with two instructions is the test. Guidance may help meanwhile.",
    "camera": "Look at its frames: is it black, frozen, or does it see nothing that another camera does not? "
    "Compare the order and names of the cameras with those of the training. If it is not needed, a policy "
    "trained without it is faster.",
    "state": "Check the statistics and the order of the state's keys. If the frames tell the state, ignoring "
    "it does no harm and helps on a robot with other sensors.",
    "history": "The newest frame and state tell what the policy needs; one step is faster.",
}
FEW = (
    f"A verdict needs at least {FEWEST_EPISODES} episodes. Record more, or pass more with --episodes: this "
    "says nothing about the policy."
)
NOTHING_SHOWN = (
    f"Nothing that the policy is shown changes its actions: another observation changes less than {DEAF:.0%} "
    "of what another noise does. Look at the checkpoint first: was it trained, and are all its weights there?"
)
SAME = "It is the same in all of these recordings, so they cannot show whether the policy uses it."
SELDOM = (
    f"It differs in fewer than {FEWEST_EPISODES} of the episodes, so they cannot show whether the policy "
    "uses it. Record more in which it differs."
)
#: The main change is not possible, and another one has an effect.
NO_MAIN = {
    "instruction": "All episodes have the same instruction, so nothing shows what another one would change. "
    "Record at least two.",
    "other": "In too few episodes does it differ from that of the partner, another episode, so its main "
    "change could not be tried. Record episodes that differ more in it.",
}
NO_ACTIONS_CHANGE = (
    "Neither another observation nor another noise changes the actions, so no effect can be measured. Look "
    "at the checkpoint first: is its last layer zero?"
)
AT_A_LIMIT = "Record more episodes, or pass more with --episodes: an interval contains a limit."
LEAK = (
    "The state may leak the action: a policy that repeats what the arm does anyway looks good in open loop "
    "and drifts on the robot. If frozen states change the actions most, try dropping the state in training."
)


def advice(name: str, verdict: Verdict) -> str:
    """What to do about the verdict on an input; empty if nothing.

    Args:
        name: The input, such as ``"camera.front"``.
        verdict: The verdict on it.
    """
    kind, rule = name.partition(".")[0], verdict.rule
    if rule == Rule.FEW_EPISODES:
        return FEW
    if rule == Rule.DEAF:
        return NOTHING_SHOWN
    if rule == Rule.NO_CHANGE:
        return SELDOM if verdict.changes else SAME
    if verdict.name == "undecided" and math.isnan(verdict.effect):
        return NO_ACTIONS_CHANGE
    if rule == Rule.NO_MAIN_CHANGE and verdict.name == "undecided":
        return NO_MAIN.get(kind, NO_MAIN["other"])
    if rule == Rule.UNDECIDED:
        return AT_A_LIMIT
    if rule == Rule.USED:
        frozen = verdict.changes.get("frozen")
        return LEAK if kind == "state" and frozen is not None and frozen.share.low > 1 else ""
    return LITTLE[kind]
