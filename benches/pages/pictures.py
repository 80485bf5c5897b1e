r"""Makes the GIF of the README from videos of rollouts, and the diagram of docs/future-tokens.md.

    saccade rollout --episodes 1 --video --out out/gif
    python -m benches.pages.pictures gif \
        out/gif/videos/{reach,push,drawer-open,button-press-topdown,window-open}-0.mp4

    python -m benches.pages.pictures step

`gif` joins videos into one looping GIF; frames are scaled down, thinned out and reduced to one palette, so
that the file stays small. `step` draws one denoising step of N1.5's action head. Needs the lab's extra `sim`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"


def frames(video: Path, every: int, width: int) -> Iterator[Image.Image]:
    """Every `every`-th frame of a video and its last one, `width` pixels wide."""
    pictures = [Image.fromarray(np.asarray(frame)) for frame in imageio.mimread(video, memtest=False)]
    for picture in [*pictures[:-1:every], pictures[-1]]:
        yield picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)


def palette(pictures: list[Image.Image], colours: int) -> Image.Image:
    """One palette for all pictures, from some of them below each other."""
    some = pictures[:: max(1, len(pictures) // 12)]
    column = Image.new("RGB", (some[0].width, sum(picture.height for picture in some)))
    top = 0
    for picture in some:
        column.paste(picture, (0, top))
        top += picture.height
    return column.quantize(colours, Image.Quantize.MEDIANCUT)


def make_gif(args: argparse.Namespace) -> None:
    """Writes the GIF."""
    pictures = [picture for video in args.videos for picture in frames(video, args.every, args.width)]
    colours = palette(pictures, args.colours)
    reduced = [picture.quantize(palette=colours, dither=Image.Dither.NONE) for picture in pictures]
    first, *rest = reduced
    first.save(args.out, save_all=True, append_images=rest, duration=args.frame_ms, loop=0, optimize=True)
    print(f"{args.out}: {len(reduced)} frames, {args.out.stat().st_size / 1e6:.2f} MB")


def make_step(args: argparse.Namespace) -> None:
    """Draws one denoising step, to be read in black and white."""
    picture = Figure(figsize=(9, 5.6), layout="constrained")
    axes = picture.subplots()
    axes.set_xlim(0, 100)
    axes.set_ylim(1, 59)
    axes.axis("off")

    def box(left: float, bottom: float, width: float, height: float, text: str, **style: Any) -> None:
        frame = {"facecolor": "white", "edgecolor": "black", "linewidth": 1, **style}
        axes.add_patch(Rectangle((left, bottom), width, height, **frame))
        axes.text(left + width / 2, bottom + height / 2, text, ha="center", va="center", fontsize=9)

    def arrow(start: tuple[float, float], end: tuple[float, float], **style: Any) -> None:
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "black", **style})

    def rows(left: float, bottom: float, count: int, pitch: float, **style: Any) -> None:
        frame = {"facecolor": "white", "edgecolor": "black", "linewidth": 0.6, **style}
        for place in range(count):
            axes.add_patch(Rectangle((left + pitch * place, bottom), 0.8 * pitch, 3, **frame))

    for bottom, text in ((53, "camera 1"), (47, "camera 2"), (41, "instruction")):
        box(0, bottom, 13, 5, text)
        arrow((13, bottom + 2.5), (17, 49.5))
    box(17, 43, 15, 13, "vision-language\nbackbone\n(runs once)")
    arrow((32, 49.5), (36, 49.5))
    rows(36, 48, 27, 1.05, facecolor="0.85")
    axes.text(66.5, 49.5, "...", ha="center", va="center", fontsize=12)
    rows(69, 48, 29, 1.05, facecolor="0.85")
    axes.text(36, 52.5, "T_vl vision-language tokens: 256 for each camera, and the words", fontsize=9)

    for left, count, style, text in (
        (6, 1, {"facecolor": "0.55"}, "state"),
        (11, 32, {"hatch": "////"}, "32 future tokens: learned, the same for every input"),
        (72, 16, {}, "16 actions, noise at first"),
    ):
        rows(left, 30, count, 1.75, **style)
        axes.text(left, 34, text, fontsize=9, va="bottom")
        rows(left, 8, count, 1.75, **style)
    box(6, 17, 94, 4.5, "odd blocks: the 49 rows attend to each other")
    box(6, 22, 94, 4.5, "")
    axes.text(
        53,
        24.2,
        "even blocks: each of the 49 rows attends to the vision-language tokens",
        ha="center",
        va="center",
        fontsize=9,
    )
    arrow((69.5, 48), (69.5, 26.8), linestyle="--")
    axes.text(2, 21.7, "16 blocks in turn", rotation=90, ha="center", va="center", fontsize=9)
    axes.text(6, 6.2, "the results of state and future rows are not used", fontsize=9, va="top")
    axes.text(72, 6.2, "action rows: how the\nactions must change", fontsize=9, va="top")
    for place in (6.7, 39, 86):
        arrow((place, 29.5), (place, 26.8))
        arrow((place, 16.8), (place, 11.3))
    picture.savefig(args.out, dpi=110, metadata={"Software": None})
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    """Runs one of the two."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(required=True)
    gif = kinds.add_parser("gif", help="the rollout as a GIF")
    gif.add_argument("videos", nargs="+", type=Path, help="MP4 files, in the order in which they are shown")
    gif.add_argument("--out", type=Path, default=IMAGES / "rollout.gif")
    gif.add_argument("--width", type=int, default=480, help="pixels (default: 480)")
    gif.add_argument("--every", type=int, default=2, help="use every n-th frame (default: 2)")
    gif.add_argument("--colours", type=int, default=128, help="size of the palette (default: 128)")
    gif.add_argument("--frame-ms", type=int, default=80, help="duration of a frame (default: 80)")
    gif.set_defaults(make=make_gif)
    step = kinds.add_parser("step", help="one denoising step")
    step.add_argument("--out", type=Path, default=IMAGES / "step.png")
    step.set_defaults(make=make_step)
    args = parser.parse_args()
    args.make(args)


if __name__ == "__main__":
    main()
