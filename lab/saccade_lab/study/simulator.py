"""The simulator as a source: closed-loop episodes of a policy, recorded observation by observation."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import ArrayLike, Float32Array
from saccade.errors import CheckpointError
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.input_files import BoolArray
from saccade.head.intervention import Intervention
from saccade.policy.interfaces import Head
from saccade_lab.files import path_text
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy, check_trained_on
from saccade_lab.sim.rollout import Episode, environment_for, run_episode
from saccade_lab.sim.settings import EMBODIMENT_ID
from saccade_lab.study.source import Source, episode_rng
from saccade_lab.study.wrapped_head import WrappedHead


@dataclass(frozen=True)
class Simulator(Source):
    """Episodes of a policy in MuJoCo.

    Attributes:
        checkpoint: Directory of the policy.
        tasks: Names of tasks.
        seeds: One episode of each task for each seed.
        engine: What computes the head in closed loop, ``"rust"`` or ``"torch"``.
    """

    checkpoint: str
    tasks: tuple[str, ...]
    seeds: range
    engine: str = "rust"
    closed_loop: ClassVar[bool] = True

    def describe(self) -> dict[str, Any]:
        """See ``Source``."""
        policy = policy_of(self.checkpoint)
        return {
            "checkpoint": {
                "name": Path(self.checkpoint).resolve().name,
                "sha256": policy.checkpoint_sha256(),
                "num_future_tokens": self.config.num_future_tokens,
                "num_layers": self.config.num_layers,
                "num_steps": self.config.num_steps,
                "num_vl_tokens": policy.num_vl_tokens(),
            }
        }

    @property
    def units(self) -> list[tuple[str, int]]:
        """Task and seed of every episode."""
        return [(task, seed) for task in self.tasks for seed in self.seeds]

    @property
    def config(self) -> HeadConfig:
        """See ``Source``."""
        return self.policy.head.config

    @property
    def engine_name(self) -> str:
        """See ``Source``."""
        return self.engine

    @property
    def policy(self) -> Policy:
        """The policy with the chosen engine."""
        return policy_of(self.checkpoint, self.engine)

    def head(self, precision: str = "float32") -> ActionHead:
        """See ``Source``. Computes on one thread, because cells are spread over processes."""
        return head_of(self.checkpoint, precision)

    def recorded(self, task: str, seed: int) -> Recorded:
        """An episode of the unchanged policy."""
        return recorded(self.checkpoint, self.engine, task, seed)

    def observed(self, task: str, seed: int) -> HeadInputs:
        """See ``Source``."""
        return self.recorded(task, seed).observation

    def rng(self, task: str, seed: int) -> np.random.Generator:
        """See ``Source``."""
        return episode_rng(task, seed)

    def first(self, task: str, seed: int, instruction: str) -> HeadInputs:
        """The first observation of an episode with another instruction, without noise."""
        environment = environment_of(self.checkpoint, task)
        environment.restart(seed)
        environment.instruction = instruction
        seen = environment.observe()
        ids = np.array([EMBODIMENT_ID])
        return HeadInputs(self.policy.features(seen), self.policy.state(seen), ids)

    def encode(self, observation: HeadInputs) -> Any:
        """See ``Source``."""
        return self.policy.head.encode(observation.backbone_features)

    def actions(
        self, observation: HeadInputs, intervention: Intervention | None, context: Any = None
    ) -> Float32Array:
        """Actions of the robot, in [-1, 1]; see ``Source``."""
        assert observation.noise is not None
        found = self.policy.head.sample(
            self.encode(observation) if context is None else context,
            observation.state,
            EMBODIMENT_ID,
            noise=observation.noise,
            intervention=intervention,
        )
        return self.comparable(np.asarray(found))[:, None]

    def comparable(self, chunk: Float32Array) -> Float32Array:
        """See ``Source``."""
        return self.policy.robot_actions(chunk)

    def outcome(self, task: str, seed: int, intervention: Intervention | None) -> dict[str, Any]:
        """See ``Source``."""
        unchanged = self.recorded(task, seed)
        episode = unchanged.episode
        if intervention is not None:
            episode = judge(self.checkpoint, task, seed, intervention, self.engine)
        return {
            "success": episode.success,
            "steps": episode.steps,
            "chunks": episode.chunks,
            "num_observations": len(unchanged.observation),
        }

    def labels(self, task: str, seed: int) -> dict[str, Any]:
        """See ``Source``."""
        return {}


def simulator(
    checkpoint: Path | None, tasks: Sequence[str] | None, seeds: range, engine: str = "rust"
) -> Simulator:
    """Episodes of a policy.

    Args:
        checkpoint: Directory of the policy. Default: the bundled policy.
        tasks: Names of tasks. Default: all that the policy was trained on.
        seeds: Seeds of the episodes of each task.
        engine: What computes the head.

    Raises:
        FileNotFoundError, CheckpointError: There is no policy, or it was not trained on a task.
    """
    path = path_text(checkpoint or DEMO_CHECKPOINT)
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
        object, goal: Positions ``(observations, 3)`` in metres. In tasks with balls, the first and the last
            ball.
        hand: Position of the hand ``(observations, 3)`` in metres.
        gripper: Opening of the gripper ``(observations, 1)``, 0 to 1.
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
    observation: HeadInputs
    privileged: PrivilegedState


class Recorder(WrappedHead):
    """A head that records its inputs and passes them on; a ``saccade.policy.interfaces.Head``.

    Args:
        head: Head that computes.
        environment: Environment whose positions are recorded at every observation.
    """

    def __init__(self, head: Head, environment: TaskEnvironment) -> None:
        super().__init__(head)
        self._environment = environment
        self._given: list[tuple[npt.NDArray[Any], ...]] = []
        self._encoded: tuple[Float32Array, BoolArray] | None = None

    def encode(self, backbone_features: ArrayLike, **masks: Any) -> Any:
        """See ``Head``."""
        self._encoded = np.array(backbone_features), np.array(masks["image_mask"])
        return self._wrapped.encode(backbone_features, **masks)

    def sample(self, context: Any, state: ArrayLike, embodiment_id: Any, **options: Any) -> Any:
        """See ``Head``."""
        targets = self._environment.privileged_targets()
        proprio = self._environment.last_observation["proprio"]
        known = (targets[None, :3], targets[None, 3:6], proprio[None, :3], proprio[None, 3:4])
        assert self._encoded is not None
        self._given.append((*self._encoded, np.array(state), np.array(options["noise"]), *known))
        return self._wrapped.sample(context, state, embodiment_id, **options)

    def recorded(self, episode: Episode) -> Recorded:
        """The recording, when the episode is over."""
        features, images, state, noise, *known = map(np.concatenate, zip(*self._given, strict=True))
        ids = np.full(len(features), EMBODIMENT_ID)
        observation = HeadInputs(features, state, ids, noise, image_mask=images)
        return Recorded(episode, observation, PrivilegedState(*known))


def judge(
    checkpoint: str, task: str, seed: int, intervention: Intervention | None = None, engine: str = "rust"
) -> Episode:
    """Runs an episode of a policy.

    Layout, wording and noise depend on task and seed alone, so that all policies and interventions are judged
    on the same episodes.
    """
    policy = policy_of(checkpoint, engine)
    return run_episode(environment_of(checkpoint, task), policy, seed, intervention=intervention)


def record_episode(environment: TaskEnvironment, policy: Policy, seed: int) -> Recorded:
    """Runs and records one episode. Recording does not change it."""
    recorder = Recorder(policy.head, environment)
    return recorder.recorded(run_episode(environment, policy.with_head(recorder), seed))


# Caches of a worker process, so that consecutive cells do not load or compute the same things twice.


@functools.lru_cache(maxsize=1)
def recorded(checkpoint: str, engine: str, task: str, seed: int) -> Recorded:
    """An episode of the unchanged policy."""
    return record_episode(environment_of(checkpoint, task), policy_of(checkpoint, engine), seed)


@functools.lru_cache(maxsize=2)
def policy_of(checkpoint: str, engine: str = "rust") -> Policy:
    """The policy in a directory; its head runs on one thread, because cells are spread over processes."""
    return Policy.from_pretrained(checkpoint, engine=engine, num_threads=1)


@functools.lru_cache(maxsize=3)
def head_of(checkpoint: str, precision: str = "float32") -> ActionHead:
    """The head alone, on one thread."""
    return ActionHead.from_pretrained(Path(checkpoint), precision=precision, num_threads=1)


_open: dict[tuple[str, str, bool], TaskEnvironment] = {}


def environment_of(checkpoint: str, task: str, *, blind: bool = False) -> TaskEnvironment:
    """The task as the policy in that directory sees it, or with black images. The two used last stay open."""
    key = (checkpoint, task, blind)
    if key in _open:
        _open[key] = _open.pop(key)  # now the last one
    else:
        if len(_open) == 2:
            _open.pop(next(iter(_open))).close()
        policy = policy_of(checkpoint)
        blanked = [camera.name for camera in policy.config.cameras] if blind else []
        _open[key] = environment_for(policy, task, blanked=blanked)
    return _open[key]
