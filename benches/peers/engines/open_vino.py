"""OpenVINO: the pieces converted from torch, for latency, in float32, bfloat16 or with weights of int8."""

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
    """Options: `arithmetic` is `float32` or `bfloat16`, OpenVINO's inference precision, or `int8`: bfloat16
    with weights that NNCF compressed to int8, one scale per output channel. All else is OpenVINO's default.
    """

    def __init__(self, task: Task) -> None:
        self.folder = task.graphs
        self.core = openvino.Core()
        self.arithmetic = task.options["arithmetic"]
        self.properties = {
            "INFERENCE_PRECISION_HINT": "f32" if self.arithmetic == "float32" else "bf16",
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
            save(model, path)
        return self.opened(path)

    def opened(self, path: Path) -> graphs.Graph:
        """A model in a file, compiled for the CPU; its weights are compressed first if the arithmetic is
        `int8`.
        """
        if self.arithmetic == "int8":
            narrow = path.with_name(f"{path.stem}-int8.xml")
            if not narrow.exists():
                compress(self.core, path, narrow)
            path = narrow
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


def compress(core: openvino.Core, path: Path, narrow: Path) -> None:
    """Weights of matrix products to int8, by NNCF."""
    import nncf

    model = nncf.compress_weights(core.read_model(path), mode=nncf.CompressWeightsMode.INT8_SYM)
    save(model, narrow)


def save(model: openvino.Model, path: Path) -> None:
    """Writes a model, under a temporary name first."""
    part = path.with_name(f"part-{path.name}")
    openvino.save_model(model, part, compress_to_fp16=False)
    part.with_suffix(".bin").rename(path.with_suffix(".bin"))
    part.rename(path)


def build(task: Task) -> Built:
    """The works of the task's piece."""
    torch.set_num_threads(task.case.threads)
    return graphs.build(OpenVino(task), task)
