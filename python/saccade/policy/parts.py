"""The parts of a whole policy, for what looks inside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from saccade.backbone.backbone import Backbone
from saccade.backbone.features import BackboneFeatures
from saccade.errors import InputError
from saccade.head.head import ActionHead
from saccade.head.inputs import HeadInputs
from saccade.observations import read
from saccade.policy.policy import Policy
from saccade.processor import Processor


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a whole policy."""

    head: ActionHead
    backbone: Backbone
    processor: Processor


def parts_of(policy: Policy) -> Parts:
    """The parts of a policy that :meth:`saccade.Policy.from_pretrained` loaded.

    Raises:
        InputError: It has no backbone or no processor, or its head is not a :class:`saccade.ActionHead`.
    """
    head, backbone, processor = policy.head, policy.backbone, policy.processor
    if backbone is None or processor is None or not isinstance(head, ActionHead):
        raise InputError(f"policy: expected one that saccade.Policy.from_pretrained loaded, got {policy!r}")
    return Parts(head, backbone, processor)


def as_head_takes_it(policy: Policy, seen: Mapping[str, Any], features: BackboneFeatures) -> HeadInputs:
    """One observation of a whole policy as its head takes it, without noise.

    Args:
        policy: The policy.
        seen: The observation, in a form of :meth:`saccade.Policy.encode`.
        features: What the backbone made of it, a batch of one.
    """
    state = read(seen, policy.requirements).state
    reads_mask = policy.head.config.mask_mode == "alternate"
    return HeadInputs(
        np.asarray(features.backbone_features),
        np.asarray(policy.normalizer.state(state)),
        np.array([policy.embodiment_id]),
        image_mask=np.asarray(features.image_mask) if reads_mask else None,
    )
