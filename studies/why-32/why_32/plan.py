"""What the study trains and judges: every constant of the study is in this file.

The plan is that of the page that was written before the first measurement, and of its section "Deviations".
Do not change a number without changing that page.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from saccade.errors import InputError
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.sim.demos import RecordingSettings
from saccade_lab.sim.tasks import check_evaluation_seeds
from saccade_lab.training.settings import TrainingSettings, released_std


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
class Backbone:
    """A backbone, trained without a head. Policies are heads that are trained on its frozen features.

    Attributes:
        name: Its name in the table, which is that of its directory.
        training: The settings, with ``only="backbone"``.
        recording: Name of the recording, of its own training and of that of all heads on it.
    """

    name: str
    training: TrainingSettings
    recording: str

    @property
    def columns(self) -> dict[str, Any]:
        """The columns that identify it."""
        return {"policy": self.name, "training_seed": self.training.seed}

    def to_dict(self) -> dict[str, Any]:
        """The backbone as JSON values."""
        return {"name": self.name, "training": self.training.to_dict(), "recording": self.recording}


@dataclass(frozen=True)
class Recipe:
    """How policies are trained that differ in their training seed only.

    Attributes:
        stage: The stage of the study that it belongs to.
        name: Its name in the table.
        training: The settings, with ``only="head"``; their seed is not used.
        backbone: Name of the backbone.
        seeds: The training seeds.
    """

    stage: str
    name: str
    training: TrainingSettings
    backbone: str
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class PlannedPolicy:
    """A policy to be trained.

    Attributes:
        recipe: How.
        backbone: On what.
        seed: Its training seed.
    """

    recipe: Recipe
    backbone: Backbone
    seed: int

    @property
    def name(self) -> str:
        """Its name in the table, which is that of its directory."""
        return f"{self.recipe.name}-seed-{self.seed}"

    @property
    def training(self) -> TrainingSettings:
        """The settings, with the seed."""
        return replace(self.recipe.training, seed=self.seed)

    @property
    def recording(self) -> str:
        """Name of the recording."""
        return self.backbone.recording

    @property
    def columns(self) -> dict[str, Any]:
        """The columns that identify it."""
        return {
            "stage": self.recipe.stage,
            "recipe": self.recipe.name,
            "policy": self.name,
            "training_seed": self.seed,
            "num_future_tokens": self.recipe.training.num_future_tokens,
        }


@dataclass(frozen=True)
class Plan:
    """All policies, and the episodes that judge them.

    Attributes:
        recordings: The demonstrations.
        backbones: What the policies are trained on.
        recipes: In the order of their stages.
        tasks, seeds: The episodes of every policy: each seed in each task.
        pilot_seeds: The seeds for the policies of the stage `PILOT`, which are different ones.

    Raises:
        InputError: two recipes, backbones or recordings have the same name, a recipe's backbone or a
            backbone's recording is unknown, settings are not those of a head or a backbone alone, a task is
            not in every recording, a seed is not for evaluation, or the pilots share one with the others.
    """

    recordings: tuple[Recording, ...]
    backbones: tuple[Backbone, ...]
    recipes: tuple[Recipe, ...]
    tasks: tuple[str, ...]
    seeds: range
    pilot_seeds: range

    def __post_init__(self) -> None:
        for seeds in (self.seeds, self.pilot_seeds):
            check_evaluation_seeds(seeds.start, len(seeds))
        if set(self.seeds) & set(self.pilot_seeds):
            raise InputError(f"pilot_seeds: given {self.pilot_seeds}, expected none of {self.seeds}")
        for what, names in (
            ("recordings", [recording.name for recording in self.recordings]),
            ("backbones", [backbone.name for backbone in self.backbones]),
            ("recipes", [recipe.name for recipe in self.recipes]),
        ):
            if len(set(names)) != len(names):
                raise InputError(f"{what}: two have the same name in {', '.join(names)}")
        for backbone in self.backbones:
            self.recording(backbone.recording)
        for recipe in self.recipes:
            self.backbone(recipe)
        for only, trained in (("backbone", self.backbones), ("head", self.recipes)):
            for one in trained:
                if one.training.only != only:
                    raise InputError(f"{one.name}: given only {one.training.only!r}, expected {only!r}")
        for recording in self.recordings:
            if not set(self.tasks) <= set(recording.counts):
                raise InputError(f"recordings: {recording.name} does not have all of {', '.join(self.tasks)}")

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages in which policies are trained, in their order."""
        return tuple(dict.fromkeys(recipe.stage for recipe in self.recipes))

    def recording(self, name: str) -> Recording:
        """The demonstrations of that name; raises `InputError` if there are none."""
        for recording in self.recordings:
            if recording.name == name:
                return recording
        raise InputError(f"recordings: {name} is not one of them")

    def backbone(self, recipe: Recipe) -> Backbone:
        """The backbone of a recipe; raises `InputError` if there is none of that name."""
        for backbone in self.backbones:
            if backbone.name == recipe.backbone:
                return backbone
        raise InputError(f"backbones: {recipe.name} has {recipe.backbone}, which is not one of them")

    def episodes(self, stage: str) -> range:
        """The seeds of the episodes that judge the policies of a stage."""
        return self.pilot_seeds if stage == PILOT else self.seeds

    def policies(self, stage: str) -> Iterator[PlannedPolicy]:
        """The policies of a stage, seed by seed: a run that is interrupted leaves whole pairs."""
        recipes = [recipe for recipe in self.recipes if recipe.stage == stage]
        for seed in sorted({seed for recipe in recipes for seed in recipe.seeds}):
            for recipe in recipes:
                if seed in recipe.seeds:
                    yield PlannedPolicy(recipe, self.backbone(recipe), seed)

    def only(self, recipes: Collection[str]) -> Plan:
        """The plan with the recipes of these names alone; with all of them if there are none."""
        return replace(self, recipes=tuple(one for one in self.recipes if one.name in recipes or not recipes))

    def all_policies(self, *, pilots: bool) -> Iterator[PlannedPolicy]:
        """The policies of all stages, with or without those of `PILOT`."""
        for stage in self.stages:
            if pilots or stage != PILOT:
                yield from self.policies(stage)


