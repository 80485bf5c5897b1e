"""Changes inside the head during a call: cuts, biases, patches, other future tokens."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import ArrayLike, Float32Array, float32, indices, integer
from saccade.errors import InputError, ShapeError

#: The groups of rows of the head in their order, and with the keys of cross-attention blocks.
ROW_GROUPS = ("state", "future", "action")
GROUPS = (*ROW_GROUPS, "vl")

#: The name of a group, or its name and the indices of some of its tokens.
Tokens: TypeAlias = "str | tuple[str, int | Collection[int]]"
#: A group and the indices of its tokens. None selects all of them.
Chosen: TypeAlias = tuple[str, tuple[int, ...] | None]


@dataclass(frozen=True, eq=False)
class Intervention:
    """A change inside the head, for :meth:`saccade.ActionHead.sample`, ``velocity`` and ``trace``.

    :class:`saccade_lab.reference.ActionHead` accepts the same object.

    The groups of tokens are ``"state"``, ``"future"`` and ``"action"``, which are the rows of the head, and
    ``"vl"``, the vision-language tokens. ``(group, indices)`` selects some tokens of a group; as the key of a
    mapping it must be hashable: ``("future", (0, 1))``. All observations and samples of a call are changed in
    the same way.

    Cross-attention blocks have ``vl`` keys; self-attention blocks have ``state``, ``future`` and ``action``
    keys. A cut or bias acts in the blocks that have the keys of its source. If none of the ``blocks`` has
    them, or no tokens are chosen, the call raises an ``InputError``, because a result without effect would be
    misleading. With interleaved self-attention, even blocks are cross-attention and odd blocks
    self-attention. Indices of ``vl`` count all positions, also in blocks that attend only to text or only to
    images.

    Several interventions in a sequence act together. Their biases add up. If two of them patch the same row,
    the later one applies. At most one may replace the future tokens.

    Args:
        cut: Pairs ``(reader, source)``. The rows of the reader no longer attend to the keys of the source. A
            row without keys has zero attention: the block adds only the bias of its output layer.
        key_bias: For a group, a number or an array ``(tokens,)`` that is added to the logits of its keys for
            every reader. Minus infinity removes a key.
        patch: ``{(step, block): {group: rows}}``. Replaces rows after that block. ``rows`` is ``(tokens,
            width)`` or ``(batch, tokens, width)``. A patch has its own step and block; ``blocks``, ``steps``
            and ``heads`` do not apply to it.
        future_tokens: ``(N', width)``, used at every step in place of the learned ones, without the
            ``future_key_bias`` of the config. N' may be any number, 0 included.
        blocks: The blocks where cuts and biases apply. Default: all.
        steps: The steps at which they apply. Default: all. ``velocity`` is step 0.
        heads: The attention heads in which they apply. Default: all.

    Raises:
        InputError: A group is unknown, a reader is ``vl``, indices are not distinct integers of at least 0,
            ``blocks``, ``steps`` or ``heads`` is empty, a bias is NaN or plus infinity, or rows are not
            finite. Sizes are checked when the intervention is used.
        DtypeError, ShapeError: An array is not floating point, or has the wrong number of axes.

    Example:
        The vision-language tokens reach the actions only through the future tokens:

        >>> Intervention(cut=[("action", "vl"), ("state", "vl")]).cut
        ((('action', None), ('vl', None)), (('state', None), ('vl', None)))

        The actions do not attend to the first two future tokens in block 1:

        >>> Intervention(cut=[("action", ("future", [0, 1]))], blocks=[1]).cut
        ((('action', None), ('future', (0, 1))),)
    """

    cut: Sequence[tuple[Tokens, Tokens]] = ()
    key_bias: Mapping[Tokens, float | ArrayLike] | None = None
    patch: Mapping[tuple[int, int], Mapping[Tokens, ArrayLike]] | None = None
    future_tokens: ArrayLike | None = None
    blocks: Sequence[int] | int | None = None
    steps: Sequence[int] | int | None = None
    heads: Sequence[int] | int | None = None

    def __post_init__(self) -> None:
        checks = {"cut": _cuts, "key_bias": _biases, "patch": _patches, "future_tokens": _future_tokens}
        for name, value in vars(self).items():
            object.__setattr__(self, name, checks[name](value) if name in checks else _some(name, value))


def as_interventions(given: Intervention | Sequence[Intervention] | None) -> tuple[Intervention, ...]:
    """No, one or several interventions as a tuple. Anything else raises an ``InputError``."""
    if given is None:
        return ()
    several: Any = (given,) if isinstance(given, Intervention) else given
    expected = "intervention: expected an Intervention or a sequence of them"
    if not isinstance(several, Sequence) or isinstance(several, (str, bytes)):
        raise InputError(f"{expected}, got {type(given).__name__}")
    for one in several:
        if not isinstance(one, Intervention):
            raise InputError(f"{expected}, got a sequence with {type(one).__name__}")
    return tuple(several)


def _some(name: str, value: Any) -> tuple[int, ...] | None:
    chosen = indices(name, value)
    if chosen == ():
        raise InputError(f"{name}: expected at least one, or None for all, got none")
    return chosen


def _cuts(cut: Any) -> tuple[tuple[Chosen, Chosen], ...]:
    try:
        given = None if isinstance(cut, (str, bytes)) else list(cut)
    except TypeError:
        given = None
    if given is None:
        raise InputError(f"cut: expected pairs (reader, source), got {cut!r}")
    pairs = []
    for pair in given:
        if isinstance(pair, (str, bytes)) or not isinstance(pair, Sequence) or len(pair) != 2:
            raise InputError(f"cut: expected pairs (reader, source), got {pair!r} among them")
        reader, source = _chosen("cut", pair[0]), _chosen("cut", pair[1])
        if reader[0] == "vl":
            raise InputError(
                "cut: expected a reader among state, future, action, got 'vl', which attends to nothing"
            )
        pairs.append((reader, source))
    return tuple(pairs)


def _biases(key_bias: Any) -> dict[Chosen, Float32Array] | None:
    if key_bias is None:
        return None
    if not isinstance(key_bias, Mapping):
        raise InputError(f"key_bias: expected a mapping of groups to biases, got {type(key_bias).__name__}")
    biases: dict[Chosen, Float32Array] = {}
    for tokens, bias in key_bias.items():
        chosen = _chosen("key_bias", tokens)
        name = f"key_bias[{tokens!r}]"
        if chosen in biases:
            raise InputError(f"{name}: expected each choice of tokens once, got it twice")
        values = float32(name, _number(name, bias))
        if values.ndim > 1:
            raise ShapeError(f"{name}: expected a number or one per token, got shape {values.shape}")
        below_infinity = ~(np.isnan(values) | np.isposinf(values))
        biases[chosen] = _kept(name, values, below_infinity, "numbers below infinity")
    return biases


def _number(name: str, bias: Any) -> Any:
    """A plain number, integers included, as a float. Anything else is returned unchanged."""
    if isinstance(bias, bool) or not isinstance(bias, Real):
        return bias  # arrays of integers are refused as everywhere else
    try:
        return float(bias)
    except OverflowError:
        raise InputError(
            f"{name}: expected a number below infinity, got one beyond the range of float"
        ) from None


def _patches(patch: Any) -> dict[tuple[int, int], dict[Chosen, Float32Array]] | None:
    if patch is None:
        return None
    if not isinstance(patch, Mapping):
        raise InputError(
            f"patch: expected a mapping of (step, block) to replaced rows, got {type(patch).__name__}"
        )
    patches: dict[tuple[int, int], dict[Chosen, Float32Array]] = {}
    for place, groups in patch.items():
        if not isinstance(place, tuple) or len(place) != 2:
            raise InputError(f"patch: expected keys (step, block), got {place!r}")
        key = (integer("patch: step", place[0], least=0), integer("patch: block", place[1], least=0))
        if not isinstance(groups, Mapping):
            raise InputError(
                f"patch[{key}]: expected a mapping of groups to rows, got {type(groups).__name__}"
            )
        for tokens, rows in groups.items():
            name = f"patch[{key}][{tokens!r}]"
            chosen = _chosen(name, tokens)
            if chosen[0] not in ROW_GROUPS:
                expected = "expected state, future or action, got 'vl', which blocks do not change"
                raise InputError(f"{name}: {expected}")
            values = float32(name, rows)
            if values.ndim not in (2, 3):
                raise ShapeError(
                    f"{name}: expected (tokens, width) or (batch, tokens, width), got shape {values.shape}"
                )
            patches.setdefault(key, {})[chosen] = _kept(name, values, np.isfinite(values), "finite values")
    return patches


def _future_tokens(future_tokens: Any) -> Float32Array | None:
    if future_tokens is None:
        return None
    values = float32("future_tokens", future_tokens)
    if values.ndim != 2:
        raise ShapeError(f"future_tokens: expected (tokens, width), got shape {values.shape}")
    return _kept("future_tokens", values, np.isfinite(values), "finite values")


def _kept(name: str, values: Float32Array, good: npt.NDArray[np.bool_], expected: str) -> Float32Array:
    """A read-only copy.

    Raises:
        InputError: A value is not ``good``.
    """
    if not good.all():
        index = tuple(np.argwhere(~good)[0].tolist())
        where = f" at index {index}" if index else ""
        raise InputError(f"{name}: expected {expected}, got {values[index]}{where}")
    kept = values.copy()
    kept.setflags(write=False)
    return kept


def _chosen(name: str, tokens: Any) -> Chosen:
    group, chosen = tokens if isinstance(tokens, tuple) and len(tokens) == 2 else (tokens, None)
    if not isinstance(group, str) or group not in GROUPS:
        raise InputError(
            f"{name}: expected a group ({', '.join(GROUPS)}) or (group, indices), got {tokens!r}"
        )
    return group, indices(f"{name}: {group}", chosen)
