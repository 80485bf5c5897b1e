"""saccade itself, through its public Python API."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import saccade
from benches.peers.cases import NUM_BLOCKS, case_of_cost
from benches.peers.engines import Built, Task
from benches.peers.inputs import EMBODIMENT
from saccade.checkpoints import read_tensors


def build(task: Task) -> Built:
    """The works of the task's piece. Options: `precision`, and optionally `future_refresh`."""
    pieces = {"cross": cross, "blocks": blocks, "head": whole, "throughput": whole, "cost": cost}
    return pieces[task.case.piece](task)


def cross(task: Task) -> Built:
    """The attention of all cross blocks; the time is that of one."""
    config = saccade.HeadConfig.from_file(task.source / "config.json")
    attentions = []
    for block in range(0, config.num_layers, 2):
        prefix = f"model.transformer_blocks.{block}.attn1."
        tensors = read_tensors(task.source, f"action_head.{prefix}")
        attentions.append(
            saccade.CrossAttention(tensors, config.num_heads, precision=task.options["precision"])
        )
    features, rows = task.arrays["features"], task.arrays["rows"]
    rows = rows.reshape(rows.shape[0], -1, rows.shape[-1])
    held = [attention.project(features) for attention in attentions]
    outs = [np.empty_like(rows) for _ in attentions]

    def attend(attention: saccade.CrossAttention, kv: Any, out: Any) -> None:
        attention(rows, kv, out=out)

    def on_held() -> Any:
        for attention, kv, out in zip(attentions, held, outs, strict=True):
            attend(attention, kv, out)
        return outs

    def both() -> None:
        for attention, out in zip(attentions, outs, strict=True):
            attend(attention, attention.project(features), out)

    return Built(
        {"held": on_held, "both": both},
        lambda: np.stack(on_held()),
        dict.fromkeys(task.case.works, len(attentions)),
    )


def blocks(task: Task) -> Built:
    """Four DiT blocks, all rows in every block: one Euler step of a head with few other layers."""
    head = load(task)
    features, state, noise = (task.arrays[name] for name in ("features", "state", "noise"))
    last = NUM_BLOCKS - 1

    def run(context: saccade.Context) -> Any:
        traced = head.trace(
            context, state, EMBODIMENT, noise=noise[:, 0], num_steps=1, record=("hidden",), blocks=last
        )
        return traced.hidden[0, last]

    context = head.encode(features)
    return Built(
        {"held": lambda: run(context), "both": lambda: run(head.encode(features))},
        lambda: np.asarray(run(head.encode(features))),
    )


def whole(task: Task) -> Built:
    """The whole head; `sample` starts from a context, as it does in a control loop."""
    head, case = load(task), task.case
    features, state, noise = (task.arrays[name] for name in ("features", "state", "noise"))
    # An option that a release does not have is not handed to it.
    refresh = {name: value for name, value in task.options.items() if name == "future_refresh"}

    def sample(context: saccade.Context) -> Any:
        return head.sample(
            context, state, EMBODIMENT, noise=noise, num_steps=case.steps, num_samples=case.samples, **refresh
        )

    context = head.encode(features)
    return Built(
        {"encode": lambda: head.encode(features), "sample": lambda: sample(context)},
        lambda: np.asarray(sample(head.encode(features))),
        notes=f"{head.nbytes / 1e9:.2f} GB of weights",
    )


def cost(task: Task) -> Built:
    """The whole head at the sizes of `COST`, each varied alone; other N by an intervention."""
    head, case = load(task), task.case
    features, state, noise = (task.arrays[name] for name in ("features", "state", "noise"))
    generator = np.random.default_rng(1)
    works: dict[str, Callable[[], Any]] = {}
    for work in case.works:
        size = case_of_cost(case, work)
        seen = generator.standard_normal((1, size.num_vl_tokens, features.shape[-1]), dtype=np.float32)
        if work.startswith("encode"):
            works[work] = partial(head.encode, seen)
            continue
        change = None
        if size.num_future_tokens != case.num_future_tokens:
            rows = generator.standard_normal((size.num_future_tokens, head.config.width), dtype=np.float32)
            change = saccade.Intervention(future_tokens=rows)
        works[work] = partial(
            head.sample,
            head.encode(seen),
            state,
            EMBODIMENT,
            noise=np.repeat(noise, size.samples, axis=1),
            num_steps=size.steps,
            num_samples=size.samples,
            intervention=change,
        )
    result = partial(
        head, features, state, EMBODIMENT, noise=noise, num_steps=case.steps, num_samples=case.samples
    )
    return Built(works, lambda: np.asarray(result()))


def load(task: Task) -> saccade.ActionHead:
    """The head, warmed up."""
    case = task.case
    head = saccade.ActionHead.from_pretrained(
        task.source,
        precision=task.options["precision"],
        num_threads=case.threads,
        embodiment_ids=[EMBODIMENT],
    )
    head.warmup(case.num_vl_tokens, case.batch, case.samples)
    return head
