"""The features that a backbone returns, with what a later call can reuse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

import saccade._saccade as _saccade
from saccade._internal.arrays import Array, like_features
from saccade._internal.handle import Handle
from saccade.errors import InputError

#: What can be recorded.
RECORDS = ("hidden", "vision", "image_tokens")


@dataclass(frozen=True, eq=False, repr=False)
class BackboneRecord:
    """The record of a call of a backbone. ``repr`` lists its contents.

    Arrays are float32, NumPy or torch like the inputs.

    Attributes:
        hidden: The rows after each layer of the language model, ``(batch, T, width)``, by layer. In N1.7 this
            is before tokens of the vision tower are added.
        vision: The patches of each view after the vision tower, ``(patches, vision_width)``, by observation
            and name of the view. In N1.5 and N1.6 this is after the last norm.
        image_tokens: The tokens of each view as the language model reads them, ``(tokens, width)``, by
            observation and name of the view.
    """

    hidden: Mapping[int, Array]
    vision: Mapping[tuple[int, str], Array]
    image_tokens: Mapping[tuple[int, str], Array]

    @property
    def nbytes(self) -> int:
        """Size in memory, in bytes."""
        parts = (self.hidden, self.vision, self.image_tokens)
        return sum(int(array.nbytes) for part in parts for array in part.values())

    def __repr__(self) -> str:
        counts = [f"{name}={len(getattr(self, name))}" for name in RECORDS]
        return f"<saccade.BackboneRecord {' '.join(counts)} {self.nbytes / 1e6:,.1f} MB>"


class BackboneFeatures(Handle):
    """The features of observations. Returned by :class:`saccade.Backbone`.

    It also contains what a later call can reuse (``previous``): the pixels and tokens of each view, and the
    keys and values of every layer. It is immutable: any number of calls and threads may use it at the same
    time. ``copy.copy`` and ``copy.deepcopy`` return the object itself. It cannot be pickled.
    """

    _not_pickled = (
        "BackboneFeatures cannot be pickled, because they belong to one loaded backbone: pickle the array "
        "backbone_features"
    )

    def __init__(
        self,
        held: _saccade.BackboneFeatures,
        names: tuple[str, ...] | None,
        use_torch: bool = False,
        recorded: _saccade._BackboneRecorded | None = None,
    ) -> None:
        self._held = held
        self._names = view_names(names, held.num_views)
        self._torch = use_torch
        self._record = None if recorded is None else self._made_record(*recorded)

    @property
    def backbone_features(self) -> Array:
        """The features, ``(batch, T, feature_dim)`` float32; a torch tensor if the inputs were torch.

        A copy of what the engine holds: a policy does not see what is written to it.
        """
        return self._features

    @cached_property
    def _features(self) -> Array:
        return like_features(self._held.features(), self._torch)

    @property
    def attention_mask(self) -> Array:
        """Booleans ``(batch, T)``, True where a token is not padding, as it was given."""
        return self._masks[0]

    @property
    def image_mask(self) -> Array:
        """Booleans ``(batch, T)``, True for tokens of views."""
        return self._masks[1]

    @cached_property
    def _masks(self) -> tuple[Array, Array]:
        attended, is_image = self._held.masks()
        return like_features(attended, self._torch), like_features(is_image, self._torch)

    @property
    def views(self) -> dict[str, npt.NDArray[np.int64]]:
        """The positions in T of the tokens of each view, int64 ``(batch, tokens)``, by name.

        The names are those of ``inputs.view_names``. If an observation has fewer tokens of a view than
        others, its row ends with -1.
        """
        return dict(self._views)

    @cached_property
    def _views(self) -> dict[str, npt.NDArray[np.int64]]:
        views, places = {}, self._held.views()
        for index, name in enumerate(self._names):
            rows = [row[index] if index < len(row) else np.empty(0, np.int64) for row in places]
            views[name] = np.full((len(rows), max(map(len, rows))), -1, np.int64)
            for to, row in zip(views[name], rows, strict=True):
                to[: len(row)] = row
        return views

    @property
    def record(self) -> BackboneRecord | None:
        """The record, or None if nothing was to be recorded."""
        return self._record

    def _made_record(
        self, hidden: list[Any], vision: list[list[Any]], image_tokens: list[list[Any]]
    ) -> BackboneRecord:
        by_view = [
            {
                (row, self._names[index]): like_features(view, self._torch)
                for row, found in enumerate(rows)
                for index, view in enumerate(found)
            }
            for rows in (vision, image_tokens)
        ]
        by_layer = {layer: like_features(rows, self._torch) for layer, rows in enumerate(hidden)}
        return BackboneRecord(by_layer, *by_view)

    @property
    def batch(self) -> int:
        """Number of observations."""
        return self._held.shape[0]

    @property
    def num_tokens(self) -> int:
        """Number of tokens of each observation (T)."""
        return self._held.shape[1]

    @property
    def nbytes(self) -> int:
        """Size in memory, in bytes. Memory that several features share is counted in each of them.

        The arrays of features and masks are made when they are first asked for, and counted from then on.
        """
        made = [vars(self)["_features"]] if "_features" in vars(self) else []
        shown = sum(int(array.nbytes) for array in (*made, *vars(self).get("_masks", ())))
        return self._held.nbytes + shown + (0 if self._record is None else self._record.nbytes)

    def __repr__(self) -> str:
        return (
            f"<saccade.BackboneFeatures batch={self.batch} num_tokens={self.num_tokens} "
            f"views=[{', '.join(self._names)}] nbytes={self.nbytes}>"
        )


def view_names(given: tuple[str, ...] | None, count: int) -> tuple[str, ...]:
    """The names of ``count`` views. Another number of given names raises an ``InputError``."""
    if given is None:
        return tuple(f"view_{index + 1}" for index in range(count))
    if len(given) != count:
        raise InputError(f"view_names: expected {count} names, one a view, got {list(given)!r}")
    return given
