"""Runs the `forward` of a torch backbone in saccade."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from saccade.backbone.backbone import Backbone
from saccade.errors import InputError
from saccade.head.options import LoadOptions
from saccade.integrations import backbones, modules
from saccade.integrations.stand_in import Features, Kinds, StandIn, tolerance_of
from saccade.integrations.weights import tensors_of


class AcceleratedBackbone(StandIn[Backbone]):
    """The replacement of a torch backbone's `forward`.

    The original runs where saccade cannot take its place: in training mode, and where a gradient is asked
    for.
    """

    _method = "forward"
    _part = "the backbone"
    _structure: ClassVar[ModuleType] = backbones

    def __init__(self, module: nn.Module, precision: str, num_threads: int | None, autocast: bool) -> None:
        self._autocast = autocast  # whether the policy calls it under autocast to bfloat16
        super().__init__(module, LoadOptions(precision=precision, num_threads=num_threads))

    @property
    def backbone(self) -> Backbone:
        """The backbone in saccade, with the current weights."""
        return self._current(self.module)

    def __call__(self, vl_input: Any) -> Any:
        """The replacement of the backbone's `forward`.

        Args:
            vl_input: What the policy's processors prepare: `pixel_values`, `input_ids (batch, T)` and
                `attention_mask (batch, T)`, in N1.5 with the prefix `eagle_`, in N1.7 also `image_grid_thw`.

        Returns:
            An instance of the original's class with `backbone_features (batch, T, feature_dim)` in the
            original's dtype and on its device, and with the original's masks.

        Raises:
            InputError: The backbone has hooks inside, or there are inputs that saccade does not read. Also
                as :meth:`saccade.Backbone.__call__`.
        """
        module = self.module
        parts = list(module.named_modules())
        if any(part.training for _, part in parts) or wants_gradient(module, vl_input):
            return self._original()(vl_input)
        if problems := list(modules.replaced_or_hooked(parts[1:], backbones.NOUN)):
            raise InputError(f"{type(module).__name__}.forward: {'; '.join(problems)}")
        with torch.no_grad():
            backbone = self._current(module)
            like = next(module.parameters())
            kinds = self._kinds_of(module, backbone, like)
            features = run(module, backbone, vl_input).to(like.device, kinds.features)
            return kinds.result(data=backbones.results_of(module, vl_input, features))

    def _convert(self, module: nn.Module) -> Backbone:
        backbone = Backbone.from_tensors(
            tensors_of(module),
            config=backbones.config_of(module),
            precision=self._options["precision"],
            num_threads=self._options["num_threads"],
        )
        parameters = list(module.parameters())
        # With parameters of mixed dtypes, the original works under autocast only.
        mixed = len({parameter.dtype for parameter in parameters}) > 1
        with torch.no_grad(), contextlib.ExitStack() as stack:
            if mixed or self._autocast:  # as lerobot's policies call it
                stack.enter_context(torch.autocast(parameters[0].device.type, torch.bfloat16))
            self._kinds_of(module, backbone, parameters[0])
        return backbone

    def _compare(self, module: nn.Module, engine: Backbone, autocast: bool, *like: Tensor) -> Kinds:
        reduced = autocast or any(p.dtype != torch.float32 for p in module.parameters())
        return agree(module, engine, like[0].device, reduced or engine.precision != "float32")


def wants_gradient(module: nn.Module, vl_input: Mapping[str, Any]) -> bool:
    """Whether a result of the original would have a gradient."""
    if not torch.is_grad_enabled():
        return False
    given = (value for value in vl_input.values() if isinstance(value, torch.Tensor))
    return any(tensor.requires_grad for tensor in (*module.parameters(), *given))


def run(module: nn.Module, backbone: Backbone, vl_input: Mapping[str, Any]) -> Tensor:
    """The features in float32 on the CPU, from the inputs of the original."""
    return backbone(backbones.inputs_of(module, vl_input)).backbone_features  # type: ignore[return-value]


def agree(module: nn.Module, backbone: Backbone, device: torch.device, rounded: bool) -> Kinds:
    """Compares both on the same random view; `rounded` if one of them rounds to 8 bits."""
    given = backbones.check_inputs(module, backbone.config, device)
    result = type(module).forward(module, Features(given))
    theirs = result["backbone_features"]
    ours = run(module, backbone, given)
    expected = theirs.float().cpu()
    # By row, and then the mean: a few rows are thousands of times as large as the others.
    error = float("inf")
    if ours.shape == expected.shape:
        sizes = torch.linalg.vector_norm(expected, dim=-1).clamp_min(torch.finfo(torch.float32).tiny)
        error = float((torch.linalg.vector_norm(ours - expected, dim=-1) / sizes).mean())
    allowed = tolerance_of(backbone.precision, rounded)
    if not error <= allowed:
        raise InputError(
            f"{type(module).__name__} cannot be accelerated: on a random view its features differ from those "
            f"of saccade; expected a relative difference of at most {allowed:.1e}, got {error:.1e}"
        )
    return Kinds(theirs.dtype, type(result))
