"""Episodes of the simulator as data sets of lerobot's format, a step for each control step.

Rollouts say which noise each chunk started from: see :meth:`saccade.datasets.Dataset.noise` for the column
``noise_seed``. ``chunk_step`` is the place of a step's action in its chunk. Actions are those of the policy,
before the robot clips them to -1 and 1.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.datasets import Writer
from saccade_lab.sim.settings import GROUPS

ROBOT = "metaworld_sawyer"
#: Columns of rollouts besides state and action, and their widths.
NOISE = {"noise_seed": 3, "chunk_step": 1}


@dataclass(frozen=True)
class Recording:
    """One episode.

    Attributes:
        instruction: What the policy was told.
        images: ``(steps, cameras, H, W, 3)`` uint8, before each control step.
        state: ``(steps, 4)`` float32.
        action: ``(steps, 4)`` float32.
        extra: Further columns of integers, ``(steps, width)``.
    """

    instruction: str
    images: npt.NDArray[np.uint8]
    state: Float32Array
    action: Float32Array
    extra: Mapping[str, npt.NDArray[np.int64]] = field(default_factory=dict)

    def to_bytes(self) -> bytes:
        """For another process."""
        file = io.BytesIO()
        arrays: dict[str, Any] = {"instruction": np.array(self.instruction), **self.extra}
        np.savez_compressed(file, images=self.images, state=self.state, action=self.action, **arrays)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> Recording:
        """Reads what ``to_bytes`` wrote."""
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            found = dict(arrays)
        extra = {name: found.pop(name) for name in NOISE if name in found}
        return cls(instruction=str(found.pop("instruction")), **found, extra=extra)


class Recorder:
    """Collects the steps of a rollout; see ``on_action`` of ``run_episode``.

    Args:
        rng_seed: What the generator of the episode's noise was made from, two numbers.
    """

    def __init__(self, rng_seed: tuple[int, int]) -> None:
        self.rng_seed = rng_seed
        self.instruction = ""
        self._steps: list[tuple[Any, ...]] = []

    def __call__(self, seen: Mapping[str, Any], action: Float32Array, chunk: int, place: int) -> None:
        """Adds a step: what was seen, and the action, which is at a place of a chunk."""
        self.instruction = seen["instruction"]
        images = np.stack(list(seen["images"].values()))
        self._steps.append((images, seen["proprio"], action, (*self.rng_seed, chunk), (place,)))

    def recording(self) -> Recording:
        """The episode."""
        images, state, action, seeds, places = map(np.stack, zip(*self._steps, strict=True))
        return Recording(
            self.instruction,
            images,
            state.astype(np.float32),
            action.astype(np.float32),
            dict(zip(NOISE, (seeds.astype(np.int64), places.astype(np.int64)), strict=True)),
        )


def write_recordings(
    path: Path,
    recordings: Iterable[Recording],
    cameras: list[str],
    image_size: int,
    fps: int,
    *,
    extra: Mapping[str, int],
) -> None:
    """Writes a data set with these episodes, in their order, all or nothing.

    Args:
        path: The folder, which must not exist or be empty.
        recordings: The episodes.
        cameras: Names of the cameras, in the order of the images.
        image_size: Pixels along each side.
        fps: Control steps per second.
        extra: Number of values by the name of each further column, which all episodes have.

    Raises:
        InputError: There is something in ``path``, or there is no episode.
        MissingExtraError: A package of saccade's extra ``data`` is not installed.
    """
    with Writer(
        path,
        fps=fps,
        robot=ROBOT,
        cameras=dict.fromkeys(cameras, (image_size, image_size)),
        state=GROUPS,
        action=GROUPS,
        extra=extra,
    ) as writer:
        for one in recordings:
            frames = {name: one.images[:, place] for place, name in enumerate(cameras)}
            writer.add_episode(
                one.instruction, frames=frames, state=one.state, action=one.action, extra=one.extra
            )
