"""Small data sets in the layouts of lerobot, written with pyarrow and PyAV alone, not with saccade."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

FPS = 10
SIZE = (48, 64)
TASKS = ("pick the cube", "close the drawer")
#: Steps of each episode; not all alike, and one of a single step.
LENGTHS = (7, 1, 23)

MODALITY = {
    "state": {"arm": {"start": 0, "end": 3}, "hand": {"start": 3, "end": 4}},
    "action": {
        "arm": {"start": 0, "end": 3},
        "hand": {"start": 3, "end": 4, "absolute": False},
        "base": {"start": 1, "end": 2, "original_key": "action.base"},
    },
    "video": {"front": {"original_key": "observation.images.front"}, "wrist": {}},
    "annotation": {
        "human.task_description": {"original_key": "task_index"},
        "human.note": {},
    },
}


def pixels(episode: int, length: int, camera: int) -> npt.NDArray[np.uint8]:
    """Frames of an episode, ``(length, H, W, 3)``: a colour that says which one it is, and noise."""
    rng = np.random.default_rng((episode, camera))
    base = np.zeros((length, *SIZE, 3), np.uint8)
    base[..., 0] = (40 * episode + 8 * np.arange(length)[:, None, None]) % 256
    base[..., 1] = 100 * camera
    base[:, 10:30, 10:30] = rng.integers(0, 256, (length, 20, 20, 3))
    return base


def columns(episode: int, length: int, first: int) -> dict[str, Any]:
    """The columns of an episode but its images."""
    rng = np.random.default_rng(episode)
    steps = np.arange(length)
    return {
        "observation.state": rng.normal(size=(length, 4)).astype(np.float32),
        "action": rng.normal(size=(length, 4)).astype(np.float32),
        "action.base": rng.normal(size=(length, 2)),
        "timestamp": (steps / FPS).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(length, episode),
        "index": first + steps,
        "task_index": np.full(length, episode % 2),
        "annotation.human.note": np.where(steps < length // 2, 1, 0),
    }


def table(given: Mapping[str, npt.NDArray[Any]]) -> Any:
    """A table of columns; vectors are lists."""
    import pyarrow as pa

    made = {}
    for name, values in given.items():
        kind = pa.from_numpy_dtype(values.dtype)
        made[name] = (
            pa.array(values)
            if values.ndim == 1
            else pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1), kind), values.shape[1])
        )
    return pa.table(made)


def write_video(path: Path, frames: Sequence[npt.NDArray[np.uint8]], keyframes: int = 5) -> None:
    """Writes a video of H.264 with a keyframe every few frames and B-frames between them."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"g": str(keyframes), "bf": "2"})
        stream.height, stream.width = SIZE
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        container.mux(stream.encode())


