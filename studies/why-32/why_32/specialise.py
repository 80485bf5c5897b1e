"""Do future tokens specialise? What their maps share, what a missing token changes, whether this adds up.

A policy's learned tokens are compared with random ones, in the same head and on the same observations. The
random ones are those of the arm `future-redrawn`: independent normal numbers with the mean and the standard
deviation of the learned tokens, other ones in each observation. The tokens that training starts from are
shorter than the learned ones, so a difference from them might be one of length alone.

The first observation of an episode is used, because it is the same for all policies with the same cameras: it
does not depend on what the policy did before. Changes are those of the head's own, normalised actions, which
are not clipped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.head.intervention import Intervention
from saccade_lab.maps.record import reads_vl
from saccade_lab.study.cell import Rows
from saccade_lab.study.questions.cuts import redrawn
from saccade_lab.study.questions.sweeps import equal_mass

if TYPE_CHECKING:
    from saccade.head.context import Context
    from saccade.head.head import ActionHead
    from saccade_lab.head_inputs import HeadInputs

Float64Array = npt.NDArray[np.float64]
Tokens: TypeAlias = npt.NDArray[np.int64]
#: Function from the tokens that are removed, and one of `WEIGHTS`, to the change of the chunk.
Change: TypeAlias = Callable[[Tokens, str], Float64Array]

#: The stage, for trained policies with at least `FEWEST` tokens.
SPECIALISE = "specialise"
FEWEST = 2
LEARNED, RANDOM = "learned", "random"
#: What becomes of the softmax weight of removed tokens. `KEPT`: the keys of the N - k others are biased by
#: ln(N / (N - k)), so that the tokens together keep their weight. `LOST`: there is no bias.
#:
#: `KEPT` is the main one. It asks for what a token has that the others have not: of equal tokens none has an
#: effect. Without the bias each of them has one, that of their number. Only `LOST` can remove all tokens.
KEPT, LOST = "kept", "lost"
WEIGHTS = (KEPT, LOST)
#: The sizes of the sets whose removal is compared with that of their members.
SIZES: Mapping[str, Callable[[int], int]] = {
    "two": lambda count: 2,
    "half": lambda count: count // 2,
    "all": lambda count: count,
}
#: A change of the chunk counts as zero if its mean absolute value is below this, which rounding alone may
#: make. The order of the tokens, which must not matter, changed the actions of a pilot policy by 5e-8.
ROUNDING = 1e-6


def measure(checkpoint: str, tasks: Sequence[str], seeds: range) -> Rows:
    """What a policy's future tokens have in common, with learned and with random tokens.

    Args:
        checkpoint: Directory of the policy, which has at least `FEWEST` tokens.
        tasks, seeds: The episodes whose first observations are used.

    Returns:
        A row for each kind of tokens and each of `WEIGHTS`, with columns `tokens`, `weight`, `overlap` (see
        `overlap`, the same for both weights) and those of `summary`.
    """
    from saccade_lab.sim.tasks import find_task
    from saccade_lab.study.simulator import Simulator

    source = Simulator(checkpoint, tuple(tasks), seeds)
    head = source.head()
    overlaps: dict[str, list[float]] = {LEARNED: [], RANDOM: []}
    removals: dict[tuple[str, str], list[Removal]] = {(kind, one): [] for kind in overlaps for one in WEIGHTS}
    for task, seed in source.units:
        rng = source.rng(task, seed)
        observation = source.first(task, seed, find_task(task).instruction(seed))
        observation = observation.with_noise(rng, source.config)
        context = observation.encode(head)
        order = rng.permutation(len(head.future_tokens))
        drawn = np.asarray(redrawn(head.future_tokens, rng).future_tokens)
        for kind, tokens in ((LEARNED, head.future_tokens), (RANDOM, drawn)):
            overlaps[kind].append(overlap(head, observation, context, tokens))
            change = change_of(head, observation, context, tokens)
            for weight in WEIGHTS:
                removals[kind, weight].append(removal(change, order, weight))
    return [
        {"tokens": kind, "weight": weight, "overlap": float(np.mean(overlaps[kind])), **summary(found)}
        for (kind, weight), found in removals.items()
    ]


def overlap(head: ActionHead, observation: HeadInputs, context: Context, tokens: Float32Array) -> float:
    """How much the future rows attend to the same vision-language tokens: 1 for equal maps, 0 for disjoint.

    `shared_mass` of the rows' maps, each a mean over heads, averaged over cross-attention blocks and Euler
    steps.

    Args:
        head, observation, context: A single observation with noise, and its context.
        tokens: The future tokens, `(N, width)`, at least two.
    """
    trace = observation.trace(
        head, context, record=("attention",), intervention=Intervention(future_tokens=tokens)
    )
    maps = [
        np.asarray(probabilities)[0, :, trace.rows["future"]].mean(axis=0)
        for (_, block), probabilities in trace.attention.items()
        if reads_vl(head.config, block)
    ]
    return float(np.mean([shared_mass(one) for one in maps]))


def shared_mass(maps: npt.ArrayLike) -> float:
    """The mass that two maps share, sum_t min(p_i(t), p_j(t)), as a mean over all pairs of maps.

    Args:
        maps: Probabilities, `(tokens, keys)`, of at least two tokens.

    Example:
        >>> shared_mass([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5]])
        0.5
    """
    # In ascending order, each probability is the smaller one in its pairs with those behind it.
    ordered = np.sort(np.asarray(maps, dtype=np.float64), axis=0)
    behind = np.arange(len(ordered))[::-1]
    return float((behind @ ordered).sum() / behind.sum())


def change_of(head: ActionHead, observation: HeadInputs, context: Context, tokens: Float32Array) -> Change:
    """The change of an observation's chunk, `(horizon, action_dim)`, when some tokens are removed.

    Args:
        head, observation, context, tokens: As of `overlap`.
    """

    def chunk(kept: Float32Array, *others: Intervention) -> Float64Array:
        changed = [Intervention(future_tokens=kept), *others]
        return np.asarray(observation.sample(head, context, intervention=changed)[0], dtype=np.float64)

    whole = chunk(tokens)

    def change(removed: Tokens, weight: str) -> Float64Array:
        kept = np.delete(tokens, removed, axis=0)
        others = [equal_mass(len(kept), len(tokens))] if weight == KEPT else []
        return chunk(kept, *others) - whole

    return change


@dataclass(frozen=True)
class MeanSquares:
    """How the change by a set of tokens compares with the sum of the changes by its members.

    Attributes:
        change: Mean square of the entries of D_S, the change when the set S is removed.
        sum: That of the sum over S of D_i, the change when only token i is removed.
        difference: That of D_S minus that sum.
    """

    change: float
    sum: float
    difference: float


@dataclass(frozen=True, eq=False)
class Removal:
    """What the removal of tokens changes in a chunk.

    Attributes:
        effects: e_i, the mean absolute change of an action when token i is removed, `(N,)`.
        together: The same when all tokens are removed.
        sets: By names of `SIZES`. Sets of fewer than two tokens are left out; so is that of all tokens with
            the weight `KEPT`, which nobody could get.
    """

    effects: Float64Array
    together: float
    sets: Mapping[str, MeanSquares]


def removal(change: Change, order: Tokens, weight: str) -> Removal:
    """Removes every token alone, all of them, and sets of them.

    Args:
        change: The change by any set.
        order: The tokens in random order. A set of k tokens is the first k of them.
        weight: One of `WEIGHTS`.
    """
    count = len(order)

    def rounded(removed: Tokens, weight: str) -> Float64Array:
        found = change(removed, weight)
        return found if np.abs(found).mean() >= ROUNDING else np.zeros_like(found)

    alone = np.stack([rounded(np.array([token]), weight) for token in range(count)])
    sets = {}
    for name, size_of in SIZES.items():
        size = size_of(count)
        if size >= 2 and (size < count or weight == LOST):
            found, added = rounded(order[:size], weight), alone[order[:size]].sum(axis=0)
            squares = (float(np.square(one).mean()) for one in (found, added, found - added))
            sets[name] = MeanSquares(*squares)
    effects = np.abs(alone).reshape(count, -1).mean(axis=1)
    return Removal(effects, float(np.abs(rounded(order, LOST)).mean()), sets)


def effective_number(effects: npt.ArrayLike) -> float | None:
    """(sum e)^2 / sum e^2: N for N equal effects, 1 if only one token has any, None if none has.

    Example:
        >>> effective_number([0.3, 0.3, 0.0]), effective_number([0.0, 0.0])
        (2.0, None)
    """
    found = np.asarray(effects, dtype=np.float64)
    return float(found.sum() ** 2 / np.square(found).sum()) if found.any() else None


def summary(removals: Sequence[Removal]) -> dict[str, Any]:
    """What the removals in several observations show together.

    Returns:
        `mean_effect`: the mean of e_i over tokens and observations. `effective_tokens`: the mean over
        observations of `effective_number`, of those that have one. `largest_share`: the mean over
        observations of the largest e_i, divided by the mean effect of removing all tokens.

        For each of `SIZES`, with squares summed over observations: `explained_SIZE`, the share of the change
        by the set that the sum of its members' changes explains, 1 - |D_S - sum|^2 / |D_S|^2; and
        `ratio_SIZE`, |D_S| / |sum|. Both are 1 where effects add up. Where the chunk is linear in the tokens'
        weights in the softmax and the weight is `KEPT`, a set of k has the ratio (N - 1) / (N - k) and the
        share 1 - ((k - 1) / (N - 1))^2, because the weight of the others grows with k.

        A quotient by zero is None, and so are the numbers of a size that was not removed.
    """
    numbers = [effective_number(one.effects) for one in removals]
    defined = [number for number in numbers if number is not None]
    together = float(np.mean([one.together for one in removals]))
    largest = float(np.mean([one.effects.max() for one in removals]))
    found = {
        "mean_effect": float(np.mean([one.effects.mean() for one in removals])),
        "effective_tokens": float(np.mean(defined)) if defined else None,
        "largest_share": largest / together if together else None,
    }
    for size in SIZES:
        squares = [one.sets[size] for one in removals if size in one.sets]
        change, added, difference = (
            float(np.mean([getattr(one, name) for one in squares])) if squares else 0.0
            for name in ("change", "sum", "difference")
        )
        found[f"explained_{size}"] = 1 - difference / change if change else None
        found[f"ratio_{size}"] = float(np.sqrt(change / added)) if added else None
    return found
