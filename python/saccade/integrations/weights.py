"""Whether a head's weights are still those that were taken from it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

#: Values of a tensor that are compared at each call, spread over its first axis. Each is a read from memory.
SAMPLES = 8

#: A first axis of at most this size is sampled whole: that of category-specific layers is embodiments.
WHOLE = 64


class Watch:
    """What a module's weights are when this is made, to be compared later.

    Seen are: submodules and parameters that were replaced, memory that was (`.to()`, `.data =`), every
    operation in place that torch counts (optimizers, `load_state_dict`, `copy_`), and, for those that it does
    not count (through `.data` or NumPy), a change of any of a few values of each tensor.
    """

    def __init__(self, module: nn.Module) -> None:
        modules = list(module.modules())
        self._children = [
            (part._modules, name, part._modules[name]) for part in modules for name in part._modules
        ]
        self._parameters = [
            (part._parameters, name, parameter, version(parameter), parameter.data_ptr())
            for part in modules
            for name, parameter in part._parameters.items()
            if parameter is not None
        ]
        self._samples = [sample(parameter) for _, _, parameter, _, _ in self._parameters]
        self._values = self._sampled()

    def changed(self) -> bool:
        """Whether anything that is seen has changed."""
        for modules, name, child in self._children:
            if modules.get(name) is not child:
                return True
        for parameters, name, parameter, counted, address in self._parameters:
            if (
                parameters.get(name) is not parameter
                or parameter.data_ptr() != address
                or version(parameter) != counted
            ):
                return True
        return self._sampled() != self._values

    def _sampled(self) -> bytes:
        import torch

        # Bytes, so that a NaN equals itself.
        return torch.cat(self._samples).float().cpu().numpy().tobytes()


def version(parameter: Tensor) -> int:
    """How often it was changed in place, as far as torch counts: not for tensors made in inference mode."""
    return 0 if parameter.is_inference() else parameter._version


def sample(parameter: Tensor) -> Tensor:
    """A few values spread over its first axis, from the middle of the others: a view."""
    tensor: Any = parameter.detach()
    if tensor.ndim == 0:
        return tensor.reshape(1)  # type: ignore[no-any-return]
    if tensor.numel() == 0:
        return tensor.flatten()  # type: ignore[no-any-return]
    step = 1 if tensor.shape[0] <= WHOLE else -(-tensor.shape[0] // SAMPLES)
    return tensor[(slice(None, None, step), *(size // 2 for size in tensor.shape[1:]))]  # type: ignore[no-any-return]


def tensors_of(module: nn.Module) -> dict[str, torch.Tensor]:
    """The module's tensors on the CPU under their names; those that are there already are not copied."""
    return {name: tensor.detach().cpu() for name, tensor in module.state_dict().items()}
