"""Ways to damage a data set: each changes the files in a folder that ``dataset_cases`` wrote."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from tests.helpers import dataset_cases as cases

STEPS = "data/chunk-000/file-000.parquet"
OLD_STEPS = "data/chunk-001/episode_000002.parquet"
OLD_VIDEO = "videos/chunk-001/observation.images.front/episode_000002.mp4"
VIDEO = "videos/observation.images.front/chunk-000/file-000.mp4"

Change = Callable[[Path], object]


def edited(name: str, change: Callable[[Any], Any]) -> Change:
    """Changes a JSON file."""

    def apply(root: Path) -> None:
        values = json.loads((root / name).read_text())
        found = change(values)
        (root / name).write_text(json.dumps(values if found is None else found))

    return apply


def cut(name: str, share: float) -> Change:
    """Keeps the beginning of a file."""

    def apply(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(share * len(content))])

    return apply


def rewritten(name: str, column: str, change: Callable[[Any], Any]) -> Change:
    """Changes a column of a Parquet file, or removes it if there is none any more."""

    def apply(root: Path) -> None:
        table = pq.read_table(root / name)
        place = table.column_names.index(column)
        values = change(table.column(column).to_pylist())
        table = (
            table.remove_column(place)
            if values is None
            else table.set_column(place, column, pa.array(values))
        )
        pq.write_table(table, root / name)

    return apply


def lines(name: str, change: Callable[[list[Any]], list[Any]]) -> Change:
    """Changes the objects of a JSON Lines file."""

    def apply(root: Path) -> None:
        values = [json.loads(line) for line in (root / name).read_text().splitlines()]
        cases.write_lines(root / name, change(values))

    return apply


def put(place: int, value: Any) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [*values[:place], value, *values[place + 1 :]]


def dangling(name: str) -> Change:
    """A link to nothing, as a cache of downloads has it that was cleared in part."""

    def apply(root: Path) -> None:
        (root / name).unlink(missing_ok=True)
        (root / name).symlink_to(root / "nothing")

    return apply


def pipe(name: str) -> Change:
    """A pipe that nobody writes to, so that reading it would never end."""

    def apply(root: Path) -> None:
        (root / name).unlink()
        os.mkfifo(root / name)

    return apply


def png(mode: str) -> bytes:
    stream = io.BytesIO()
    Image.new(mode, cases.SIZE[::-1]).save(stream, "PNG")
    return stream.getvalue()


def shorter_video(root: Path) -> None:
    """The last frames of an episode are missing from its video, which is otherwise whole."""
    cases.write_video(root / OLD_VIDEO, list(cases.pixels(2, 20, 0)))


def shifted_video(root: Path) -> None:
    """The video runs at another rate than the steps."""
    import av

    with av.open(str(root / OLD_VIDEO), "w") as container:
        stream: Any = container.add_stream("libx264", rate=9)
        stream.height, stream.width = cases.SIZE
        for frame in cases.pixels(2, 23, 0):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        container.mux(stream.encode())


def damaged_video(root: Path) -> None:
    """Some bytes within the second group of frames, of steps 5 to 9, are others."""
    import av

    with av.open(str(root / OLD_VIDEO)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    place = (packets[5].pos or 0) + packets[5].size // 2
    content = bytearray((root / OLD_VIDEO).read_bytes())
    content[place : place + 64] = b"\xff" * 64
    (root / OLD_VIDEO).write_bytes(content)


def small_video(root: Path) -> None:
    """The frames have another size than info.json says."""
    import av

    with av.open(str(root / OLD_VIDEO), "w") as container:
        stream: Any = container.add_stream("libx264", rate=cases.FPS)
        stream.height, stream.width = 32, 32
        for _ in range(23):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), "rgb24")))
        container.mux(stream.encode())
