"""What is done to the trained policies while they are judged: cuts, other softmax weights, fewer steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from saccade.policy.interfaces import Head
from saccade_lab.study.arms import Arm
from saccade_lab.study.questions.cuts import ARMS as CUTS
from saccade_lab.study.questions.resized import merged
from saccade_lab.study.questions.sweeps import equal_mass
from saccade_lab.study.questions.sweeps_results import PLAIN
from saccade_lab.study.source import episode_rng

if TYPE_CHECKING:
    from saccade_lab.sim.rollout import Episode


@dataclass(frozen=True)
class PolicyArm:
    """A change of a policy, the same in all its episodes.

    Attributes:
        arm: Name, and the change inside the head.
        applies: Function from N to whether there is anything to change.
        num_steps: Euler steps; None for those of the policy.
    """

    arm: Arm
    applies: Callable[[int], bool]
    num_steps: int | None = None

    @property
    def name(self) -> str:
        """Its name in the table."""
        return self.arm.name


def of_cuts(name: str) -> PolicyArm:
    """An arm of `saccade study cuts`."""
    return PolicyArm(CUTS[name], lambda count: CUTS[name].why_not(count) is None)


def mass_of(like: int) -> PolicyArm:
    """The future keys get the weight in the softmax that `like` of them would have."""
    arm = Arm(f"mass of {like}", intervention=lambda tokens, rng: equal_mass(len(tokens), like))
    return PolicyArm(arm, lambda count: count not in (0, like))


def merged_to(size: int) -> PolicyArm:
    """The tokens are merged to `size` of them."""
    return PolicyArm(merged(size), lambda count: count > size)


def steps_of(num_steps: int) -> PolicyArm:
    """Another number of Euler steps."""
    arm = Arm(f"steps of {num_steps}", needs_future=False)
    return PolicyArm(arm, lambda count: True, num_steps)


#: The arms of the stages that train nothing.
ARMS: dict[str, tuple[PolicyArm, ...]] = {
    "instrument": (
        of_cuts("future-unread"),
        of_cuts("future-blind"),
        of_cuts("rows-blind"),
        of_cuts("future-averaged"),
        of_cuts("future-redrawn"),
        mass_of(4),
        mass_of(32),
        merged_to(4),
        merged_to(1),
    ),
    "steps": tuple(map(steps_of, (1, 2, 8))),
}


def find_arm(name: str) -> PolicyArm | None:
    """The arm of that name; None for `PLAIN`."""
    if name == PLAIN:
        return None
    return next(arm for arms in ARMS.values() for arm in arms if arm.name == name)


class SteppedHead:
    """A head that takes another number of Euler steps; a `saccade.policy.interfaces.Head`.

    Args:
        head: The head that computes.
        num_steps: Its steps.
    """

    def __init__(self, head: Head, num_steps: int) -> None:
        self._head = head
        self._num_steps = num_steps

    def __getattr__(self, name: str) -> Any:
        return getattr(self._head, name)

    def sample(self, context: Any, state: Any, embodiment_id: Any, **options: Any) -> Any:
        """See `Head`."""
        return self._head.sample(context, state, embodiment_id, **{**options, "num_steps": self._num_steps})


def judge(checkpoint: str, task: str, seed: int, arm: PolicyArm | None, *, blind: bool = False) -> Episode:
    """An episode of a policy under an arm; layout, wording and noise are the same under all arms.

    Args:
        checkpoint: Directory of the policy.
        task, seed: The episode.
        arm: None for the unchanged policy.
        blind: Whether all pictures are black.
    """
    from saccade_lab.sim.rollout import run_episode
    from saccade_lab.study.simulator import environment_of, head_of, policy_of

    policy, change = policy_of(checkpoint), None
    if arm is not None:
        change = arm.arm.intervention(head_of(checkpoint).future_tokens, episode_rng(task, seed))
        if arm.num_steps is not None:
            policy = policy.with_head(SteppedHead(policy.head, arm.num_steps))
    environment = environment_of(checkpoint, task, blind=blind)
    return run_episode(environment, policy, seed, intervention=change)
