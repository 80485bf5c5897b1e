"""Looks inside a whole policy: its parts, and what each of them makes of an observation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import saccade
from saccade.backbone.features import BackboneFeatures
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import InputError
from saccade.observations import read
from saccade.policy.encoding import PolicyContext, compute_features, encode_features
from saccade.policy.preparing import prepare_inputs
from saccade.policy.reading import Observations, read_observations
from saccade_lab.head_inputs import HeadInputs


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a policy that ``saccade.Policy.from_pretrained`` loaded."""

    head: saccade.ActionHead
    backbone: saccade.Backbone
    processor: saccade.Processor


def parts_of(policy: saccade.Policy) -> Parts:
    """The parts of a policy that ``saccade.Policy.from_pretrained`` loaded.

    Raises:
        InputError: It has no backbone or no processor, or they or its head are not saccade's own.
    """
    head, backbone, processor = policy.head, policy.backbone, policy.processor
    if (
        processor is None
        or not isinstance(head, saccade.ActionHead)
        or not isinstance(backbone, saccade.Backbone)
    ):
        raise InputError(f"policy: expected one that saccade.Policy.from_pretrained loaded, got {policy!r}")
    return Parts(head, backbone, processor)


def inputs_of(policy: saccade.Policy, observation: Observations) -> list[BackboneInputs]:
    """The backbone's inputs for each row of observations: resized frames and token ids.

    Raises:
        InputError, ShapeError, DtypeError: As ``saccade.Policy.encode``.
    """
    if policy.processor is None:
        raise InputError(f"policy: expected one with a processor, got {policy!r}")
    return prepare_inputs(read_observations(observation, policy.requirements), policy.processor)


def features_of(
    policy: saccade.Policy, inputs: Sequence[BackboneInputs], *, previous: PolicyContext | None = None
) -> tuple[BackboneFeatures, ...]:
    """The backbone's features for each of its inputs; ``previous`` as in ``saccade.Policy.encode``."""
    if policy.backbone is None:
        raise InputError(f"policy: expected one with a backbone, got {policy!r}")
    return compute_features(inputs, policy.backbone, previous)


def context_of(policy: saccade.Policy, features: Sequence[BackboneFeatures]) -> PolicyContext:
    """What the head encodes of features of any lengths, as ``features_of`` returns them."""
    return encode_features(features, policy.head)


def head_inputs(policy: saccade.Policy, seen: Mapping[str, Any], features: BackboneFeatures) -> HeadInputs:
    """The inputs of a policy's head for one observation, without noise.

    Args:
        policy: The policy.
        seen: The observation, in a format of ``saccade.Policy.encode``.
        features: The backbone's features of it, a batch of one.
    """
    state = read(seen, policy.requirements).state
    reads_mask = policy.head.config.mask_mode == "alternate"
    return HeadInputs(
        np.asarray(features.backbone_features),
        np.asarray(policy.normalizer.state(state)),
        np.array([policy.embodiment_id]),
        image_mask=np.asarray(features.image_mask) if reads_mask else None,
    )
