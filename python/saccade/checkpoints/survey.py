"""One pass over the tensors of a head: counts, norms, distributions; and statistics of its future tokens.

One tensor, or the slice of one embodiment of it, is in memory at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.arrays import Float32Array
from saccade.checkpoints.description import QUANTIZED
from saccade.checkpoints.findings import (
    UNUSED,
    Embodiment,
    Part,
    Spread,
    TokenGeometry,
    TokenStatistics,
    in_order,
    part_of,
)
from saccade.checkpoints.initialisation import NORMAL_STD, Draw, distance, draw, is_as_drawn, is_norm, sample
from saccade.head.config import HeadConfig

#: A median absolute deviation times this is the standard deviation of normally distributed numbers.
MAD_TO_STD = 1.4826

#: Number of elements that are widened to float64 at a time: about a megabyte.
WIDENED = 1 << 17


@dataclass(frozen=True)
class Slice:
    """A tensor, or one embodiment's slice of it, while it is in memory."""

    name: str
    """Without the prefix of the head."""
    embodiment: int | None
    values: Float32Array
    drawn: Draw | None
    """The distribution at initialisation. None if it is not compared: int8 and int4, and what only training
    uses."""


class Survey:
    """Reads every tensor of a head once.

    Args:
        published: The open checkpoint.
        head: Its config.
        examine: Called with each of them, unless it is None.
        progress: Called with the number of bytes that are done and the total number of bytes.

    Attributes:
        odd: Sentences about unusual tensors.
        tokens: The future tokens, ``(N, width)``, or None.
    """

    def __init__(
        self,
        published: _saccade.HeadCheckpoint,
        head: HeadConfig,
        examine: Callable[[Slice], object] | None,
        progress: Callable[[int, int], object] | None,
    ) -> None:
        self._published = published
        self._head = head
        self._prefix = published.prefix
        self._parts: dict[str, Part] = {}
        self._squares = np.zeros(head.num_embodiments)
        self._biases_zero = np.ones(head.num_embodiments, bool)
        self._weights_drawn = np.ones(head.num_embodiments, bool)
        self.tokens: Float32Array | None = None
        self.odd: list[str] = []
        tensors = [tensor for tensor in published.tensors() if tensor[0].startswith(self._prefix)]
        done, total = 0, sum(nbytes for *_, nbytes in tensors)
        self._shapes = {name.removeprefix(self._prefix): tuple(shape) for name, _, shape, _ in tensors}
        for full_name, dtype, shape, nbytes in tensors:
            name = full_name.removeprefix(self._prefix)
            part = self._parts.setdefault(part_of(name), Part())
            part.tensors += 1
            part.parameters += math.prod(shape)
            part.nbytes += nbytes
            part.dtypes[dtype] = part.dtypes.get(dtype, 0) + 1
            judged = []
            for one in self._slices(name, dtype, tuple(shape)):
                if examine is not None:
                    examine(one)
                judged.append(self._judge(one))
            if judged and None not in judged:
                part.judged += 1
                part.as_drawn += all(judged)
            done += nbytes
            if progress is not None:
                progress(done, total)

    def _slices(self, name: str, dtype: str, shape: tuple[int, ...]) -> Iterator[Slice]:
        is_drawn = dtype not in QUANTIZED and part_of(name) != UNUSED and not name.endswith("_scale")
        drawn = draw(name, self._inputs(name, shape)) if is_drawn else None
        is_category = name.endswith((".W", ".b"))
        indices: list[int | None] = list(range(shape[0])) if is_category else [None]
        for index in indices:
            yield Slice(name, index, self._published.read(self._prefix + name, index), drawn)

    def _inputs(self, name: str, shape: tuple[int, ...]) -> int:
        """Number of inputs of the linear layer that a weight or bias belongs to."""
        module, _, kind = name.rpartition(".")
        if kind == "bias" and not is_norm(name):
            return self._shapes[f"{module}.weight"][1]
        return shape[1] if len(shape) == 2 else 1

    def _judge(self, one: Slice) -> bool | None:
        """Counts a tensor. Whether it is distributed as at initialisation; None if that is not compared."""
        values, name = one.values, one.name
        where = name if one.embodiment is None else f"{name}[{one.embodiment}]"
        squares = dot(values, values)
        if not math.isfinite(squares):
            count = int(np.sum(~np.isfinite(values)))
            self.odd.append(f"{where} contains {count} values that are NaN or infinite")
            return False
        is_weight = not name.endswith((".b", ".bias")) and one.drawn is not None
        if one.embodiment is None and is_weight and values.size > 1 and not is_norm(name):
            low, high = float(values.min()), float(values.max())
            if low == high:
                self.odd.append(f"every value of {where} is {low:g}")
        if name == "future_tokens.weight":
            self.tokens = values
        as_drawn = None if one.drawn is None else is_as_drawn(sample(values), one.drawn)
        if one.embodiment is not None:
            self._squares[one.embodiment] += squares
            if name.endswith(".b"):
                self._biases_zero[one.embodiment] &= squares == 0.0
            else:
                self._weights_drawn[one.embodiment] &= as_drawn is not False
        return as_drawn

    def parts(self) -> dict[str, Part]:
        """The parts of the head."""
        return in_order(self._parts)

    def embodiments(self, names: Mapping[int, list[str]]) -> list[Embodiment]:
        """All embodiments in ascending order of their ids."""
        norms = np.sqrt(self._squares)
        scores = robust_z(norms)
        return [
            Embodiment(
                id=index,
                names=names.get(index, []),
                norm=float(norms[index]),
                robust_z=None if scores is None else float(scores[index]),
                weights=self._weights_of(index, norms[index] == 0.0),
            )
            for index in range(self._head.num_embodiments)
        ]

    def _weights_of(self, index: int, is_zero: bool) -> str:
        if is_zero:
            return "zero"
        return "as initialised" if self._biases_zero[index] and self._weights_drawn[index] else "trained"


