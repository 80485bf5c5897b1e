"""Recordings of LIBERO as small as they can be, made up without a simulator."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from saccade._internal.files import write_json
from saccade_lab.libero.checkpoint import LiberoConfig, recorded_statistics
from saccade_lab.libero.recording import LiberoRecording
from saccade_lab.sim.demos import Demonstration
from saccade_lab.training.settings import LIBERO_SETTINGS, TrainingSettings

SIZE = 48  # pixels of a frame
STRIDE = 4
SAID = ("pick up the milk and place it in the basket", "pick up the alphabet soup and place it in the basket")
TINY = dataclasses.replace(
    LIBERO_SETTINGS,
    steps=4,
    batch_size=3,
    width=32,
    num_layers=4,
    num_heads=2,
    language_layers=2,
    vision_width=16,
    vision_layers=2,
    vision_heads=2,
    num_future_tokens=3,
    view_size=64,
)


def tiny(version: str) -> TrainingSettings:
    """``TINY`` for a release."""
    return dataclasses.replace(TINY, version=version)


def demonstration(seed: int, steps: int = 22, frame_stride: int = STRIDE) -> Demonstration:
    """A demonstration of random numbers, whose gripper is open first and closed then."""
    rng = np.random.default_rng(seed)
    frame_steps = np.arange(0, steps, frame_stride, dtype=np.int32)
    actions = rng.uniform(-1, 1, (steps, 7)).astype(np.float32)
    actions[:, -1] = np.where(np.arange(steps) < steps // 2, -1, 1)
    return Demonstration(
        images=rng.integers(0, 256, (len(frame_steps), 2, SIZE, SIZE, 3), dtype=np.uint8),
        proprio=rng.uniform(-1, 1, (len(frame_steps), 8)).astype(np.float32),
        targets=rng.uniform(-1, 1, (len(frame_steps), 6)).astype(np.float32),
        frame_steps=frame_steps,
        actions=actions,
        disturbed=np.arange(steps) == 9,
    )


def write_recording(folder: Path, episodes: int = 2, frame_stride: int = STRIDE) -> Path:
    """Writes a recording of two tasks."""
    for task, said in enumerate(SAID):
        settings = LiberoRecording("libero_object", task, said, 2, SIZE, frame_stride)
        (folder / settings.name).mkdir(parents=True)
        write_json(folder / settings.name / "recording.json", settings.to_dict())
        for episode in range(episodes):
            path = folder / settings.name / f"{1_000_000 + episode}.npz"
            one = demonstration(10 * task + episode, frame_stride=frame_stride)
            path.write_bytes(one.to_bytes())
    return folder


def with_statistics(config: LiberoConfig) -> LiberoConfig:
    """A config with the statistics of random numbers."""
    rng = np.random.default_rng(1)
    numbers = recorded_statistics(
        rng.uniform(-1, 1, (9, 8)).astype(np.float32), rng.uniform(-1, 1, (9, 7)).astype(np.float32)
    )
    return dataclasses.replace(config, statistics=numbers)
