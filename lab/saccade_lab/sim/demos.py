"""Demonstrations: scripted experts recorded with the policy's cameras, one file per episode.

A recording is a directory with ``<task>/<seed>.npz`` and ``<task>/recording.json``, which has the settings.
Files are written under a temporary name and renamed, so that an interrupted recording can be continued. An
episode depends only on its task, its seed and the settings, so that several processes record the same files
as one.
"""

from __future__ import annotations

import functools
import io
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal import run_settings
from saccade._internal.arrays import Float32Array
from saccade._internal.files import write_atomically
from saccade._internal.small_files import read_json
from saccade.errors import InputError
from saccade_lab.parallel import ALONE, Lost, Workers, check_lost, each
from saccade_lab.sim import environment_cache
from saccade_lab.sim.cameras import DEFAULT_CAMERAS, DEFAULT_IMAGE_SIZE, CameraPose
from saccade_lab.sim.experts import Expert, NoiseBursts
from saccade_lab.sim.tasks import DEMO_TASKS, DEMONSTRATION_SEEDS, STUDY_TASKS, TASKS, find_task

if TYPE_CHECKING:
    from saccade_lab.sim.environment import TaskEnvironment
    from saccade_lab.sim.scenarios import StepOutcome

MAX_STEPS = 250  # bursts lengthen the expert's path
STEPS_AFTER_SUCCESS = 8  # so that the last chunks show how to stay
#: The column of a data set that says at which steps another action than the recorded one was executed.
DISTURBED = {"disturbed": 1}
MAX_MISSES = 0.5  # a task is given up if more than this share of at least 20 episodes fails
# The success of reach and of the study tasks depends only on the position of the hand. They need the most
# precision and therefore the most demonstrations.
DEFAULT_COUNTS = (
    {task.name: 100 for task in DEMO_TASKS} | {"reach": 300} | {task.name: 200 for task in STUDY_TASKS}
)


