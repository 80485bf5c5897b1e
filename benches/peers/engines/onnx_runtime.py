"""ONNX Runtime: the pieces exported by torch, in float32 or dynamically quantised to int8."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.peers.engines import Built, Task, graphs


class OnnxRuntime:
    """Options: `arithmetic` is `float32` or `int8` (weights int8 per output channel, inputs uint8)."""

    def __init__(self, task: Task) -> None:
        self.arithmetic = task.options["arithmetic"]
        self.folder = task.graphs
        self.options = onnxruntime.SessionOptions()
        self.options.intra_op_num_threads = task.case.threads
        self.options.inter_op_num_threads = 1
        self.options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL

    def graph(self, name: str, module: Callable[[], nn.Module], inputs: tuple[Tensor, ...]) -> graphs.Graph:
        """A session of the exported module."""
        path = self.folder / f"{name}.onnx"
        if not path.exists():
            export(module(), inputs, path)
        return self.opened(path)

    def opened(self, path: Path) -> graphs.Graph:
        """A session of a model in a file, which is quantised first if the arithmetic is `int8`."""
        if self.arithmetic == "int8":
            narrow = path.with_name(f"{path.stem}-int8.onnx")
            if not narrow.exists():
                quantize(path, narrow)
            path = narrow
        session = onnxruntime.InferenceSession(path, self.options, providers=["CPUExecutionProvider"])
        names = [each.name for each in session.get_inputs()]

        def call(*arrays: NDArray[np.float32]) -> tuple[Any, ...]:
            return tuple(session.run(None, dict(zip(names, arrays, strict=True))))

        return call

    def array(self, tensor: Tensor) -> NDArray[np.float32]:
        """A NumPy array, which the session reads in place."""
        return np.ascontiguousarray(tensor.numpy())

    def numpy(self, array: NDArray[np.float32]) -> NDArray[np.float32]:
        """The output unchanged."""
        return array


def export(module: nn.Module, inputs: tuple[Tensor, ...], path: Path, dynamic_shapes: Any = None) -> None:
    """Writes the module as ONNX with external weights, under a temporary name first.

    Args:
        module: takes the inputs.
        inputs: examples.
        path: of the file.
        dynamic_shapes: the axes whose length varies, as for `torch.onnx.export`. Default: none.
    """
    part = path.with_name(f"part-{path.name}")
    torch.onnx.export(
        module.eval(),
        inputs,
        part,
        dynamo=True,
        external_data=True,
        verbose=False,
        dynamic_shapes=dynamic_shapes,
    )
    model = onnx.load(part, load_external_data=False)
    # Shapes between the layers are partly those of the examples, which the quantiser would believe.
    del model.graph.value_info[:]
    onnx.save(model, part)
    part.rename(path)


def quantize(path: Path, narrow: Path) -> None:
    """Weights of matrix products to int8, one scale per output channel."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    part = narrow.with_name(f"part-{narrow.name}")
    quantize_dynamic(
        path,
        part,
        per_channel=True,
        weight_type=QuantType.QInt8,
        use_external_data_format=True,
        extra_options={"MatMulConstBOnly": True},
    )
    part.rename(narrow)


def build(task: Task) -> Built:
    """The works of the task's piece."""
    torch.set_num_threads(task.case.threads)
    return graphs.build(OnnxRuntime(task), task)
