"""A recording and a policy as small as they can be, for tests of training."""

from __future__ import annotations

from saccade.sim import demos, train
from saccade.sim.cameras import DEFAULT_CAMERAS
from saccade.sim.training_settings import TrainingSettings

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


def ignore(progress: train.Progress) -> None:
    """Shows no progress."""
