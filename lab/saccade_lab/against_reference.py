"""`saccade verify --reference`: what a policy computes in float32, beside the torch reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import saccade
from saccade._internal.arrays import Float32Array
from saccade.checkpoints.precisions import difference, features_error
from saccade.observations import read
from saccade_lab.extras import LAB
from saccade_lab.inside import features_of, head_inputs, inputs_of, parts_of


def reference(
    policy: saccade.Policy, observation: Mapping[str, Any], noise: Float32Array
) -> Callable[[], dict[str, float]]:
    """A :class:`saccade.checkpoints.trial.Reference`: backbone and head in torch, one after the other.

    The torch head gets the features that ``policy`` computed, so that the errors of the two do not add up.

    Args:
        policy: In float32, from ``saccade.Policy.from_pretrained``.
        observation: A batch of one.
        noise: ``(1, T, width)``.

    Raises:
        MissingExtraError: torch or safetensors is not installed.
        InputError: The policy is of another kind.
    """
    LAB.require("torch", "safetensors")
    source = parts_of(policy).head.source
    assert source is not None
    inputs = inputs_of(policy, observation)
    (features,) = features_of(policy, inputs)
    given = head_inputs(policy, observation, features)
    exact = policy.act(observation, noise=noise)
    normalizer, embodiment_id = policy.normalizer, policy.embodiment_id
    state = read(observation, policy.requirements).state
    kept_features = np.array(features.backbone_features[0])

    def compare() -> dict[str, float]:
        import torch

        from saccade_lab.reference import ActionHead, Backbone

        with torch.no_grad():
            backbone = Backbone.from_pretrained(source)
            expected_features = backbone(inputs[0]).backbone_features[0].numpy()
            del backbone  # before the head is loaded
            head = ActionHead.from_pretrained(source)
            vl_embs = head.encode(given.backbone_features, drop_vl=given.drop_vl)
            sampled = head.sample(
                vl_embs,
                given.state,
                embodiment_id,
                noise=noise,
                drop_vl=given.drop_vl,
                attention_mask=given.attention_mask,
                image_mask=given.image_mask,
            ).numpy()
        restored = np.asarray(normalizer.actions(sampled, state))
        expected = {
            key: restored[..., normalizer.action_slices[key]][:, : exact[key].shape[1]] for key in exact
        }
        apart = difference([expected], [exact], normalizer.action_groups)
        return {
            "features, relative to a token's norm, mean": features_error(
                [expected_features], [kept_features]
            ),
            **{f"{key}, in the robot's units": value for key, value in apart.largest.items()},
            "of range": apart.worst,
        }

    return compare
