"""A policy in the simulator: a whole checkpoint, and the cameras and tasks that it was trained on."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

import saccade
from saccade._internal.arrays import Float32Array
from saccade._internal.environment import arithmetic
from saccade.errors import CheckpointError, InputError, ShapeError
from saccade.head.intervention import Intervention
from saccade.policy.interfaces import Head
from saccade.processor import Processor
from saccade.robots import LANGUAGE_KEY, DataConfigLike
from saccade_lab.files import checkpoint_identity
from saccade_lab.inside import context_of, features_of, inputs_of
from saccade_lab.sim.settings import CONFIG_FILE, FILES, GROUPS, SimulationConfig
from saccade_lab.sim.tasks import find_task

#: One intervention, several that act together, or none.
Interventions: TypeAlias = Intervention | Sequence[Intervention] | None

DEMO_CHECKPOINT = saccade.demo_checkpoint()
ENGINES = ("rust", "torch")


def load_whole(
    checkpoint: Path,
    engine: str = "rust",
    num_threads: int | None = None,
    *,
    data_config: DataConfigLike | None = None,
    action_horizon: int | None = None,
    processor_options: Mapping[str, Any] | None = None,
) -> saccade.Policy:
    """The policy of a checkpoint, computed by one of ``ENGINES``.

    Args:
        checkpoint: A directory.
        engine: ``"rust"``, or ``"torch"`` for ``saccade_lab.reference``, which needs torch.
        num_threads: Number of threads; for torch, of the whole process.
        data_config, action_horizon, processor_options: As for ``saccade.Policy.from_pretrained``; only with
            ``"rust"``.

    Raises:
        FileNotFoundError, CheckpointError: As ``saccade.Policy.from_pretrained``.
        InputError: Unknown engine, ``num_threads`` below 1, or one of the last three with ``"torch"``.
    """
    if num_threads is not None and num_threads < 1:
        raise InputError(f"num_threads: given {num_threads}, expected at least 1")
    if engine == "rust":
        return saccade.Policy.from_pretrained(
            checkpoint,
            num_threads=num_threads,
            data_config=data_config,
            action_horizon=action_horizon,
            processor_options=processor_options,
        )
    if engine == "torch":
        overrides = {
            "data_config": data_config,
            "action_horizon": action_horizon,
            "processor_options": processor_options,
        }
        given = [name for name, value in overrides.items() if value is not None]
        if given:
            raise InputError(f"{', '.join(given)}: expected engine 'rust', got 'torch'")
        from saccade_lab.sim.torch_engine import load_policy

        return load_policy(checkpoint, num_threads)
    raise InputError(f"engine: unknown name {engine!r}, expected one of {', '.join(ENGINES)}")


@dataclass(frozen=True)
class Chunk:
    """A chunk of actions and the time that it took.

    Attributes:
        answer: ``(horizon, action_dim)`` float32, as the policy gave them.
        milliseconds: Time of each part: backbone (with preprocessing), encode, sample.
    """

    answer: Float32Array
    milliseconds: dict[str, float]

    @property
    def actions(self) -> Float32Array:
        """``(horizon, action_dim)`` float32, clipped to [-1, 1]."""
        clipped: Float32Array = np.clip(self.answer, -1.0, 1.0)
        return clipped


class Policy:
    """A whole policy that drives the simulated robot.

    Args:
        whole: The policy.
        config: How it is run in the simulator.
        checkpoint: The directory that it was loaded from.
        engine: Which of ``ENGINES`` computes it.

    Example:
        >>> import gymnasium, saccade_lab.sim
        >>> policy, env = Policy.from_pretrained(), gymnasium.make("saccade/reach-v0")
        >>> observation, info = env.reset(seed=0)
        >>> chunk = policy.act(observation, noise=policy.noise(np.random.default_rng(0)))
        >>> for action in chunk.actions[: policy.config.execute_steps]:
        ...     observation, reward, done, truncated, info = env.step(action)
        >>> env.close()
    """

    def __init__(
        self, whole: saccade.Policy, config: SimulationConfig, checkpoint: Path, engine: str = "rust"
    ) -> None:
        self.whole = whole
        self.config = config
        self.checkpoint = checkpoint
        self.engine = engine

    @classmethod
    def from_pretrained(
        cls,
        checkpoint: str | os.PathLike[str] = DEMO_CHECKPOINT,
        *,
        engine: str = "rust",
        num_threads: int | None = None,
        data_config: DataConfigLike | None = None,
        action_horizon: int | None = None,
        processor_options: Mapping[str, Any] | None = None,
    ) -> Policy:
        """Loads a policy.

        Args:
            checkpoint: A directory that ``saccade train`` wrote. Default: the bundled policy.
            engine: ``"rust"`` or ``"torch"``.
            num_threads: Number of threads.
            data_config, action_horizon, processor_options: As for ``saccade.Policy.from_pretrained``; only
                with ``"rust"``.

        Raises:
            FileNotFoundError: A file is not there.
            CheckpointError: Config or tensors do not fit.
            InputError: As ``load_whole``.
        """
        directory = Path(checkpoint)
        if not directory.is_dir():
            raise FileNotFoundError(f"{directory}: no such checkpoint directory")
        config = SimulationConfig.from_file(directory / CONFIG_FILE)
        for name in FILES:
            if not (directory / name).is_file():
                raise FileNotFoundError(f"{directory / name}: no such file")
        whole = load_whole(
            directory,
            engine,
            num_threads,
            data_config=data_config,
            action_horizon=action_horizon,
            processor_options=processor_options,
        )
        normalizer = whole.normalizer
        for kind, groups in (("state", normalizer.state_groups), ("action", normalizer.action_groups)):
            found = {group.key: group.size for group in groups}
            if found != GROUPS:
                raise CheckpointError(f"{directory}: {kind}: expected the groups {GROUPS}, got {found}")
        return cls(whole, config, directory, engine)

    @property
    def head(self) -> Head:
        """The action head."""
        return self.whole.head

    @property
    def horizon(self) -> int:
        """Actions in a chunk."""
        return self.head.config.action_horizon

    def with_head(self, head: Head) -> Policy:
        """The same policy with another head."""
        whole = saccade.Policy(
            head,
            self.whole.normalizer,
            self.whole.embodiment_id,
            backbone=self.whole.backbone,
            processor=self.whole.processor,
            requirements=self.whole.requirements,
        )
        return Policy(whole, self.config, self.checkpoint, self.engine)

    def num_vl_tokens(self, instruction: str | None = None) -> int:
        """T_vl with an instruction. Default: the most that one of the tasks' instructions gives."""
        assert self.whole.processor is not None
        return num_vl_tokens(self.whole.processor, self.config, instruction)

    def noise(self, rng: np.random.Generator) -> Float32Array:
        """The noise that a chunk starts from, ``(1, horizon, action_dim)``."""
        return rng.standard_normal((1, self.horizon, self.head.config.encoder_action_dim), dtype=np.float32)

    def observation(self, seen: Mapping[str, Any]) -> dict[str, Any]:
        """What the simulator shows, in Isaac-GR00T's nested form with a batch of one.

        Args:
            seen: ``images`` by camera name ``(H, W, 3)`` uint8, ``proprio (4,)``, ``instruction``.

        Raises:
            ShapeError: A camera is missing, or ``proprio`` has another shape.
        """
        missing = [camera.name for camera in self.config.cameras if camera.name not in seen["images"]]
        if missing:
            raise ShapeError(
                f"images: none of camera {', '.join(missing)}; there are {', '.join(seen['images'])}"
            )
        state = np.asarray(seen["proprio"], dtype=np.float32)
        if state.shape != (sum(GROUPS.values()),):
            raise ShapeError(f"proprio: shape {state.shape}, expected ({sum(GROUPS.values())},)")
        parts = np.split(state[None, None], np.cumsum(list(GROUPS.values()))[:-1], axis=-1)
        return {
            "video": {
                camera.name: np.asarray(seen["images"][camera.name])[None, None]
                for camera in self.config.cameras
            },
            "state": dict(zip(GROUPS, parts, strict=True)),
            "language": {LANGUAGE_KEY: [[seen["instruction"]]]},
        }

    def features(self, seen: Mapping[str, Any]) -> Float32Array:
        """Backbone features of what the simulator shows, ``(1, T_vl, width)``."""
        (found,) = features_of(self.whole, inputs_of(self.whole, self.observation(seen)))
        return np.asarray(found.backbone_features)

    def state(self, seen: Mapping[str, Any]) -> Float32Array:
        """Normalised proprioception, ``(1, state_dim)``."""
        parts = self.observation(seen)["state"].values()
        return np.asarray(self.whole.normalizer.state(np.concatenate([part[0] for part in parts], axis=-1)))

    def robot_actions(self, chunk: Float32Array) -> Float32Array:
        """Actions of the head ``(..., horizon, action_dim)`` as the robot takes them, in [-1, 1]."""
        actions: Float32Array = np.clip(np.asarray(self.whole.normalizer.actions(chunk)), -1.0, 1.0)
        return actions

    def act(
        self, seen: Mapping[str, Any], *, noise: Float32Array, intervention: Interventions = None
    ) -> Chunk:
        """Computes a chunk of actions.

        Args:
            seen: See ``observation``.
            noise: The result of ``noise``.
            intervention: A change inside the head, see ``saccade.Intervention``.
        """
        observation = self.observation(seen)
        times = [time.perf_counter()]
        features = features_of(self.whole, inputs_of(self.whole, observation))
        times.append(time.perf_counter())
        context = context_of(self.whole, features)
        times.append(time.perf_counter())
        answer = self.whole.sample(context, observation, noise=noise, intervention=intervention)
        times.append(time.perf_counter())
        spent = {
            part: 1e3 * (after - before)
            for part, before, after in zip(("backbone", "encode", "sample"), times, times[1:], strict=False)
        }
        actions = np.concatenate([answer[name][0] for name in GROUPS], axis=-1)
        return Chunk(actions, spent)

    def blank(self, instruction: str) -> dict[str, Any]:
        """What a black room would show, with the hand in the middle of its range."""
        size = self.config.image_size
        middle = self.whole.normalizer.denormalize_state(
            np.zeros((1, self.head.config.state_dim), np.float32)
        )
        return {
            "images": {camera.name: np.zeros((size, size, 3), np.uint8) for camera in self.config.cameras},
            "proprio": np.asarray(middle)[0],
            "instruction": instruction,
        }

    def warmup(self) -> None:
        """Acts once on black images, so that the first real call is not slow."""
        instruction = find_task(self.config.tasks[0]).instructions[0]
        self.act(self.blank(instruction), noise=self.noise(np.random.default_rng(0)))

    def describe(self) -> dict[str, Any]:
        """What computes the policy, for a result file."""
        if self.engine == "torch":
            from saccade_lab.sim.torch_engine import describe

            return describe()
        return {"name": "rust", **arithmetic(), "num_threads": self.head.num_threads}

    def checkpoint_sha256(self) -> str:
        """SHA-256 of the policy's files, see ``checkpoint_identity``."""
        return checkpoint_identity(self.checkpoint)["sha256"]


def num_vl_tokens(processor: Processor, config: SimulationConfig, instruction: str | None = None) -> int:
    """T_vl of a policy with an instruction. Default: the most that one of its tasks' instructions gives."""
    blank = np.zeros((config.image_size, config.image_size, 3), np.uint8)
    frames = [blank] * len(config.cameras)
    texts = [text for name in config.tasks for text in find_task(name).instructions]
    if instruction is not None:
        texts = [instruction]
    return max(int(processor(frames, text).input_ids.shape[1]) for text in texts)


def check_trained_on(policy: Policy, tasks: list[str]) -> None:
    """Raises ``CheckpointError`` if the policy was not trained on a task."""
    unknown = [task for task in tasks if task not in policy.config.tasks]
    if unknown:
        raise CheckpointError(
            f"{policy.checkpoint}: does not know {', '.join(unknown)}; "
            f"it was trained on {', '.join(policy.config.tasks)}"
        )
