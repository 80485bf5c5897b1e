"""Folds of a cross-validation whose groups (episodes) stay together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError

Rows: TypeAlias = npt.NDArray[np.int64]


def grouped_folds(groups: npt.NDArray[Any], folds: int) -> Iterator[tuple[Rows, Rows]]:
    """Deals groups to folds of about as many rows: the largest group first, each to the smallest fold.

    Of equal groups the last in sorted order comes first, of equal folds the first. These are the folds
    of scikit-learn's ``GroupKFold``.

    Args:
        groups: ``(rows,)``, the group of each row.
        folds: At most as many as there are groups.

    Yields:
        The rows to train on and those to test on, ascending, for each fold.
    """
    number, sizes = _numbered(groups, folds)
    rows_in = np.zeros(folds, np.int64)
    fold_of = np.empty(len(sizes), np.int64)
    for group in np.argsort(sizes, kind="stable")[::-1]:
        fold_of[group] = rows_in.argmin()
        rows_in[fold_of[group]] += sizes[group]
    yield from _split(fold_of[number], folds)


def stratified_folds(
    classes: npt.NDArray[Any], groups: npt.NDArray[Any], folds: int, seed: int
) -> Iterator[tuple[Rows, Rows]]:
    """Deals groups to folds so that each fold has about the same share of every class (task).

    Groups come in random order, those first whose counts by class differ most. Each goes to the fold that
    leaves the shares of the classes most even over the folds; among equally good ones to the one with the
    fewest rows. These are the folds of scikit-learn's ``StratifiedGroupKFold``, shuffled with this seed.

    Args:
        classes: ``(rows,)``, the class of each row.
        groups: ``(rows,)``, the group of each row.
        folds: At most as many as there are groups.
        seed: Of the order of the groups.

    Yields:
        As :func:`grouped_folds`.
    """
    number, sizes = _numbered(groups, folds)
    _, class_of, class_sizes = np.unique(classes, return_inverse=True, return_counts=True)
    counts = np.zeros((len(sizes), len(class_sizes)))  # rows of each class in each group
    np.add.at(counts, (number, class_of), 1)
    order = np.arange(len(sizes))
    np.random.RandomState(seed).shuffle(order)
    rows_in = np.zeros((folds, len(class_sizes)))
    fold_of = np.empty(len(sizes), np.int64)
    for group in order[np.argsort(-counts[order].std(axis=1), kind="stable")]:
        best, least = 0, np.inf
        for fold in range(folds):
            trial = rows_in.copy()
            trial[fold] += counts[group]
            unevenness = (trial / class_sizes).std(axis=0).mean()
            smaller = rows_in[fold].sum() < rows_in[best].sum()
            if unevenness < least or (np.isclose(unevenness, least) and smaller):
                best, least = fold, unevenness
        fold_of[group] = best
        rows_in[best] += counts[group]
    yield from _split(fold_of[number], folds)


def _numbered(groups: npt.NDArray[Any], folds: int) -> tuple[Rows, Rows]:
    """The number of each row's group, and how many rows each group has."""
    _, number, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if not 2 <= folds <= len(sizes):
        raise InputError(f"folds: expected 2 to {len(sizes)}, the number of groups, got {folds}")
    return number, sizes


def _split(fold_of: Rows, folds: int) -> Iterator[tuple[Rows, Rows]]:
    for fold in range(folds):
        yield np.flatnonzero(fold_of != fold), np.flatnonzero(fold_of == fold)
