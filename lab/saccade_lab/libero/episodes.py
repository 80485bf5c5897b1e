"""Episodes of LIBERO as independent work items, in one process or in many."""

from __future__ import annotations

import functools
import io
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

import saccade
from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.episode import Episode, Key, Noise
from saccade_lab.libero.policy import LiberoPolicy
from saccade_lab.libero.rollout import run_episode
from saccade_lab.libero.starts import Starts
from saccade_lab.libero.video import FRAMES_PER_SECOND, EpisodeVideo, thumbnail
from saccade_lab.sim.environment_cache import cached_environment
from saccade_lab.sim.video import VideoWriter


@dataclass(frozen=True)
class Rolled:
    """One episode, and what was drawn.

    Attributes:
        episode: The outcome.
        picture: What the first camera saw last, a small PNG.
        video: Bytes of the MP4, if one was wanted.
    """

    episode: Episode
    picture: bytes
    video: bytes | None = None


@dataclass(frozen=True)
class Episodes:
    """Runs episodes of a checkpoint. It is pickled; each process loads the policy once.

    Attributes:
        checkpoint: Path of the checkpoint.
        protocol: Name of the protocol, or ``"auto"``.
        options: Keyword arguments of :meth:`saccade.Policy.from_pretrained`, as JSON values.
        noise: Seeds of the noise.
        video: Whether a video is made of each episode.
    """

    checkpoint: str
    protocol: str
    options: Mapping[str, Any] = field(default_factory=dict)
    noise: Noise = field(default_factory=Noise)
    video: bool = False

    @property
    def policy(self) -> LiberoPolicy:
        """The policy. The first call in a process loads it.

        Raises:
            FileNotFoundError, CheckpointError, InputError: As :meth:`saccade.Policy.from_pretrained` and
                ``LiberoPolicy``.
        """
        return policy_of(self.checkpoint, self.protocol, json.dumps(dict(self.options), sort_keys=True))

    def __call__(self, key: Key) -> Rolled:
        """Runs an episode."""
        suite, task, _ = key
        policy = self.policy
        name = (suite, task, policy.protocol.name)
        starts = cached_environment(
            name, lambda: Starts(environment_for(policy, suite, task), policy.protocol)
        )
        if not self.video:
            episode = run_episode(starts, policy, key, self.noise)
            return Rolled(episode, png_of(starts.environment))
        with tempfile.TemporaryDirectory(prefix="saccade-video-") as folder:
            path = Path(folder) / "episode.mp4"
            with VideoWriter(path, FRAMES_PER_SECOND) as writer:
                add = EpisodeVideo(writer)
                episode = run_episode(starts, policy, key, self.noise, add)
            return Rolled(episode, png_of(starts.environment), path.read_bytes())


def environment_for(policy: LiberoPolicy, suite: str, task: int) -> LiberoEnvironment:
    """The environment of a task, as the policy's protocol has it."""
    protocol = policy.protocol
    return LiberoEnvironment(
        suite,
        task,
        image_size=protocol.image_size,
        max_steps=protocol.limit(suite),
        settle_steps=protocol.settle_steps,
        official_states=protocol.official_states,
        state_of="lerobot" if protocol.lerobot_form else "isaac",
    )


def png_of(environment: LiberoEnvironment) -> bytes:
    """What the first camera has seen last, small."""
    picture = next(iter(environment.last_observation["images"].values()))
    stream = io.BytesIO()
    Image.fromarray(thumbnail(picture)).save(stream, "PNG", optimize=True)
    return stream.getvalue()


@functools.lru_cache(maxsize=1)
def policy_of(checkpoint: str, protocol: str, options: str) -> LiberoPolicy:
    """The policy of a checkpoint. The last one is kept for the next episode."""
    whole = saccade.Policy.from_pretrained(checkpoint, **json.loads(options))
    return LiberoPolicy(whole, Path(checkpoint), protocol)
