"""What to change inside the head while it runs: cuts, biases, patches, replaced tokens."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._arrays import ArrayLike, Float32Array, float32, indices, integer
from saccade.errors import InputError, ShapeError

#: The rows of the head in the order in which they lie, and the tokens that cross-attention blocks read.
ROW_GROUPS = ("state", "future", "action")
GROUPS = (*ROW_GROUPS, "vl")

#: A group's name, or the name and the indices of some of its tokens.
Tokens: TypeAlias = "str | tuple[str, int | Collection[int]]"
#: A group and the indices of its tokens; None stands for all of them.
Chosen: TypeAlias = tuple[str, tuple[int, ...] | None]


@dataclass(frozen=True, eq=False)
class Intervention:
    """A change of what the head computes, for :meth:`ActionHead.sample`, ``velocity`` and ``trace``, and for
    those of :class:`saccade.reference.ActionHead`.

    Groups of tokens are ``"state"``, ``"future"`` and ``"action"`` (the rows of the head) and ``"vl"`` (what
    cross-attention blocks read). Where a group stands, ``(group, indices)`` may stand for some of its tokens.
    Cross-attention blocks have the keys ``vl``, self-attention blocks those of the three others; a cut or
    bias acts where its keys are. All batch elements and samples are treated alike. Keys of a mapping must be
    hashable: ``("future", (0, 1))``. Indices of ``vl`` are of all positions, in blocks that see only some of
    them too; what such a block does not see is neither cut nor biased there.

    Several interventions given in a sequence act together: biases add up, of two patches of one row the later
    one counts, and at most one replaces the future tokens.

    Args:
        cut: Pairs ``(reader, source)``: the reader's rows no longer see the source's keys. A row with no key
            left gets zero from the attention, so that the block adds only its output bias.
        key_bias: Group to a number or ``(tokens,)`` numbers, added to the logits of these keys for every
            reader. Minus infinity removes a key.
        patch: ``{(step, block): {group: rows}}``, rows after that block replaced; ``rows`` is
            ``(tokens, width)`` or ``(batch, tokens, width)``. A patch names its own step and block, and
            ``blocks``, ``steps`` and ``heads`` do not limit it.
        future_tokens: ``(N', width)``, used in place of the learned ones at every step; N' may be any number,
            0 included, and the group ``future`` then has N' tokens. They come without the config's
            ``future_key_bias``.
        blocks: Blocks in which cuts and biases act; default all.
        steps: Euler steps at which they act; default all. ``velocity`` is step 0.
        heads: Attention heads in which they act; default all.

    Raises:
        InputError: an unknown group, a reader that is not a row, indices that are no distinct integers of at
            least 0, a bias that is not a number below infinity, rows that are not finite. What depends on the
            head's sizes is checked when it is used.
        DtypeError, ShapeError: arrays that are not floating point, or of the wrong number of axes.

    Example:
        Nothing but the vision-language tokens reaches the actions, and only by way of the future tokens:

        >>> through_future = Intervention(cut=[("action", "vl"), ("state", "vl")])
        >>> through_future.cut
        ((('action', None), ('vl', None)), (('state', None), ('vl', None)))

        The first two future tokens hidden from the actions, in block 1 only:

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
        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("cut", _cuts(self.cut))
        keep("key_bias", _biases(self.key_bias))
        keep("patch", _patches(self.patch))
        keep("future_tokens", _future_tokens(self.future_tokens))
        for name in ("blocks", "steps", "heads"):
            keep(name, indices(name, getattr(self, name)))


def as_interventions(given: Intervention | Sequence[Intervention] | None) -> tuple[Intervention, ...]:
    """One, several or none as a tuple.

    Raises:
        InputError: it is anything else.
    """
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
                "cut: 'vl' is read, it does not read; expected a reader among state, future, action"
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
    """A plain number as a float, integers too; anything else as it is."""
    if isinstance(bias, bool) or not isinstance(bias, Real):
        return bias  # arrays of integers are refused like everywhere else
    try:
        return float(bias)
    except OverflowError:
        raise InputError(f"{name}: expected a number below infinity, got one that no float holds") from None


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
            if chosen[0] == "vl":
                raise InputError(f"{name}: blocks change rows, not 'vl'; expected state, future or action")
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
    """A copy that nobody can change; refused unless all of it is good."""
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
