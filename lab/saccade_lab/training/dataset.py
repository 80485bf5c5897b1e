"""Demonstrations as training samples: one observation and the chunk of expert actions that follows it.

Frames and words are prepared by the processor that runs the policy later, so that training and inference see
the same.
"""

import functools
import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.processor import Processor
from saccade.robots import Normalizer
from saccade_lab.sim import demos
from saccade_lab.sim.tasks import TASKS
from saccade_lab.training.frames import prepared

VALIDATION_EVERY = 20  # every 20th demonstration of a task is held out
MIN_VALID_ACTIONS = 4  # a frame with fewer usable actions is left out


@dataclass(frozen=True)
class Samples:
    """Observations with their chunks. Only the frames are prepared; nothing else is normalised.

    Attributes:
        images: ``(frames, cameras, 3, H, W)`` uint8, see ``prepared``: every recorded frame once, including
            those that are only the later frame of a sample.
        now: ``(samples,)`` the index in ``images`` of the observation.
        later: ``(samples,)`` the index of the observation after the chunk was executed, see ``later_frames``.
        state: ``(samples, state_dim)`` float32, proprioception.
        targets: ``(samples, 6)`` float32, positions of object and goal.
        actions: ``(samples, horizon, action_dim)`` float32, zero where not valid.
        mask: ``(samples, horizon, 1)`` float32, 1 where an action is valid.
        tasks: ``(samples,)`` number of the task, in ``TASKS`` or in the suite of LIBERO.
    """

    images: npt.NDArray[np.uint8]
    now: npt.NDArray[np.int64]
    later: npt.NDArray[np.int64]
    state: Float32Array
    targets: Float32Array
    actions: Float32Array
    mask: Float32Array
    tasks: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.state)


def chunks(demonstration: demos.Demonstration, horizon: int) -> tuple[Float32Array, Float32Array]:
    """The expert's actions from each frame on, and which of them are valid.

    After a disturbance the expert reacts to something that the frame does not show. Actions are therefore
    valid up to and including the first disturbed step.

    Returns:
        ``(frames, horizon, action_dim)`` and ``(frames, horizon, 1)`` of zeros and ones.
    """
    steps = demonstration.frame_steps[:, None] + np.arange(horizon)  # (frames, horizon)
    inside = steps < len(demonstration.actions)
    steps = np.minimum(steps, len(demonstration.actions) - 1)
    disturbed = demonstration.disturbed[steps].astype(np.int64)
    earlier = np.cumsum(disturbed, axis=1) - disturbed  # disturbances before each step of the chunk
    valid = (inside & (earlier == 0))[..., None]
    return (demonstration.actions[steps] * valid).astype(np.float32), valid.astype(np.float32)


def later_frames(demonstration: demos.Demonstration, horizon: int) -> npt.NDArray[np.int64]:
    """For each frame, the first one that was recorded at least ``horizon`` control steps later.

    If the demonstration ends before that, this is its last frame: once the task is done nothing moves.

    Returns:
        ``(frames,)`` indices of frames.
    """
    steps = demonstration.frame_steps
    return np.minimum(np.searchsorted(steps, steps + horizon), len(steps) - 1)


def load_samples(
    directory: Path,
    tasks: list[str],
    horizon: int,
    processor: Processor | None,
    numbers: Sequence[int] | None = None,
    num_threads: int = 1,
) -> tuple[Samples, Samples]:
    """Training and validation samples, split by demonstration.

    Args:
        directory: The demonstrations.
        tasks: Their tasks.
        horizon: Actions in a chunk.
        processor: Processor of the policy, which prepares the frames. None: no frame is read, which saves
            most of the time, and ``images`` is ``(frames, 0, 3, 0, 0)``.
        numbers: The number that samples have of each task. Default: that in ``TASKS``.
        num_threads: Threads that read and prepare frames.

    Raises:
        InputError: A task has no demonstrations.
    """
    parts: tuple[list[Samples], list[Samples]] = ([], [])
    with ThreadPoolExecutor(num_threads) as threads:  # reading and preparing frames release Python's lock
        for task, number in zip(tasks, numbers or map(list(TASKS).index, tasks), strict=True):
            read = functools.partial(samples_of, task=number, horizon=horizon, processor=processor)
            found = list(threads.map(read, demos.episode_files(directory, task)))
            if not found:
                raise InputError(f"{directory}: no demonstrations of {task}")
            for place, samples in enumerate(found):
                parts[place % VALIDATION_EVERY == VALIDATION_EVERY - 1].append(samples)
    training = join(parts[0])
    return training, join(parts[1]) if parts[1] else training


def samples_of(path: Path, *, task: int, horizon: int, processor: Processor | None) -> Samples:
    """The samples of the demonstration in a file; the other arguments are as in ``load_samples``."""
    demonstration = demos.load(path, images=processor is not None)
    actions, mask = chunks(demonstration, horizon)
    keep = mask[..., 0].sum(axis=1) >= MIN_VALID_ACTIONS
    without = np.empty((len(demonstration.images), 0, 3, 0, 0), np.uint8)
    return Samples(
        images=without if processor is None else prepared(demonstration.images, processor),
        now=np.flatnonzero(keep),
        later=later_frames(demonstration, horizon)[keep],
        state=demonstration.proprio[keep],
        targets=demonstration.targets[keep],
        actions=actions[keep],
        mask=mask[keep],
        tasks=np.full(int(keep.sum()), task, dtype=np.int64),
    )


def describe(directory: Path, tasks: list[str]) -> dict[str, Any]:
    """A recording, for a run's settings: the number of episodes per task, and a digest that identifies it.

    The digest covers the seeds of the episodes and the settings of the recording, which together determine
    the episodes.
    """
    return described(directory, tasks, demos.read_settings(directory, tasks).to_dict())


def described(directory: Path, tasks: list[str], settings: Any) -> dict[str, Any]:
    """Like ``describe``, with the settings of the recording as JSON values."""
    seeds = {task: sorted(int(path.stem) for path in (directory / task).glob("[0-9]*.npz")) for task in tasks}
    recorded = {"settings": settings, "seeds": seeds}
    digest = hashlib.sha256(json.dumps(recorded, sort_keys=True).encode()).hexdigest()
    return {"sha256": digest, "tasks": {task: len(found) for task, found in seeds.items()}}


def join(parts: list[Samples]) -> Samples:
    """Concatenates samples."""
    firsts = np.cumsum([0, *(len(part.images) for part in parts[:-1])])  # of each part's images
    moved = [
        replace(part, now=part.now + first, later=part.later + first)
        for part, first in zip(parts, firsts, strict=True)
    ]
    fields = Samples.__dataclass_fields__
    return Samples(**{name: np.concatenate([getattr(part, name) for part in moved]) for name in fields})


def normalized_actions(normalizer: Normalizer, actions: Float32Array) -> Float32Array:
    """``(..., T, action_dim)`` in the robot's units to what the head is trained on."""
    flat = actions.reshape(-1, *actions.shape[-2:])
    state = np.zeros((len(flat), normalizer.state_width), np.float32)  # no action is relative to it
    return np.asarray(normalizer.previous_chunk(flat, state)).reshape(actions.shape)
