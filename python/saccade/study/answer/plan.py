"""What `saccade study answer` trains and judges: every constant of the study is in this file.

The plan is that of the page that was written before the first measurement. Do not change a number without
changing that page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from saccade.errors import InputError
from saccade.sim.demos import RecordingSettings
from saccade.sim.training_settings import TrainingSettings


@dataclass(frozen=True)
class Recording:
    """Demonstrations that policies are trained on.

    Attributes:
        name: Name of their directory.
        counts: Number of episodes by the name of the task.
        settings: What is recorded.
    """

    name: str
    counts: Mapping[str, int]
    settings: RecordingSettings


@dataclass(frozen=True)
class Recipe:
    """How policies are trained that differ in their training seed only.

    Attributes:
        stage: The stage of the study that it belongs to.
        name: Its name in the table.
        training: The settings; their seed is not used.
        recording: Name of the recording.
        seeds: The training seeds.
    """

    stage: str
    name: str
    training: TrainingSettings
    recording: str
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class PlannedPolicy:
    """A policy to be trained.

    Attributes:
        recipe: How.
        seed: Its training seed.
    """

    recipe: Recipe
    seed: int

    @property
    def name(self) -> str:
        """Its name in the table, which is that of its directory."""
        return f"{self.recipe.name}-seed-{self.seed}"

    @property
    def training(self) -> TrainingSettings:
        """The settings, with the seed."""
        return replace(self.recipe.training, seed=self.seed)


@dataclass(frozen=True)
class Plan:
    """All policies, and the episodes that judge them.

    Attributes:
        recordings: The demonstrations.
        recipes: In the order of their stages.
        tasks, seeds: The episodes of every policy: each seed in each task.

    Raises:
        InputError: two recipes or recordings have the same name, a recipe's recording is unknown, or a task
            is not in every recording.
    """

    recordings: tuple[Recording, ...]
    recipes: tuple[Recipe, ...]
    tasks: tuple[str, ...]
    seeds: range

    def __post_init__(self) -> None:
        for what, names in (
            ("recordings", [recording.name for recording in self.recordings]),
            ("recipes", [recipe.name for recipe in self.recipes]),
        ):
            if len(set(names)) != len(names):
                raise InputError(f"{what}: two have the same name in {', '.join(names)}")
        for recipe in self.recipes:
            self.recording(recipe)
        for recording in self.recordings:
            if not set(self.tasks) <= set(recording.counts):
                raise InputError(f"recordings: {recording.name} does not have all of {', '.join(self.tasks)}")

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages in which policies are trained, in their order."""
        return tuple(dict.fromkeys(recipe.stage for recipe in self.recipes))

    def recording(self, recipe: Recipe) -> Recording:
        """The demonstrations of a recipe; raises `InputError` if there are none of that name."""
        for recording in self.recordings:
            if recording.name == recipe.recording:
                return recording
        raise InputError(f"recordings: {recipe.name} has {recipe.recording}, which is not one of them")

    def policies(self, stage: str) -> Iterator[PlannedPolicy]:
        """The policies of a stage, seed by seed: a run that is interrupted leaves whole pairs."""
        recipes = [recipe for recipe in self.recipes if recipe.stage == stage]
        for seed in sorted({seed for recipe in recipes for seed in recipe.seeds}):
            yield from (PlannedPolicy(recipe, seed) for recipe in recipes if seed in recipe.seeds)


def tokens(stage: str, counts: Sequence[int], *, aligned: bool = False) -> Iterator[Recipe]:
    """Recipes that differ from `BASE` in N, and in the alignment loss."""
    for count in counts:
        changed = replace(BASE, num_future_tokens=count, alignment_weight=ALIGNMENT if aligned else 0.0)
        yield Recipe(stage, f"n-{count}" + ("-aligned" if aligned else ""), changed, "plain", SEEDS)


ALIGNMENT = 0.2  # the weight of the loss in FLARE
SEEDS = tuple(range(8))  # of training
TASKS = ("reach", "two-goals", "stereo-reach", "two-stage")
BASE = TrainingSettings(steps=3200, width=64, learning_rate=2e-3, ema_decay=0.995)

PLAN = Plan(
    recordings=(Recording("plain", dict.fromkeys(TASKS, 200), RecordingSettings()),),
    recipes=(
        *tokens("core", (0, 4, 32)),
        *tokens("alignment", (4, 32), aligned=True),
        *tokens("numbers", (1, 16, 64)),
    ),
    tasks=TASKS,
    seeds=range(25),
)
