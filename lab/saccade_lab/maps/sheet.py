"""The PNG sheet: one observation, all chosen blocks, means over the chosen heads and Euler steps."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize, to_rgb
from matplotlib.figure import Figure
from PIL import Image

from saccade._internal.arrays import Float32Array
from saccade._internal.files import write_atomically
from saccade_lab.maps.drawing import CAMERA_COLOURS, CHANGE, HEAT, MATRIX_COLOURS, borders, ranges, show
from saccade_lab.maps.layout import ViewLayout
from saccade_lab.maps.notes import GROUP_COLOURS, KIND_COLOURS, NO_FUTURE, NO_IMAGES, NO_PICTURES
from saccade_lab.maps.record import BASELINES, MEAN, Maps

# All lengths are in inches.
WIDTH, MARGIN, GAP = 13.0, 0.3, 0.06
INNER = WIDTH - 2 * MARGIN
TITLE_HEIGHT = 0.36
BAR_WIDTH = 0.75  # a colour bar with its numbers
MASS_WIDTH = 2.3  # the bars of how attention divides
DOTS_PER_INCH = 100
COLOUR_STEP = 5  # of 255: invisible, and makes the file of a sheet a third smaller

MAX_TOKENS_DRAWN = 32  # one by one
MAX_NAMED_TOKENS = 60


def write_sheet(maps: Maps, path: Path) -> None:
    """Draws the sheet and writes it as a PNG."""
    figure = Sheet(maps).draw()
    figure.set_dpi(DOTS_PER_INCH)
    canvas: Any = FigureCanvasAgg(figure)  # its methods are untyped
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].astype(np.float32)
    rounded = (np.rint(pixels / COLOUR_STEP) * COLOUR_STEP).astype(np.uint8)
    with write_atomically(path) as temporary:
        Image.fromarray(rounded).save(temporary, optimize=True)


class Sheet:
    """Draws the sections from top to bottom. Sections that do not apply are left out; the header says why.

    Args:
        maps: What to draw.
    """

    def __init__(self, maps: Maps) -> None:
        self.maps = maps
        self.cameras = maps.view.layout.cameras
        self._drawn: list[tuple[Axes, tuple[float, float, float, float]]] = []
        self._figure = Figure(figsize=(WIDTH, 1.0))
        self._texts: list[tuple[float, float, str, dict[str, Any]]] = []
        self._top = 0.15  # of the next section

    def draw(self) -> Figure:
        """The whole sheet."""
        self.header()
        cross, own = self.maps.cross_blocks(), self.maps.self_blocks()
        if self.cameras:
            self.pictures()
        if cross and self.cameras:
            self.camera_maps(cross)
        if cross and self.maps.view.layout.tokens:
            self.named_tokens(cross)
        if cross and self.cameras and self.maps.num_future_tokens:
            self.token_maps(cross[-1])
        if cross:
            self.matrices(cross, "vision-language tokens", across=2, height=2.7)
        if own:
            self.matrices(own, "rows", across=2 if len(own) <= 2 else 4, height=2.75)
        self.numbers()
        return self._placed(self._top + 0.1)

    def _placed(self, height: float) -> Figure:
        """Sets all positions, which are fractions of a height that is known only now."""
        self._figure.set_size_inches(WIDTH, height)
        for axes, (left, top, wide, high) in self._drawn:
            axes.set_position((left / WIDTH, 1 - (top + high) / height, wide / WIDTH, high / height))
        for left, top, text, style in self._texts:
            self._figure.text(left / WIDTH, 1 - top / height, text, va="top", **style)
        return self._figure

    def _axes(self, left: float, top: float, wide: float, high: float) -> Axes:
        axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0), label=str(len(self._drawn)))
        self._drawn.append((axes, (left, top, wide, high)))
        return axes

    def _text(self, left: float, top: float, text: str, **style: Any) -> None:
        self._texts.append((left, top, text, style))

    def _title(self, text: str, *, note: str = "") -> None:
        """Starts a section."""
        self._top += 0.18
        self._text(MARGIN, self._top, text, fontsize=10.5, weight="bold")
        self._top += 0.21
        if note:
            self._note(note)
        self._top += 0.04

    def _note(self, text: str, **style: Any) -> None:
        lines = textwrap.wrap(text, 178)
        self._text(MARGIN, self._top, "\n".join(lines), **{"fontsize": 8, "color": "#444444"} | style)
        self._top += 0.155 * len(lines) + 0.02

    def header(self) -> None:
        """The observation, the checkpoint and the caveat."""
        maps, selection = self.maps, self.maps.selection
        self._text(MARGIN, self._top, maps.view.title, fontsize=13, weight="bold")
        self._top += 0.3
        self._note(
            f"checkpoint {maps.checkpoint['name']} (sha256 {maps.checkpoint['sha256'][:12]}), N = "
            f"{maps.num_future_tokens} future tokens, T_vl = {maps.view.layout.num_tokens}; means over "
            f"heads {ranges(selection.heads)} and Euler steps {ranges(selection.steps)}"
        )
        if not maps.num_future_tokens:
            self._note(NO_FUTURE, weight="bold", color="black")
        if not self.cameras:
            self._note(NO_IMAGES, weight="bold", color="black")
        elif not maps.view.images:
            self._note(NO_PICTURES, weight="bold", color="black")
        self._note(maps.caveat, fontsize=8.5, style="italic", color="#8c1d18")

    def pictures(self) -> None:
        """The pictures, and next to them how the actions change without each patch."""
        occlusion = self.maps.occlusion
        assert occlusion is not None  # it is None only without cameras
        patches = "one patch" if occlusion.cell == 1 else f"{occlusion.cell} x {occlusion.cell} patches"
        self._title(
            "What the cameras see, and what the actions depend on",
            note=f"Blue: mean |change of the chunk|, same noise, without {patches}; {occlusion.method}. "
            f"For scale: another noise changes the chunk by {occlusion.other_noise:.2g}.",
        )
        self._top += 0.16
        high = self._height_for(INNER - BAR_WIDTH - 0.4, 2, 2.2)
        end = self._strip(MARGIN, high, None, 1.0, HEAT, names=True)
        most = max(float(change.max()) for change in occlusion.change.values())
        end = self._strip(end + 0.4, high, occlusion.change, most, CHANGE, names=True)
        self._colour_bar(end + 0.08, high, most, CHANGE, "mean |change|")
        self._top += high

    def camera_maps(self, blocks: Sequence[int]) -> None:
        """One line per block: each group's mean map on each camera, and how its attention divides."""
        self._title(
            "Mean maps by group of rows, in the cross-attention blocks",
            note="Red: probability, with one scale per block. r: rank correlation with the occlusion map "
            "over all patches. Right: how the attention of a row divides, in %.",
        )
        groups = len(self.maps.rows)
        high = self._height_for(INNER - BAR_WIDTH - MASS_WIDTH - 0.45 - 0.15 * groups, groups, 1.9)
        for block in blocks:
            self._top += 0.22
            mean = self.maps.mean(block)
            shown = {
                group: self._on_cameras(mean[rows].mean(axis=0)) for group, rows in self.maps.rows.items()
            }
            most = max(float(heat.max()) for heats in shown.values() for heat in heats.values())
            left = MARGIN
            for group, heats in shown.items():
                rows = self.maps.rows[group]
                count = rows.stop - rows.start
                label = f"block {block}: {group}" + (f" (mean of {count})" if count > 1 else "")
                found = self.maps.agreement(mean[rows].mean(axis=0))
                label += "" if found is None else f", r = {found:.2f}"
                self._text(left, self._top - 0.19, label, fontsize=8.5, color=GROUP_COLOURS[group])
                end = self._strip(left, high, heats, most, HEAT)
                left = max(end + 0.15, left + 2.3)  # room for the label
            self._colour_bar(end + 0.08, high, most, HEAT, "probability")
            self._masses(self._axes(WIDTH - MARGIN - MASS_WIDTH, self._top, MASS_WIDTH, high * 0.72), block)
            self._top += high + 0.05

    def _masses(self, axes: Axes, block: int) -> None:
        """Stacked bars: the attention of each group by camera and kind of token."""
        mean, parts, groups = self.maps.mean(block), self.maps.parts(block), list(self.maps.rows)
        colours = dict(zip((camera.name for camera in self.cameras), CAMERA_COLOURS * 9, strict=False))
        colours |= KIND_COLOURS
        left = np.zeros(len(groups))
        for name, positions in parts.items():
            wide = np.array([mean[rows][:, positions].sum(axis=1).mean() for rows in self.maps.rows.values()])
            ink = "white" if np.dot(to_rgb(colours[name]), (0.3, 0.6, 0.1)) < 0.6 else "black"  # brightness
            axes.barh(groups, wide, left=left, color=colours[name], label=name, height=0.8)
            for row, (start, width) in enumerate(zip(left, wide, strict=True)):
                if width > 0.09:
                    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7, "color": ink}
                    axes.text(start + width / 2, row, f"{100 * width:.0f}", **style)
            left += wide
        axes.set_xlim(0, 1)
        axes.invert_yaxis()
        axes.set_xticks([])
        axes.tick_params(labelsize=7.5, length=0)
        axes.spines[:].set_visible(False)
        place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.45, 0.02)}
        axes.legend(ncols=3, fontsize=7, frameon=False, handlelength=0.8, columnspacing=0.9, **place)

    def named_tokens(self, blocks: Sequence[int]) -> None:
        """Probability on each token that is not an image patch, by block and group."""
        tokens: Sequence[Any] = self.maps.view.layout.tokens
        lines = [(block, group) for block in blocks for group in self.maps.rows]
        positions = [token.position for token in tokens]
        values = np.array(
            [self.maps.mean(block)[self.maps.rows[group]].mean(axis=0)[positions] for block, group in lines]
        )
        left_out = ""
        if len(tokens) > MAX_NAMED_TOKENS:
            kept = np.sort(np.argsort(-values.max(axis=0), kind="stable")[:MAX_NAMED_TOKENS])
            left_out = f"; the {MAX_NAMED_TOKENS} of {len(tokens)} with the most attention"
            values, tokens = values[:, kept], [tokens[index] for index in kept]
        self._title(
            f"Words, special tokens (red) and padding (grey): attention in %{left_out}",
            note="With uniform attention each token has "
            f"{100 / self.maps.view.layout.num_tokens:.2g} %. Special tokens are often attention sinks.",
        )
        wide, high = INNER - 1.1, 0.19 * len(lines)
        axes = self._axes(MARGIN + 1.1, self._top, min(wide, 0.95 * len(tokens)), high)
        axes.imshow(values, aspect="auto", cmap="Greys", vmin=0, vmax=values.max() * 1.3)
        axes.set_yticks(
            range(len(lines)), [f"block {block}: {group}" for block, group in lines], fontsize=7.5
        )
        for label, (_, group) in zip(axes.get_yticklabels(), lines, strict=True):
            label.set_color(GROUP_COLOURS[group])
        upright = len(tokens) > 16
        names = [token.name for token in tokens]
        axes.set_xticks(range(len(tokens)), names, fontsize=8, rotation=90 if upright else 0)
        for label, token in zip(axes.get_xticklabels(), tokens, strict=True):
            label.set_color({"special": KIND_COLOURS["special"], "pad": "#888888"}.get(token.kind, "black"))
        if len(tokens) <= 24:
            for (row, column), value in np.ndenumerate(values):
                colour = "white" if value > 0.7 * values.max() else "black"
                style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5, "color": colour}
                axes.text(column, row, f"{100 * value:.1f}", **style)
        axes.tick_params(length=0)
        longest = max(len(name) for name in names)
        self._top += high + (0.1 + 0.085 * min(longest, 24) if upright else 0.25)

    def token_maps(self, block: int) -> None:
        """The map of every future token on all cameras, with one scale."""
        mean = self.maps.mean(block)[self.maps.rows["future"]][:MAX_TOKENS_DRAWN]
        shown = [self._on_cameras(one) for one in mean]
        most = max(float(heat.max()) for heats in shown for heat in heats.values())
        first = "" if len(mean) == self.maps.num_future_tokens else f", the first {len(mean)}"
        self._title(
            f"Single future tokens{first}: block {block}",
            note=f"Cameras {', '.join(camera.name for camera in self.cameras)}. All maps have one scale, "
            f"up to probability {most:.2g}.",
        )
        across = {1: 16, 2: 8, 3: 8}.get(len(self.cameras), 4)
        apart = 0.1
        high = self._height_for((INNER - apart * (across - 1)) / across, 1, 2.0)
        pitch = (INNER + apart) / across
        for place, heats in enumerate(shown):
            column = place % across
            if column == 0:
                self._top += 0.17 + (high if place else 0.0)
            left = MARGIN + pitch * column
            self._text(left, self._top - 0.14, str(place), fontsize=7.5, color=GROUP_COLOURS["future"])
            self._strip(left, high, heats, most, HEAT, gap=0.02)
        self._top += high

    def matrices(self, blocks: Sequence[int], what: str, *, across: int, height: float) -> None:
        """Whole matrices: all rows by all keys."""
        self._title(
            f"All rows (vertical) by all keys (horizontal): blocks that read the {what}",
            note="Probability, with one scale per block.",
        )
        pitch = INNER / across
        for place, block in enumerate(blocks):
            column = place % across
            if column == 0:
                self._top += 0.2 + (height + 0.3 if place else 0.0)
            left = MARGIN + 0.25 + column * pitch
            axes = self._axes(left, self._top, pitch - 0.95, height)
            mean = self.maps.mean(block)
            drawn = axes.imshow(mean, aspect="auto", cmap=MATRIX_COLOURS, vmin=0)
            axes.set_title(f"block {block}", fontsize=9, pad=3)
            keys = self._runs() if self.maps.reads_vl(block) else list(self.maps.rows.items())
            borders(axes, list(self.maps.rows.items()), down=True)
            borders(axes, keys, down=False)
            bar = self._axes(left + pitch - 0.9, self._top, 0.1, height)
            self._figure.colorbar(drawn, cax=bar)
            bar.tick_params(labelsize=6.5)
        self._top += height + 0.25

    def _runs(self) -> list[tuple[str, slice]]:
        """Cameras and runs of other tokens, by their label below a matrix."""
        runs = [(camera.name, camera.positions) for camera in self.cameras]
        start: int | None = None
        positions = {token.position for token in self.maps.view.layout.tokens}
        for position in range(self.maps.view.layout.num_tokens + 1):
            if position in positions:
                start = position if start is None else start
            elif start is not None:
                runs.append(("other" if position - start > 4 else "", slice(start, position)))
                start = None
        return runs

    def numbers(self) -> None:
        """Entropy and overlap by block, compared with identical, random and unrelated tokens."""
        maps = self.maps
        summaries = [entry for entry in maps.summaries if entry["head"] == MEAN]
        blocks = maps.selection.blocks
        several = maps.num_future_tokens > 1
        notes = [f"{name}: {meaning}." for name, meaning in BASELINES.items()] if several else []
        self._title(
            f"Do the rows attend to different keys? Means over Euler steps {ranges(maps.selection.steps)}",
            note=" ".join(notes),
        )
        self._top += 0.22
        wide, high = (INNER - 1.2) / 3, 2.2
        panels = [
            self._axes(MARGIN + 0.25 + place * (wide + 0.45), self._top, wide, high)
            for place in range(3 if several else 1)
        ]
        places = list(range(len(blocks)))
        alike = [
            [place for place in places if maps.reads_vl(blocks[place])],
            [place for place in places if not maps.reads_vl(blocks[place])],
        ]

        def line(axes: Axes, values: Sequence[float], style: str, colour: str, label: str) -> None:
            """By block; only blocks that read the same keys are joined."""
            for joined in alike:
                axes.plot(joined, [values[place] for place in joined], style, color=colour, markersize=4)
            axes.plot([], [], style, color=colour, markersize=4, label=label)

        def means(group: str, *keys: str) -> list[float]:
            """By block, over the steps."""
            values = []
            for block in blocks:
                found: list[Any] = [e for e in summaries if e["block"] == block and e["group"] == group]
                for key in keys:
                    found = [entry[key] for entry in found]
                values.append(float(np.mean(found)))
            return values

        for group in maps.rows:
            spread = np.exp(means(group, "per_head", "entropy")).tolist()
            line(panels[0], spread, "o-", GROUP_COLOURS[group], group)
        keys = [sum(map(len, maps.parts(block).values())) for block in blocks]
        panels[0].plot(places, keys, "_", color="#888888", markersize=14, label="uniform attention")
        panels[0].set_title("keys that a row attends to in one head: exp(entropy)", fontsize=9)
        panels[0].set_ylim(bottom=0)
        future = GROUP_COLOURS["future"]
        for axes, key, title, identical in zip(
            panels[1:],
            ("jensen_shannon", "distinct"),
            (
                "future tokens: divergence between maps (0 to 1)",
                f"future tokens: distinct maps (1 to {maps.num_future_tokens})",
            ),
            (0.0, 1.0),
            strict=False,
        ):
            for path, style, colour, label in (
                (("per_head", "shuffled"), "x--", "#b79500", "shuffled maps, in one head"),
                (("per_head", "overlap"), "o-", future, "learned tokens, in one head"),
                (("overlap",), "s:", future, "learned tokens, mean of the heads' maps"),
                (("per_head", "redrawn"), "^--", "#8a8a8a", "redrawn tokens, in one head"),
            ):
                line(axes, means("future", *path, key), style, colour, label)
            axes.axhline(identical, color="black", linewidth=0.7, label="identical tokens")
            axes.set_title(title, fontsize=9)
        for axes in panels:
            labels = [f"{block}\n{'vl' if maps.reads_vl(block) else 'rows'}" for block in blocks]
            axes.set_xticks(places, labels, fontsize=7)
            axes.tick_params(axis="y", labelsize=7)
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_ylim(top=1.7 * axes.get_ylim()[1])  # room for the legend
            axes.legend(fontsize=7, frameon=False, loc="upper right")
        self._top += high + 0.4
        self._note("Below the axes: the block and what it reads. Lines join blocks that read the same keys.")

    def _on_cameras(self, keys: Float32Array) -> dict[str, Float32Array]:
        """A row's map ``(T_vl,)`` by camera, ``(rows, columns)`` each."""
        return {
            camera.name: keys[camera.positions].reshape(camera.rows, camera.columns)
            for camera in self.cameras
        }

    def _aspect(self, camera: ViewLayout) -> float:
        """Width by height."""
        picture = self.maps.view.images.get(camera.name)
        return camera.columns / camera.rows if picture is None else picture.shape[1] / picture.shape[0]

    def _height_for(self, wide: float, strips: int, highest: float) -> float:
        """Height of pictures at which ``strips`` strips of all cameras fit next to each other."""
        aspects = sum(self._aspect(camera) for camera in self.cameras)
        gaps = GAP * (len(self.cameras) - 1) * strips
        return min(highest, (wide - gaps) / (aspects * strips))

    def _strip(
        self,
        left: float,
        high: float,
        heats: Mapping[str, Float32Array] | None,
        most: float,
        colours: Colormap,
        *,
        names: bool = False,
        gap: float = GAP,
    ) -> float:
        """All cameras next to each other, with their maps; returns the right edge."""
        wide = [high * self._aspect(camera) for camera in self.cameras]
        total = sum(wide) + gap * (len(wide) - 1)
        axes = self._axes(left, self._top, total, high)  # one for all: axes are slow to create
        axes.set_axis_off()
        start = 0.0
        for camera, width in zip(self.cameras, wide, strict=True):
            heat = None if heats is None else heats[camera.name]
            extent = (start, start + width, high, 0.0)
            picture = self.maps.view.images.get(camera.name)
            show(axes, extent, picture, heat, most, colours, camera.region)
            if names:
                self._text(left + start, self._top - 0.16, camera.name, fontsize=8.5)
            start += width + gap
        axes.set(xlim=(0.0, total), ylim=(high, 0.0), aspect="auto")
        return left + total

    def _colour_bar(self, left: float, high: float, most: float, colours: Colormap, label: str) -> None:
        axes = self._axes(left, self._top, 0.1, high)
        bar = self._figure.colorbar(ScalarMappable(Normalize(0, most or 1.0), colours), cax=axes)
        bar.set_label(label, fontsize=7.5)
        axes.tick_params(labelsize=6.5)
