"""Code shared by the engines that run torch modules or graphs exported from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.peers import pieces
from benches.peers.cases import LINEAR_SHAPES
from benches.peers.engines import Built, Task
from benches.peers.inputs import EMBODIMENT
from saccade import HeadConfig
from saccade_lab.reference import ActionHead

WEIGHT_BYTES = 160 << 20  # of linear layers, in float32: several times any cache
Graph = Callable[..., tuple[Any, ...]]


class Engine(Protocol):
    """Runs modules. Its arrays are of its own type and support `+` and `*`."""

    def graph(self, name: str, module: Callable[[], nn.Module], inputs: tuple[Tensor, ...]) -> Graph:
        """The module in this engine. `module` builds it, and is not called if `name` is cached."""

    def array(self, tensor: Tensor) -> Any:
        """An input converted for the engine."""

    def numpy(self, array: Any) -> NDArray[np.float32]:
        """An output converted to float32."""


def build(engine: Engine, task: Task) -> Built:
    """The works of the task's piece in this engine."""
    head: list[ActionHead] = []

    def loaded() -> ActionHead:
        if not head:
            head.append(ActionHead.from_pretrained(task.source).requires_grad_(False))
        return head[0]

    with torch.no_grad():
        pieces = {"linear": linear, "cross": cross, "blocks": blocks, "head": whole, "throughput": whole}
        result = pieces[task.case.piece](engine, task, loaded)
        result.result()  # some engines compile at the first call, which needs the weights
        return result


def linear(engine: Engine, task: Task, loaded: Callable[[], ActionHead]) -> Built:
    """Linear layers of each shape, with enough weights to exceed the caches. They are rolled, because equal
    weights might be merged.
    """
    del loaded
    works, calls, firsts = {}, {}, []
    for index, (name, (_, inputs, outputs)) in enumerate(zip(task.case.works, LINEAR_SHAPES, strict=True)):
        copies = max(2, WEIGHT_BYTES // (4 * inputs * outputs))
        weight, x = (torch.from_numpy(task.arrays[f"{letter}{index}"]) for letter in "wx")
        x = x[None]  # a batch, as layers of the head have it

        def module(weight: Tensor = weight, copies: int = copies) -> nn.Module:
            return pieces.Linears([weight.roll(shift, 0) for shift in range(copies)])

        graph, own = engine.graph(f"linear{index}", module, (x,)), engine.array(x)
        works[name], calls[name] = bind(graph, own), copies
        firsts.append(works[name])
    return Built(
        works,
        lambda: np.concatenate([engine.numpy(first()[0]).ravel() for first in firsts]),
        calls,
    )


def cross(engine: Engine, task: Task, loaded: Callable[[], ActionHead]) -> Built:
    """The attention of all cross blocks; the time is that of one."""

    def attentions() -> list[Any]:
        modules: Any = loaded().model
        return [block.attn1 for block in modules.transformer_blocks if block.is_cross]

    features, rows = tensors(task, "features", "rows")
    rows = rows.flatten(1, 2)
    project = engine.graph("project", lambda: pieces.Project(attentions()), (features,))
    held = examples_of_held(task)
    attend = engine.graph("attend", lambda: pieces.CrossAttentions(attentions()), (rows, *held))
    own_features, own_rows = engine.array(features), engine.array(rows)
    own_held = project(own_features)
    return Built(
        {
            "held": lambda: attend(own_rows, *own_held),
            "both": lambda: attend(own_rows, *project(own_features)),
        },
        lambda: np.stack([engine.numpy(each) for each in attend(own_rows, *own_held)]),
        dict.fromkeys(task.case.works, len(held) // 2),
    )


def blocks(engine: Engine, task: Task, loaded: Callable[[], ActionHead]) -> Built:
    """Four DiT blocks from given rows, scales and shifts."""

    def modules() -> list[Any]:
        model: Any = loaded().model
        return list(model.transformer_blocks)

    def attentions() -> list[Any]:
        return [block.attn1 for block in modules() if block.is_cross]

    features, rows = tensors(task, "features", "rows")
    modulations = torch.from_numpy(task.arrays["modulations0"])[:-1]
    held = examples_of_held(task)
    project = engine.graph("project", lambda: pieces.Project(attentions()), (features,))
    run = engine.graph("blocks", lambda: pieces.Blocks(modules()), (rows, modulations, *held))
    own_features, own_rows, own_modulations = (engine.array(each) for each in (features, rows, modulations))
    own_held = project(own_features)
    return Built(
        {
            "held": lambda: run(own_rows, own_modulations, *own_held),
            "both": lambda: run(own_rows, own_modulations, *project(own_features)),
        },
        lambda: engine.numpy(run(own_rows, own_modulations, *project(own_features))[0]),
    )


def whole(engine: Engine, task: Task, loaded: Callable[[], ActionHead]) -> Built:
    """The whole head: one graph an observation, one for the state row, one for an Euler step."""
    case = task.case
    features, state, noise = tensors(task, "features", "state", "noise")
    state = state[:, None].repeat_interleave(case.samples, dim=0)  # (B S, 1, state_dim)
    noise = noise.flatten(0, 1)  # (B S, T, A)
    pairs = [tensors(task, f"time{step}", f"modulations{step}") for step in range(case.steps)]
    times = [tuple(map(engine.array, pair)) for pair in pairs]
    held = examples_of_held(task)
    encode = engine.graph("encode", lambda: pieces.Encode(loaded()), (features,))
    state_row = engine.graph("state", lambda: pieces.State(loaded(), EMBODIMENT), (state,))
    row = torch.zeros(noise.shape[0], 1, pairs[0][0].shape[-1])
    step = engine.graph(
        "step",
        lambda: pieces.Step(loaded(), EMBODIMENT, case.samples),
        (noise, row, *pairs[0], *held),
    )
    own_features, own_state, own_noise = (engine.array(each) for each in (features, state, noise))
    own_held = encode(own_features)

    def sample(held: tuple[Any, ...]) -> Any:
        (row,), actions = state_row(own_state), own_noise
        for time, modulations in times:
            actions = actions + step(actions, row, time, modulations, *held)[0] / case.steps
        return actions

    shape = task.arrays["expected"].shape
    return Built(
        {"encode": lambda: encode(own_features), "sample": lambda: sample(own_held)},
        lambda: engine.numpy(sample(encode(own_features))).reshape(shape),
    )


def bind(graph: Graph, *inputs: Any) -> Graph:
    """A call with these inputs."""
    return lambda: graph(*inputs)


def tensors(task: Task, *names: str) -> list[Tensor]:
    """Inputs as tensors."""
    return [torch.from_numpy(task.arrays[name]) for name in names]


def examples_of_held(task: Task) -> list[Tensor]:
    """Zeros of the shapes of the keys and values that a context holds."""
    config = HeadConfig.from_file(task.source / "config.json")
    num_cross = sum(index % 2 == 0 for index in range(config.num_layers))
    shape = (task.case.batch, config.num_heads, task.case.num_vl_tokens, config.head_dim)
    return [torch.zeros(shape) for _ in range(2 * num_cross)]
