"""saccade's whole policy, through its public Python API: raw frames and words to the robot's actions."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

import saccade
from benches.peers.engines import Built, Task
from benches.peers.policy_inputs import VIEWS, given, observation_of, with_views
from saccade._internal.arrays import Float32Array
from saccade.observations import read_state


def build(task: Task) -> Built:
    """Options: `precision`. Unlike in other engines, resizing, tokens and units are part of a work."""
    policy = saccade.Policy.from_pretrained(
        task.source, precision=task.options["precision"], num_threads=task.case.threads
    )
    noise = task.arrays["noise"]
    seeing = {views: with_views(policy, views) for views in VIEWS}
    observations = {views: observation_of(one) for views, one in seeing.items()}

    def normalised(views: int) -> Float32Array:
        one, observation = seeing[views], observations[views]
        state = policy.normalizer.state(read_state(observation, one.requirements).state)
        context = one.encode(observation).context
        embodiment_id = given(task.arrays, views).embodiment_id
        sampled = policy.head.sample(context, state, embodiment_id, noise=noise)
        actions: Float32Array = np.asarray(sampled)[0]
        return actions

    works: dict[str, Any] = {
        work: partial(seeing[views].act, observations[views], noise=noise)
        for work, views in zip(task.case.works, VIEWS, strict=True)
    }
    return Built(works, lambda: np.stack([normalised(views) for views in VIEWS]), is_warm=True)
