"""The whole policy as graphs: torch's ONNX export of the vision tower, the language model and the head.

OpenVINO and ONNX Runtime open the same files. The number of views and of tokens is open in them.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benches.backbone.setup import sizes_of
from benches.peers import inputs, pieces
from benches.peers.engines import Built, Task, n15_graphs, n17_graphs
from benches.peers.policy_inputs import STEPS, VIEWS, Arrays, given
from saccade_lab.reference import ActionHead

NAMES = ("tower", "language", "encode", "state", "step")
RELEASES: dict[str, ModuleType] = {"n1.5": n15_graphs, "n1.7": n17_graphs}


def build(task: Task) -> Built:
    """Options: `opened_by` is `open_vino` or `onnx_runtime`; `arithmetic` as there."""
    torch.set_num_threads(task.case.threads)
    release: Any = RELEASES[task.case.release]
    engine = engine_of(task)
    write(task, release)
    run = {name: engine.opened(task.graphs / f"{name}.onnx") for name in NAMES}
    with np.load(task.graphs / "rest.npz") as held:
        rest = dict(held)
    table = torch.from_numpy(rest["table"]).view(torch.bfloat16)
    sizes = sizes_of(task.source)
    times = [(rest[f"time{step}"], rest[f"modulations{step}"]) for step in range(STEPS)]

    def chunk_of(views: int) -> NDArray[np.float32]:
        one = given(task.arrays, views)
        embedded = table[torch.from_numpy(one.ids)].float().numpy()
        features = release.features_of(run, one, embedded, sizes)
        held = release.context_of(run, one, features, sizes)
        (row,) = run["state"](one.state.reshape(1, 1, -1))
        actions = one.noise
        for time, modulations in times:
            velocity: NDArray[np.float32] = run["step"](actions, row, time, modulations, *held)[0]
            actions = actions + velocity / np.float32(STEPS)
        chunk: NDArray[np.float32] = actions[0]
        return chunk

    works: dict[str, Callable[[], Any]] = {
        work: partial(chunk_of, views) for work, views in zip(task.case.works, VIEWS, strict=True)
    }
    return Built(works, lambda: np.stack([work() for work in works.values()]), is_warm=True)


def engine_of(task: Task) -> Any:
    """The engine, which opens files."""
    if task.options["opened_by"] == "open_vino":
        from benches.peers.engines.open_vino import OpenVino

        return OpenVino(task)
    from benches.peers.engines.onnx_runtime import OnnxRuntime

    return OnnxRuntime(task)


def write(task: Task, release: Any) -> None:
    """Exports the graphs, and writes what is not in them, if they are not there. One process at a time."""
    with (task.graphs / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        rest = task.graphs / "rest.npz"
        if rest.exists():
            return
        with torch.no_grad():
            embeddings: torch.Tensor = release.write_backbone(task.source, task.graphs, task.arrays)
            table = embeddings.bfloat16().view(torch.int16).numpy()  # NumPy has no bfloat16
            times = write_head(task.source, task.graphs, task.arrays, release)
        part = rest.with_suffix(".part.npz")
        np.savez(part, allow_pickle=False, table=table, **times)
        part.rename(rest)


def write_head(source: Path, folder: Path, arrays: Arrays, release: Any) -> Arrays:
    """Exports the head's graphs; returns what depends on the time alone."""
    from benches.peers.engines.onnx_runtime import export

    two = given(arrays, 2)
    head = ActionHead.from_pretrained(source).requires_grad_(False)
    config, num_tokens = head.config, two.ids.shape[1]
    varying = release.write_encode(head, folder, arrays)
    state = torch.from_numpy(two.state).reshape(1, 1, -1)
    export(pieces.State(head, two.embodiment_id), (state,), folder / "state.onnx")
    times = inputs.times_of(head, STEPS, two.embodiment_id)
    held = [torch.zeros(1, config.num_heads, num_tokens, config.head_dim) for _ in varying]
    given_first = (
        torch.from_numpy(two.noise),
        torch.zeros(1, 1, config.width),
        *(torch.from_numpy(times[name]) for name in ("time0", "modulations0")),
    )
    shapes = (*[None] * len(given_first), tuple(varying))
    export(pieces.Step(head, two.embodiment_id, 1), (*given_first, *held), folder / "step.onnx", shapes)
    return times
