"""How often a robot's camera shows the same pixels again: where the exact reuse of views applies.

    python -m benches.unchanged_views mujoco=out/demos libero=out/libero-demos

Takes recordings of `saccade demos` (a folder for each task, files of episodes) under names, and writes
`benches/results/unchanged-views.json` and the rows of a table for docs/real-time.md.

A backbone compares what the processor made of a frame, 224 x 224 pixels, so this does too. Each observation
is compared with the one that a policy would have seen before it, `EVERY` recorded frames earlier. Recordings
are of rendered scenes without noise. `NOISE` adds that of a camera to both: normal, independent in every
value, and rounded to whole levels.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from benches.pages.report import require_commit
from benches.peers import machine
from saccade._internal.arrays import UInt8Array
from saccade._internal.files import write_json
from saccade_lab.libero.checkpoint import CAMERAS
from saccade_lab.sim import demos

RECORD = Path(__file__).parent / "results" / "unchanged-views.json"

#: Recorded frames from one observation to the next. 0 is a scene that stands still: each frame is seen twice.
EVERY = (0, 1, 4)
#: Standard deviations of a camera's noise, in levels of 256.
NOISE = (0.0, 0.1, 0.25, 0.5)
#: Episodes of each task that are read: the first ones.
EPISODES = 1


@dataclass
class Counts:
    """Of one recording, interval and noise."""

    recording: str
    control_steps: int
    """Control steps from one observation to the next."""
    noise: float
    """Standard deviation, in levels of 256."""
    observations: int = 0
    """Pairs of an observation and the one before it."""
    all_same: int = 0
    """Observations with every view as before: nothing of the backbone is computed again."""
    some_same: int = 0
    """Observations with at least one view as before."""
    same: dict[str, int] = field(default_factory=dict)
    """Views as before, by camera."""


def episodes(folder: Path) -> Iterator[tuple[list[str], int, UInt8Array]]:
    """Names of the cameras, control steps between frames, and images ``(frames, cameras, H, W, 3)``."""
    for settings in sorted(folder.glob("*/recording.json")):
        said = json.loads(settings.read_text())
        for path in sorted(settings.parent.glob("[0-9]*.npz"))[:EPISODES]:
            images = demos.load(path).images
            names = [camera["name"] for camera in said["cameras"]] if "cameras" in said else list(CAMERAS)
            yield names, int(said["frame_stride"]), images


def prepared(processor: saccade.Processor, images: UInt8Array) -> list[list[bytes]]:
    """What the backbone gets of each frame and camera, as bytes that are equal where the pixels are."""
    found = []
    for views in images:
        pixels = np.asarray(processor(list(views), "open the drawer").pixel_values)
        found.append([view.tobytes() for view in pixels.reshape(len(views), -1)])
    return found


def noisy(images: UInt8Array, deviation: float, rng: np.random.Generator) -> UInt8Array:
    """Images with independent normal noise in every value, rounded and clipped to 0..255."""
    if deviation == 0.0:
        return images
    added = images + deviation * rng.standard_normal(images.shape, np.float32)
    return np.clip(np.rint(added), 0, 255).astype(np.uint8)


def count(name: str, folder: Path) -> list[Counts]:
    """Counts of one recording, for each interval and noise."""
    # The processor of N1.5 by Isaac-GR00T; the tokenizer does not matter.
    processor = saccade.Processor("n1.5", saccade.demo_checkpoint() / "tokenizer.json", preprocessing="isaac")
    found: dict[tuple[int, float], Counts] = {}
    rng = np.random.default_rng(0)
    for cameras, stride, images in episodes(folder):
        for deviation in NOISE:
            views, again = (prepared(processor, noisy(images, deviation, rng)) for _ in range(2))
            for every in EVERY:
                row = found.setdefault((every, deviation), Counts(name, every * stride, deviation))
                for before, now in zip(views, again[every:], strict=False):
                    same = [one == other for one, other in zip(before, now, strict=True)]
                    row.observations += 1
                    row.all_same += all(same)
                    row.some_same += any(same)
                    for camera, is_same in zip(cameras, same, strict=True):
                        row.same[camera] = row.same.get(camera, 0) + is_same
    if not found:
        raise FileNotFoundError(f"{folder}: no recording of `saccade demos`")
    return list(found.values())


def table(rows: list[Mapping[str, Any]]) -> str:
    """Markdown: a row for each recording and interval, a column for each noise.

    A cell is the share of observations with at least one view as before.
    """
    by_interval: dict[tuple[str, int], dict[float, Mapping[str, Any]]] = {}
    for row in rows:
        by_interval.setdefault((row["recording"], row["control_steps"]), {})[row["noise"]] = row
    lines = [
        "| recording | control steps apart | observations |" + "".join(f" noise {one:g} |" for one in NOISE),
        "|---|---|---|" + "---|" * len(NOISE),
    ]
    for (name, steps), by_noise in by_interval.items():
        cells = [f"{row['some_same'] / row['observations']:.1%}" for row in by_noise.values()]
        count = by_noise[0.0]["observations"]
        lines.append(f"| {name} | {steps} | {count} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Counts, writes the record and prints the table."""
    parser = argparse.ArgumentParser(prog="python -m benches.unchanged_views", description=__doc__)
    parser.add_argument("recordings", nargs="+", metavar="NAME=DIR")
    parser.add_argument("--out", type=Path, default=RECORD)
    args = parser.parse_args(arguments)
    named = [(word, *word.partition("=")) for word in args.recordings]
    for word, name, _, folder in named:
        if not (name and folder):
            parser.error(f"expected NAME=DIR, got {word!r}")
    here = machine.describe()
    require_commit(here, args.out)
    rows: list[Mapping[str, Any]] = []
    for _, name, _, folder in named:
        rows += [asdict(row) for row in count(name, Path(folder))]
    write_json(args.out, {"machine": here, "episodes_of_a_task": EPISODES, "rows": rows})
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
