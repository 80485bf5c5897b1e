"""Demonstrations of LIBERO: the scripted expert, recorded with both cameras of a policy.

They start from layouts that LIBERO's reset draws, spread further by ``placements``, never from an official
initial state, some of them after a grasp that missed. Episodes, files and their continuation are as in
``saccade_lab.sim.demos``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from saccade.datasets import Writer
from saccade.errors import InputError
from saccade_lab.libero.checkpoint import CAMERAS, policy_actions
from saccade_lab.libero.expert import INTO_BASKET, ONTO_PLATE, Expert, Technique
from saccade_lab.libero.grasps import Points
from saccade_lab.libero.layout import ACTION_GROUPS, CONTROL_HZ, STATE_GROUPS
from saccade_lab.libero.misses import MISS_SHARE, miss
from saccade_lab.libero.placements import TRADE_SHARE, wider
from saccade_lab.libero.recording import LiberoRecording
from saccade_lab.libero.scene import Scene
from saccade_lab.libero.suites import SUITES, find_task
from saccade_lab.parallel import ALONE, Workers
from saccade_lab.sim import demos, environment_cache
from saccade_lab.sim.experts import NoiseBursts

if TYPE_CHECKING:
    from saccade_lab.libero.environment import LiberoEnvironment


@dataclass(frozen=True)
class SuiteExpert:
    """How the tasks of a suite are demonstrated, which all put one object somewhere.

    Attributes:
        technique: How the object is taken and let go.
        trade_share: Share of the demonstrations in which objects trade places. 0 if instructions say where an
            object stands.
        miss_share: Share of the demonstrations that begin after a grasp that missed; see ``misses``.
        version: Raised whenever one of what decides an episode changes: the expert, its grasps and misses,
            placements, bursts, numbers of steps. So a recording does not go on with other episodes.
        radius: Metres from the middle of an object that others stay away, by its ground plan ``(n, 2)``.
    """

    technique: Technique
    trade_share: float
    miss_share: float
    version: int
    radius: Callable[[Points], float]


def half_diagonal(plan: Points) -> float:
    """Half of the diagonal of the box around a ground plan: more than a circle needs."""
    return 0.5 * float(np.linalg.norm(np.ptp(plan, axis=0)))


def largest_distance(plan: Points) -> float:
    """The largest distance from the middle of the box around a ground plan."""
    middle = 0.5 * (plan.min(axis=0) + plan.max(axis=0))
    return float(np.linalg.norm(plan - middle, axis=1).max())


EXPERTS: Mapping[str, SuiteExpert] = {
    "libero_object": SuiteExpert(INTO_BASKET, TRADE_SHARE, MISS_SHARE, 2, half_diagonal),
    # Its objects are round and near to each other: with half a diagonal there is no room to move them.
    "libero_spatial": SuiteExpert(ONTO_PLATE, 0.0, 0.0, 1, largest_distance),
}
DEFAULT_COUNT = 40
IMAGE_SIZE, FRAME_STRIDE = 256, 5
MAX_STEPS = 280  # as in evaluations; without a miss the expert needs 80 to 210
SETTLE_STEPS = 10
ROBOT = "libero_panda"
#: Milder than Meta-World's, because a step moves the hand further: up to 5 cm instead of 1.
BURSTS: Mapping[str, Any] = {"start_probability": 0.02, "min_steps": 2, "max_steps": 6}


def recording(suite: str, task: int, image_size: int, frame_stride: int) -> LiberoRecording:
    """The settings of the recording of a task.

    Raises:
        InputError: The suite has no expert, or there is no such task.
    """
    if suite not in EXPERTS:
        raise InputError(f"suite: given {suite!r}, expected one with an expert: {', '.join(EXPERTS)}")
    instruction, version = find_task(suite, task).instruction, EXPERTS[suite].version
    return LiberoRecording(suite, task, instruction, version, image_size, frame_stride)


def all_tasks(suite: str) -> tuple[int, ...]:
    """The numbers of the tasks of a suite."""
    return tuple(range(SUITES[suite].num_tasks))


def scene_of(environment: LiberoEnvironment) -> Scene:
    """The scene of a task that puts one object into or onto another."""
    inner = environment.simulation.inner
    ((_, target, place),) = inner.parsed_problem["goal_state"]
    return Scene(inner, target, place.removesuffix("_contain_region"))


def start(environment: LiberoEnvironment, settings: LiberoRecording, seed: int) -> Scene:
    """Starts an episode with objects at wider places, and waits until they have come to rest.

    An object on another one moves with it, and one on furniture stays.

    Args:
        environment: One without official states and without steps for settling.
        settings: Of the task.
        seed: Of the layout.
    """
    environment.restart(None, seed)
    scene = scene_of(environment)
    expert, carriers = EXPERTS[settings.suite], scene.carriers()
    groups = {
        carrier: [name for name, below in carriers.items() if below == carrier]
        for carrier in scene.names()
        if carriers[carrier] == carrier
    }
    found = {carrier: scene.position(carrier)[:2] for carrier in groups}
    plans = {
        carrier: np.concatenate([scene.points(name)[:, :2] for name in names])
        for carrier, names in groups.items()
    }
    radii = {carrier: expert.radius(plan) for carrier, plan in plans.items()}
    rng = np.random.default_rng((settings.task, seed))
    for carrier, place in wider(rng, found, radii, scene.goal, expert.trade_share).items():
        for name in groups[carrier]:
            scene.move(name, place - found[carrier])
    for _ in range(SETTLE_STEPS):
        environment.advance([0, 0, 0, 0, 0, 0, -1])
    return scene


def record_episode(
    environment: LiberoEnvironment, settings: LiberoRecording, seed: int
) -> demos.Demonstration | None:
    """Records one episode of the expert, from its start or after a miss; None if it did not succeed.

    For ``environment`` see ``start``. Control steps of the miss are not recorded.
    """
    scene = start(environment, settings, seed)
    of_suite = EXPERTS[settings.suite]
    expert, rng = Expert(scene, of_suite.technique), np.random.default_rng((settings.task, seed, 2))
    if rng.random() < of_suite.miss_share:
        if not miss(scene, of_suite.technique, environment.advance, rng):
            return None
        expert.begin_again()

    def look() -> demos.Look:
        seen = environment.observe()
        return np.stack([seen["images"][name] for name in CAMERAS]), seen["state"], scene.targets()

    return demos.demonstrated(
        expert.action,
        environment.advance,
        look,
        NoiseBursts(np.random.default_rng((settings.task, seed, 1)), **BURSTS),
        frame_stride=settings.frame_stride,
        max_steps=MAX_STEPS,
    )


@dataclass(frozen=True)
class Recorder:
    """Records one episode; what a process runs.

    Attributes:
        settings: Of each task, by the name of its directory.
    """

    settings: Mapping[str, LiberoRecording]

    def __call__(self, item: tuple[str, int]) -> bytes | None:
        """The file of the episode of a task and a seed; None if the expert did not succeed."""
        from saccade_lab.libero.environment import LiberoEnvironment  # needs the simulator

        name, seed = item
        task = self.settings[name]
        environment = environment_cache.cached_environment(
            task,
            lambda: LiberoEnvironment(
                task.suite, task.task, image_size=task.image_size, settle_steps=0, official_states=False
            ),
        )
        demonstration = record_episode(environment, task, seed)
        return None if demonstration is None else demonstration.to_bytes()


def record(
    recordings: list[LiberoRecording],
    count: int,
    out: Path,
    on_episode: Callable[[str], None],
    workers: Workers = ALONE,
) -> None:
    """Records episodes of tasks, less those that are recorded already.

    Args:
        recordings: The tasks.
        count: Number of episodes of each.
        out, on_episode, workers: See ``saccade_lab.sim.demos.record_tasks``, which also says what is raised.
    """
    settings = {task.name: task for task in recordings}
    counts = dict.fromkeys(settings, count)
    demos.record_with(Recorder(settings), settings, counts, out, on_episode, workers)


def export(directory: Path, recordings: list[LiberoRecording], count: int, path: Path) -> None:
    """Writes the first episodes of a recording as a data set of lerobot's format.

    Keys and units are those of ``saccade_lab.libero.checkpoint``. A step is a control step, and its action
    the expert's, also where another one was executed: there the column ``disturbed`` is 1.

    Args:
        directory: The recording, with an observation for every control step.
        recordings: Its tasks.
        count: Number of episodes of each.
        path: The folder of the data set, which must not exist or be empty.

    Raises:
        InputError: There is something in ``path``, or there is no episode.
        MissingExtraError: A package of saccade's extra ``data`` is not installed.
    """
    size = recordings[0].image_size

    def episodes() -> Iterator[tuple[str, demos.Demonstration]]:
        for task in recordings:
            for _, one in itertools.islice(demos.episodes(directory, task.name), count):
                yield task.instruction, one

    with Writer(
        path,
        fps=CONTROL_HZ,
        robot=ROBOT,
        cameras=dict.fromkeys(CAMERAS, (size, size)),
        state=STATE_GROUPS,
        action=ACTION_GROUPS,
        extra=demos.DISTURBED,
    ) as writer:
        for instruction, one in episodes():
            writer.add_episode(
                instruction,
                frames={name: one.images[:, place] for place, name in enumerate(CAMERAS)},
                state=one.proprio,
                action=policy_actions(one.actions),
                extra=demos.disturbed_column(one),
            )
