"""Detects changes of a module's weights."""

from __future__ import annotations

import torch
from torch import Tensor, nn

#: Number of values of a tensor that each call compares, spread over its axes. Each is a read from memory.
SAMPLES = 8

#: A first axis of at most this size is sampled completely. In category-specific layers, it is embodiments.
WHOLE = 64


class Watch:
    """A record of a module's weights, with which they are compared later.

    It detects submodules that were added or replaced, parameters and memory that were replaced (`.to()`,
    `.data =`), and every in-place operation that torch counts (optimizers, `load_state_dict`, `copy_`). For
    operations that torch does not count (through `.data` or NumPy), it detects a change of the few values of
    each tensor that are sampled. It does not detect changes of other attributes, such as the `eps` of a norm.
    """

    def __init__(self, module: nn.Module) -> None:
        modules = list(module.modules())
        self._counts = [(part._modules, len(part._modules)) for part in modules]
        self._children = [
            (part._modules, name, part._modules[name]) for part in modules for name in part._modules
        ]
        self._parameters = [
            (part._parameters, name, parameter, place(parameter))
            for part in modules
            for name, parameter in part._parameters.items()
            if parameter is not None
        ]
        self._samples = [sample(parameter) for _, _, parameter, _ in self._parameters]
        self._values = self._sampled()

    def changed(self) -> bool:
        """Whether a change is detected."""
        if any(len(children) != count for children, count in self._counts):
            return True
        if any(modules.get(name) is not child for modules, name, child in self._children):
            return True
        for parameters, name, parameter, before in self._parameters:
            if parameters.get(name) is not parameter or place(parameter) != before:
                return True
        return self._sampled() != self._values

    def _sampled(self) -> bytes:
        # As bytes, so that NaN equals itself.
        return torch.cat(self._samples).float().cpu().numpy().tobytes()


def place(parameter: Tensor) -> tuple[int, int]:
    """Address, and torch's count of in-place changes. Tensors created in inference mode have none."""
    return parameter.data_ptr(), 0 if parameter.is_inference() else parameter._version


def sample(parameter: Tensor) -> Tensor:
    """A view of a few values spread over the first and the last axis."""
    tensor = parameter.detach()
    if tensor.ndim == 0 or tensor.numel() == 0:
        return tensor.reshape(-1)
    count = tensor.shape[0] if tensor.shape[0] <= WHOLE else SAMPLES
    if not tensor.is_contiguous():
        index: list[slice | int] = [size // 2 for size in tensor.shape]
        index[0] = slice(None, None, -(-tensor.shape[0] // count))
        return tensor[tuple(index)]
    # Along the diagonal: each step advances on the first axis and on the last.
    width = tensor.shape[-1] if tensor.ndim > 1 else 0
    step = max(1, tensor.numel() // count + width // count)
    return tensor.view(-1)[width // (2 * count) :: step]


def tensors_of(module: nn.Module) -> dict[str, torch.Tensor]:
    """The module's tensors by name, on the CPU. Those that are there already are not copied."""
    return {name: tensor.detach().cpu() for name, tensor in module.state_dict().items()}