#: The stage whose policies only help to plan. It is run if it is named, and is no result.
PILOT = "pilot"
#: The stage of the confirmatory tests. Nothing is judged before all its policies are there.
CORE_STAGE = "core"

TASKS = ("stereo-reach", "two-goals")
# Demonstrations of each task. reach is learned, too, and not judged: a blindfolded policy succeeds too often.
COUNTS = dict.fromkeys((*TASKS, "reach"), 500)
EPISODES = range(75)  # seeds of the episodes of each task
PILOT_EPISODES = range(500_000, 500_075)
SEEDS = tuple(range(12))  # of training
#: Training seeds of what comes after *scaled*, so that it fits. Six are the least with which the sign-flip
#: interval at 95 % is finite.
LATER_SEEDS = SEEDS[:6]
PILOT_SEEDS = (100, 101)
BASE = TrainingSettings(
    only="head",
    absent_share=0.0,
    steps=1400,
    learning_rate=2e-3,
    ema_decay=0.995,
    width=64,
    vision_width=64,
    vision_layers=3,
    vision_heads=4,
    execute_steps=8,
)
# No future tokens, so that a backbone has nothing of any N.
BACKBONE = replace(BASE, only="backbone", steps=4000, learning_rate=1e-3, seed=0, num_future_tokens=0)
ALIGNMENT = 0.2  # the weight of the loss in FLARE
# Larger first weights, see `released_std`. With those of `BASE`, half of the core's policies had not
# left the first plateau of their loss when the training ended; with these there is none (the page's pilots).
SCALED = replace(BASE, steps=1000, category_std=round(released_std(BASE.width), 3))
# What makes a policy without future tokens as costly as `SCALED`: `costs.matched_width` for a chunk,
# `costs.matched_steps` for the training. A test computes them again.
WIDTH, STEPS = 104, 1628


def recipes(
    stage: str,
    suffix: str,
    counts: Sequence[int],
    *,
    backbone: str = "backbone",
    seeds: tuple[int, ...] = LATER_SEEDS,
    base: TrainingSettings = SCALED,
    **changes: Any,
) -> Iterator[Recipe]:
    """Recipes that differ from `base` in N and in `changes`.

    Args:
        stage: Their stage.
        suffix: What follows `n-N` in their names.
        counts: Each N.
        backbone: Name of their backbone.
        seeds: Their training seeds.
        base: The other training settings.
        changes: Training settings and their values.
    """
    for count in counts:
        training = replace(base, num_future_tokens=count, **changes)
        yield Recipe(stage, f"n-{count}{suffix}", training, backbone, seeds)


PLAN = Plan(
    recordings=(
        Recording("plain", COUNTS, RecordingSettings()),
        Recording("two-cameras", COUNTS, RecordingSettings(cameras=DEFAULT_CAMERAS[:2])),
    ),
    backbones=(
        Backbone("backbone", BACKBONE, "plain"),
        Backbone("backbone-two-cameras", BACKBONE, "two-cameras"),
        Backbone("backbone-patch-32", replace(BACKBONE, patch_size=32), "plain"),
        Backbone("backbone-patch-8", replace(BACKBONE, patch_size=8), "plain"),
    ),
    recipes=(
        *recipes(PILOT, "-pilot", (0, 32), seeds=PILOT_SEEDS, base=BASE),
        *recipes(PILOT, "-pilot-blind", (32,), seeds=PILOT_SEEDS, base=BASE, blind=True),
        *recipes(CORE_STAGE, "", (0, 4, 32), seeds=SEEDS, base=BASE),
        *recipes("scaled", "-scaled", (0, 4, 32), seeds=SEEDS),
        *recipes("alignment", "-aligned", (4, 32), alignment_weight=ALIGNMENT),
        *recipes("numbers", "-scaled", (1, 16, 64)),
        *recipes(
            "compute",
            "-wide",
            (0,),
            width=WIDTH,
            language_width=BASE.width,
            category_std=round(released_std(WIDTH), 3),
        ),
        # Seeds 6 to 11 are a test of what was seen in seeds 0 to 5.
        *recipes("compute", "-long", (0, 32), seeds=SEEDS, steps=STEPS),
        *recipes("patch-32", "-patch-32", (4, 32), backbone="backbone-patch-32", patch_size=32),
        *recipes("vlsa", "-vlsa-0", (4, 32), vl_num_layers=0),
        *recipes("vlsa", "-vlsa-4", (4, 32), vl_num_layers=4),
        *recipes("patch-8", "-patch-8", (4, 32), backbone="backbone-patch-8", patch_size=8),
        *recipes("two-cameras", "-two-cameras", (4, 32), backbone="backbone-two-cameras"),
        # The weights of *alignment*'s policies are gone. These are trained to be changed, see `arms`.
        *recipes("aligned-again", "-aligned-again", (4, 32), alignment_weight=ALIGNMENT),
    ),
    tasks=TASKS,
    seeds=EPISODES,
    pilot_seeds=PILOT_EPISODES,
)
