"""Processes of a farm: they compute at the same time, and their memory is read meanwhile."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import numpy as np

import saccade

TASKS = ("reach", "push", "drawer-open", "button-press-topdown", "window-open")
PATIENCE = 900.0  # seconds that a process waits for the others


@dataclass(frozen=True)
class Setting:
    """What is measured.

    Attributes:
        section: `"chunks"` or `"episodes"`.
        policy: `"demo"` or `"full"`.
        precision: Of backbone and head.
        processes: How many compute at the same time.
        threads: Of each process.
        batch: Observations, or robots, of each process.
        engine: `"saccade"` or `"torch"`.
        sharing: `"fork"`: one process loads the policy and forks the others. `"spawn"`: each loads its own.
        least_episodes: Stop when so many episodes have ended, instead of by time. Their mean length is then
            that of whole episodes, of which time would leave out the long ones. 0: stop by time.
    """

    section: str
    policy: str
    precision: str
    processes: int
    threads: int
    batch: int
    engine: str = "saccade"
    sharing: str = "fork"
    least_episodes: int = 0

    @property
    def name(self) -> str:
        """For progress."""
        return (
            f"{self.policy} {self.section}, {self.engine} {self.precision}, "
            f"{self.processes} x {self.threads}, batch {self.batch}, {self.sharing}"
        )


def measure(setting: Setting, checkpoint: Path, seconds: float) -> dict[str, Any]:
    """Runs a setting in processes of its own.

    Returns:
        `chunks`: chunks that each process computed; `seconds`: of each; `episodes`, `successes`, `lengths`:
        finished episodes, those that succeeded, and the sum of their chunks; `memory`: `pss` and `private`
        bytes of each process, the one that only loaded among them. Or `failed`: the reason.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    holder = context.Process(target=hold, args=(theirs, setting, checkpoint, seconds))
    holder.start()
    theirs.close()
    try:
        found = ours.recv()
        holder.join()
    except EOFError:
        end(holder)
        found = {"failed": "a process died"}
    except BaseException:  # this program is interrupted
        end(holder)
        raise
    return dict(found)


def end(holder: SpawnProcess) -> None:
    """Kills the process that `measure` started, and those that it started."""
    assert holder.pid is not None
    with contextlib.suppress(ProcessLookupError):  # it is not so far yet, or they are gone
        os.killpg(holder.pid, signal.SIGKILL)
    holder.kill()
    holder.join()


def hold(pipe: Connection, setting: Setting, checkpoint: Path, seconds: float) -> None:
    """The process that starts the others, and with `fork` loads the policy for them."""
    os.setsid()  # so that all of them can be ended together
    try:
        pipe.send(run(setting, checkpoint, seconds))
    except (EOFError, BrokenPipeError, TimeoutError):
        pipe.send({"failed": "a process died"})
    except Exception as error:  # reported in place of the measurement
        pipe.send({"failed": f"{type(error).__name__}: {error}"})


def run(setting: Setting, checkpoint: Path, seconds: float) -> dict[str, Any]:
    """See `measure`.

    Raises:
        EOFError, BrokenPipeError, TimeoutError: a process died or is stuck.
    """
    policy = load(setting, checkpoint) if setting.sharing == "fork" else None
    context: Any = multiprocessing.get_context(setting.sharing)
    pipes, processes = [], []
    for number in range(setting.processes):
        ours, theirs = context.Pipe()
        processes.append(
            context.Process(
                target=work, args=(theirs, setting, checkpoint, seconds, number, policy), daemon=True
            )
        )
        processes[-1].start()
        theirs.close()
        pipes.append(ours)
    for one in pipes:
        receive(one)  # it is ready
    for one in pipes:
        one.send("begin")
    found = [receive(one) for one in pipes]
    ids = [process.pid for process in processes]
    memory = [memory_of(pid) for pid in (([os.getpid()] if policy is not None else []) + ids)]
    for one, process in zip(pipes, processes, strict=True):
        one.send("end")
        process.join()
    return {key: [one[key] for one in found] for key in found[0]} | {"memory": memory}


def receive(pipe: Connection) -> Any:
    """What a process sends; raises what it sends if that is an exception."""
    if not pipe.poll(PATIENCE):
        raise TimeoutError
    found = pipe.recv()
    if isinstance(found, Exception):
        raise found
    return found


