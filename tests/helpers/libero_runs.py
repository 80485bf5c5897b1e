"""Small random checkpoints for LIBERO, observations of it, and an environment without physics."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import saccade
from saccade_lab import random_checkpoint
from saccade_lab.libero.protocols import Protocol
from saccade_lab.sim.scenarios import StepOutcome

#: The data config of N1.5 in Isaac-GR00T's examples.
DATA_CONFIG = "examples.Libero.custom_data_config:LiberoDataConfig"
INSTRUCTION = "pick up the milk and place it in the basket"

_FOLDER = tempfile.TemporaryDirectory(prefix="saccade-libero-")


@functools.cache
def checkpoint(version: str) -> Path:
    """A small random checkpoint with the keys, cameras and bounds of published LIBERO checkpoints."""
    return random_checkpoint.write(
        Path(_FOLDER.name) / version,
        version,
        backbone=random_checkpoint.small_backbone(version),
        head=random_checkpoint.small_head(version),
        robot="libero",
    )


@functools.cache
def whole(version: str) -> saccade.Policy:
    """Its policy."""
    data_config = DATA_CONFIG if version == "n1.5" else None
    return saccade.Policy.from_pretrained(checkpoint(version), data_config=data_config)


def seen(size: int, seed: int = 0) -> dict[str, Any]:
    """What the environment would show: random frames, a state within the published bounds."""
    rng = np.random.default_rng(seed)
    frames = rng.integers(0, 256, (2, size, size, 3), dtype=np.uint8)
    state = np.array([-0.1, 0.02, 0.9, 3.1, 0.1, -0.2, 0.03, -0.03]) + 0.01 * rng.standard_normal(8)
    return {
        "images": dict(zip(("image", "wrist_image"), frames, strict=True)),
        "state": state.astype(np.float32),
        "instruction": INSTRUCTION,
    }


class StandIn:
    """An environment without physics: an episode succeeds after ``lasts`` steps. It notes what is done to it.

    Args:
        protocol: Whose frames it shows.
        lasts: Steps to success; None for never.
    """

    def __init__(self, protocol: Protocol, lasts: int | None) -> None:
        self.size = protocol.image_size
        self.initial_states = np.zeros((50, 1)) if protocol.official_states else None
        self.lasts = lasts
        self.steps = 0
        self.is_closed = False
        self.starts: list[tuple[int | None, int | None, int, int | None]] = []
        self.actions: list[npt.NDArray[np.float32]] = []
        self.looks: list[int] = []
        self.last_observation: dict[str, Any] = {}
        self.instruction = INSTRUCTION

    def restart(
        self, state: int | None, seed: int | None, *, resets: int = 1, loads: int | None = None
    ) -> None:
        """See ``LiberoEnvironment``."""
        self.starts.append((state, seed, resets, loads))
        self.steps = 0

    def observe(self) -> dict[str, Any]:
        """Frames that depend on the number of steps."""
        self.looks.append(self.steps)
        self.last_observation = seen(self.size, self.steps)
        return self.last_observation

    def advance(self, action: npt.NDArray[np.float32]) -> StepOutcome:
        """Notes the action."""
        self.actions.append(action)
        self.steps += 1
        is_done = self.steps == self.lasts
        return StepOutcome(float(is_done), is_done)

    def close(self) -> None:
        """Notes it."""
        self.is_closed = True
