"""The tasks: which Meta-World task, how it is told to the robot, and which seeds are used for what."""

from dataclasses import dataclass

from saccade.errors import InputError

# A seed fixes where objects and goals lie. The three uses have ranges of their own, so that no policy is
# judged on a layout it was trained or chosen on. `check_evaluation_seeds` and `demos.py` hold to them.
EVALUATION_SEEDS = range(1_000_000)
DEMONSTRATION_SEEDS = range(1_000_000, 2_000_000)
VALIDATION_SEEDS = range(2_000_000, 3_000_000)


@dataclass(frozen=True)
class Task:
    """One task.

    Attributes:
        name: How users call it.
        scene: Meta-World's name of its environment.
        expert: Class of its scripted expert in `metaworld.policies`.
        objects: What stands on the table. Tasks with the same objects can all be done in the same scene.
        instructions: Wordings; an episode's seed picks one of them. The first is the plainest.
        draws_goal: Whether the goal is marked in the picture. Where the goal is an object's own state (an
            open drawer), a marker would only give the answer away.
        max_steps: An episode that has not succeeded by then has failed. About twice what the slowest expert
            takes.
    """

    name: str
    scene: str
    expert: str
    objects: str
    instructions: tuple[str, ...]
    draws_goal: bool = False
    max_steps: int = 200

    def instruction(self, seed: int) -> str:
        """The wording of the episode with this seed."""
        return self.instructions[seed % len(self.instructions)]


# reach and push show the same scene, hand, puck and green ball alike: only the instruction tells them apart.
ALL_TASKS = (
    Task(
        name="reach",
        scene="reach-v3",
        expert="SawyerReachV3Policy",
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
        expert="SawyerPushV3Policy",
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
        expert="SawyerDrawerOpenV3Policy",
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
        expert="SawyerButtonPressTopdownV3Policy",
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
        expert="SawyerWindowOpenV3Policy",
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
TASKS = {task.name: task for task in ALL_TASKS}


def find_task(name: str) -> Task:
    """The task of that name.

    Raises:
        InputError: there is none; lists those there are.
    """
    if name not in TASKS:
        raise InputError(f"task: unknown name {name!r}, expected one of {', '.join(TASKS)}")
    return TASKS[name]


def check_evaluation_seeds(first: int, count: int) -> range:
    """The seeds `first .. first + count - 1`, all of them meant for evaluation.

    Raises:
        InputError: `count` is below 1, or a seed belongs to demonstrations or validation.
    """
    if count < 1:
        raise InputError(f"episodes: given {count}, expected at least 1")
    seeds = range(first, first + count)
    if seeds[0] not in EVALUATION_SEEDS or seeds[-1] not in EVALUATION_SEEDS:
        raise InputError(
            f"seed: {seeds[0]} to {seeds[-1]} leaves the evaluation seeds "
            f"{EVALUATION_SEEDS.start} to {EVALUATION_SEEDS.stop - 1}; later ones are used for training"
        )
    return seeds
