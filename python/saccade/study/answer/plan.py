"""What `saccade study answer` trains and judges: every constant of the study is in this file.

The plan is that of the page that was written before the first measurement. Do not change a number without
changing that page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from saccade.errors import InputError
from saccade.sim.cameras import DEFAULT_CAMERAS
from saccade.sim.demos import RecordingSettings
from saccade.sim.tasks import check_evaluation_seeds
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
            is not in every recording, or a seed is not for evaluation.
    """

    recordings: tuple[Recording, ...]
    recipes: tuple[Recipe, ...]
    tasks: tuple[str, ...]
    seeds: range

    def __post_init__(self) -> None:
        check_evaluation_seeds(self.seeds.start, len(self.seeds))
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

    def all_policies(self) -> Iterator[PlannedPolicy]:
        """The policies of all stages."""
        for stage in self.stages:
            yield from self.policies(stage)


TASKS = ("reach", "two-goals", "stereo-reach", "two-stage")
COUNTS = dict.fromkeys(TASKS, 200)  # demonstrations of each task
EPISODES = range(25)  # seeds of the episodes of each task
SEEDS = tuple(range(8))  # of training
BASE = TrainingSettings(steps=3200, width=64, learning_rate=2e-3, ema_decay=0.995)
ALIGNMENT = 0.2  # the weight of the loss in FLARE
# What makes a policy without future tokens as costly as `BASE`: `costs.matched_width` for a chunk,
# `costs.matched_steps` for the training. A test computes them again.
WIDTH, STEPS = 88, 3511


def recipes(
    stage: str,
    suffix: str,
    counts: Sequence[int],
    *,
    recording: str = "plain",
    seeds: tuple[int, ...] = SEEDS,
    **changes: Any,
) -> Iterator[Recipe]:
    """Recipes that differ from `BASE` in N and in `changes`.

    Args:
        stage: Their stage.
        suffix: What follows `n-N` in their names.
        counts: Each N.
        recording: Name of their recording.
        seeds: Their training seeds.
        changes: Training settings and their values.
    """
    for count in counts:
        training = replace(BASE, num_future_tokens=count, **changes)
        yield Recipe(stage, f"n-{count}{suffix}", training, recording, seeds)


PLAN = Plan(
    recordings=(
        Recording("plain", COUNTS, RecordingSettings()),
        Recording("one-camera", COUNTS, RecordingSettings(cameras=DEFAULT_CAMERAS[:1])),
    ),
    recipes=(
        *recipes("core", "", (0, 4, 32)),
        *recipes("alignment", "-aligned", (4, 32), alignment_weight=ALIGNMENT),
        *recipes("numbers", "", (1, 16, 64)),
        *recipes("compute", "-wide", (0,), width=WIDTH),
        *recipes("compute", "-long", (0,), steps=STEPS),
        *recipes("vision", "-one-camera", (4, 32), recording="one-camera"),
        *recipes("vision", "-patch-32", (4, 32), patch_size=32),
        *recipes("vision", "-patch-8", (4, 32), patch_size=8),
        *recipes("vlsa", "-vlsa-0", (4, 32), vl_num_layers=0),
        *recipes("vlsa", "-vlsa-4", (4, 32), vl_num_layers=4),
    ),
    tasks=TASKS,
    seeds=EPISODES,
)
