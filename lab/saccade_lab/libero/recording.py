"""The files of recorded demonstrations of a LIBERO suite; reading them needs no simulator.

A recording is a directory with ``<suite>-<task>/<seed>.npz``, see ``saccade_lab.sim.demos.Demonstration``,
and ``<suite>-<task>/recording.json``, which has the settings.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from saccade._internal.small_files import read_json
from saccade.errors import InputError
from saccade.processor import Processor
from saccade_lab.libero.checkpoint import policy_actions
from saccade_lab.training import dataset
from saccade_lab.training.dataset import Samples

SETTINGS_FILE = "recording.json"


@dataclass(frozen=True)
class LiberoRecording:
    """The settings of the recording of one task.

    Attributes:
        suite: Its suite.
        task: Its number in the suite.
        instruction: What a policy is told.
        expert: The version of the expert that recorded it; see ``demos.SuiteExpert``.
        image_size: Pixels along each side of a frame.
        frame_stride: Control steps between recorded observations.
    """

    suite: str
    task: int
    instruction: str
    expert: int
    image_size: int = 256
    frame_stride: int = 5

    @property
    def name(self) -> str:
        """The name of its directory."""
        return f"{self.suite}-{self.task}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def is_recording(directory: Path) -> bool:
    """Whether a directory has demonstrations of LIBERO.

    Raises:
        InputError: A file with settings is damaged.
    """
    return any("suite" in read_json(path, InputError) for path in directory.glob(f"*/{SETTINGS_FILE}"))


def read_recordings(directory: Path) -> list[LiberoRecording]:
    """The tasks of a recording, in the order of their numbers.

    Raises:
        FileNotFoundError: There are none.
        InputError: They differ in their suite, their frames or how many there are, are not of LIBERO, or a
            file is damaged.
    """
    found = []
    for path in directory.glob(f"*/{SETTINGS_FILE}"):
        values = read_json(path, InputError)
        if set(values) != set(LiberoRecording.__dataclass_fields__):
            raise InputError(f"{path}: expected a recording of LIBERO, got the settings {', '.join(values)}")
        found.append(LiberoRecording(**values))
    if not found:
        raise FileNotFoundError(f"{directory}: no demonstrations found; `saccade demos --env` records them")
    if len({(one.suite, one.image_size, one.frame_stride, one.expert) for one in found}) > 1:
        raise InputError(f"{directory}: the tasks were recorded with different settings")
    return sorted(found, key=lambda one: one.task)


def load_samples(
    directory: Path,
    recordings: list[LiberoRecording],
    horizon: int,
    processor: Processor,
    num_threads: int = 1,
) -> tuple[Samples, Samples]:
    """Training and validation samples, split by demonstration, with actions as a policy gives them.

    Args:
        directory: The demonstrations.
        recordings: Their tasks; a sample has the number of its task in this list.
        horizon: Actions in a chunk.
        processor: Processor of the policy, which prepares the frames.
        num_threads: Threads that read and prepare frames.

    Raises:
        InputError: A task has no demonstrations.
    """
    names = [task.name for task in recordings]
    training, validation = dataset.load_samples(
        directory, names, horizon, processor, range(len(names)), num_threads
    )
    changed = [
        replace(part, actions=policy_actions(part.actions) * part.mask)
        for part in ([training] if validation is training else [training, validation])
    ]
    return changed[0], changed[-1]


def describe(directory: Path, recordings: list[LiberoRecording]) -> dict[str, Any]:
    """A recording, for a run's settings; see ``saccade_lab.training.dataset.describe``."""
    names = [task.name for task in recordings]
    return dataset.described(directory, names, [task.to_dict() for task in recordings])