def robust_z(values: np.ndarray) -> np.ndarray | None:
    """Distances from the median in units of 1.4826 median absolute deviations; None if the deviation is 0."""
    centre = np.median(values)
    spread = MAD_TO_STD * float(np.median(np.abs(values - centre)))
    return None if spread == 0.0 else (values - centre) / spread


def dot(a: Float32Array, b: Float32Array) -> float:
    """The dot product of all elements in float64. One thread, because reading the file takes longer."""
    a, b = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for first in range(0, a.size, WIDENED):
        part = slice(first, first + WIDENED)
        total += float(np.einsum("i,i->", a[part].astype(np.float64), b[part].astype(np.float64)))
    return total


def token_statistics(tokens: Float32Array, key_bias: Sequence[float] | None = None) -> TokenStatistics:
    """Statistics of future tokens ``(N, width)``, at least one, and the ``future_key_bias`` of the config."""
    drawn = NORMAL_STD * np.random.default_rng(0).standard_normal(tokens.shape, np.float32)
    values, fresh = sample(tokens), Draw("normal", NORMAL_STD)
    _, index, counts = np.unique(tokens, axis=0, return_inverse=True, return_counts=True)
    groups = [np.flatnonzero(index.reshape(-1) == group).tolist() for group in np.flatnonzero(counts > 1)]
    groups.sort()
    return TokenStatistics(
        **vars(token_geometry(tokens)),
        count=tokens.shape[0],
        std=float(np.std(tokens, dtype=np.float64)),
        distance=distance(values, fresh),
        as_drawn=is_as_drawn(values, fresh),
        identical=groups,
        zero=np.flatnonzero(~tokens.any(axis=1)).tolist(),
        drawn=token_geometry(drawn),
        key_bias=None if key_bias is None else list(key_bias),
    )


def token_geometry(tokens: Float32Array) -> TokenGeometry:
    """Norms, cosines of pairs and effective rank of tokens ``(N, width)``, computed in float64."""
    wide = tokens.astype(np.float64)
    norms = np.linalg.norm(wide, axis=1)
    unit = wide / np.where(norms == 0.0, 1.0, norms)[:, None]
    cosines = (unit @ unit.T)[np.triu_indices(len(unit), 1)]
    values = np.linalg.svd(wide, compute_uv=False)
    shares = values[values > 0.0] / max(float(values.sum()), np.finfo(np.float64).tiny)
    return TokenGeometry(
        norm=spread_of(norms),
        cosine=spread_of(cosines),
        effective_rank=float(np.exp(-np.sum(shares * np.log(shares)))) if shares.size else 0.0,
    )


def spread_of(values: np.ndarray) -> Spread | None:
    """Mean, minimum and maximum; None if there are no values."""
    if values.size == 0:
        return None
    return Spread(mean=float(values.mean()), min=float(values.min()), max=float(values.max()))
