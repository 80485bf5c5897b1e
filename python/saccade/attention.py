"""Cross-attention alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, overload

import numpy as np

from saccade import _saccade
from saccade._arrays import (
    Array,
    ArrayLike,
    apart,
    boolean,
    float32,
    integer,
    is_torch,
    like_features,
    result,
)
from saccade.errors import DtypeError, InputError


class KeyValues:
    """Held keys and values of :class:`CrossAttention`: immutable, for any number of calls and threads."""

    def __init__(self, held: _saccade.KeyValues, use_torch: bool) -> None:
        self._held = held
        self._torch = use_torch

    @property
    def batch(self) -> int:
        """Sequences."""
        return self._held.batch

    @property
    def num_vl_tokens(self) -> int:
        """Keys of each sequence."""
        return self._held.num_vl_tokens

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._held.nbytes


class CrossAttention:
    """Multi-head cross-attention with its projections: ``to_out(softmax(q k^T / sqrt(head_dim)) v)``.

    Heads are contiguous slices of the width, as in the released head (diffusers' ``Attention``).

    Args:
        tensors: ``to_q.weight (width, width)``, ``to_k.weight`` and ``to_v.weight (width, context_dim)``,
            ``to_out.0.weight (width, width)``, and ``to_q.bias``, ``to_k.bias``, ``to_v.bias``,
            ``to_out.0.bias (width,)``.
        num_heads: A divisor of the width.
        precision: ``"float32"``, ``"bfloat16"`` or ``"int8"``, as in :meth:`saccade.ActionHead.load`.

    Raises:
        CheckpointError: tensors are missing, unknown or misshaped; all of them are listed.
        DtypeError: a tensor is not floating point or not on the CPU.
        InputError: ``num_heads`` does not divide the width, or the precision is unknown.

    Example:
        >>> import numpy as np, saccade
        >>> rng = np.random.default_rng(0)
        >>> shapes = {"to_q": (64, 64), "to_k": (64, 32), "to_v": (64, 32), "to_out.0": (64, 64)}
        >>> tensors = {f"{name}.weight": rng.standard_normal(shape) / 8 for name, shape in shapes.items()}
        >>> tensors |= {f"{name}.bias": np.zeros(64) for name in shapes}
        >>> attn = saccade.CrossAttention(tensors, num_heads=4)
        >>> kv = attn.project(rng.standard_normal((2, 10, 32)))
        >>> attn(rng.standard_normal((2, 5, 64)), kv).shape
        (2, 5, 64)
    """

    def __init__(
        self, tensors: Mapping[str, ArrayLike], num_heads: int, *, precision: str = "float32"
    ) -> None:
        if not isinstance(tensors, Mapping):
            raise DtypeError(f"tensors: expected a mapping of names to arrays, got {type(tensors).__name__}")
        check_precision(precision)
        arrays = {str(name): float32(f"tensors[{name!r}]", value) for name, value in tensors.items()}
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise InputError(f"tensors[{name!r}]: expected finite values")
        self._attention = _saccade.CrossAttention(arrays, integer("num_heads", num_heads), precision)

    @property
    def num_heads(self) -> int:
        """Attention heads."""
        return self._attention.num_heads

    @property
    def width(self) -> int:
        """Width of queries and output."""
        return self._attention.width

    @property
    def context_dim(self) -> int:
        """Width of the tokens attended to."""
        return self._attention.context_dim

    @property
    def precision(self) -> str:
        """What it computes in: ``"float32"``, ``"bfloat16"`` or ``"int8"``."""
        return self._attention.precision

    @property
    def nbytes(self) -> int:
        """Bytes of weights in memory."""
        return self._attention.nbytes

    def project(self, encoder_hidden_states: ArrayLike) -> KeyValues:
        """Projects tokens to keys and values, to be held over many calls.

        Args:
            encoder_hidden_states: ``(batch, T_vl, context_dim)``.

        Raises:
            ShapeError, DtypeError, InputError: wrong shape or dtype; NaN or infinity.
        """
        held = self._attention.project(float32("encoder_hidden_states", encoder_hidden_states))
        return KeyValues(held, is_torch(encoder_hidden_states))

    @overload
    def __call__(
        self,
        hidden_states: ArrayLike,
        kv: KeyValues,
        *,
        key_mask: ArrayLike | None = None,
        key_bias: ArrayLike | None = None,
        return_weights: Literal[False] = False,
        out: ArrayLike | None = None,
    ) -> Array: ...
    @overload
    def __call__(
        self,
        hidden_states: ArrayLike,
        kv: KeyValues,
        *,
        key_mask: ArrayLike | None = None,
        key_bias: ArrayLike | None = None,
        return_weights: Literal[True],
        out: ArrayLike | None = None,
    ) -> tuple[Array, Array]: ...
    def __call__(
        self,
        hidden_states: ArrayLike,
        kv: KeyValues,
        *,
        key_mask: ArrayLike | None = None,
        key_bias: ArrayLike | None = None,
        return_weights: bool = False,
        out: ArrayLike | None = None,
    ) -> Array | tuple[Array, Array]:
        """Attends from ``hidden_states`` to the held keys and values.

        Args:
            hidden_states: ``(batch, queries, width)``.
            kv: From :meth:`project`.
            key_mask: bool ``(batch, T_vl)``, True = attended. A query with no key left gets zeros: the
                output is then ``to_out``'s bias.
            key_bias: ``(batch, T_vl)``, added to the logits; minus infinity removes a key.
            return_weights: Also return the attention probabilities.
            out: Where the result goes: writable float32, C-contiguous, ``(batch, queries, width)``.

        Returns:
            ``(batch, queries, width)`` float32, torch if the tokens of ``kv`` were torch; with
            ``return_weights`` also ``(batch, heads, queries, T_vl)``.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit.
        """
        if not isinstance(kv, KeyValues):
            raise InputError(f"kv: expected what project returns, got {type(kv).__name__}")
        states = float32("hidden_states", hidden_states)
        output = result(states.shape, out)
        weights = None
        if return_weights:
            weights = np.empty((kv.batch, self.num_heads, *states.shape[1:2], kv.num_vl_tokens), np.float32)
        bias = None if key_bias is None else apart(float32("key_bias", key_bias), output)
        self._attention.attend(
            apart(states, output), kv._held, boolean("key_mask", key_mask), bias, weights, output
        )
        attended = like_features(output, kv._torch) if out is None else out
        if weights is None:
            return attended  # type: ignore[return-value]
        return attended, like_features(weights, kv._torch)  # type: ignore[return-value]


def check_precision(precision: str) -> None:
    """That it is text; which texts there are, the engine knows."""
    if not isinstance(precision, str):
        raise InputError(
            "precision: expected one of 'float32', 'bfloat16', 'int8', got "
            f"{precision!r} ({type(precision).__name__})"
        )
