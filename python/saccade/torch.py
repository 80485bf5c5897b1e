"""Cross-attention as a torch module, a replacement for diffusers' ``Attention`` in the blocks of GR00T.

The module has its weights as torch parameters and passes them to a custom operator, so that ``torch.compile``
and ``torch.export`` see only tensors. The packed copy of the weights is cached for as long as the weights
live. Needs torch 2.4 or newer.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.extras import SACCADE
from saccade.errors import DtypeError, InputError, ShapeError
from saccade.head.cross_attention import CrossAttention as PackedAttention

SACCADE.require("torch")

import torch  # noqa: E402
from torch import nn  # noqa: E402

__all__ = ["CrossAttention"]

#: The weights in the order in which the operator takes them.
NAMES = tuple(
    f"{layer}.{kind}" for layer in ("to_q", "to_k", "to_v", "to_out.0") for kind in ("weight", "bias")
)
#: Features of diffusers' Attention that GR00T does not use: attribute and the value that turns it off.
UNUSED: dict[str, Any] = {
    "group_norm": None,
    "spatial_norm": None,
    "norm_cross": None,
    "norm_q": None,
    "norm_k": None,
    "added_kv_proj_dim": None,
    "fused_projections": False,
    "is_causal": False,
    "pre_only": False,
    "residual_connection": False,
    "rescale_output_factor": 1.0,
    "scale_qk": True,
}
#: The processors that compute the plain softmax(q k^T / sqrt(head_dim)) v.
PROCESSORS = ("AttnProcessor", "AttnProcessor2_0")
#: At least this many elements of every row and every column of a weight are compared.
SAMPLES = 4


class CrossAttention(nn.Module):
    """Multi-head attention with its projections: ``to_out(softmax(q k^T / sqrt(head_dim)) v)``.

    A drop-in replacement for diffusers' ``Attention`` as GR00T uses it, with the same parameter names and the
    same call. It computes on the CPU in float32 (or ``precision``) for inputs of any dtype, without gradients
    and without dropout. Keys and values are projected in every call, as in diffusers.
    :class:`saccade.CrossAttention` shares them between calls.

    The parameters are ordinary torch memory, shared with ``state_dict``. The engine has a packed copy. Every
    call compares the weights with the packed ones and packs them again if they have changed, also if torch
    does not count the change (through ``.data`` or NumPy). This reads the weights once, which was 6 to 26 %
    of a call at N1.5's sizes.

    Args:
        state_dict: ``to_q.weight (width, width)``, ``to_k.weight`` and ``to_v.weight (width, context_dim)``,
            ``to_out.0.weight (width, width)``, and ``to_q.bias``, ``to_k.bias``, ``to_v.bias``,
            ``to_out.0.bias (width,)``; floating point, on the CPU.
        heads: Number of attention heads, a divisor of the width.
        precision: ``"float32"``, ``"bfloat16"``, ``"int8"`` or ``"int4"``, as in
            :meth:`saccade.ActionHead.from_pretrained`.
        dropout: Probability of the dropout after ``to_out.0`` in training. It is not implemented: a call in
            training mode with a dropout other than 0 raises an error.

    Raises:
        CheckpointError: Tensors are missing, unknown or of the wrong shape. The message lists all of them.
        DtypeError: A tensor is not floating point or not on the CPU.
        InputError: ``heads`` does not divide the width, the precision is unknown, or a weight is not finite.

    Example:
        >>> import torch
        >>> from saccade.torch import CrossAttention
        >>> shapes = {"to_q": (64, 64), "to_k": (64, 32), "to_v": (64, 32), "to_out.0": (64, 64)}
        >>> weights = {f"{name}.weight": torch.randn(shape) / 8 for name, shape in shapes.items()}
        >>> weights |= {f"{name}.bias": torch.zeros(64) for name in shapes}
        >>> attn = CrossAttention(weights, heads=4).eval()
        >>> attn(torch.randn(2, 5, 64), torch.randn(2, 10, 32)).shape
        torch.Size([2, 5, 64])
    """

    def __init__(
        self,
        state_dict: Mapping[str, torch.Tensor],
        heads: int,
        *,
        precision: str = "float32",
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        # The engine checks the tensors, and the first call uses what it packs here.
        engine = PackedAttention(state_dict, heads, precision=precision)
        self.heads, self.precision = engine.num_heads, engine.precision
        width, context_dim = engine.width, engine.context_dim
        self.to_q = nn.Linear(width, width, device="meta")
        self.to_k = nn.Linear(context_dim, width, device="meta")
        self.to_v = nn.Linear(context_dim, width, device="meta")
        self.to_out = nn.ModuleList([nn.Linear(width, width, device="meta"), nn.Dropout(dropout)])
        self.requires_grad_(False)
        # Detached tensors share memory and the version counter with the caller's.
        self.load_state_dict({name: state_dict[name].detach() for name in NAMES}, assign=True)
        _packed(self._weights(), self.heads, self.precision, engine)

    @classmethod
    def from_attention(cls, attention: nn.Module, *, precision: str = "float32") -> CrossAttention:
        """A replacement for a diffusers ``Attention``, with shared weights and the same training mode.

        Raises:
            InputError: ``attention`` uses features that GR00T does not. The message lists them.
            CheckpointError, DtypeError: Its weights do not fit, as for the class.
        """
        state_dict = attention.state_dict()
        wrong = [
            f"{name} {getattr(attention, name)!r}"
            for name, off in UNUSED.items()
            if getattr(attention, name, off) != off
        ]
        processor = type(getattr(attention, "processor", None)).__name__
        if processor not in PROCESSORS:
            wrong.append(f"processor {processor}")
        if wrong:
            raise InputError(f"attention: expected only features that GR00T uses, got {', '.join(wrong)}")
        dropout = attention.to_out[1].p  # type: ignore[index,union-attr]
        module = cls(state_dict, attention.heads, precision=precision, dropout=dropout)  # type: ignore[arg-type]
        return module.train(attention.training)

    def forward(
        self,
        hidden_states: torch.Tensor,
        encoder_hidden_states: torch.Tensor | None = None,
        attention_mask: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Attends from ``hidden_states`` to ``encoder_hidden_states``.

        Args:
            hidden_states: ``(batch, queries, width)``, any floating dtype.
            encoder_hidden_states: ``(batch, T_vl, context_dim)``. None means self-attention.
            attention_mask: ``(batch, T_vl)``, optionally with axes of size 1 in between. Either bool, True
                for attended keys, or floating point, added to the logits (minus infinity removes a key). If
                no key is left, the output of a query is the bias of ``to_out``.

        Returns:
            ``(batch, queries, width)`` in the dtype of ``hidden_states``, or in that of autocast if it is on.

        Raises:
            ShapeError, DtypeError: An argument does not fit, or is not on the CPU.
            InputError: An input is not finite, a gradient is requested, or the module is in training mode
                with dropout.
        """
        encoder = hidden_states if encoder_hidden_states is None else encoder_hidden_states
        weights = self._weights()
        if torch.is_grad_enabled() and any(t.requires_grad for t in (hidden_states, encoder, *weights)):
            raise InputError(
                "CrossAttention computes no gradient: call it under torch.no_grad(), or use "
                "saccade_lab.reference"
            )
        if self.training and self.to_out[1].p > 0:  # type: ignore[operator]
            raise InputError(
                "CrossAttention has no dropout: expected evaluation mode (call eval()), got training"
            )
        for name, value in (("hidden_states", hidden_states), ("encoder_hidden_states", encoder)):
            if value.device.type != "cpu":
                raise DtypeError(f"{name}: expected a tensor on the CPU, got one on {value.device}")
        mask = _key_mask(attention_mask, encoder)
        output: torch.Tensor = cross_attention(
            hidden_states, encoder, mask, weights, self.heads, self.precision
        )
        # The dtype of diffusers' linear layers. Nothing is computed in less than `precision`.
        return output.to(torch.get_autocast_dtype("cpu")) if torch.is_autocast_enabled("cpu") else output

    def extra_repr(self) -> str:
        """Number of heads and precision, for ``print(module)``."""
        return f"heads={self.heads}, precision={self.precision!r}"

    def _weights(self) -> list[torch.Tensor]:
        layers = (self.to_q, self.to_k, self.to_v, self.to_out[0])
        return [tensor for layer in layers for tensor in (layer.weight, layer.bias)]  # type: ignore[misc]

    def _apply(self, fn: Callable[[torch.Tensor], torch.Tensor], recurse: bool = True) -> CrossAttention:
        # .to() and similar methods call this. It refuses before anything has moved.
        device = fn(self.to_q.bias.detach()[:0]).device
        if device.type != "cpu":
            raise DtypeError(f"CrossAttention: expected the CPU, got a move to {device}")
        return super()._apply(fn, recurse)  # type: ignore[no-any-return,no-untyped-call]


