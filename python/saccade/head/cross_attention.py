"""Cross-attention without the rest of the head, with keys and values that are computed once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, overload

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.arrays import (
    Array,
    ArrayLike,
    apart,
    check_precision,
    float32,
    integer,
    is_torch,
    like_features,
    mask_bytes,
    result,
    text,
)
from saccade._internal.handle import Handle
from saccade.errors import DtypeError, InputError


class KeyValues(Handle):
    """Keys and values of :class:`CrossAttention`, computed once. Returned by :meth:`CrossAttention.project`.

    Immutable: any number of calls and threads may use them at the same time. ``copy.copy`` and
    ``copy.deepcopy`` return the object itself. It cannot be pickled.
    """

    _not_pickled = (
        "KeyValues cannot be pickled, because they belong to one CrossAttention: pickle the tokens and call "
        "project again"
    )

    def __init__(self, held: _saccade.KeyValues, use_torch: bool) -> None:
        self._held = held
        self._torch = use_torch

    @property
    def batch(self) -> int:
        """Number of sequences."""
        return self._held.batch

    @property
    def num_vl_tokens(self) -> int:
        """Number of keys of each sequence."""
        return self._held.num_vl_tokens

    @property
    def nbytes(self) -> int:
        """Size in memory, in bytes."""
        return self._held.nbytes


class CrossAttention(Handle):
    """Multi-head cross-attention with its projections: ``to_out(softmax(q k^T / sqrt(head_dim)) v)``.

    Attention heads are contiguous slices of the width, as in the released head (``Attention`` of diffusers).
    Immutable: any number of threads may call it at the same time. ``copy.copy`` and ``copy.deepcopy`` return
    the object itself. It cannot be pickled.

    Args:
        tensors: ``to_q.weight (width, width)``, ``to_k.weight`` and ``to_v.weight (width, context_dim)``,
            ``to_out.0.weight (width, width)``, and ``to_q.bias``, ``to_k.bias``, ``to_v.bias``,
            ``to_out.0.bias (width,)``.
        num_heads: Number of attention heads, a divisor of the width.
        precision: ``"float32"``, ``"bfloat16"``, ``"int8"`` or ``"int4"``, as in
            :meth:`saccade.ActionHead.from_pretrained`.

    Raises:
        CheckpointError: Tensors are missing, unknown or of the wrong shape. The message lists all of them.
        DtypeError: A tensor is not floating point or not on the CPU.
        InputError: ``num_heads`` does not divide the width, the precision is unknown, or a tensor is not
            finite.

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

    _not_pickled = (
        "a CrossAttention cannot be pickled, because its weights are packed for this machine: pickle the "
        "tensors and create it again"
    )

    def __init__(
        self, tensors: Mapping[str, ArrayLike], num_heads: int, *, precision: str = "float32"
    ) -> None:
        if not isinstance(tensors, Mapping):
            raise DtypeError(f"tensors: expected a mapping of names to arrays, got {type(tensors).__name__}")
        check_precision(precision)
        arrays = {text("tensors", str(key)): float32(f"tensors[{key!r}]", tensors[key]) for key in tensors}
        for name, array in arrays.items():
            if not np.isfinite(array).all():
                raise InputError(f"tensors[{name!r}]: expected finite values")
        self._attention = _saccade.CrossAttention(arrays, integer("num_heads", num_heads), precision)

    @property
    def num_heads(self) -> int:
        """Number of attention heads."""
        return self._attention.num_heads

    @property
    def width(self) -> int:
        """Width of the queries and of the output."""
        return self._attention.width

    @property
    def context_dim(self) -> int:
        """Width of the tokens that are attended to."""
        return self._attention.context_dim

    @property
    def precision(self) -> str:
        """How it computes: ``"float32"``, ``"bfloat16"``, ``"int8"`` or ``"int4"``."""
        return self._attention.precision

    @property
    def nbytes(self) -> int:
        """Size of the weights in memory, in bytes."""
        return self._attention.nbytes

    def project(self, encoder_hidden_states: ArrayLike) -> KeyValues:
        """Computes keys and values, which any number of calls can share.

        Args:
            encoder_hidden_states: ``(batch, T_vl, context_dim)``, floating point.

        Raises:
            ShapeError, DtypeError, InputError, MemoryError: As a call.
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
        """Attends from ``hidden_states`` to keys and values.

        Args:
            hidden_states: ``(batch, queries, width)``.
            kv: From :meth:`project`.
            key_mask: bool ``(batch, T_vl)``, True where a key is attended. If no key is left, the attention
                of a query is zero and its output is the bias of ``to_out``.
            key_bias: ``(batch, T_vl)``, added to the logits. Minus infinity removes a key.
            return_weights: Whether to return the attention probabilities as well.
            out: The array that the result is written to and that is returned, as in
                :meth:`saccade.ActionHead.sample`.

        Returns:
            ``(batch, queries, width)`` float32; a torch tensor if the tokens of ``kv`` were torch. With
            ``return_weights`` a pair of this and the probabilities ``(batch, heads, queries, T_vl)``.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit or is not finite.
            MemoryError: There is not enough memory.
        """
        if not isinstance(kv, KeyValues):
            raise InputError(f"kv: expected what project returns, got {type(kv).__name__}")
        states = float32("hidden_states", hidden_states)
        output = result(states.shape, out)
        weights = None
        if return_weights:
            weights = result((kv.batch, self.num_heads, *states.shape[1:2], kv.num_vl_tokens), None)
        bias = None if key_bias is None else apart(float32("key_bias", key_bias), output)
        self._attention.attend(
            apart(states, output), kv._held, mask_bytes("key_mask", key_mask), bias, weights, output
        )
        attended = like_features(output, kv._torch) if out is None else out
        if weights is None:
            return attended  # type: ignore[return-value]
        return attended, like_features(weights, kv._torch)  # type: ignore[return-value]
