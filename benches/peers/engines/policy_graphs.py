"""The whole policy as graphs: torch's ONNX export of the vision tower, the language model and the head.

OpenVINO and ONNX Runtime open the same files. The number of views and of tokens is open in them.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import fcntl
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.backbone.setup import sizes_of
from benches.peers import inputs, pieces
from benches.peers.engines import Built, Task
from benches.peers.policy_inputs import VIEWS, Arrays, given
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.reference import ActionHead, Backbone
from saccade_lab.reference.backbone.attention import split_heads
from saccade_lab.reference.backbone.rotary import rotate, text_angles

STEPS = 4
NAMES = ("tower", "language", "encode", "state", "step")


class Tower(nn.Module):
    """Views to image tokens: SigLIP and the connector."""

    def __init__(self, eagle: Any) -> None:
        super().__init__()
        self.eagle = eagle

    def forward(self, views: Tensor) -> tuple[Tensor, ...]:
        """`(V, 3, side, side)` to `(V * tokens of a view, width)`."""
        return (self.eagle.image_tokens(views),)


class Language(nn.Module):
    """Qwen3 with torch's SDPA, without padding."""

    def __init__(self, decoder: Any, sizes: BackboneSizes) -> None:
        super().__init__()
        self.layers, self.norm, self.sizes = decoder.layers, decoder.norm, sizes.text

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        """Embedded tokens `(1, T, width)` to features of the same shape."""
        text = self.sizes
        angles = text_angles(torch.arange(x.shape[1])[None], text.theta, text.head_dim // 2, x.dtype)[:, None]
        for layer in self.layers:
            attention, y = layer.self_attn, layer.input_layernorm(x)
            q, k, v = (
                split_heads(projection(y), text.head_dim)
                for projection in (attention.q_proj, attention.k_proj, attention.v_proj)
            )
            q, k = rotate(attention.q_norm(q), angles), rotate(attention.k_norm(k), angles)
            k, v = (each.repeat_interleave(attention.queries_per_key, dim=1) for each in (k, v))
            attended = F.scaled_dot_product_attention(q, k, v, is_causal=True)
            x = x + attention.o_proj(attended.transpose(1, 2).flatten(2))
            x = x + layer.mlp(layer.post_attention_layernorm(x))
        return (self.norm(x),)


def build(task: Task) -> Built:
    """Options: `opened_by` is `open_vino` or `onnx_runtime`; `arithmetic` as there."""
    torch.set_num_threads(task.case.threads)
    engine = engine_of(task)
    write(task)
    run = {name: engine.opened(task.graphs / f"{name}.onnx") for name in NAMES}
    with np.load(task.graphs / "rest.npz") as held:
        rest = dict(held)
    table = torch.from_numpy(rest["table"]).view(torch.bfloat16)
    image_token = sizes_of(task.source).image_token
    times = [(rest[f"time{step}"], rest[f"modulations{step}"]) for step in range(STEPS)]

    def chunk(views: int) -> NDArray[np.float32]:
        one = given(task.arrays, views)
        (tokens,) = run["tower"](one.pixels)
        embedded = table[torch.from_numpy(one.ids)].float().numpy()
        embedded[one.ids == image_token] = tokens
        (features,) = run["language"](embedded)
        held = run["encode"](features)
        (row,) = run["state"](one.state.reshape(1, 1, -1))
        actions = one.noise
        for time, modulations in times:
            actions = actions + run["step"](actions, row, time, modulations, *held)[0] / np.float32(STEPS)
        return actions[0]

    works: dict[str, Callable[[], Any]] = {
        work: partial(chunk, views) for work, views in zip(task.case.works, VIEWS, strict=True)
    }
    return Built(works, lambda: np.stack([work() for work in works.values()]), is_warm=True)


def engine_of(task: Task) -> Any:
    """The engine, which opens files."""
    if task.options["opened_by"] == "open_vino":
        from benches.peers.engines.open_vino import OpenVino

        return OpenVino(task)
    from benches.peers.engines.onnx_runtime import OnnxRuntime

    return OnnxRuntime(task)


def write(task: Task) -> None:
    """Exports the graphs, and writes what is not in them, if they are not there. One process at a time."""
    with (task.graphs / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        rest = task.graphs / "rest.npz"
        if rest.exists():
            return
        with torch.no_grad():
            table = write_backbone(task.source, task.graphs, task.arrays)
            times = write_head(task.source, task.graphs, task.arrays)
        part = rest.with_suffix(".part.npz")
        np.savez(part, allow_pickle=False, table=table, **times)
        part.rename(rest)


def write_backbone(source: Path, folder: Path, arrays: Arrays) -> NDArray[np.int16]:
    """Exports tower and language model; returns the bits of the table of tokens in bfloat16."""
    from benches.peers.engines.onnx_runtime import export

    eagle: Any = Backbone.from_pretrained(source).requires_grad_(False).eagle_model
    decoder = eagle.language_model.model
    two = given(arrays, 2)
    tokens = torch.export.Dim("tokens", min=2, max=4096)
    pixels = torch.from_numpy(two.pixels)
    export(Tower(eagle), (pixels,), folder / "tower.onnx", ({0: torch.export.Dim("views", max=64)},))
    embedded = decoder.embed_tokens(torch.from_numpy(two.ids))
    export(Language(decoder, eagle.sizes), (embedded,), folder / "language.onnx", ({1: tokens},))
    bits: NDArray[np.int16] = decoder.embed_tokens.weight.bfloat16().view(torch.int16).numpy()
    return bits


def write_head(source: Path, folder: Path, arrays: Arrays) -> Arrays:
    """Exports the head's graphs; returns what depends on the time alone."""
    from benches.peers.engines.onnx_runtime import export

    two = given(arrays, 2)
    head = ActionHead.from_pretrained(source).requires_grad_(False)
    config, num_tokens = head.config, two.ids.shape[1]
    tokens = torch.export.Dim("tokens", min=2, max=4096)
    features = torch.zeros(1, num_tokens, config.context_dim)
    export(pieces.Encode(head), (features,), folder / "encode.onnx", ({1: tokens},))
    state = torch.from_numpy(two.state).reshape(1, 1, -1)
    export(pieces.State(head, two.embodiment_id), (state,), folder / "state.onnx")
    times = inputs.times_of(head, STEPS, two.embodiment_id)
    num_cross = sum(index % 2 == 0 for index in range(config.num_layers))
    held = [torch.zeros(1, config.num_heads, num_tokens, config.head_dim) for _ in range(2 * num_cross)]
    given_first = (
        torch.from_numpy(two.noise),
        torch.zeros(1, 1, config.width),
        *(torch.from_numpy(times[name]) for name in ("time0", "modulations0")),
    )
    shapes = (*[None] * len(given_first), tuple({2: tokens} for _ in held))
    export(pieces.Step(head, two.embodiment_id, 1), (*given_first, *held), folder / "step.onnx", shapes)
    return times
