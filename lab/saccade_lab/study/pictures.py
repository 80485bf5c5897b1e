"""Pictures as a source: a whole checkpoint, and directories of what its robot saw, without a simulator."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from saccade._internal.arrays import LOADING_OPTIONS
from saccade.backbone.config import BackboneConfig
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.observations import read
from saccade.observations.pictures import PictureObservation, read_frames
from saccade.policy.encoding import pad_tokens
from saccade.policy.policy import Policy
from saccade.robots.data_configs import RELEASED
from saccade_lab.files import checkpoint_identity, loading_identity
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.inside import context_of, features_of, head_inputs, inputs_of, parts_of
from saccade_lab.maps.grid import layout_of
from saccade_lab.maps.layout import Layout
from saccade_lab.study.recording import NOISES, Recorded, num_episodes

Preprocessing = Literal["lerobot", "isaac"]


@dataclass(frozen=True)
class PictureSource(Recorded):
    """A whole checkpoint, and observations from pictures for it.

    The policy encodes all observations once in a process, and is then let go. Where a study needs the head,
    it is loaded alone, in float32: what computes gradients in torch has the memory for itself.

    Attributes:
        checkpoint: A checkpoint that ``saccade.Policy.from_pretrained`` reads.
        frames: Directory of the pictures, see ``saccade.observations.pictures.read_frames``.
        instruction, state: As ``read_frames`` takes them.
        other_frames, other_instruction: Of the observations to compare with. Where one is None, it is that of
            the others; with both None nothing is compared.
        embodiment, preprocessing, tokenizer, data_config, action_horizon: As
            ``saccade.Policy.from_pretrained`` takes them.
        processor_options: The same, as JSON.
        precision: How the backbone computes.
        seed: Seed of random tokens and of the noise.
        num_threads: Number of threads. Default: that of the engine.
        on_observation: Called after each encoded observation, with its number and that of all.
    """

    checkpoint: str
    frames: str
    instruction: str | None = None
    state: str | None = None
    other_frames: str | None = None
    other_instruction: str | None = None
    embodiment: str | int | None = None
    precision: str = "float32"
    preprocessing: Preprocessing | None = None
    tokenizer: str | None = None
    data_config: str | None = None
    action_horizon: int | None = None
    processor_options: str | None = None
    seed: int = 0
    num_threads: int | None = None
    on_observation: Callable[[int, int], None] | None = field(default=None, compare=False, repr=False)
    task: ClassVar[str] = "frames"

    @property
    def files(self) -> tuple[str, ...]:
        """See ``Source``."""
        config = None if self.data_config in RELEASED else self.data_config
        read = (self.frames, self.other_frames, self.state, self.tokenizer, config)
        return (*super().files, *(path for path in read if path is not None and Path(path).exists()))

    @property
    def options(self) -> dict[str, Any]:
        """How the policy is loaded, besides precision and threads: arguments of ``from_pretrained``."""
        found = {name: getattr(self, name) for name in LOADING_OPTIONS}
        if self.processor_options is not None:
            found["processor_options"] = json.loads(self.processor_options)
        return found

    def describe(self) -> dict[str, Any]:
        """See ``Source``."""
        encoded = encode(self)
        other = described(self.other_frames or self.frames, encoded.others) if encoded.others else None
        return {
            "checkpoint": self.describe_head(encoded.identity),
            "frames": {
                **described(self.frames, encoded.pictures),
                "episodes": num_episodes(encoded.observation),
                "noise": f"{NOISES} draws an observation",
                "precision": self.precision,
                "preprocessing": encoded.preprocessing,
                **loading_identity(Path(self.checkpoint), self.options),
                "embodiment_id": int(encoded.observation.embodiment_id[0]),
                "action_width": encoded.action_width,
                "other": other,
            },
            "seed": self.seed,
        }

    def head(self, precision: str = "float32") -> ActionHead:
        """See ``Source``."""
        if precision != "float32":
            raise InputError(f"precision: expected float32 for a head on pictures, got {precision}")
        (embodiment_id,) = set(self.all.embodiment_id.tolist())
        config = self.config
        return head_of(
            self.checkpoint, embodiment_id, config.action_horizon, config.num_states, self.num_threads
        )

    @property
    def config(self) -> HeadConfig:
        """See ``Source``."""
        return encode(self).config

    @property
    def action_width(self) -> int:
        """Those of the robot: nothing was learned for the others."""
        return encode(self).action_width

    @property
    def all(self) -> HeadInputs:
        """See ``Recorded``; raises as ``read_frames`` and ``saccade.Policy.from_pretrained``."""
        return encode(self).observation

    @property
    def others(self) -> HeadInputs | None:
        """The observation to compare with each: of the other directory, or with the other instruction."""
        return encode(self).other_observation

    def labels(self, task: str, seed: int) -> dict[str, Any]:
        """See ``Source``; with the name of the observation."""
        return {**super().labels(task, seed), "observation": encode(self).pictures[seed].name}


@dataclass(frozen=True, eq=False)
class Encoded:
    """What a policy made of the observations of a source.

    Attributes:
        config: Config of the head.
        identity: Name and hash of the checkpoint.
        preprocessing: How images and instruction were prepared.
        action_width: Number of the head's action dimensions that the robot uses.
        pictures, others: The observations, and those to compare them with.
        observation, other_observation: The same as the head takes them; None without others.
        inputs: What the backbone was given for each of ``pictures``.
        layouts: What is at each position of each of ``pictures``.
        backbone_config: Config of the backbone.
    """

    config: HeadConfig
    identity: dict[str, str]
    preprocessing: str
    action_width: int
    pictures: Sequence[PictureObservation]
    others: Sequence[PictureObservation]
    observation: HeadInputs
    other_observation: HeadInputs | None
    inputs: Sequence[BackboneInputs]
    layouts: Sequence[Layout]
    backbone_config: BackboneConfig


@functools.lru_cache(maxsize=1)
def encode(source: PictureSource) -> Encoded:
    """Loads the policy and encodes all observations; cached for the next cell."""
    policy = Policy.from_pretrained(
        source.checkpoint,
        **source.options,
        precision={"backbone": source.precision, "head": "float32"},
        num_threads=source.num_threads,
    )
    parts = parts_of(policy)
    pictures = pictures_of(source, policy, source.frames, source.instruction)
    others: list[PictureObservation] = []
    if (source.other_frames, source.other_instruction) != (None, None):
        words = source.instruction if source.other_instruction is None else source.other_instruction
        found = pictures_of(source, policy, source.other_frames or source.frames, words)
        others = [found[place % len(found)] for place in range(len(pictures))]
    seen, compared, given, layouts = [], [], [], []
    for place, picture in enumerate(pictures):
        (inputs,) = inputs_of(policy, picture.observation)
        context = context_of(policy, features_of(policy, [inputs]))
        seen.append(head_inputs(policy, picture.observation, context.features[0]))
        given.append(inputs)
        frames = read(picture.observation, policy.requirements).frames[0]
        layouts.append(layout_of(policy, frames, inputs, context.features[0].views))
        if others:  # views with the same frames are not computed again
            other = others[place].observation
            (features,) = features_of(policy, inputs_of(policy, other), previous=context)
            compared.append(head_inputs(policy, other, features))
        if source.on_observation is not None:
            source.on_observation(place + 1, len(pictures))
    return Encoded(
        config=parts.head.config,
        identity=checkpoint_identity(Path(source.checkpoint)),
        preprocessing=parts.processor.preprocessing,
        action_width=policy.normalizer.head_action_width,
        pictures=pictures,
        others=others,
        observation=joined(seen, pictures),
        other_observation=joined(compared, others) if others else None,
        inputs=given,
        layouts=layouts,
        backbone_config=parts.backbone.config,
    )


@functools.lru_cache(maxsize=1)
def head_of(
    checkpoint: str, embodiment_id: int, action_horizon: int, num_states: int, num_threads: int | None
) -> ActionHead:
    """The head with the layers of one embodiment, as the policy had it."""
    return ActionHead.from_pretrained(
        checkpoint,
        embodiment_ids=[embodiment_id],
        action_horizon=action_horizon,
        num_states=num_states,
        num_threads=num_threads,
    )


def pictures_of(
    source: PictureSource, policy: Policy, directory: str, instruction: str | None
) -> list[PictureObservation]:
    """The observations of a directory, with the state of the source."""
    state = None if source.state is None else Path(source.state)
    return read_frames(Path(directory), policy, instruction=instruction, state=state)


def joined(observations: Sequence[HeadInputs], pictures: Sequence[PictureObservation]) -> HeadInputs:
    """Observations of one row each as one, the shorter ones padded and their padding dropped.

    The head drops padding exactly: each has the bits that it has alone.
    """
    lengths = np.array([one.num_vl_tokens for one in observations])
    longest = int(lengths.max())
    masks = [pad_tokens(one.image_mask, longest) for one in observations if one.image_mask is not None]
    dropped = np.arange(longest) >= lengths[:, None]
    episodes = [picture.episode for picture in pictures]
    return HeadInputs(
        np.concatenate([pad_tokens(one.backbone_features, longest) for one in observations]),
        np.concatenate([one.state for one in observations]),
        np.concatenate([one.embodiment_id for one in observations]),
        image_mask=np.concatenate(masks) if masks else None,
        drop_vl=dropped if dropped.any() else None,
        episode=None if None in episodes else np.unique(np.array(episodes), return_inverse=True)[1],
    )


def described(directory: str, pictures: Sequence[PictureObservation]) -> dict[str, Any]:
    """What identifies observations, as JSON values; the hash covers names, pixels, states and instruction."""
    digest = hashlib.sha256()
    for picture in pictures:
        given = picture.observation
        values = {key: np.asarray(state).tolist() for key, state in given["state"].items()}
        digest.update(json.dumps([picture.name, picture.instruction, values]).encode())
        for name, frames in given["video"].items():
            digest.update(f"{name} {frames.shape}".encode())
            digest.update(frames.tobytes())
    return {
        "name": Path(directory).resolve().name,
        "sha256": digest.hexdigest(),
        "observations": len(pictures),
        "instruction": pictures[0].instruction,
    }
