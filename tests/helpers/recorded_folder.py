"""Recordings in memory as a data set in a folder, written with pyarrow alone, not with saccade."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers.recorded_cases import Recorded


def written(data: Recorded, root: Path) -> Path:
    """The recordings as a LeRobotDataset v2.1 with a ``modality.json``, written by pyarrow alone."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    from PIL import Image

    def png(frame: Any) -> dict[str, Any]:
        stream = io.BytesIO()
        Image.fromarray(frame).save(stream, "PNG")
        return {"bytes": stream.getvalue(), "path": None}

    first = data.seen[0][0]
    cameras, states = list(first["video"]), list(first["state"])
    height, width = first["video"][cameras[0]].shape[-3:-1]
    texts = list(dict.fromkeys(told(one) for episode in data.seen for one in episode))
    meta = root / "meta"
    meta.mkdir(parents=True)
    lines, index = [], 0
    for episode, steps in enumerate(data.seen):
        path = root / "data" / "chunk-000" / f"episode_{episode:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        state = [np.concatenate([one["state"][key][0, 0] for key in states]).tolist() for one in steps]
        action = np.concatenate([data.done[key][episode] for key in states], axis=-1).tolist()
        count = len(steps)
        columns: dict[str, Any] = {
            f"observation.images.{camera}": [png(one["video"][camera][0, 0]) for one in steps]
            for camera in cameras
        }
        columns |= {
            "observation.state": pa.array(state, pa.list_(pa.float32(), len(state[0]))),
            "action": pa.array(action, pa.list_(pa.float32(), len(action[0]))),
            "timestamp": pa.array([step / 10 for step in range(count)], pa.float32()),
            "frame_index": list(range(count)),
            "episode_index": [episode] * count,
            "index": list(range(index, index + count)),
            "task_index": [texts.index(told(one)) for one in steps],
        }
        pq.write_table(pa.table(columns), path)
        index += count
        lines.append({"episode_index": episode, "tasks": [told(steps[0])], "length": count})
    vector = {"dtype": "float32", "names": None}
    scalars = {
        name: {"dtype": "int64", "shape": [1]}
        for name in ("frame_index", "episode_index", "index", "task_index")
    }
    features = {
        **{f"observation.images.{name}": {"dtype": "image", "shape": [height, width, 3]} for name in cameras},
        "observation.state": {**vector, "shape": [len(state[0])]},
        "action": {**vector, "shape": [len(action[0])]},
        "timestamp": {"dtype": "float32", "shape": [1]},
        **scalars,
    }
    about = {
        "codebase_version": "v2.1",
        "fps": 10,
        "total_episodes": len(data),
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": features,
    }
    sizes = [first["state"][key].shape[-1] for key in states]
    ends = np.cumsum(sizes).tolist()
    parts = {
        key: {"start": end - size, "end": end} for key, size, end in zip(states, sizes, ends, strict=True)
    }
    modality = {
        "state": parts,
        "action": parts,
        "video": {camera: {"original_key": f"observation.images.{camera}"} for camera in cameras},
        "annotation": {"human.action.task_description": {"original_key": "task_index"}},
    }
    (meta / "info.json").write_text(json.dumps(about))
    (meta / "modality.json").write_text(json.dumps(modality))
    (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    rows = [{"task_index": place, "task": text} for place, text in enumerate(texts)]
    (meta / "tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return root


def told(observation: Mapping[str, Any]) -> str:
    """The instruction of an observation."""
    (text,) = observation["language"].values()
    return str(text[0][0])
