"""The recorded moments that `saccade demo` shows; `python -m saccade_lab.sim.demo_frames` recorded them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.robots import LANGUAGE_KEY

FILE = Path(__file__).parent / "demo_frames.npz"


@dataclass(frozen=True, eq=False)
class Moment:
    """What the bundled policy's robot saw at one moment of a task, and what the scripted expert did then."""

    task: str
    """Its name, such as ``"push"``."""
    instruction: str
    """The instruction of the episode."""
    images: dict[str, UInt8Array]
    """By camera, ``(H, W, 3)``."""
    state: Float32Array
    """Position of the hand in metres and opening of the gripper, ``(4,)``."""
    actions: Float32Array
    """Velocity of the hand and effort of the gripper, ``(16, 4)`` in [-1, 1]; a row for each step."""

    def observation(self, instruction: str | None = None) -> dict[str, Any]:
        """What :meth:`saccade.Policy.act` takes, a batch of one; with other words than the recorded ones."""
        return {
            "video": {camera: image[None, None] for camera, image in self.images.items()},
            "state": {"hand": self.state[None, None, :3], "gripper": self.state[None, None, 3:]},
            "language": {LANGUAGE_KEY: [[self.instruction if instruction is None else instruction]]},
        }


def moments() -> dict[str, Moment]:
    """All of them, by the name of their task.

    Example:
        >>> import saccade
        >>> moment = moments()["push"]
        >>> policy = saccade.Policy.from_pretrained(saccade.demo_checkpoint())
        >>> policy.act(moment.observation(), seed=0)["hand"].shape
        (1, 16, 3)
    """
    with np.load(FILE, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    cameras = arrays["camera"].tolist()
    return {
        task: Moment(
            task=task,
            instruction=str(arrays["instruction"][row]),
            images=dict(zip(cameras, arrays["images"][row], strict=True)),
            state=arrays["state"][row],
            actions=arrays["actions"][row],
        )
        for row, task in enumerate(arrays["task"].tolist())
    }
