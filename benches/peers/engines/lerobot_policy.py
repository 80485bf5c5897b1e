"""lerobot's own model of a whole policy, called as its policy calls it, and the same model accelerated."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor
from torch._inductor import config as inductor

from benches.peers.engines import Built, Task
from benches.peers.policy_inputs import VIEWS, Given, given

MODELS = {"n1.5": "lerobot_n15_model", "n1.7": "lerobot_n17_model"}


def build(task: Task) -> Built:
    """Options: `arithmetic` is the dtype of the weights; `autocast`: under autocast to bfloat16, lerobot's
    default; `compiled`: by `torch.compile`, whose settings hold for the process; `accelerated`: by
    `saccade.integrations.accelerate`, with this precision.

    Contenders of one process share the weights.
    """
    torch.set_num_threads(task.case.threads)
    dtype = getattr(torch, task.options["arithmetic"])
    if "tensors" not in task.shared:
        task.shared["tensors"] = tensors_of(task.source, dtype)
    autocast = bool(task.options.get("autocast"))
    # Each imports its release of lerobot, of which an environment has one.
    released: Any = importlib.import_module(f"benches.peers.engines.{MODELS[task.case.release]}")
    model = released.build(task.source, task.shared["tensors"], torch.bfloat16 if autocast else dtype)
    if "accelerated" in task.options:
        from saccade.integrations import accelerate

        precision = task.options["accelerated"]
        accelerate(model, backbone=True, precision=precision, num_threads=task.case.threads)
    if "compiled" in task.options:
        # Weights become constants, packed for the products; each number of views is compiled apart.
        inductor.freezing = True
        for module in (model.backbone, model.action_head.vl_self_attention, model.action_head.model):
            module.compile(dynamic=False)
    inputs = {views: released.inputs_of(given(task.arrays, views)) for views in VIEWS}

    def chunk(views: int) -> Any:
        # As `GrootPolicy.predict_action_chunk`, whose dict of tensors the model casts itself.
        with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
            return model.get_action(dict(inputs[views]))["action_pred"]

    named = dict(zip(task.case.works, VIEWS, strict=True))
    works: dict[str, Callable[[], Any]] = {work: partial(chunk, views) for work, views in named.items()}
    return Built(
        works,
        lambda: np.stack(
            [with_noise(given(task.arrays, views), works[work]) for work, views in named.items()]
        ),
        is_warm=True,
    )


def tensors_of(source: Path, dtype: torch.dtype) -> dict[str, Tensor]:
    """All tensors of a checkpoint in `dtype`, by their names."""
    tensors = {}
    for path in sorted(source.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 (the handle of safetensors is not a dict)
                # Copied, because a mapped file has no huge pages.
                tensors[name] = file.get_tensor(name).to(dtype, copy=True)
    return tensors


def with_noise(one: Given, work: Callable[[], Any]) -> NDArray[np.float32]:
    """The actions `(horizon, action_dim)` from the given noise instead of the noise that the model draws."""
    noise = torch.from_numpy(one.noise)

    def drawn(size: Any, dtype: Any = None, device: Any = None) -> Any:
        assert tuple(size) == tuple(noise.shape)
        return noise.clone().to(device, dtype)  # what is drawn may be written into

    with mock.patch.object(torch, "randn", drawn):
        return np.asarray(work()[0].float().numpy())