def work(
    pipe: Connection, setting: Setting, checkpoint: Path, seconds: float, number: int, policy: Any
) -> None:
    """One of the processes that compute."""
    try:
        held = load(setting, checkpoint) if policy is None else policy
        make = episodes if setting.section == "episodes" else chunks
        step, ended = make(held, setting, number)
        step()  # so that no setting pays for first calls
        pipe.send("ready")
        receive(pipe)
        ended.clear()
        begin, done, enough = time.perf_counter(), 0, False
        while not enough:  # all begin together; a step that takes longer than the time is done once
            done += step()
            elapsed = time.perf_counter() - begin
            least = setting.least_episodes
            enough = len(ended) >= least if least else elapsed >= seconds
        successes = sum(success for success, _ in ended)
        lengths = sum(length for _, length in ended)
        pipe.send(
            {
                "chunks": done,
                "seconds": elapsed,
                "episodes": len(ended),
                "successes": successes,
                "lengths": lengths,
            }
        )
        receive(pipe)
    except (EOFError, BrokenPipeError, TimeoutError):
        return
    except Exception as error:
        pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))


def load(setting: Setting, checkpoint: Path) -> Any:
    """The policy: one of the simulator for `episodes`."""
    engine = "rust" if setting.engine == "saccade" else "torch"
    if setting.section == "episodes":
        from saccade_lab.sim.policy import Policy

        return Policy.from_pretrained(checkpoint, engine=engine, num_threads=setting.threads)
    if engine == "torch":
        from saccade_lab.sim.policy import load_whole

        return load_whole(checkpoint, engine, setting.threads)
    return saccade.Policy.from_pretrained(
        checkpoint, precision=setting.precision, num_threads=setting.threads
    )


#: Computes a batch and returns its number of chunks; and a list of episodes that ended, `(success, chunks)`.
Made = tuple[Callable[[], int], list[tuple[bool, int]]]


def chunks(policy: saccade.Policy, setting: Setting, number: int) -> Made:
    """Acts on random frames."""
    first = number * setting.batch
    observations = [policy.example_observation(first + row) for row in range(setting.batch)]
    noise = noise_of(policy, np.random.default_rng(number), setting.batch)

    def step() -> int:
        policy.act(observations, noise=noise)
        return setting.batch

    return step, []


def noise_of(policy: saccade.Policy, rng: np.random.Generator, batch: int) -> Any:
    """Noise for a batch, `(batch, horizon, action_dim)`."""
    config = policy.head.config
    return rng.standard_normal((batch, config.action_horizon, config.encoder_action_dim), dtype=np.float32)


def episodes(policy: Any, setting: Setting, number: int) -> Made:
    """Runs robots in the simulator; all observations of a step are one batch.

    Seeds and noise differ between processes, and are the same in every setting with as many.
    """
    from saccade_lab.sim.rollout import environment_for

    tasks = [task for task in TASKS if task in policy.config.tasks]
    order = ((task, seed) for seed in itertools.count(number * 1000) for task in tasks)
    ended: list[tuple[bool, int]] = []
    rng = np.random.default_rng(number)
    robots: list[Robot] = []
    opened: dict[tuple[int, str], Any] = {}

    def begin(place: int) -> Robot:
        task, seed = next(order)
        if (place, task) not in opened:
            opened[place, task] = environment_for(policy, task)
        environment = opened[place, task]
        environment.restart(seed)
        return Robot(environment)

    robots += [begin(place) for place in range(setting.batch)]

    def step() -> int:
        seen = [policy.observation(robot.environment.observe()) for robot in robots]
        noise = noise_of(policy.whole, rng, setting.batch)
        answers = policy.whole.act(seen, noise=noise)
        for place, (robot, answer) in enumerate(zip(robots, answers, strict=True)):
            actions = np.concatenate([part[0] for part in answer.values()], axis=-1)
            if robot.advance(np.clip(actions, -1.0, 1.0)[: policy.config.execute_steps]):
                ended.append((robot.success, robot.chunks))
                robots[place] = begin(place)
        return setting.batch

    return step, ended


@dataclass
class Robot:
    """A robot in an episode.

    Attributes:
        environment: Its simulation.
        steps, chunks, success: How far it is.
    """

    environment: Any
    steps: int = 0
    chunks: int = 0
    success: bool = False

    def advance(self, actions: Any) -> bool:
        """Executes actions; whether the episode has ended."""
        self.chunks += 1
        limit = self.environment.task.max_steps
        for action in actions:
            self.success = self.environment.advance(action).success
            self.steps += 1
            if self.success or self.steps == limit:
                return True
        return False


def memory_of(pid: int) -> dict[str, int]:
    """Bytes of a process: `pss`, in which a shared page counts by its share, and `private` ones."""
    found: dict[str, int] = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]:
        name, amount = line.split()[:2]
        found[name.rstrip(":")] = int(amount) * 1024
    return {"pss": found["Pss"], "private": found["Private_Clean"] + found["Private_Dirty"]}
