"""A plan of the study as small as it can be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from saccade_lab.sim import demos
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.training.settings import TrainingSettings
from why_32.plan import Backbone, Plan, Recipe, Recording

TASK = "fork"  # its episodes are short
TINY = TrainingSettings(
    only="head",
    absent_share=0.0,
    steps=2,
    batch_size=2,
    width=8,
    num_layers=2,
    num_heads=1,
    language_layers=1,
    vision_width=8,
    vision_layers=1,
    vision_heads=1,
    patch_size=8,
)
RECORDING = Recording(
    "tiny",
    {TASK: 2},
    demos.RecordingSettings(image_size=16, frame_stride=12, cameras=DEFAULT_CAMERAS[:1]),
)
BACKBONE = Backbone("backbone", replace(TINY, only="backbone", num_future_tokens=0), "tiny")


def recipe(stage: str, name: str, seeds: tuple[int, ...] = (0, 1), **changes: Any) -> Recipe:
    return Recipe(stage, name, replace(TINY, **changes), "backbone", seeds)


PLAN = Plan(
    recordings=(RECORDING,),
    backbones=(BACKBONE,),
    recipes=(
        recipe("pilot", "n-4-pilot", (100,), num_future_tokens=4),
        recipe("pilot", "n-4-pilot-blind", (100,), num_future_tokens=4, blind=True),
        *(recipe("core", f"n-{count}", num_future_tokens=count) for count in (0, 4, 32)),
        recipe("alignment", "n-4-aligned", num_future_tokens=4, alignment_weight=0.2),
    ),
    tasks=(TASK,),
    seeds=range(2),
    pilot_seeds=range(500, 502),
)
