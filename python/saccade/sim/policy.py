"""The policy: from an observation to a chunk of actions, by the NumPy backbone and either head engine."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import threadpoolctl  # type: ignore[import-untyped]

import saccade
from saccade._arrays import Float32Array
from saccade._files import sha256_of
from saccade.checkpoints import read_tensors
from saccade.errors import CheckpointError, InputError, ShapeError
from saccade.intervention import Intervention
from saccade.sim.backbone import Backbone, stack_images
from saccade.sim.instructions import Tokenizer
from saccade.sim.settings import CONFIG_FILE, TENSOR_FILE, PolicyConfig

#: One intervention, several that act together, or none.
Interventions: TypeAlias = Intervention | Sequence[Intervention] | None

DEMO_CHECKPOINT = Path(__file__).parent / "demo"
EMBODIMENT_ID = 0
ENGINES = ("rust", "torch")


class HeadEngine(Protocol):
    """An action head, computed by one of `ENGINES`."""

    def encode(self, features: Float32Array) -> Any:
        """The context for `sample`, from features `(1, T_vl, width)`."""

    def sample(
        self, context: Any, state: Float32Array, noise: Float32Array, intervention: Interventions = None
    ) -> Float32Array:
        """Normalised actions `(1, horizon, action_dim)` from state `(1, state_dim)` and noise of their shape.

        For `intervention` see `saccade.Intervention`.
        """

    def describe(self) -> dict[str, Any]:
        """The engine, for a result file."""


class RustEngine:
    """The head in Rust.

    Args:
        checkpoint: directory of a policy.
        num_threads: as `saccade.ActionHead.load` takes it.
    """

    def __init__(self, checkpoint: Path, num_threads: int | None = None) -> None:
        self._head = saccade.ActionHead.load(checkpoint, num_threads=num_threads)

    def encode(self, features: Float32Array) -> Any:
        """See `HeadEngine`."""
        return self._head.encode(features)

    def sample(
        self, context: Any, state: Float32Array, noise: Float32Array, intervention: Interventions = None
    ) -> Float32Array:
        """See `HeadEngine`."""
        actions = self._head.sample(context, state, EMBODIMENT_ID, noise=noise, intervention=intervention)
        return np.asarray(actions)

    def describe(self) -> dict[str, Any]:
        """See `HeadEngine`."""
        return {
            "name": "rust",
            "saccade": saccade.__version__,
            "isa": self._head.isa,
            "num_threads": self._head.num_threads,
        }


class TorchEngine:
    """The same head in plain torch. Only this engine needs torch.

    Args:
        checkpoint: directory of a policy.
        num_threads: threads of torch, for the whole process; None leaves torch's default.
    """

    def __init__(self, checkpoint: Path, num_threads: int | None = None) -> None:
        import torch

        from saccade.reference import ActionHead

        self._torch = torch
        if num_threads is not None:
            torch.set_num_threads(num_threads)
        self._head = ActionHead.load(checkpoint)

    def encode(self, features: Float32Array) -> Any:
        """See `HeadEngine`."""
        with self._torch.no_grad():
            return self._head.encode(features)

    def sample(
        self, context: Any, state: Float32Array, noise: Float32Array, intervention: Interventions = None
    ) -> Float32Array:
        """See `HeadEngine`."""
        with self._torch.no_grad():
            actions = self._head.sample(context, state, EMBODIMENT_ID, noise=noise, intervention=intervention)
            return np.asarray(actions.numpy())

    def describe(self) -> dict[str, Any]:
        """See `HeadEngine`."""
        return {
            "name": "torch",
            "torch": self._torch.__version__,
            "num_threads": self._torch.get_num_threads(),
        }


def make_engine(name: str, checkpoint: Path, num_threads: int | None = None) -> HeadEngine:
    """The engine of that name, with the head of a checkpoint.

    Raises:
        InputError: unknown engine, or `num_threads` below 1.
    """
    if num_threads is not None and num_threads < 1:
        raise InputError(f"num_threads: given {num_threads}, expected at least 1")
    if name == "rust":
        return RustEngine(checkpoint, num_threads)
    if name == "torch":
        return TorchEngine(checkpoint, num_threads)
    raise InputError(f"engine: unknown name {name!r}, expected one of {', '.join(ENGINES)}")


@dataclass(frozen=True)
class Chunk:
    """A chunk of actions and the time that it took.

    Attributes:
        actions: `(horizon, action_dim)` float32 in [-1, 1].
        milliseconds: Time of each part: backbone, encode, sample.
    """

    actions: Float32Array
    milliseconds: dict[str, float]


class Policy:
    """A language-conditioned policy on camera pixels.

    Args:
        config: its config.
        backbone: its backbone.
        engine: engine that computes its head.
        checkpoint: the directory that it was loaded from.

    Example:
        >>> import gymnasium, saccade.sim
        >>> policy, env = Policy.load(), gymnasium.make("saccade/reach-v0")
        >>> observation, info = env.reset(seed=0)
        >>> chunk = policy.act(observation, noise=policy.noise(np.random.default_rng(0)))
        >>> for action in chunk.actions[: policy.config.execute_steps]:
        ...     observation, reward, done, truncated, info = env.step(action)
        >>> env.close()
    """

    def __init__(
        self, config: PolicyConfig, backbone: Backbone, engine: HeadEngine, checkpoint: Path
    ) -> None:
        self.config = config
        self.backbone = backbone
        self.engine = engine
        self.checkpoint = checkpoint
        self._tokenizer = Tokenizer(config.vocabulary, config.backbone.text_length)
        self._camera_names = [camera.name for camera in config.cameras]
        self._libraries = threadpoolctl.ThreadpoolController()

    @classmethod
    def load(
        cls,
        checkpoint: str | os.PathLike[str] = DEMO_CHECKPOINT,
        *,
        engine: str = "rust",
        num_threads: int | None = None,
    ) -> Policy:
        """Loads a policy.

        Args:
            checkpoint: a directory with `config.json` and `model.safetensors`. Default: the bundled policy.
            engine: `"rust"` or `"torch"`.
            num_threads: number of threads of the head.

        Raises:
            FileNotFoundError: a file is not there.
            CheckpointError: config or tensors do not fit.
            InputError: unknown engine, or `num_threads` below 1.
        """
        directory = Path(checkpoint)
        if not directory.is_dir():
            raise FileNotFoundError(f"{directory}: no such checkpoint directory")
        config = PolicyConfig.from_file(directory / CONFIG_FILE)
        if not (directory / TENSOR_FILE).is_file():
            raise FileNotFoundError(f"{directory / TENSOR_FILE}: no such file")
        backbone = Backbone(config.backbone, read_tensors(directory / TENSOR_FILE, "backbone."))
        return cls(config, backbone, make_engine(engine, directory, num_threads), directory)

    @property
    def horizon(self) -> int:
        """Actions in a chunk."""
        return int(self.config.head["action_horizon"])

    def noise(self, rng: np.random.Generator) -> Float32Array:
        """The noise that a chunk starts from, `(1, horizon, action_dim)`."""
        return rng.standard_normal((1, self.horizon, len(self.config.action.mean)), dtype=np.float32)

    def features(self, observation: Mapping[str, Any]) -> Float32Array:
        """Backbone features of one observation, `(1, T_vl, width)`."""
        images = stack_images(observation["images"], self._camera_names)
        # NumPy's BLAS would use every core, and its threads wait by spinning. With one other busy process
        # these small products took up to a hundred times longer than on one thread.
        with self._libraries.limit(limits=1, user_api="blas"):
            return self.backbone(images, self._tokenizer(observation["instruction"])[None])

    def state(self, observation: Mapping[str, Any]) -> Float32Array:
        """Normalised proprioception, `(1, state_dim)`.

        Raises:
            ShapeError: `observation["proprio"]` has another shape than in training.
        """
        proprio = np.asarray(observation["proprio"], dtype=np.float32)
        if proprio.shape != (len(self.config.state.mean),):
            raise ShapeError(f"proprio: shape {proprio.shape}, expected ({len(self.config.state.mean)},)")
        return self.config.state.normalize(proprio)[None]

    def act(
        self, observation: Mapping[str, Any], *, noise: Float32Array, intervention: Interventions = None
    ) -> Chunk:
        """Computes a chunk of actions.

        Args:
            observation: `images` by camera name `(H, W, 3)` uint8, `proprio (4,)`, `instruction`.
            noise: the result of `noise`.
            intervention: a change inside the head, see `saccade.Intervention`.
        """
        times = [time.perf_counter()]
        features = self.features(observation)
        times.append(time.perf_counter())
        context = self.engine.encode(features)
        times.append(time.perf_counter())
        normalised = self.engine.sample(context, self.state(observation), noise, intervention)[0]
        times.append(time.perf_counter())
        spent = {
            part: 1e3 * (after - before)
            for part, before, after in zip(("backbone", "encode", "sample"), times, times[1:], strict=False)
        }
        return Chunk(np.clip(self.config.action.restore(normalised), -1.0, 1.0), spent)

    def warmup(self) -> None:
        """Acts once on a black observation, so that the first real call is not slow."""
        size = self.config.backbone.image_size
        observation = {
            "images": {name: np.zeros((size, size, 3), np.uint8) for name in self._camera_names},
            "proprio": np.array(self.config.state.mean, dtype=np.float32),
            "instruction": "",
        }
        self.act(observation, noise=self.noise(np.random.default_rng(0)))

    def checkpoint_sha256(self) -> str:
        """SHA-256 of config and tensors, in this order."""
        return sha256_of(self.checkpoint / CONFIG_FILE, self.checkpoint / TENSOR_FILE)


def check_trained_on(policy: Policy, tasks: list[str]) -> None:
    """Raises `CheckpointError` if the policy was not trained on a task."""
    unknown = [task for task in tasks if task not in policy.config.tasks]
    if unknown:
        raise CheckpointError(
            f"{policy.checkpoint}: does not know {', '.join(unknown)}; "
            f"it was trained on {', '.join(policy.config.tasks)}"
        )
