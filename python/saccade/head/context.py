"""An encoded observation, which any number of ``sample`` calls can share."""

from __future__ import annotations

import saccade._saccade as _saccade
from saccade._internal.arrays import Array, like_features
from saccade._internal.handle import Handle
from saccade.head.trace import Record


class Context(Handle):
    """An encoded observation. Returned by :meth:`saccade.ActionHead.encode`.

    It contains the keys and values of every cross-attention block. It is immutable: any number of calls and
    threads may use it at the same time. ``copy.copy`` and ``copy.deepcopy`` return the context itself. It
    cannot be pickled.
    """

    _not_pickled = (
        "a Context cannot be pickled, because it belongs to one loaded head: pickle the backbone features "
        "and call head.encode again"
    )

    def __init__(self, held: _saccade.Context, use_torch: bool, record: Record | None) -> None:
        self._held = held
        self._torch = use_torch
        self._record = record

    @property
    def batch(self) -> int:
        """Number of observations."""
        return self._held.batch

    @property
    def num_vl_tokens(self) -> int:
        """Number of vision-language tokens of each observation (T_vl), dropped ones included."""
        return self._held.num_vl_tokens

    @property
    def nbytes(self) -> int:
        """Size in memory, in bytes."""
        return self._held.nbytes + (0 if self._record is None else self._record.nbytes)

    @property
    def record(self) -> Record | None:
        """The record of the VL self-attention that :meth:`saccade.ActionHead.encode` made, or None."""
        return self._record

    @property
    def vl_embs(self) -> Array:
        """The tokens that the cross-attention blocks attend to, ``(batch, T_vl, context_dim)`` float32.

        A copy. Positions that ``drop_vl`` removed are zero.
        """
        return like_features(self._held.vl_embs(), self._torch)

    @property
    def image_mask(self) -> Array | None:
        """The ``image_mask`` given to :meth:`saccade.ActionHead.encode`, bool ``(batch, T_vl)``, or None."""
        mask = self._held.image_mask()
        return None if mask is None else like_features(mask, self._torch)

    def __repr__(self) -> str:
        return f"<saccade.Context batch={self.batch} num_vl_tokens={self.num_vl_tokens} nbytes={self.nbytes}>"
