"""Closed-loop episodes in which all that the head was given is written down, look by look."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.errors import CheckpointError, InputError
from saccade.intervention import Intervention
from saccade.sim import graphics
from saccade.sim.environment import TaskEnvironment
from saccade.sim.policy import DEMO_CHECKPOINT, HeadEngine, Policy, check_trained_on
from saccade.sim.rollout import Episode, run_episode
from saccade.sim.tasks import check_evaluation_seeds, find_task
from saccade.study.arguments import names
from saccade.study.loaded import policy_of

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Look:
    """One look of an episode: what the head was given, and what the simulator knew.

    Attributes:
        features: Backbone features, `(1, T_vl, width)`.
        state: Normalised proprioception, `(1, state_dim)`.
        noise: What the chunk started from, `(1, horizon, action_dim)`.
        object, goal: Positions `(3,)`, metres; the first and the last ball where a task has its own balls.
        hand: Its position `(3,)`, metres.
        gripper: How far it is open `(1,)`, 0 to 1.
    """

    features: Float32Array
    state: Float32Array
    noise: Float32Array
    object: Float32Array
    goal: Float32Array
    hand: Float32Array
    gripper: Float32Array


class Recorder:
    """A head engine that writes down what it is given and lets another one answer.

    Args:
        engine: answers.
        environment: is asked for positions at every look.
    """

    def __init__(self, engine: HeadEngine, environment: TaskEnvironment) -> None:
        self.looks: list[Look] = []
        self._engine = engine
        self._environment = environment
        self._features = np.empty((1, 0, 0), np.float32)

    def encode(self, features: Float32Array) -> Any:
        """See `HeadEngine`."""
        self._features = features.copy()
        return self._engine.encode(features)

    def sample(
        self,
        context: Any,
        state: Float32Array,
        noise: Float32Array,
        intervention: Intervention | Sequence[Intervention] | None = None,
    ) -> Float32Array:
        """See `HeadEngine`."""
        targets = self._environment.privileged_targets()
        proprio = self._environment.last_observation["proprio"]
        known = {"object": targets[:3], "goal": targets[3:6], "hand": proprio[:3], "gripper": proprio[3:4]}
        self.looks.append(Look(self._features, state.copy(), noise.copy(), **known))
        return self._engine.sample(context, state, noise, intervention)

    def describe(self) -> dict[str, Any]:
        """See `HeadEngine`."""
        return self._engine.describe()


def record_looks(environment: TaskEnvironment, policy: Policy, seed: int) -> tuple[Episode, list[Look]]:
    """Runs one episode; the policy does what it does without being watched."""
    recorder = Recorder(policy.engine, environment)
    watched = Policy(policy.config, policy.backbone, recorder, policy.checkpoint)
    return run_episode(environment, watched, seed), recorder.looks


@dataclass(frozen=True)
class Rollouts:
    """Which episodes of which policy.

    Attributes:
        checkpoint: Directory of the policy.
        tasks: Their names.
        seeds: One episode of each task for each seed.
    """

    checkpoint: str
    tasks: tuple[str, ...]
    seeds: range

    @property
    def episodes(self) -> list[tuple[str, int]]:
        """Task and seed of each."""
        return [(task, seed) for task in self.tasks for seed in self.seeds]


def add_rollout_arguments(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Declares policy, tasks and seeds; `episodes` is the default number of each task."""
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="PATH",
        help="policy to look into (default: the one shipped); with --features any checkpoint of a head",
    )
    parser.add_argument(
        "--tasks", metavar="NAME,...", help="tasks, separated by commas (default: all that it knows)"
    )
    parser.add_argument(
        "--episodes", type=int, metavar="NUMBER", help=f"episodes per task (default: {episodes})"
    )
    parser.set_defaults(default_episodes=episodes)
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="first seed; the next episodes count up. With --features: of what is drawn (default: 0)",
    )
    file = parser.add_argument_group("recorded features instead of the simulator")
    file.add_argument(
        "--features",
        type=Path,
        metavar="FILE",
        help=".npz or .safetensors as `saccade attention` takes it, with `episode` for intervals by episode",
    )
    file.add_argument("--config", type=Path, help="the head's config (default: config.json beside it)")


def rollouts_of(args: argparse.Namespace) -> Rollouts:
    """The episodes that the arguments ask for, all checked; needs a working OpenGL.

    Raises:
        InputError: an unknown task, seeds kept for training, no episode, a file of features.
        FileNotFoundError, CheckpointError: no policy, or one that was not trained on a task.
        GraphicsError: nothing can be drawn here.
    """
    if args.features is not None:
        raise InputError(
            "--features: this study asks for what only the simulator knows; cuts, patching, gradients and "
            "n-runtime take a file of features"
        )
    if args.config is not None:
        raise InputError("--config: only with --features; a policy of the simulator has its own")
    episodes = args.default_episodes if args.episodes is None else args.episodes
    seeds = check_evaluation_seeds(args.seed, episodes)
    named = None if args.tasks is None else task_names(args.tasks)
    graphics.check()
    checkpoint = str(args.checkpoint or DEMO_CHECKPOINT)
    try:
        policy = policy_of(checkpoint)
    except (CheckpointError, FileNotFoundError) as error:
        if Path(checkpoint).exists():
            raise CheckpointError(f"{error}; for a checkpoint of a head alone: --features FILE") from None
        raise
    tasks = named or policy.config.tasks
    check_trained_on(policy, list(tasks))
    return Rollouts(checkpoint, tasks, seeds)


def task_names(text: str) -> tuple[str, ...]:
    """Tasks out of a list with commas.

    Raises:
        InputError: a name is unknown, or there is none.
    """
    return tuple(find_task(name).name for name in names("--tasks", text))
