"""The whole policy: its checkpoint, observations of one and two cameras, and the reference's actions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benches.backbone.setup import INSTRUCTION_TEXT
from benches.checkpoints import random_policy
from benches.peers.cases import WORKS, Case
from saccade.observations import Requirements

if TYPE_CHECKING:
    import saccade

Arrays = dict[str, NDArray[Any]]
VIEWS = tuple(int(work.split()[0]) for work in WORKS["policy"])
"""Cameras of each work."""
STEPS = 4
"""Euler steps of a chunk."""


@dataclass(frozen=True)
class Given:
    """What is given to a policy that sees so many cameras.

    Attributes:
        pixels: float32 `(views, 3, side, side)`. N1.7: patches, `(views * patches of a view, values)`.
        grids: Time, height and width of each view's grid of patches, `(views, 3)`. N1.5: None.
        ids: int64 `(1, T_vl)`.
        state: Normalised, float32 `(1, 1, state_dim)`.
        noise: float32 `(1, horizon, action_dim)`.
        embodiment_id: Of the robot.
    """

    pixels: NDArray[np.float32]
    grids: NDArray[np.int64] | None
    ids: NDArray[np.int64]
    state: NDArray[np.float32]
    noise: NDArray[np.float32]
    embodiment_id: int


def given(arrays: Arrays, views: int) -> Given:
    """What `expected_of` holds for so many cameras."""
    return Given(
        arrays[f"pixels{views}"],
        arrays.get(f"grids{views}"),
        arrays[f"ids{views}"],
        arrays["state"],
        arrays["noise"],
        int(arrays["embodiment_id"]),
    )


def with_views(policy: saccade.Policy, views: int) -> saccade.Policy:
    """The same policy with the first of its cameras."""
    import saccade

    needs = policy.requirements
    assert needs.cameras is not None
    return saccade.Policy(
        policy.head,
        policy.normalizer,
        backbone=policy.backbone,
        processor=policy.processor,
        requirements=Requirements(
            cameras=needs.cameras[:views],
            video_horizon=needs.video_horizon,
            language_keys=needs.language_keys,
        ),
    )


def observation_of(policy: saccade.Policy) -> dict[str, Any]:
    """Random frames of the size that the policy expects, a state in the middle of its range, and the usual
    instruction.
    """
    observation = policy.example_observation()
    return {**observation, "language": {key: [[INSTRUCTION_TEXT]] for key in observation["language"]}}


def expected_of(case: Case, folder: Path) -> Arrays:
    """The arrays of `given`, and as `expected (works, horizon, action_dim)` the normalised actions of
    `saccade_lab.reference` in float32. They are kept under `folder`.
    """
    path = folder / f"expected-policy-{case.release}-{case.size}.npz"
    if path.exists():
        with np.load(path) as held:
            return dict(held)
    source = source_of(case, folder)
    arrays = inputs_of(source)
    arrays["expected"] = np.stack([reference_actions(source, given(arrays, views)) for views in VIEWS])
    part = path.with_suffix(".part.npz")
    np.savez(part, allow_pickle=False, **arrays)
    part.rename(path)
    return arrays


def source_of(case: Case, folder: Path) -> Path:
    """The checkpoint of a case, written under `folder` if it is not there."""
    return random_policy(folder, case.release, small=case.size == "small")


def inputs_of(source: Path) -> Arrays:
    """The inputs as saccade's processor prepares them, and noise."""
    import saccade
    from saccade.observations import read, read_state
    from saccade.policy.preparing import prepare_inputs

    policy = saccade.Policy.from_pretrained(source, precision="int8")
    config = policy.head.config
    shape = (1, config.action_horizon, config.encoder_action_dim)
    arrays: Arrays = {
        "noise": np.random.default_rng(0).standard_normal(shape, dtype=np.float32),
        "embodiment_id": np.array(policy.embodiment_id),
    }
    for views in VIEWS:
        seeing = with_views(policy, views)
        observation = observation_of(seeing)
        assert seeing.processor is not None
        (inputs,) = prepare_inputs([read(observation, seeing.requirements)], seeing.processor)
        assert inputs.attention_mask.all()
        arrays |= {f"pixels{views}": np.asarray(inputs.pixel_values), f"ids{views}": inputs.input_ids}
        if inputs.image_grid_thw is not None:
            arrays[f"grids{views}"] = inputs.image_grid_thw
        arrays["state"] = np.asarray(
            policy.normalizer.state(read_state(observation, seeing.requirements).state)
        )
    return arrays


def reference_actions(source: Path, one: Given) -> NDArray[np.float32]:
    """Normalised actions `(horizon, action_dim)`. Backbone and head are in memory one after the other."""
    import torch

    import saccade
    from saccade_lab.reference import ActionHead, Backbone

    with torch.inference_mode():
        inputs = saccade.BackboneInputs(one.pixels, one.ids, image_grid_thw=one.grids)
        seen = Backbone.from_pretrained(source)(inputs)
        head = ActionHead.from_pretrained(source)
        context = head.encode(seen.backbone_features)
        masks = {"image_mask": seen.image_mask} if head.config.mask_mode != "none" else {}
        actions = head.sample(
            context, one.state, one.embodiment_id, noise=one.noise, num_steps=STEPS, **masks
        )
    return np.asarray(actions[0].numpy())
