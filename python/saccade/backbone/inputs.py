"""The inputs of a vision-language backbone: pixels and token ids, as the released processors prepare them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import ArrayLike, Float32Array, boolean, float32, int64, is_torch
from saccade.errors import InputError, ShapeError


class BackboneInputs:
    """The inputs of a backbone, in the shapes of the released code. They always have a batch axis.

    :class:`saccade.Processor` makes them from camera frames and an instruction. NumPy arrays and torch CPU
    tensors are both taken, and kept under the names of the arguments: arrays as float32, int64 and bool,
    sequences as tuples.

    Args:
        pixel_values: The normalised pixels of all views, those of the first observation first. N1.5:
            ``(batch * views, 3, height, width)``. N1.6: a list of ``(1, 3, height, width)``, one array a
            view, since their sizes may differ. N1.7: ``(patches, 1536)``, the patches of all views.
        input_ids: The tokens of the prompts, ``(batch, T)``.
        attention_mask: ``(batch, T)``, integers or booleans; 0 or False marks padding. Default: no padding.
        image_grid_thw: N1.7 only: the grid of patches of each view, ``(batch * views, 3)``: time, height,
            width.
        view_names: The names of the views of an observation, in the order of the prompt. Default:
            ``"view_1"``, ``"view_2"``, and so on.

    Raises:
        ShapeError: An array has another shape.
        DtypeError: An array has another type.
        InputError: A mask contains anything but 0 and 1, or a name occurs twice.

    Example:
        >>> import numpy as np, saccade
        >>> inputs = saccade.BackboneInputs(np.zeros((1, 3, 224, 224), np.float32), [[151644, 8948, 198]])
        >>> inputs.input_ids.shape, inputs.attention_mask.all()
        ((1, 3), np.True_)
    """

    pixel_values: Float32Array | tuple[Float32Array, ...]
    input_ids: npt.NDArray[np.int64]
    attention_mask: npt.NDArray[np.bool_]
    image_grid_thw: npt.NDArray[np.int64] | None
    view_names: tuple[str, ...] | None

    def __init__(
        self,
        pixel_values: ArrayLike | Sequence[ArrayLike],
        input_ids: ArrayLike,
        attention_mask: ArrayLike | None = None,
        image_grid_thw: ArrayLike | None = None,
        *,
        view_names: Sequence[str] | None = None,
    ) -> None:
        if isinstance(pixel_values, (list, tuple)) and all(hasattr(view, "shape") for view in pixel_values):
            self.pixel_values = tuple(
                _with_axes(name := f"pixel_values[{index}]", float32(name, view), 4)
                for index, view in enumerate(pixel_values)
            )
            self._is_torch = any(map(is_torch, pixel_values))
        else:
            self._is_torch = is_torch(pixel_values)
            self.pixel_values = float32("pixel_values", cast("ArrayLike", pixel_values))
            if self.pixel_values.ndim not in (2, 4):
                raise ShapeError(
                    "pixel_values: expected (views, 3, height, width), or (patches, values) for N1.7, got "
                    f"shape {self.pixel_values.shape}"
                )
        self.input_ids = _with_axes("input_ids", int64("input_ids", input_ids), 2)
        self.attention_mask = _mask(attention_mask, self.input_ids.shape)
        self.image_grid_thw = None
        if image_grid_thw is not None:
            grid = int64("image_grid_thw", image_grid_thw)
            if grid.ndim != 2 or grid.shape[1] != 3:
                raise ShapeError(f"image_grid_thw: expected (views, 3), got shape {grid.shape}")
            self.image_grid_thw = grid
        self.view_names = None
        if view_names is not None:
            self.view_names = tuple(view_names)
            if len(set(self.view_names)) != len(self.view_names):
                raise InputError(f"view_names: expected distinct names, got {list(view_names)!r}")

    @property
    def batch(self) -> int:
        """Number of observations."""
        return int(self.input_ids.shape[0])

    def __repr__(self) -> str:
        pixels: Any = self.pixel_values
        shape = [view.shape for view in pixels] if isinstance(pixels, tuple) else pixels.shape
        return f"<saccade.BackboneInputs input_ids={self.input_ids.shape} pixel_values={shape}>"


def _with_axes(name: str, array: Any, axes: int) -> Any:
    if array.ndim != axes:
        raise ShapeError(f"{name}: expected {axes} axes, got shape {array.shape}")
    return array


def _mask(mask: ArrayLike | None, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    if mask is None:
        return np.ones(shape, np.bool_)
    dtype = str(getattr(mask, "dtype", np.asarray(mask).dtype)).removeprefix("torch.")
    if dtype == "bool":
        found = cast("npt.NDArray[np.bool_]", boolean("attention_mask", mask))
    else:
        numbers = int64("attention_mask", mask)
        if not np.isin(numbers, (0, 1)).all():
            raise InputError("attention_mask: expected 0 and 1 only, got other numbers")
        found = numbers.astype(np.bool_)
    if found.shape != shape:
        raise ShapeError(f"attention_mask: expected the shape of input_ids, {shape}, got {found.shape}")
    return found
