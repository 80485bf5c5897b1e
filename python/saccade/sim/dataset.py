"""Demonstrations as training samples: one observation and the chunk of expert actions that follows it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError
from saccade.sim import demos
from saccade.sim.settings import Statistics
from saccade.sim.tasks import TASKS

Float32Array = npt.NDArray[np.float32]

VALIDATION_EVERY = 20  # of so many demonstrations of a task, one is held out
MIN_VALID_ACTIONS = 4  # a frame with fewer usable actions is left out


@dataclass(frozen=True)
class Samples:
    """`frames` observations with their chunks, as recorded (nothing is normalised).

    Attributes:
        images: `(frames, cameras, H, W, 3)` uint8.
        state: `(frames, 4)` float32, proprioception.
        targets: `(frames, 6)` float32, positions of object and goal.
        actions: `(frames, horizon, 4)` float32, zero where not valid.
        mask: `(frames, horizon, 1)` float32, 1 where an action is valid.
        tasks: `(frames,)` number of the task in `TASKS`.
    """

    images: npt.NDArray[np.uint8]
    state: Float32Array
    targets: Float32Array
    actions: Float32Array
    mask: Float32Array
    tasks: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.state)


def chunks(demonstration: demos.Demonstration, horizon: int) -> tuple[Float32Array, Float32Array]:
    """The expert's actions from each frame on, and which of them follow from what the frame shows.

    After a disturbance the expert reacts to something that the frame could not foretell, so actions count up
    to and including the first disturbed step.

    Returns:
        `(frames, horizon, 4)` and `(frames, horizon, 1)` of zeros and ones.
    """
    steps = demonstration.frame_steps[:, None] + np.arange(horizon)  # (frames, horizon)
    inside = steps < len(demonstration.actions)
    steps = np.minimum(steps, len(demonstration.actions) - 1)
    disturbed = demonstration.disturbed[steps].astype(np.int64)
    earlier = np.cumsum(disturbed, axis=1) - disturbed  # disturbances before each step of the chunk
    valid = (inside & (earlier == 0))[..., None]
    return (demonstration.actions[steps] * valid).astype(np.float32), valid.astype(np.float32)


def load_samples(directory: Path, tasks: list[str], horizon: int) -> tuple[Samples, Samples]:
    """Training and validation samples, split by demonstration.

    Raises:
        InputError: a task has no demonstrations.
    """
    parts: tuple[list[Samples], list[Samples]] = ([], [])
    for task in tasks:
        found = 0
        for number, (_, demonstration) in enumerate(demos.episodes(directory, task)):
            found += 1
            actions, mask = chunks(demonstration, horizon)
            keep = mask[..., 0].sum(axis=1) >= MIN_VALID_ACTIONS
            samples = Samples(
                images=demonstration.images[keep],
                state=demonstration.proprio[keep],
                targets=demonstration.targets[keep],
                actions=actions[keep],
                mask=mask[keep],
                tasks=np.full(int(keep.sum()), list(TASKS).index(task), dtype=np.int64),
            )
            held_out = number % VALIDATION_EVERY == VALIDATION_EVERY - 1
            parts[held_out].append(samples)
        if found == 0:
            raise InputError(f"{directory}: no demonstrations of {task}")
    training = join(parts[0])
    return training, join(parts[1]) if parts[1] else training


def join(parts: list[Samples]) -> Samples:
    """All samples in one."""
    fields = Samples.__dataclass_fields__
    return Samples(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})


def statistics(samples: Samples) -> dict[str, Statistics]:
    """Of state, valid actions and targets."""
    valid = samples.mask[..., 0] > 0
    return {
        "state": Statistics.of(samples.state),
        "action": Statistics.of(samples.actions[valid]),
        "targets": Statistics.of(samples.targets),
    }
