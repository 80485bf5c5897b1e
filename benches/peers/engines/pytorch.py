"""torch: the pieces as they are, or compiled by inductor with frozen weights."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.peers.engines import Built, Task, graphs


class Torch:
    """Options: `arithmetic` is `float32`, `bfloat16` (all tensors), `autocast` (bfloat16 products, the rest
    in float32) or `int8` (torch's own dynamic quantisation of linear layers); `compiled`: with inductor;
    `autotuned`: it also tries its own product kernels.
    """

    def __init__(self, options: dict[str, Any]) -> None:
        self.arithmetic = options["arithmetic"]
        self.compiled = options.get("compiled", False)
        self.autotuned = options.get("autotuned", False)
        self.dtype = torch.bfloat16 if self.arithmetic == "bfloat16" else torch.float32

    def graph(self, name: str, module: Callable[[], nn.Module], inputs: tuple[Tensor, ...]) -> graphs.Graph:
        """The module, called in inference mode."""
        del name, inputs
        built = module().requires_grad_(False).eval()
        # Copied, because a mapped file has no huge pages.
        for parameter in built.parameters():
            parameter.data = parameter.data.to(self.dtype, copy=True)
        for layer in built.modules():
            if self.arithmetic == "autocast" and isinstance(layer, nn.Linear):
                layer.to(torch.bfloat16)
            if self.arithmetic == "autocast" and isinstance(layer, nn.ParameterList):
                layer.to(torch.bfloat16)
        if self.arithmetic == "int8":
            quantize: Any = torch.ao.quantization.quantize_dynamic
            built = quantize(built, {nn.Linear}, dtype=torch.qint8)
        run: Callable[..., Any] = built
        if self.compiled:
            import torch._inductor.config as inductor

            inductor.freezing = True  # weights become constants, packed for the product kernels
            inductor.cpp.enable_kernel_profile = False
            run = torch.compile(built, dynamic=False, mode="max-autotune" if self.autotuned else None)
        autocast = self.arithmetic == "autocast"

        def call(*arrays: Tensor) -> tuple[Tensor, ...]:
            # Freezing asks for no_grad; eager code is a little faster in inference mode.
            without = torch.no_grad() if self.compiled else torch.inference_mode()
            cast = torch.autocast("cpu", dtype=torch.bfloat16) if autocast else contextlib.nullcontext()
            with without, cast:
                outputs: tuple[Tensor, ...] = run(*arrays)
            return outputs

        return call

    def array(self, tensor: Tensor) -> Tensor:
        """In the dtype of the arithmetic."""
        return tensor.to(self.dtype).contiguous()

    def numpy(self, array: Tensor) -> NDArray[np.float32]:
        """In float32."""
        return array.float().numpy()


def build(task: Task) -> Built:
    """The works of the task's piece."""
    torch.set_num_threads(task.case.threads)
    return graphs.build(Torch(task.options), task)
