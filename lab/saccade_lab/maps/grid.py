"""Where the image tokens of a whole policy lie: their grid in a view, and the view on the camera's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.backbone.config import BackboneConfig
from saccade.backbone.inputs import BackboneInputs
from saccade.errors import ShapeError
from saccade.policy.policy import Policy
from saccade.processor import Processor
from saccade_lab.inside import parts_of
from saccade_lab.maps.layout import WHOLE, Layout, Region, ViewLayout, kind_of

#: Axes of N1.7's patches: a patch holds the same picture twice, as if it were two frames of a video.
N17_TIME = 2


def layout_of(
    policy: Policy,
    frames: Mapping[str, UInt8Array],
    inputs: BackboneInputs,
    views: Mapping[str, npt.NDArray[np.int64]],
) -> Layout:
    """What is at each position of one observation of a whole policy.

    Args:
        policy: The policy.
        frames: The frame ``(height, width, 3)`` of each view.
        inputs: What the policy's processor made of them, a batch of one.
        views: :attr:`saccade.BackboneFeatures.views` of the features.

    Raises:
        ShapeError: The tokens of a view are not a grid of consecutive positions.
    """
    parts = parts_of(policy)
    config, processor = parts.backbone.config, parts.processor
    ids = inputs.input_ids[0]
    regions: dict[tuple[int, int], Region] = {}
    cameras = []
    for (name, positions), picture in zip(
        views.items(), view_pictures(inputs.pixel_values, inputs, config), strict=True
    ):
        rows, columns = (side // (config.patch_size * config.merge) for side in picture.shape[:2])
        found = positions[0][positions[0] >= 0]
        if len(found) != rows * columns or (np.diff(found) != 1).any():
            raise ShapeError(
                f"view {name}: expected {rows} x {columns} tokens at consecutive positions, got {len(found)}"
            )
        height, width = frames[name].shape[:2]
        if (height, width) not in regions:
            regions[height, width] = region_of(processor, config, height, width)
        cameras.append(ViewLayout(name, int(found[0]), rows, columns, regions[height, width]))
    texts = processor.texts(ids)
    is_image = ids == config.image_token_id
    tokens = [kind_of(position, text) for position, text in enumerate(texts) if not is_image[position]]
    return Layout(len(ids), tuple(cameras), tuple(tokens))


def region_of(processor: Processor, config: BackboneConfig, height: int, width: int) -> Region:
    """The part of a frame that becomes a view.

    It is found by looking: the processor prepares two frames whose colours grow along x and along y, so that
    every pixel of a view says where on the frame it comes from. This holds for any crop and any resizing.

    Args:
        processor: The processor.
        config: Config of the backbone.
        height, width: Size of the frames.

    Returns:
        Left, top, right and bottom, as shares of width and height. Where a processor adds bars to a frame,
        the view reaches beyond it: below 0 or above 1.
    """
    # Growing and falling: rounding and truncation cancel. White tells the frame from bars.
    ramps = [(np.arange(side) + 0.5) / side for side in (width, height)]
    across, down = ramps[0][None, :], ramps[1][:, None]
    probes = []
    for ramp in (across, down):
        probe = np.full((height, width, 3), 255, np.uint8)
        probe[..., 0] = np.rint(255 * ramp)
        probe[..., 1] = 255 - probe[..., 0]
        probes.append(probe)
    inputs = processor(probes, "look")
    sides = []
    for axis, picture in zip((1, 0), view_pictures(inputs.pixel_values, inputs, config), strict=True):
        is_frame = picture[..., 2] > 0.99
        share = (picture[..., 0] - picture[..., 1]) / 4 + 0.5
        place = (np.indices(is_frame.shape)[axis] + 0.5) / is_frame.shape[axis]
        if len(np.unique(place[is_frame])) < 2:
            return WHOLE
        slope, start = np.polyfit(place[is_frame], share[is_frame].astype(np.float64), 1)
        sides.append((float(start), float(start + slope)))
    (left, right), (top, bottom) = sides
    return left, top, right, bottom


def view_pictures(
    values: Float32Array | Sequence[Float32Array], inputs: BackboneInputs, config: BackboneConfig
) -> list[Float32Array]:
    """Pixel values of one observation as pictures.

    Args:
        values: ``inputs.pixel_values``, or anything of their shape, such as their derivative.
        inputs: The inputs, a batch of one.
        config: Config of the backbone.

    Returns:
        ``(height, width, 3)`` for each view.
    """
    if config.version != "n1.7":
        return [np.moveaxis(view.reshape(3, *view.shape[-2:]), 0, -1) for view in values]
    assert inputs.image_grid_thw is not None
    side, merge = config.patch_size, config.merge
    pictures: list[Float32Array] = []
    start = 0
    for _, rows, columns in inputs.image_grid_thw.tolist():
        patches: npt.NDArray[Any] = np.asarray(values)[start : start + rows * columns]
        start += rows * columns
        # Patches of a token follow each other.
        whole = patches.reshape(rows // merge, columns // merge, merge, merge, 3, N17_TIME, side, side)
        picture = whole.mean(axis=5).transpose(0, 2, 5, 1, 3, 6, 4)
        pictures.append(picture.reshape(rows * side, columns * side, 3))
    return pictures


def by_token(picture: Float32Array, config: BackboneConfig) -> Float32Array:
    """The pixels of a view by token, ``(rows, columns, pixels, 3)``."""
    side = config.patch_size * config.merge
    rows, columns = (length // side for length in picture.shape[:2])
    cells = picture.reshape(rows, side, columns, side, 3).transpose(0, 2, 1, 3, 4)
    return np.ascontiguousarray(cells.reshape(rows, columns, side * side, 3))
