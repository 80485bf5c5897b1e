"""Makes the pictures of the README from what the commands write.

    saccade rollout --episodes 1 --video --out out/gif python docs/make_pictures.py gif
    out/gif/videos/{reach,push,drawer-open,button-press-topdown,window-open}-0.mp4

    saccade attention --task push --seed 3 --out out/look
    python docs/make_pictures.py map out/look/sheet.png

`gif` joins videos into one looping GIF; frames are scaled down, thinned out and reduced to one palette, so
that the file stays small. `map` cuts out the upper part of a sheet: images, occlusion and the first attention
maps. Needs the extra `sim`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image

IMAGES = Path(__file__).resolve().parent / "images"


def frames(video: Path, every: int, width: int) -> Iterator[Image.Image]:
    """Every `every`-th frame of a video and its last one, `width` pixels wide."""
    with imageio.get_reader(video) as reader:
        pictures = [Image.fromarray(np.asarray(frame)) for frame in reader]
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


def make_map(args: argparse.Namespace) -> None:
    """Writes the upper part of the sheet."""
    with Image.open(args.sheet) as sheet:
        sheet.convert("RGB").crop((0, args.top, sheet.width, args.bottom)).save(args.out, optimize=True)
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
    one = kinds.add_parser("map", help="the upper part of a sheet of attention maps")
    one.add_argument("sheet", type=Path, help="sheet.png of `saccade attention`")
    one.add_argument("--out", type=Path, default=IMAGES / "map.png")
    one.add_argument("--top", type=int, default=105, help="first row of pixels (default: 105)")
    one.add_argument("--bottom", type=int, default=670, help="last row of pixels (default: 670)")
    one.set_defaults(make=make_map)
    args = parser.parse_args()
    args.make(args)


if __name__ == "__main__":
    main()
