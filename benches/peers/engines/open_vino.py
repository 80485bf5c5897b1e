"""OpenVINO: the pieces converted from torch, for latency, in float32 or bfloat16."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openvino
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.peers.engines import Built, Task, graphs


class OpenVino:
    """Options: `arithmetic` is `float32` or `bfloat16` (OpenVINO's inference precision)."""

    def __init__(self, task: Task) -> None:
        self.folder = task.graphs
        self.core = openvino.Core()
        self.properties = {
            "INFERENCE_PRECISION_HINT": {"float32": "f32", "bfloat16": "bf16"}[task.options["arithmetic"]],
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": task.case.threads,
            "NUM_STREAMS": 1,
        }

    def graph(self, name: str, module: Callable[[], nn.Module], inputs: tuple[Tensor, ...]) -> graphs.Graph:
        """The converted module, compiled for the CPU."""
        path = self.folder / f"{name}.xml"
        if not path.exists():
            shapes = [list(tensor.shape) for tensor in inputs]
            model = openvino.convert_model(module().eval(), example_input=inputs, input=shapes)
            part = path.with_name(f"part-{path.name}")
            openvino.save_model(model, part, compress_to_fp16=False)
            part.with_suffix(".bin").rename(path.with_suffix(".bin"))
            part.rename(path)
        return self.opened(path)

    def opened(self, path: Path) -> graphs.Graph:
        """A model in a file, compiled for the CPU."""
        request = self.core.compile_model(path, "CPU", self.properties).create_infer_request()

        def call(*arrays: NDArray[np.float32]) -> tuple[Any, ...]:
            # Inputs are read in place. Outputs are copied: the next call writes over the request's own.
            outputs = request.infer(list(arrays), share_inputs=True, share_outputs=False)
            return tuple(outputs.values())

        return call

    def array(self, tensor: Tensor) -> NDArray[np.float32]:
        """A NumPy array, which the request reads in place."""
        return np.ascontiguousarray(tensor.numpy())

    def numpy(self, array: NDArray[np.float32]) -> NDArray[np.float32]:
        """The output unchanged."""
        return array


def build(task: Task) -> Built:
    """The works of the task's piece."""
    torch.set_num_threads(task.case.threads)
    return graphs.build(OpenVino(task), task)
