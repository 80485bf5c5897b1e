"""Policies whose backbone and processor stand in for the real ones, for tests of everything around these."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import saccade
from saccade import BackboneInputs, Normalizer, Policy
from saccade.observations import Requirements, read_requirements
from saccade.policy.preparing import prepare_inputs
from saccade.policy.reading import read_observations
from tests.helpers import whole_checkpoints

#: The id that stands for an image token, and how many there are of a view.
IMAGE, TOKENS = 300, 4


class StandInProcessor:
    """A token for each byte of the instruction, and a few for each view. Remembers what it was told."""

    def __init__(self) -> None:
        self.seen: list[tuple[str | None, bool]] = []

    def __call__(
        self, frames: Sequence[NDArray[np.uint8]], instruction: str | None, *, plain_text: bool = False
    ) -> BackboneInputs:
        self.seen.append((instruction, plain_text))
        instruction = instruction or "default"
        pixels = np.stack([np.resize(view, (3, 4, 4)) / np.float32(255) for view in frames])
        ids = np.concatenate([np.full(TOKENS * len(frames), IMAGE), list(instruction.encode())])
        return BackboneInputs(pixels.astype(np.float32), ids[None])


@dataclass(frozen=True)
class StandInFeatures:
    backbone_features: NDArray[np.float32]
    image_mask: NDArray[np.bool_]


class StandInBackbone:
    """A row of features for each token, which for image tokens depends on the pixels."""

    def __init__(self, width: int) -> None:
        self.table = np.random.default_rng(0).standard_normal((IMAGE + 1, width), np.float32)
        self.previous: list[Any] = []

    def encode_many(
        self, inputs: Sequence[BackboneInputs], *, previous: Sequence[Any] = ()
    ) -> list[StandInFeatures]:
        self.previous.append(previous)
        return [self._features(one) for one in inputs]

    def _features(self, inputs: BackboneInputs) -> StandInFeatures:
        image = inputs.input_ids == IMAGE
        features = self.table[inputs.input_ids]
        features[image] += np.repeat(np.mean(np.asarray(inputs.pixel_values), (1, 2, 3)), TOKENS)[:, None]
        return StandInFeatures(features, image)


@functools.cache
def head(layout: str) -> saccade.ActionHead:
    """The head of a whole checkpoint."""
    return saccade.ActionHead.from_pretrained(whole_checkpoints.whole(layout))


def policy(layout: str, requirements: Requirements | None = None) -> Policy:
    """A policy with the head, the statistics and the cameras of a whole checkpoint, and stand-ins."""
    folder = whole_checkpoints.whole(layout)
    if requirements is None:
        normalizer = Normalizer.from_pretrained(folder, whole_checkpoints.EMBODIMENT)
        requirements = read_requirements(folder, normalizer)
    backbone: Any = StandInBackbone(head(layout).config.context_dim)
    processor: Any = StandInProcessor()
    return Policy(
        head(layout),
        embodiment=whole_checkpoints.EMBODIMENT,
        backbone=backbone,
        processor=processor,
        requirements=requirements,
    )


def inputs_of(policy: Policy, observation: Any) -> list[BackboneInputs]:
    """The backbone's inputs for each row of observations."""
    assert policy.processor is not None
    return prepare_inputs(read_observations(observation, policy.requirements), policy.processor)


def noise(policy: Policy, count: int = 1) -> NDArray[np.float32]:
    """The same noise for as many rows, ``(count, action_horizon, encoder_action_dim)``."""
    config = policy.head.config
    shape = (count, config.action_horizon, config.encoder_action_dim)
    return np.random.default_rng(1).standard_normal(shape, dtype=np.float32)


def with_parts(policy: Any, **parts: Any) -> Policy:
    """The policy with other parts."""
    kept = {name: getattr(policy, name) for name in ("head", "backbone", "processor")} | parts
    return Policy(
        kept.pop("head"), policy.normalizer, policy.embodiment_id, requirements=policy.requirements, **kept
    )
