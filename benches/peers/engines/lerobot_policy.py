"""lerobot 0.4.4's own N1.5 model, called as its policy calls it, and the same model accelerated."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray

from benches.peers.engines import Built, Task, lerobot_model
from benches.peers.policy_inputs import VIEWS, Given, given


def build(task: Task) -> Built:
    """Options: `arithmetic` is the dtype of the weights; `autocast`: under autocast to bfloat16, lerobot's
    default; `accelerated`: by `saccade.integrations.accelerate`, with this precision.

    Contenders of one process share the weights.
    """
    torch.set_num_threads(task.case.threads)
    dtype = getattr(torch, task.options["arithmetic"])
    if "tensors" not in task.shared:
        task.shared["tensors"] = lerobot_model.tensors_of(task.source, dtype)
    autocast = bool(task.options.get("autocast"))
    computing = torch.bfloat16 if autocast else dtype
    model = lerobot_model.build(task.source, task.shared["tensors"], computing)
    if "accelerated" in task.options:
        from saccade.integrations import accelerate

        precision = task.options["accelerated"]
        accelerate(model, backbone=True, precision=precision, num_threads=task.case.threads)
    inputs = {views: lerobot_model.inputs_of(given(task.arrays, views)) for views in VIEWS}

    def chunk(views: int) -> Any:
        # As `GrootPolicy.predict_action_chunk`, whose dict of tensors the model casts itself.
        with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
            return model.get_action(dict(inputs[views])).action_pred

    named = dict(zip(task.case.works, VIEWS, strict=True))
    works: dict[str, Callable[[], Any]] = {work: partial(chunk, views) for work, views in named.items()}
    return Built(
        works,
        lambda: np.stack(
            [with_noise(given(task.arrays, views), works[work]) for work, views in named.items()]
        ),
        is_warm=True,
    )


def with_noise(one: Given, work: Callable[[], Any]) -> NDArray[np.float32]:
    """The actions `(horizon, action_dim)` from the given noise instead of the noise that the model draws."""
    noise = torch.from_numpy(one.noise)

    def drawn(size: Any, dtype: Any = None, device: Any = None) -> Any:
        assert tuple(size) == tuple(noise.shape)
        return noise.to(device, dtype)

    with mock.patch.object(torch, "randn", drawn):
        return np.asarray(work()[0].float().numpy())
