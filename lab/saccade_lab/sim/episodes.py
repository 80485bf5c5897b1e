"""Episodes as independent work items, for ``saccade rollout`` in one process or in many."""

from __future__ import annotations

import functools
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saccade._internal.arrays import UInt8Array
from saccade_lab.sim import rollout
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.environment_cache import cached_environment
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.recordings import Recorder
from saccade_lab.sim.report import tile
from saccade_lab.sim.rollout import Episode, environment_for
from saccade_lab.sim.video import VideoWriter


@dataclass(frozen=True)
class Rolled:
    """One episode, and what was drawn.

    Attributes:
        episode: The outcome.
        picture: The last picture of the simulation, as a contact sheet shows it.
        video: Bytes of the MP4, if one was wanted.
        recording: The episode as ``Recording.to_bytes`` gives it, if it was wanted.
    """

    episode: Episode
    picture: UInt8Array | None
    video: bytes | None = None
    recording: bytes | None = None


@dataclass(frozen=True)
class Episodes:
    """Runs episodes of a policy. It is pickled; each process loads the policy once.

    Attributes:
        checkpoint: Directory of the policy.
        engine: What computes backbone and head, ``"rust"`` or ``"torch"``.
        num_threads: Threads of the policy; None for its default.
        instruction_from: A task whose instruction the policy gets instead.
        video: Whether a video is made of each episode.
        data_config, action_horizon: As ``saccade.Policy.from_pretrained`` takes them.
        processor_options: The same, as JSON.
        record: Whether each episode is recorded.
    """

    checkpoint: str
    engine: str = "rust"
    num_threads: int | None = None
    instruction_from: str | None = None
    video: bool = False
    data_config: str | None = None
    action_horizon: int | None = None
    processor_options: str | None = None
    record: bool = False

    @property
    def overrides(self) -> dict[str, Any]:
        """What is given of ``data_config``, ``action_horizon`` and ``processor_options``, as JSON values."""
        options = None if self.processor_options is None else json.loads(self.processor_options)
        found = {
            "data_config": self.data_config,
            "action_horizon": self.action_horizon,
            "processor_options": options,
        }
        return {name: value for name, value in found.items() if value is not None}

    @property
    def policy(self) -> Policy:
        """The policy. The first call in a process loads it; raises as ``Policy.from_pretrained``."""
        return policy_of(self.checkpoint, self.engine, self.num_threads, json.dumps(self.overrides))

    def __call__(self, item: tuple[str, int]) -> Rolled:
        """Runs the episode of a task and a seed."""
        task, seed = item
        policy = self.policy
        environment = cached_environment(
            (self.checkpoint, task), lambda: environment_for(policy, task, render_mode="rgb_array")
        )
        recorder = Recorder(rollout.rng_seed(task, seed)) if self.record else None
        run = self._filmed if self.video else self._unseen
        episode, video = run(environment, seed, on_action=recorder)
        picture = environment.render()
        assert picture is not None
        recording = None if recorder is None else recorder.recording().to_bytes()
        return Rolled(episode, tile(picture), video, recording)

    def _run(self, environment: TaskEnvironment, seed: int, **options: Any) -> Episode:
        """The episode; options as ``run_episode``."""
        return rollout.run_episode(
            environment, self.policy, seed, instruction_from=self.instruction_from, **options
        )

    def _unseen(self, environment: TaskEnvironment, seed: int, **options: Any) -> tuple[Episode, None]:
        """The episode without a video."""
        return self._run(environment, seed, **options), None

    def _filmed(self, environment: TaskEnvironment, seed: int, **options: Any) -> tuple[Episode, bytes]:
        """The episode and its video."""
        with tempfile.TemporaryDirectory(prefix="saccade-video-") as folder:
            path = Path(folder) / "episode.mp4"
            with VideoWriter(path) as video:
                episode = self._run(environment, seed, on_step=video.add, **options)
            episode.video = f"videos/{environment.task.name}-{seed}.mp4"
            return episode, path.read_bytes()


@functools.lru_cache(maxsize=1)
def policy_of(checkpoint: str, engine: str, num_threads: int | None, overrides: str) -> Policy:
    """The policy in a directory, warmed up. The last one is kept for the next episode."""
    policy = Policy.from_pretrained(
        checkpoint, engine=engine, num_threads=num_threads, **json.loads(overrides)
    )
    policy.warmup()
    return policy
