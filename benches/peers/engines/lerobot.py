"""lerobot 0.4.4's own head, as lerobot runs it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import torch

from benches.peers.engines import Built, Task
from benches.peers.inputs import EMBODIMENT
from saccade_lab.reference import ActionHead, lerobot_head, tables


def build(task: Task) -> Built:
    """The works of the task's piece. Options: `arithmetic` is `float32`, `autocast` (lerobot's default:
    bfloat16 autocast; here over weights converted beforehand, which is faster) or `bfloat16` (everything).
    """
    torch.set_num_threads(task.case.threads)
    config = json.loads((task.source / "config.json").read_text())
    head: Any = lerobot_head.build(config, device="meta")
    arithmetic = task.options["arithmetic"]
    dtype = torch.float32 if arithmetic == "float32" else torch.bfloat16
    head.load_state_dict(ActionHead.from_pretrained(task.source, dtype=dtype).state_dict(), assign=True)
    head.requires_grad_(False)
    # Copied, because a mapped file has no huge pages.
    for parameter in head.parameters():
        parameter.data = parameter.data.clone()

    def run(work: Callable[[], Any]) -> Callable[[], Any]:
        def timed() -> Any:
            with (
                torch.inference_mode(),
                torch.autocast("cpu", dtype=torch.bfloat16, enabled=arithmetic == "autocast"),
            ):
                return work()

        return timed

    return {"head": whole, "blocks": blocks}[task.case.piece](task, head, run)


def whole(task: Task, head: Any, run: Callable[[Callable[[], Any]], Callable[[], Any]]) -> Built:
    """The whole head; for `sample` its work on the features is replaced by its earlier result."""
    case = task.case
    features, state, noise = (torch.from_numpy(task.arrays[name]) for name in ("features", "state", "noise"))
    state = state[:, None].repeat_interleave(case.samples, dim=0)
    noise = noise.flatten(0, 1)
    ids = torch.full((case.batch * case.samples,), EMBODIMENT)
    head.num_inference_timesteps = case.steps
    if task.options["arithmetic"] != "float32":  # as lerobot does: inputs are cast before the head is called
        features, state = features.bfloat16(), state.bfloat16()
    encode = head.process_backbone_output

    def encoded() -> Any:
        vl_embs = encode({"backbone_features": features})["backbone_features"]
        return vl_embs.repeat_interleave(case.samples, dim=0)  # it has no other way to several chunks

    vl_embs = run(encoded)()

    def sample(vl_embs: Any) -> Any:
        head.process_backbone_output = lambda output: output
        try:
            return lerobot_head.get_action(head, vl_embs, state, ids, noise)
        finally:
            head.process_backbone_output = encode

    both = run(lambda: sample(encoded()))
    return Built(
        {"encode": run(encoded), "sample": run(lambda: sample(vl_embs))},
        lambda: both().float().numpy().reshape(task.arrays["expected"].shape),
    )


def blocks(task: Task, head: Any, run: Callable[[Callable[[], Any]], Callable[[], Any]]) -> Built:
    """Four DiT blocks; its own way computes keys, values and the time's scales at every call."""
    features, rows = (torch.from_numpy(task.arrays[name]) for name in ("features", "rows"))
    encoder = head.model.timestep_encoder.timestep_embedder
    dtype = encoder.linear_1.weight.dtype
    temb = run(lambda: encoder(tables.timestep_table(torch.zeros(len(rows))).to(dtype)))()
    features, rows = features.to(dtype), rows.to(dtype)

    def both() -> Any:
        result = rows
        for index, block in enumerate(head.model.transformer_blocks):
            result = block(result, encoder_hidden_states=None if index % 2 else features, temb=temb)
        return result

    timed = run(both)
    return Built({"both": timed}, lambda: timed().float().numpy())