class Settings(Protocol):
    """The settings of a recording, of Meta-World or of LIBERO."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        ...


@dataclass(frozen=True)
class RecordingSettings:
    """The settings of a recording.

    Attributes:
        image_size: Pixels along each side.
        frame_stride: Control steps between recorded observations.
        cameras: The cameras that are recorded.
    """

    image_size: int = DEFAULT_IMAGE_SIZE
    frame_stride: int = 3
    cameras: tuple[CameraPose, ...] = DEFAULT_CAMERAS

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "image_size": self.image_size,
            "frame_stride": self.frame_stride,
            "cameras": [camera.to_dict() for camera in self.cameras],
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RecordingSettings:
        """Reads what ``to_dict`` wrote."""
        cameras = tuple(CameraPose.from_dict(camera) for camera in values["cameras"])
        return cls(int(values["image_size"]), int(values["frame_stride"]), cameras)


#: Images ``(cameras, H, W, 3)`` uint8, proprioception and targets of one moment.
Look: TypeAlias = tuple[npt.NDArray[np.uint8], Float32Array, Float32Array]


@dataclass(frozen=True)
class Demonstration:
    """One recorded episode of ``steps`` control steps and ``frames`` observations.

    Attributes:
        images: ``(frames, cameras, H, W, 3)`` uint8.
        proprio: ``(frames, state_dim)`` float32.
        targets: ``(frames, 6)`` float32, positions of object and goal, metres.
        frame_steps: ``(frames,)`` int32, the control step before which a frame was drawn.
        actions: ``(steps, action_dim)`` float32, the expert's action at each step.
        disturbed: ``(steps,)`` bool, where another action was executed.
    """

    images: npt.NDArray[np.uint8]
    proprio: npt.NDArray[np.float32]
    targets: npt.NDArray[np.float32]
    frame_steps: npt.NDArray[np.int32]
    actions: npt.NDArray[np.float32]
    disturbed: npt.NDArray[np.bool_]

    def to_bytes(self) -> bytes:
        """The file of the episode."""
        file = io.BytesIO()
        np.savez_compressed(file, **vars(self))
        return file.getvalue()


def record_episode(
    environment: TaskEnvironment, seed: int, settings: RecordingSettings
) -> Demonstration | None:
    """Records one episode of the expert; None if it did not succeed."""
    environment.restart(seed)
    task_number = list(TASKS).index(environment.task.name)

    def look() -> Look:
        seen = environment.observe()
        images = np.stack(list(seen["images"].values()))
        return images, seen["proprio"], environment.privileged_targets()

    return demonstrated(
        Expert(environment).action,
        environment.advance,
        look,
        NoiseBursts(np.random.default_rng((task_number, seed))),
        frame_stride=settings.frame_stride,
        max_steps=MAX_STEPS,
    )


def demonstrated(
    expert: Callable[[], Float32Array],
    advance: Callable[[Float32Array], StepOutcome],
    look: Callable[[], Look],
    bursts: NoiseBursts,
    *,
    frame_stride: int,
    max_steps: int,
) -> Demonstration | None:
    """Lets an expert act from where an episode stands; None if it does not succeed.

    Args:
        expert: Its next action.
        advance: Executes an action.
        look: Images, proprioception and targets of the moment.
        bursts: Replace some of its actions.
        frame_stride: Control steps between recorded observations.
        max_steps: Control steps until it is given up.
    """
    frames: list[tuple[Any, ...]] = []
    actions: list[Float32Array] = []
    disturbed: list[bool] = []
    steps_left, succeeded = max_steps, False
    while steps_left > 0:
        if len(actions) % frame_stride == 0:
            frames.append((*look(), np.int32(len(actions))))
        action = expert()
        executed, replaced = bursts.apply(action)
        actions.append(action)
        disturbed.append(replaced)
        steps_left -= 1
        if advance(executed).success and not succeeded:
            succeeded, steps_left = True, min(steps_left, STEPS_AFTER_SUCCESS)
    if not succeeded:
        return None
    images, proprio, targets, frame_steps = map(np.stack, zip(*frames, strict=True))
    return Demonstration(
        images, proprio, targets, frame_steps, np.stack(actions), np.array(disturbed, dtype=np.bool_)
    )


@dataclass(frozen=True)
class Recorder:
    """Records one episode; what a process runs.

    Attributes:
        settings: As of the whole recording.
    """

    settings: RecordingSettings

    def __call__(self, item: tuple[str, int]) -> bytes | None:
        """The file of the episode of a task and a seed; None if the expert did not succeed."""
        from saccade_lab.sim.environment import TaskEnvironment  # not at the top: reading needs no simulator

        task, seed = item
        settings = self.settings
        environment = environment_cache.cached_environment(
            (task, settings),
            lambda: TaskEnvironment(task, image_size=settings.image_size, cameras=settings.cameras),
        )
        demonstration = record_episode(environment, seed, settings)
        return None if demonstration is None else demonstration.to_bytes()


@dataclass
class Seeds:
    """The seeds of one task: the first ones at which the expert succeeds.

    Attributes:
        task: Its name.
        count: Number of episodes that are wanted.
        directory: Where they are written.
        done: Number of episodes that are there.
        outcomes: Whether the expert succeeded, by the seeds that were tried now or by an earlier run, in
            their order; None while it is not known.
    """

    task: str
    count: int
    directory: Path
    done: int = 0
    outcomes: dict[int, bool | None] = field(default_factory=dict)
    _left: Iterator[int] = field(default_factory=lambda: iter(DEMONSTRATION_SEEDS))

    def next_seeds(self, on_episode: Callable[[], None]) -> list[int]:
        """Seeds that one process would certainly try next: as many as episodes are missing.

        Args:
            on_episode: Called for each episode that an earlier run recorded.
        """
        found: list[int] = []
        for seed in self._left if self.done < self.count else ():
            if self.path(seed).exists():
                self.done += 1
                self.outcomes[seed] = True
                on_episode()
            else:
                found.append(seed)
                self.outcomes[seed] = None
            if self.done + len(found) == self.count:
                break
        return found

    def path(self, seed: int) -> Path:
        """The file of an episode."""
        return self.directory / f"{seed}.npz"

    def check(self) -> None:
        """Raises ``InputError`` if the expert fails too often, judged in the order of the seeds."""
        succeeded = 0
        for tried, outcome in enumerate(self.outcomes.values(), start=1):
            if outcome is None:
                return
            succeeded += outcome
            if not outcome and tried >= 20 and succeeded < (1 - MAX_MISSES) * tried:
                raise InputError(f"{self.task}: the expert failed in {tried - succeeded} of {tried} episodes")


def record_tasks(
    counts: Mapping[str, int],
    out: Path,
    settings: RecordingSettings,
    on_episode: Callable[[str], None],
    workers: Workers = ALONE,
) -> None:
    """Records episodes of tasks, less those that are recorded already, in one process or in several.

    Args:
        counts: Number of episodes by the name of the task: those with the first seeds at which the expert
            succeeds.
        out: Directory of the whole recording.
        settings: Must be the same as those of earlier episodes in ``out``.
        on_episode: Called with the task after each episode, recorded now or earlier.
        workers: The processes. Files and episodes are the same with any of them.

    Raises:
        InputError: ``out`` was recorded with other settings, or the expert fails too often.
        GraphicsError: OpenGL cannot be loaded.
        SaccadeError: Processes died again and again; the other episodes are recorded.
    """
    record_with(Recorder(settings), dict.fromkeys(counts, settings), counts, out, on_episode, workers)


def record_with(
    recorder: Callable[[tuple[str, int]], bytes | None],
    settings: Mapping[str, Settings],
    counts: Mapping[str, int],
    out: Path,
    on_episode: Callable[[str], None],
    workers: Workers = ALONE,
) -> None:
    """Like ``record_tasks``, for any recorder.

    Args:
        recorder: From a task and a seed to the file of the episode, or None if the expert did not succeed.
        settings: Of each task.
        counts, out, on_episode, workers: See ``record_tasks``, which also says what is raised.
    """
    tasks = {task: Seeds(task, count, out / task) for task, count in counts.items()}
    for task in tasks.values():
        task.directory.mkdir(parents=True, exist_ok=True)
        where = task.directory / "recording.json"
        run_settings.begin(where, settings[task.task].to_dict(), task.directory)
    lost = []
    try:
        # Failures of the experts are known only after a round; the next one makes up for them.
        while items := [
            (name, seed)
            for name, task in tasks.items()
            for seed in task.next_seeds(functools.partial(on_episode, name))
        ]:
            for (name, seed), file in each(recorder, items, workers):
                task = tasks[name]
                if isinstance(file, Lost):
                    lost.append(f"{name} {seed}: {file.reason}")
                    continue
                task.outcomes[seed] = file is not None
                if file is None:
                    task.check()
                    continue
                with write_atomically(task.path(seed)) as temporary:
                    temporary.write_bytes(file)
                task.done += 1
                on_episode(name)
            check_lost(lost, sum(counts.values()))
    finally:
        environment_cache.close()


def load(path: Path, *, images: bool = True) -> Demonstration:
    """Reads one episode, with or without its images. Without, ``images`` is ``(frames, 0, 0, 0, 3)``."""
    with np.load(path, allow_pickle=False) as arrays:  # reads an array when it is asked for
        names = [name for name in Demonstration.__dataclass_fields__ if images or name != "images"]
        found = {name: arrays[name] for name in names}
    return Demonstration(**{"images": np.empty((len(found["proprio"]), 0, 0, 0, 3), np.uint8), **found})


def recorded_tasks(directory: Path) -> list[str]:
    """Tasks with a recording in the directory, in the order of ``TASKS``.

    Raises:
        FileNotFoundError: There is none.
    """
    tasks = [name for name in TASKS if (directory / name / "recording.json").is_file()]
    if not tasks:
        raise FileNotFoundError(f"{directory}: no demonstrations found; `saccade demos` records them")
    return tasks


def read_settings(directory: Path, tasks: Sequence[str]) -> RecordingSettings:
    """The settings that all tasks of a recording share.

    Raises:
        FileNotFoundError: A task has no recording.
        InputError: They differ, or a file is damaged.
    """
    files = [directory / name / "recording.json" for name in tasks]
    found = [read_json(file, InputError) for file in files]
    if any(settings != found[0] for settings in found):
        raise InputError(f"{directory}: the tasks were recorded with different settings")
    try:
        return RecordingSettings.from_dict(found[0])
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise InputError(f"{files[0]}: settings of an unknown form ({error!r})") from None


def export(directory: Path, counts: Mapping[str, int], path: Path) -> None:
    """Writes the first episodes of a recording as a data set of lerobot's format.

    A step is a control step, and its action the expert's, also where another one was executed: there the
    column ``disturbed`` is 1.

    Args:
        directory: The recording, with an observation for every control step.
        counts: Number of episodes by task.
        path: As of ``write_recordings``, which says what is raised.
    """
    from saccade_lab.sim.environment import SIMULATION_HZ  # not at the top: reading needs no simulator
    from saccade_lab.sim.recordings import Recording, write_recordings

    settings = read_settings(directory, list(counts))

    def recordings() -> Iterator[Recording]:
        for task, count in counts.items():
            for seed, one in itertools.islice(episodes(directory, task), count):
                instruction = find_task(task).instruction(seed)
                yield Recording(instruction, one.images, one.proprio, one.actions, disturbed_column(one))

    cameras = [camera.name for camera in settings.cameras]
    write_recordings(path, recordings(), cameras, settings.image_size, SIMULATION_HZ, extra=DISTURBED)


def disturbed_column(demonstration: Demonstration) -> dict[str, npt.NDArray[np.int64]]:
    """The column ``DISTURBED`` of an episode: ``(steps, 1)``, 1 where another action was executed."""
    (name,) = DISTURBED
    return {name: demonstration.disturbed[:, None].astype(np.int64)}


def episodes(directory: Path, task: str, *, images: bool = True) -> Iterator[tuple[int, Demonstration]]:
    """Seeds and episodes of a task, in the order of their seeds, with or without images as in ``load``."""
    for path in episode_files(directory, task):
        yield int(path.stem), load(path, images=images)


def episode_files(directory: Path, task: str) -> list[Path]:
    """The files of the episodes of a task, in the order of their seeds."""
    return sorted((directory / task).glob("[0-9]*.npz"), key=lambda path: int(path.stem))