def _key_mask(mask: torch.Tensor | None, encoder: torch.Tensor) -> torch.Tensor | None:
    """A mask that is the same for all queries, in any form that diffusers accepts, as ``(batch, T_vl)``."""
    if mask is None:
        return None
    if mask.dtype != torch.bool and not mask.dtype.is_floating_point:
        raise DtypeError(f"attention_mask: expected booleans or floating point values, got {mask.dtype}")
    batch, keys = encoder.shape[0], encoder.shape[1]
    if mask.ndim not in (2, 3, 4) or mask.shape != (batch, *[1] * (mask.ndim - 2), keys):
        raise ShapeError(
            f"attention_mask: expected (batch, T_vl) = ({batch}, {keys}), optionally with axes of size 1 in "
            f"between (one mask for all queries and heads), got {tuple(mask.shape)}"
        )
    return mask.reshape(batch, keys)


def _new_output(
    hidden_states: torch.Tensor,
    encoder_hidden_states: torch.Tensor,
    attention_mask: torch.Tensor | None,
    weights: Sequence[torch.Tensor],
    heads: int,
    precision: str,
) -> torch.Tensor:
    """An empty result, after checking shapes. Tracing compilers call it in place of the operator."""
    inputs = (
        ("hidden_states", hidden_states, "batch, queries", weights[0].shape[1]),
        ("encoder_hidden_states", encoder_hidden_states, "batch, T_vl", weights[2].shape[1]),
    )
    for name, value, axes, width in inputs:
        if not value.dtype.is_floating_point:
            raise DtypeError(f"{name}: expected floating point values, got {value.dtype}")
        if value.ndim != 3 or value.shape[2] != width:
            raise ShapeError(f"{name}: expected ({axes}, {width}), got {tuple(value.shape)}")
    if hidden_states.shape[0] != encoder_hidden_states.shape[0]:
        raise ShapeError(
            f"encoder_hidden_states: expected the batch of hidden_states, {hidden_states.shape[0]}, "
            f"got {encoder_hidden_states.shape[0]}"
        )
    return hidden_states.new_empty(hidden_states.shape)


