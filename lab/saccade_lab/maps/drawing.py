"""How the sheet draws: colours, a picture under a map, borders in a matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.patches import Rectangle

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade_lab.maps.layout import WHOLE, Region

CAMERA_COLOURS = ("#1b7837", "#5aae61", "#a6dba0", "#00696b", "#3ba5a7", "#9bd5d6")
MATRIX_COLOURS = "inferno"


def see_through(name: str, least: float, name_of_map: str) -> ListedColormap:
    """A colour map from transparent to nearly opaque, to be drawn on a grey picture."""
    colours = colormaps[name](np.linspace(least, 1.0, 256))
    colours[:, 3] = 0.88 * np.linspace(0.0, 1.0, 256) ** 0.8
    return ListedColormap(colours, name=name_of_map)


# Attention and occlusion have different colours.
HEAT = see_through("YlOrRd", 0.25, "saccade-attention")
CHANGE = see_through("GnBu", 0.35, "saccade-occlusion")


def show(
    axes: Axes,
    extent: tuple[float, float, float, float],
    picture: UInt8Array | None,
    heat: Float32Array | None,
    most: float,
    colours: Colormap,
    region: Region = WHOLE,
) -> None:
    """Draws the picture, in grey under a map. The map is not smoothed: patches keep their edges.

    Args:
        axes: Where.
        extent: Left, right, bottom and top of the picture, with the top at 0.
        picture: The picture, or None.
        heat: The map, or None.
        most: Value of the strongest colour.
        colours: Colours of the map.
        region: The part of the picture that the map covers. What lies outside the picture is not drawn.
    """
    left, right, bottom, _ = extent
    frame = Rectangle((left, 0.0), right - left, bottom, fill=False, linewidth=0.5, clip_on=False)
    if picture is not None and heat is None:
        axes.imshow(picture, extent=extent)
    elif picture is not None:
        grey = picture.astype(np.float32).mean(axis=2) / 255.0
        axes.imshow(grey, extent=extent, cmap="gray", vmin=-0.4, vmax=1.0)
    axes.add_patch(frame)
    if heat is not None:
        covered = (
            left + region[0] * (right - left),
            left + region[2] * (right - left),
            region[3] * bottom,
            region[1] * bottom,
        )
        drawn = axes.imshow(
            heat, extent=covered, cmap=colours, vmin=0, vmax=most or 1.0, interpolation="nearest"
        )
        drawn.set_clip_path(frame)


def borders(axes: Axes, runs: Sequence[tuple[str, slice]], *, down: bool) -> None:
    """Draws lines between the runs, and their names at their centres."""
    for _, run in runs:
        if run.start:
            draw = axes.axhline if down else axes.axvline
            draw(run.start - 0.5, color="white", linewidth=0.7)
    middles, names = [(run.start + run.stop - 1) / 2 for _, run in runs], [name for name, _ in runs]
    if down:
        axes.set_yticks(middles, names, fontsize=7, rotation=90, va="center")
    else:
        axes.set_xticks(middles, names, fontsize=7)
    axes.tick_params(length=0, pad=2)


def ranges(numbers: Sequence[int]) -> str:
    """Sorted numbers as text, with runs abbreviated.

    Example:
        >>> ranges((0, 1, 2, 5))
        '0-2, 5'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