def encode(path: Path, codec: str, options: dict[str, str], frames: npt.NDArray[np.uint8]) -> None:
    """Writes a video of frames at twice their size."""
    import av

    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=FPS, options=options)
        stream.height, stream.width, stream.pix_fmt = 2 * SIZE[0], 2 * SIZE[1], "yuv420p"
        for pixels in frames.repeat(2, axis=1).repeat(2, axis=2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        container.mux(stream.encode())


def decoded(path: Path) -> list[tuple[float, npt.NDArray[np.uint8]]]:
    """All frames of a video with their times, decoded from its start."""
    import av

    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        return [
            (float(frame.pts * stream.time_base), frame.to_ndarray(format="rgb24"))
            for frame in container.decode(stream)
        ]


def info(version: str, cameras: str = "video") -> dict[str, Any]:
    """``meta/info.json``."""
    camera = {"dtype": cameras, "shape": [*SIZE, 3], "names": ["height", "width", "channels"]}
    features: dict[str, Any] = {f"observation.images.{name}": camera for name in ("front", "wrist")}
    for name, values in columns(0, 2, 0).items():
        shape = list(values.shape[1:]) or [1]
        features[name] = {"dtype": str(values.dtype), "shape": shape, "names": None}
    is_old = version != "v3.0"
    part = "{episode_chunk:03d}" if is_old else "{chunk_index:03d}"
    file = "episode_{episode_index:06d}" if is_old else "file-{file_index:03d}"
    video = f"chunk-{part}/{{video_key}}" if is_old else f"{{video_key}}/chunk-{part}"
    return {
        "codebase_version": version,
        "robot_type": "so100",
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "total_tasks": len(TASKS),
        "chunks_size": 2 if is_old else 1000,
        "fps": FPS,
        "data_path": f"data/chunk-{part}/{file}.parquet",
        "video_path": f"videos/{video}/{file}.mp4",
        "features": features,
    }


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def write_lines(path: Path, rows: Sequence[Any]) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def statistics(values: npt.NDArray[Any]) -> dict[str, list[float]]:
    """The statistics of a column, or of frames by colour, as lerobot writes them."""
    rows = values.astype(np.float64)
    axes: tuple[int, ...] = (0,)
    if values.ndim == 4:
        rows, axes = np.moveaxis(rows, -1, 1) / 255, (0, 2, 3)
    found = {
        name: getattr(np, name)(rows, axis=axes, keepdims=True)[0].tolist()
        for name in ("min", "max", "mean", "std")
    }
    found = {name: value if isinstance(value, list) else [value] for name, value in found.items()}
    return {**found, "count": [len(values)]}


def all_statistics(episode: int, length: int, first: int) -> dict[str, Any]:
    """The statistics of an episode."""
    found = {name: statistics(values) for name, values in columns(episode, length, first).items()}
    for camera, name in enumerate(("front", "wrist")):
        found[f"observation.images.{name}"] = statistics(pixels(episode, length, camera))
    return found


def write_old(root: Path, version: str = "v2.1", modality: Any = MODALITY) -> Path:
    """A data set of v2.0 or v2.1: a file for each episode, two episodes in a chunk."""
    import pyarrow.parquet as pq

    meta, first = root / "meta", 0
    write_json(meta / "info.json", info(version))
    if modality is not None:
        write_json(meta / "modality.json", modality)
    write_lines(
        meta / "tasks.jsonl", [{"task_index": place, "task": text} for place, text in enumerate(TASKS)]
    )
    write_lines(
        meta / "episodes.jsonl",
        [
            {"episode_index": episode, "tasks": [TASKS[episode % 2]], "length": length}
            for episode, length in enumerate(LENGTHS)
        ],
    )
    starts = np.cumsum([0, *LENGTHS]).tolist()
    if version == "v2.1":
        stats = [
            {"episode_index": episode, "stats": all_statistics(episode, length, starts[episode])}
            for episode, length in enumerate(LENGTHS)
        ]
        write_lines(meta / "episodes_stats.jsonl", stats)
    else:
        parts = [columns(*one) for one in zip(range(len(LENGTHS)), LENGTHS, starts, strict=False)]
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        write_json(meta / "stats.json", {name: statistics(values) for name, values in joined.items()})
    for episode, length in enumerate(LENGTHS):
        chunk = f"chunk-{episode // 2:03d}"
        path = root / "data" / chunk / f"episode_{episode:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table(columns(episode, length, first)), path)
        first += length
        for camera, name in enumerate(("front", "wrist")):
            video = root / "videos" / chunk / f"observation.images.{name}" / f"episode_{episode:06d}.mp4"
            write_video(video, list(pixels(episode, length, camera)))
    return root


def write_new(root: Path, cameras: str = "video", modality: Any = MODALITY) -> Path:
    """A data set of v3.0: all episodes in one Parquet file, and in one video of each camera."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    meta = root / "meta"
    about = info("v3.0", cameras)
    if cameras == "image":
        about["video_path"] = None
    write_json(meta / "info.json", about)
    if modality is not None:
        write_json(meta / "modality.json", modality)
    pq.write_table(
        pa.table({"task_index": list(range(len(TASKS))), "__index_level_0__": list(TASKS)}),
        meta / "tasks.parquet",
    )
    rows, tables, first = [], [], 0
    for episode, length in enumerate(LENGTHS):
        made = table(columns(episode, length, first))
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [TASKS[episode % 2]],
            "length": length,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": first,
            "dataset_to_index": first + length,
            "stats/action/mean": [0.0],
        }
        for camera, name in enumerate(("front", "wrist")):
            key = f"observation.images.{name}"
            if cameras == "image":
                stored = [{"bytes": png(frame), "path": None} for frame in pixels(episode, length, camera)]
                made = made.append_column(key, pa.array(stored))
                continue
            row[f"videos/{key}/chunk_index"] = 0
            row[f"videos/{key}/file_index"] = 0
            row[f"videos/{key}/from_timestamp"] = float(Fraction(first, FPS))
            row[f"videos/{key}/to_timestamp"] = float(Fraction(first + length, FPS))
        tables.append(made)
        rows.append(row)
        first += length
    for path, made in (
        (meta / "episodes" / "chunk-000" / "file-000.parquet", pa.Table.from_pylist(rows)),
        (root / "data" / "chunk-000" / "file-000.parquet", pa.concat_tables(tables)),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(made, path, row_group_size=5)
    if cameras == "video":
        for camera, name in enumerate(("front", "wrist")):
            frames = [
                frame for episode, length in enumerate(LENGTHS) for frame in pixels(episode, length, camera)
            ]
            path = root / "videos" / f"observation.images.{name}" / "chunk-000" / "file-000.mp4"
            write_video(path, frames)
    return root


def png(frame: npt.NDArray[np.uint8]) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(frame).save(file, "png")
    return file.getvalue()
