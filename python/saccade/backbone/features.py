"""The features that a backbone returns, with what a later call can reuse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
        arrays: tuple[Array, Array, Array],
        views: dict[str, npt.NDArray[np.int64]],
        record: BackboneRecord | None,
    ) -> None:
        self._held = held
        self._arrays = arrays
        self._views = views
        self._record = record

    @property
    def backbone_features(self) -> Array:
        """The features, ``(batch, T, feature_dim)`` float32; a torch tensor if the inputs were torch."""
        return self._arrays[0]

    @property
    def attention_mask(self) -> Array:
        """Booleans ``(batch, T)``, True where a token is not padding, as it was given."""
        return self._arrays[1]

    @property
    def image_mask(self) -> Array:
        """Booleans ``(batch, T)``, True for tokens of views."""
        return self._arrays[2]

    @property
    def views(self) -> dict[str, npt.NDArray[np.int64]]:
        """The positions in T of the tokens of each view, int64 ``(batch, tokens)``, by name.

        The names are those of ``inputs.view_names``. If an observation has fewer tokens of a view than
        others, its row ends with -1.
        """
        return dict(self._views)

    @property
    def record(self) -> BackboneRecord | None:
        """The record, or None if nothing was to be recorded."""
        return self._record

    @property
    def batch(self) -> int:
        """Number of observations."""
        return int(self._arrays[0].shape[0])

    @property
    def num_tokens(self) -> int:
        """Number of tokens of each observation (T)."""
        return int(self._arrays[0].shape[1])

    @property
    def nbytes(self) -> int:
        """Size in memory, in bytes. Memory that several features share is counted in each of them."""
        shown = sum(int(array.nbytes) for array in self._arrays)
        return self._held.nbytes + shown + (0 if self._record is None else self._record.nbytes)

    def __repr__(self) -> str:
        views = ", ".join(self._views)
        return (
            f"<saccade.BackboneFeatures batch={self.batch} num_tokens={self.num_tokens} views=[{views}] "
            f"nbytes={self.nbytes}>"
        )


def made(
    held: _saccade.BackboneFeatures,
    recorded: _saccade._BackboneRecorded | None,
    inputs: Any,
    image_token_id: int,
) -> BackboneFeatures:
    """The features of ``inputs`` from the result of the engine."""

    def shown(array: npt.NDArray[Any]) -> Array:
        return like_features(array, inputs._is_torch)

    features, is_image = shown(held.features()), shown(inputs.input_ids == image_token_id)
    places = held.views()
    names = view_names(inputs.view_names, max(map(len, places), default=0))
    views = {}
    for index, name in enumerate(names):
        rows = [row[index] if index < len(row) else np.empty(0, np.int64) for row in places]
        views[name] = np.full((len(rows), max(map(len, rows))), -1, np.int64)
        for to, row in zip(views[name], rows, strict=True):
            to[: len(row)] = row
    record = None
    if recorded is not None:
        hidden, *of_views = recorded
        by_view = [
            {
                (row, names[index]): shown(view)
                for row, found in enumerate(rows)
                for index, view in enumerate(found)
            }
            for rows in of_views
        ]
        record = BackboneRecord({layer: shown(rows) for layer, rows in enumerate(hidden)}, *by_view)
    return BackboneFeatures(held, (features, shown(inputs.attention_mask.copy()), is_image), views, record)


def view_names(given: tuple[str, ...] | None, count: int) -> tuple[str, ...]:
    """The names of ``count`` views. Another number of given names raises an ``InputError``."""
    if given is None:
        return tuple(f"view_{index + 1}" for index in range(count))
    if len(given) != count:
        raise InputError(f"view_names: expected {count} names, one a view, got {list(given)!r}")
    return given
