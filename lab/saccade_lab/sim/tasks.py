"""The tasks: their Meta-World scenes and instructions, and the ranges of seeds for each purpose."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from saccade.errors import InputError
from saccade_lab.sim.scenarios import (
    Fork,
    MetaWorldScenario,
    NamedBall,
    Scenario,
    StereoReach,
    TwoGoals,
    TwoStage,
)

# The robot is the same in every task.
ACTION_DIM = 4  # hand velocity along x, y, z and gripper effort, each in [-1, 1]
PROPRIO_DIM = 4  # hand position in metres and gripper opening in [0, 1]

# A seed determines the positions of objects and goals. The three purposes have separate ranges, so that no
# policy is evaluated on a layout that it was trained or selected on. `check_evaluation_seeds` and `demos.py`
# enforce them.
EVALUATION_SEEDS = range(1_000_000)
DEMONSTRATION_SEEDS = range(1_000_000, 2_000_000)
VALIDATION_SEEDS = range(2_000_000, 3_000_000)


@dataclass(frozen=True)
class Task:
    """One task.

    Attributes:
        name: Its name in saccade.
        scene: Meta-World's name of the environment.
        scenario: Creates the rules of one environment, given the Meta-World environment.
        objects: The objects on the table. Tasks with the same objects can be done in the same scene.
        instructions: Wordings; the seed of an episode selects one of them. The first is the plainest.
        draws_goal: Whether the goal is marked in the images. Where the goal is the state of an object (an
            open drawer), a marker would reveal the answer.
        max_steps: Control steps after which an episode has failed. About twice those of the slowest expert,
            unless the task requires an immediate choice.
    """

    name: str
    scene: str
    scenario: Callable[[Any], Scenario]
    objects: str
    instructions: tuple[str, ...]
    draws_goal: bool = False
    max_steps: int = 200

    def instruction(self, seed: int) -> str:
        """The wording of the episode with this seed."""
        return self.instructions[seed % len(self.instructions)]


# The tasks of the demo, on which the bundled policy was trained. reach and push have the same scene with puck
# and green ball: only the instruction distinguishes them.
DEMO_TASKS = (
    Task(
        name="reach",
        scene="reach-v3",
        scenario=functools.partial(
            MetaWorldScenario, expert="SawyerReachV3Policy", aims_with_fingertips=True
        ),
        objects="puck and ball",
        draws_goal=True,
        instructions=(
            "reach the green ball",
            "move the hand to the green ball",
            "go to the green ball",
            "touch the green ball with the gripper",
            "bring the gripper to the green marker",
        ),
    ),
    Task(
        name="push",
        scene="push-v3",
        scenario=functools.partial(MetaWorldScenario, expert="SawyerPushV3Policy"),
        objects="puck and ball",
        draws_goal=True,
        instructions=(
            "push the puck to the green ball",
            "move the puck to the green ball",
            "slide the puck onto the green marker",
            "bring the red puck to the green ball",
            "push the red puck to the marker",
        ),
    ),
    Task(
        name="drawer-open",
        scene="drawer-open-v3",
        scenario=functools.partial(MetaWorldScenario, expert="SawyerDrawerOpenV3Policy"),
        objects="drawer",
        instructions=(
            "open the drawer",
            "pull the drawer open",
            "pull the handle of the drawer",
            "slide the drawer out",
            "please open the green drawer",
        ),
    ),
    Task(
        name="button-press-topdown",
        scene="button-press-topdown-v3",
        scenario=functools.partial(MetaWorldScenario, expert="SawyerButtonPressTopdownV3Policy"),
        objects="button",
        instructions=(
            "press the button",
            "press the red button down",
            "push the button from above",
            "push down the red button",
            "please press the button on the box",
        ),
    ),
    Task(
        name="window-open",
        scene="window-open-v3",
        scenario=functools.partial(MetaWorldScenario, expert="SawyerWindowOpenV3Policy"),
        objects="window",
        instructions=(
            "open the window",
            "slide the window open",
            "push the window to the right",
            "push the handle of the window",
            "please open the window",
        ),
    ),
)
# Harder tasks for studies: two equally good answers, a position that one image does not determine, two steps
# in order, two paths around an obstacle, and two balls of which the instruction names one.
STUDY_TASKS = (
    Task(
        name="two-goals",
        scene="reach-v3",
        scenario=TwoGoals,
        objects="two yellow balls",
        instructions=(
            "reach a yellow ball",
            "touch one of the yellow balls",
            "go to either yellow ball",
            "move the hand to one yellow ball",
            "bring the gripper to either yellow ball",
        ),
        max_steps=100,
    ),
    Task(
        name="stereo-reach",
        scene="reach-v3",
        scenario=StereoReach,
        objects="blue ball",
        instructions=(
            "reach the blue ball",
            "move the hand to the blue ball",
            "go to the blue ball",
            "touch the blue ball with the gripper",
            "bring the gripper to the blue ball",
        ),
        max_steps=100,
    ),
    Task(
        name="two-stage",
        scene="reach-v3",
        scenario=TwoStage,
        objects="blue ball and green ball",
        instructions=(
            "touch the blue ball and then the green ball",
            "reach the blue ball, then the green one",
            "first the blue ball, then the green one",
            "go to the blue ball before the green ball",
            "touch both balls, the blue one first",
        ),
        max_steps=200,
    ),
    Task(
        name="fork",
        scene="reach-v3",
        scenario=Fork,
        objects="two yellow balls and a blue ball",
        instructions=(
            "touch a yellow ball but not the blue one",
            "reach either yellow ball past the blue ball",
            "go around the blue ball to a yellow one",
            "move to one yellow ball, not the blue ball",
            "pass the blue ball and touch a yellow ball",
        ),
        max_steps=28,  # 5 more than the expert needs: no time to drift off the middle line gradually
    ),
    Task(
        name="touch-yellow",
        scene="reach-v3",
        scenario=functools.partial(NamedBall, named=0),
        objects="yellow ball and blue ball",
        instructions=(
            "touch the yellow ball",
            "tap the yellow ball",
            "move to the yellow ball",
            "bring the hand to the yellow ball",
            "reach over to the yellow ball",
        ),
        max_steps=40,
    ),
    Task(
        name="touch-blue",
        scene="reach-v3",
        scenario=functools.partial(NamedBall, named=1),
        objects="yellow ball and blue ball",
        instructions=(
            "touch the blue ball",
            "tap the blue ball",
            "move to the blue ball",
            "bring the hand to the blue ball",
            "reach over to the blue ball",
        ),
        max_steps=40,
    ),
)
# The index of a task in this order seeds its noise: append new tasks at the end.
TASKS = {task.name: task for task in (*DEMO_TASKS, *STUDY_TASKS)}


def find_task(name: str) -> Task:
    """The task of that name.

    Raises:
        InputError: There is no such task. The message lists all tasks.
    """
    if name not in TASKS:
        raise InputError(f"task: unknown name {name!r}, expected one of {', '.join(TASKS)}")
    return TASKS[name]


def check_evaluation_seeds(first: int, count: int) -> range:
    """The seeds ``first .. first + count - 1``, checked to be evaluation seeds.

    Raises:
        InputError: ``count`` is below 1, or a seed belongs to demonstrations or validation.
    """
    if count < 1:
        raise InputError(f"episodes: given {count}, expected at least 1")
    seeds = range(first, first + count)
    if seeds[0] not in EVALUATION_SEEDS or seeds[-1] not in EVALUATION_SEEDS:
        raise InputError(
            f"seed: given {seeds[0]} to {seeds[-1]}, expected evaluation seeds, {EVALUATION_SEEDS.start} to "
            f"{EVALUATION_SEEDS.stop - 1}; larger ones are used for training"
        )
    return seeds
