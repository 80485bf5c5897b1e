"""The simulator as a source: closed-loop episodes of a policy, recorded observation by observation."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from saccade._arrays import Float32Array
from saccade.config import HeadConfig
from saccade.errors import CheckpointError
from saccade.head import ActionHead
from saccade.intervention import Intervention
from saccade.observation import Observation
from saccade.sim.environment import TaskEnvironment
from saccade.sim.policy import DEMO_CHECKPOINT, EMBODIMENT_ID, HeadEngine, Policy, check_trained_on
from saccade.sim.rollout import Episode, environment_for, run_episode
from saccade.study.source import Source, episode_rng


@dataclass(frozen=True)
class Simulator(Source):
    """Episodes of a policy in MuJoCo.

    Attributes:
        checkpoint: Directory of the policy.
        tasks: Names of tasks.
        seeds: One episode of each task for each seed.
        engine: What computes the head in closed loop, `"rust"` or `"torch"`.
    """

    checkpoint: str
    tasks: tuple[str, ...]
    seeds: range
    engine: str = "rust"
    closed_loop: ClassVar[bool] = True

    def describe(self) -> dict[str, Any]:
        """See `Source`."""
        policy = policy_of(self.checkpoint)
        return {
            "checkpoint": {
                "name": Path(self.checkpoint).resolve().name,
                "sha256": policy.checkpoint_sha256(),
                "num_future_tokens": self.config.num_future_tokens,
                "num_layers": self.config.num_layers,
                "num_steps": self.config.num_steps,
                "num_vl_tokens": policy.config.backbone.num_tokens,
            }
        }

    @property
    def units(self) -> list[tuple[str, int]]:
        """Task and seed of every episode."""
        return [(task, seed) for task in self.tasks for seed in self.seeds]

    @property
    def config(self) -> HeadConfig:
        """See `Source`."""
        return HeadConfig.from_dict(self.policy.config.head)

    @property
    def engine_name(self) -> str:
        """See `Source`."""
        return self.engine

    @property
    def policy(self) -> Policy:
        """The policy with the chosen engine."""
        return policy_of(self.checkpoint, self.engine)

    def head(self, precision: str = "float32") -> ActionHead:
        """See `Source`. Computes on one thread, because cells are spread over processes."""
        return head_of(self.checkpoint, precision)

    def recorded(self, task: str, seed: int) -> Recorded:
        """An episode of the unchanged policy."""
        return recorded(self.checkpoint, self.engine, task, seed)

    def observed(self, task: str, seed: int) -> Observation:
        """See `Source`."""
        return self.recorded(task, seed).observation

    def rng(self, task: str, seed: int) -> np.random.Generator:
        """See `Source`."""
        return episode_rng(task, seed)

    def first(self, task: str, seed: int, instruction: str) -> Observation:
        """The first observation of an episode with another instruction, without noise."""
        environment = environment_of(self.checkpoint, task)
        environment.restart(seed)
        environment.instruction = instruction
        seen = environment.observe()
        ids = np.array([EMBODIMENT_ID])
        return Observation(self.policy.features(seen), self.policy.state(seen), ids)

    def encode(self, observation: Observation) -> Any:
        """See `Source`."""
        return self.policy.engine.encode(observation.backbone_features)

    def actions(
        self, observation: Observation, intervention: Intervention | None, context: Any = None
    ) -> Float32Array:
        """Actions of the robot, in [-1, 1]; see `Source`."""
        assert observation.noise is not None
        found = self.policy.engine.sample(
            self.encode(observation) if context is None else context,
            observation.state,
            observation.noise,
            intervention,
        )
        return self.comparable(found)[:, None]

    def comparable(self, chunk: Float32Array) -> Float32Array:
        """See `Source`."""
        return np.clip(self.policy.config.action.restore(chunk), -1.0, 1.0)

    def outcome(self, task: str, seed: int, intervention: Intervention | None) -> dict[str, Any]:
        """See `Source`."""
        unchanged = self.recorded(task, seed)
        episode = unchanged.episode
        if intervention is not None:
            environment = environment_of(self.checkpoint, task)
            episode = run_episode(environment, self.policy, seed, intervention=intervention)
        return {
            "success": episode.success,
            "steps": episode.steps,
            "chunks": episode.chunks,
            "looks": len(unchanged.observation),
        }

    def labels(self, task: str, seed: int) -> dict[str, Any]:
        """See `Source`."""
        return {}


def simulator(
    checkpoint: Path | None, tasks: Sequence[str] | None, seeds: range, engine: str = "rust"
) -> Simulator:
    """Episodes of a policy.

    Args:
        checkpoint: directory of the policy. Default: the bundled policy.
        tasks: names of tasks. Default: all that the policy was trained on.
        seeds: seeds of the episodes of each task.
        engine: what computes the head.

    Raises:
        FileNotFoundError, CheckpointError: there is no policy, or it was not trained on a task.
    """
    path = str(checkpoint or DEMO_CHECKPOINT)
    try:
        policy = policy_of(path)
    except (CheckpointError, FileNotFoundError) as error:
        if Path(path).exists():
            raise CheckpointError(f"{error}; for a checkpoint of a head alone: --features FILE") from None
        raise
    named = tuple(tasks or policy.config.tasks)
    check_trained_on(policy, list(named))
    return Simulator(path, named, seeds, engine)


@dataclass(frozen=True, eq=False)
class PrivilegedState:
    """What the simulator knows and the policy does not, at every observation of an episode.

    Attributes:
        object, goal: Positions `(observations, 3)` in metres. In tasks with balls, the first and the last
            ball.
        hand: Position of the hand `(observations, 3)` in metres.
        gripper: Opening of the gripper `(observations, 1)`, 0 to 1.
    """

    object: Float32Array
    goal: Float32Array
    hand: Float32Array
    gripper: Float32Array


@dataclass(frozen=True, eq=False)
class Recorded:
    """An episode and the inputs of the head in it.

    Attributes:
        episode: The outcome.
        observation: A row for each chunk, with its noise.
        privileged: A row for each chunk.
    """

    episode: Episode
    observation: Observation
    privileged: PrivilegedState


class Recorder:
    """A head engine that records its inputs and passes them to another engine.

    Args:
        engine: engine that computes.
        environment: environment whose positions are recorded at every observation.
    """

    def __init__(self, engine: HeadEngine, environment: TaskEnvironment) -> None:
        self._engine = engine
        self._environment = environment
        self._given: list[tuple[Float32Array, ...]] = []
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
        known = (targets[None, :3], targets[None, 3:6], proprio[None, :3], proprio[None, 3:4])
        self._given.append((self._features, state.copy(), noise.copy(), *known))
        return self._engine.sample(context, state, noise, intervention)

    def describe(self) -> dict[str, Any]:
        """See `HeadEngine`."""
        return self._engine.describe()

    def recorded(self, episode: Episode) -> Recorded:
        """The recording, when the episode is over."""
        features, state, noise, *known = (np.concatenate(arrays) for arrays in zip(*self._given, strict=True))
        ids = np.full(len(features), EMBODIMENT_ID)
        return Recorded(episode, Observation(features, state, ids, noise), PrivilegedState(*known))


def record_episode(environment: TaskEnvironment, policy: Policy, seed: int) -> Recorded:
    """Runs and records one episode. Recording does not change it."""
    recorder = Recorder(policy.engine, environment)
    watched = Policy(policy.config, policy.backbone, recorder, policy.checkpoint)
    return recorder.recorded(run_episode(environment, watched, seed))


# Caches of a worker process, so that consecutive cells do not load or compute the same things twice.


@functools.lru_cache(maxsize=1)
def recorded(checkpoint: str, engine: str, task: str, seed: int) -> Recorded:
    """An episode of the unchanged policy."""
    return record_episode(environment_of(checkpoint, task), policy_of(checkpoint, engine), seed)


@functools.lru_cache(maxsize=2)
def policy_of(checkpoint: str, engine: str = "rust") -> Policy:
    """The policy in a directory; its head runs on one thread, because cells are spread over processes."""
    return Policy.load(checkpoint, engine=engine, num_threads=1)


@functools.lru_cache(maxsize=3)
def head_of(checkpoint: str, precision: str = "float32") -> ActionHead:
    """The head alone, on one thread."""
    return ActionHead.load(Path(checkpoint), precision=precision, num_threads=1)


_open: dict[tuple[str, str], TaskEnvironment] = {}


def environment_of(checkpoint: str, task: str) -> TaskEnvironment:
    """The task as the policy in that directory sees it. The two used last stay open."""
    key = (checkpoint, task)
    if key in _open:
        _open[key] = _open.pop(key)  # now the last one
    else:
        if len(_open) == 2:
            _open.pop(next(iter(_open))).close()
        _open[key] = environment_for(policy_of(checkpoint), task)
    return _open[key]