@torch.library.custom_op(
    "saccade::cross_attention",
    mutates_args=(),
    device_types="cpu",
    schema="(Tensor hidden_states, Tensor encoder_hidden_states, Tensor? attention_mask, Tensor[] weights, "
    "int heads, str precision) -> Tensor",
)
def cross_attention(
    hidden_states: torch.Tensor,
    encoder_hidden_states: torch.Tensor,
    attention_mask: torch.Tensor | None,
    weights: Sequence[torch.Tensor],
    heads: int,
    precision: str,
) -> torch.Tensor:
    """The operator ``saccade::cross_attention``, which :class:`CrossAttention` calls after its checks.

    ``weights`` are in the order of `NAMES`, and the mask has the shape ``(batch, T_vl)``.
    """
    expected = _new_output(hidden_states, encoder_hidden_states, attention_mask, weights, heads, precision)
    output = torch.empty(expected.shape, dtype=torch.float32)
    if output.numel() == 0:
        pass
    elif encoder_hidden_states.shape[1] == 0:
        output.copy_(weights[-1])  # without keys, attention is zero, and to_out adds its bias
    else:
        engine = _packed(weights, heads, precision)
        is_bool = attention_mask is not None and attention_mask.dtype == torch.bool
        key_mask, key_bias = (attention_mask, None) if is_bool else (None, attention_mask)
        kv = engine.project(encoder_hidden_states)
        engine(hidden_states, kv, key_mask=key_mask, key_bias=key_bias, out=output)
    return output.to(hidden_states.dtype)


cross_attention.register_fake(_new_output)


#: Fingerprints and packed weights, until the memory of one of the weights is freed.
_PACKED: dict[tuple[Any, ...], tuple[bytes, PackedAttention]] = {}


def _packed(
    weights: Sequence[torch.Tensor], heads: int, precision: str, made: PackedAttention | None = None
) -> PackedAttention:
    """The packed weights: `made`, or those in the cache unless the weights have changed, or packed now."""
    places = ((w.untyped_storage()._cdata, w.storage_offset(), w.shape, w.stride(), w.dtype) for w in weights)
    key = heads, precision, *places
    fingerprint = _fingerprint(weights)
    held, engine = _PACKED.get(key, (None, None))
    if made is None and engine is not None and held == fingerprint:
        return engine
    if made is None:
        tensors = {name: weight.detach() for name, weight in zip(NAMES, weights, strict=True)}
        made = PackedAttention(tensors, heads, precision=precision)
    if engine is None:
        for weight in weights:
            weakref.finalize(weight.untyped_storage(), _PACKED.pop, key, None).atexit = False
    _PACKED[key] = fingerprint, made
    return made


def _fingerprint(weights: Sequence[torch.Tensor]) -> bytes:
    """A fingerprint of the weights: version counters, the xor of the bits of each column, and samples.

    The xor shows changes that torch does not count, unless changes in a column cancel (two rows swapped, an
    even number of signs flipped). Samples in every row and every column detect those as well, if they affect
    a whole row, a whole column or a larger block.
    """
    parts = []
    for weight in weights:
        # A tensor created under torch.inference_mode has no version counter.
        parts.append(b"" if weight.is_inference() else weight._version.to_bytes(8, "little"))
        bits = weight.detach().view(_INTEGERS[weight.element_size()]).numpy()
        bits = bits.reshape(len(bits), -1)
        parts.append(np.bitwise_xor.reduce(bits, axis=0).tobytes())
        parts.append(bits[_samples(bits.shape)].tobytes())
    return b"".join(parts)


_INTEGERS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}


@cache
def _samples(shape: tuple[int, int]) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Rows and columns of sampled elements: at least `SAMPLES` in every row and every column."""
    rng = np.random.default_rng(0)
    k = np.arange(max(shape))
    columns = [rng.permutation(shape[1])[k % shape[1]] for _ in range(SAMPLES)]
    return np.tile(k % shape[0], SAMPLES), np.concatenate(columns)
