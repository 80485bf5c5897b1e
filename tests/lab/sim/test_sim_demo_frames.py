"""The recorded moments in the wheel are what the program that recorded them records."""

from __future__ import annotations

import numpy as np

from saccade.checkpoints.demo_frames import moments
from saccade_lab.sim import demo_frames
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig


def test_a_moment_is_recorded_again() -> None:
    config = SimulationConfig.from_file(DEMO_CHECKPOINT / CONFIG_FILE)
    again, kept = demo_frames.record("push", config), moments()["push"]
    assert again["instruction"] == kept.instruction
    np.testing.assert_allclose(again["state"], kept.state, atol=1e-4)
    np.testing.assert_allclose(again["actions"], kept.actions, atol=1e-2)
    images = np.stack(list(kept.images.values()))
    assert again["images"].shape == images.shape
    # Another version of OpenGL may round otherwise.
    assert np.abs(again["images"].astype(float) - images).mean() < 1.0
