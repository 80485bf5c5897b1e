"""Recordings and policies as small as they can be, for tests of training."""

from __future__ import annotations

import atexit
import dataclasses
import functools
import shutil
import tempfile
from pathlib import Path

import numpy as np

from saccade_lab.sim import demos
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.training import train
from saccade_lab.training.batches import Batches, prompts_of
from saccade_lab.training.dataset import describe, load_samples
from saccade_lab.training.settings import TrainingSettings

RECORDING = demos.RecordingSettings(image_size=16, frame_stride=6, cameras=DEFAULT_CAMERAS[:2])
TASKS = ["reach", "button-press-topdown"]  # whose wordings have different lengths
TINY = TrainingSettings(
    steps=6,
    batch_size=2,
    width=16,
    num_layers=2,
    num_heads=2,
    language_layers=1,
    vision_width=16,
    vision_layers=1,
    vision_heads=2,
    num_future_tokens=3,
    patch_size=8,
)
ALIGNED = dataclasses.replace(TINY, alignment_weight=0.2)


def ignore(progress: train.Progress) -> None:
    """Shows no progress."""


@functools.cache
def recorded() -> Path:
    """Two demonstrations of two tasks; not to be changed."""
    out = Path(tempfile.mkdtemp(prefix="saccade-demos-"))
    atexit.register(shutil.rmtree, out)
    demos.record_tasks(dict.fromkeys(TASKS, 2), out, RECORDING, lambda task: None)
    return out


def make_batches(
    recording: Path, settings: TrainingSettings, *, with_later: bool = True, device: str = "cpu"
) -> tuple[train.Run, Batches]:
    """A run before its first step, and what it draws from."""
    config = train.policy_config(settings, RECORDING, TASKS)
    samples, _ = load_samples(recording, TASKS, settings.horizon, config.processor())
    config = train.with_statistics(config, samples)
    run = train.new_run(settings, config, describe(recording, TASKS), device)
    targets = samples.targets.mean(axis=0), samples.targets.std(axis=0) + np.float32(1e-3)
    batches = Batches(
        samples,
        config,
        run.learner.backbone,
        prompts_of(config, config.processor()),
        targets,
        settings.batch_size,
        absent_share=settings.absent_share,
        with_later=with_later,
    )
    return run, batches
