"""vla.cpp's N1.5 and N1.7, through the C interface of its library, `include/vla.h`."""

from __future__ import annotations

import ctypes
import fcntl
import os
import subprocess
import sys
from collections.abc import Callable
from ctypes import POINTER, byref, c_float, c_int32, c_int64, c_void_p
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benches.peers.engines import Built, Task
from benches.peers.policy_inputs import VIEWS, Given, given

FLOAT32_RGB = 1
CONVERTERS = {"n1.5": "convert_gr00t_n1_5_to_gguf.py", "n1.7": "convert_gr00t_n1_7_to_gguf.py"}


class Image(ctypes.Structure):
    """`vla_image`."""

    _fields_ = (("data", c_void_p), ("width", c_int32), ("height", c_int32), ("format", c_int32))


class Inputs(ctypes.Structure):
    """`vla_inputs`."""

    _fields_ = (
        ("images", POINTER(Image)),
        ("n_images", c_int32),
        ("image_embeddings", POINTER(c_float)),
        ("n_image_views", c_int32),
        ("tokens", POINTER(c_int32)),
        ("n_tokens", c_int32),
        ("state", POINTER(c_float)),
        ("noise", POINTER(c_float)),
        ("attention_mask", POINTER(c_int32)),
        ("n_attention_mask", c_int32),
        ("timing_detail", c_int32),
    )


def build(task: Task) -> Built:
    """Options: `weights` is `BF16`, its default, or a type that its script packs to.

    Only the published size.
    """
    folder = Path(os.environ.get("SACCADE_PEERS_VLA") or "vla")
    if not (folder / "libvla.so").exists():
        raise FileNotFoundError(
            f"{folder}/libvla.so is not there; make bench-peers VLA_SOURCE=CLONE builds it from "
            "github.com/VinRobotics/vla.cpp"
        )
    weights = packed(task, folder)
    one = given(task.arrays, VIEWS[0])
    # It reads both when it loads.
    os.environ["VLA_GR00T_EMBODIMENT"] = str(one.embodiment_id)
    os.environ["VLA_N_THREADS"] = str(task.case.threads)
    library = opened(folder / "libvla.so")
    model = library.vla_model_load(None, os.fsencode(weights), None)
    if not model:
        raise RuntimeError("vla_model_load failed")
    shape = one.noise.shape[1:]
    works: dict[str, Callable[[], Any]] = {
        work: partial(chunk, library, model, arguments(given(task.arrays, views)), shape)
        for work, views in zip(task.case.works, VIEWS, strict=True)
    }
    version = (folder / "version.txt").read_text().strip()
    return Built(works, lambda: np.stack([work() for work in works.values()]), notes=version, is_warm=True)


def packed(task: Task, folder: Path) -> Path:
    """The checkpoint in its format, 5 to 6 GB, or packed, written by its own scripts if it is not there."""
    weights = task.options["weights"]
    with (task.graphs / "vla.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        whole = task.graphs / "vla-BF16.gguf"
        script = folder / "scripts" / CONVERTERS[task.case.release]
        written(whole, folder, script, "--ckpt", task.source.absolute())
        if weights == "BF16":
            return whole.absolute()
        narrow = task.graphs / f"vla-{weights}.gguf"
        script = folder / "scripts" / "quantize_gguf.py"
        written(narrow, folder, script, "--type", weights, "--vision", "--in", whole.absolute())
        return narrow.absolute()


def written(path: Path, folder: Path, script: Path, *options: str | Path) -> None:
    """Runs a script that writes to `--out`, unless the file is there."""
    if path.exists():
        return
    part = path.with_name(f"part-{path.name}").absolute()
    environment = {**os.environ, "PYTHONPATH": str(folder / "gguf-py")}
    command = [sys.executable, *map(str, (script, *options, "--out", part))]
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    part.rename(path)


def opened(path: Path) -> Any:
    """The library with the types of its functions."""
    library: Any = ctypes.CDLL(str(path.absolute()))
    library.vla_model_load.restype = c_void_p
    library.vla_predict.argtypes = (c_void_p, POINTER(Inputs), POINTER(POINTER(c_float)), POINTER(c_int64))
    library.vla_free_actions.argtypes = (POINTER(c_float),)
    return library


def arguments(one: Given) -> tuple[Inputs, list[Any]]:
    """The inputs of a call, and what must live as long."""
    # Pixels from 0 to 1, rows of RGB; the library maps them back to -1 to 1.
    views = one.pixels if one.grids is None else unpatched(one.pixels, one.grids)
    frames = [np.ascontiguousarray((view.transpose(1, 2, 0) + 1) / 2, np.float32) for view in views]
    images = (Image * len(frames))(
        *(Image(frame.ctypes.data, frame.shape[1], frame.shape[0], FLOAT32_RGB) for frame in frames)
    )
    tokens = np.ascontiguousarray(one.ids[0], np.int32)
    state, noise = (np.ascontiguousarray(values, np.float32) for values in (one.state, one.noise))
    held = Inputs(
        images=images,
        n_images=len(frames),
        tokens=tokens.ctypes.data_as(POINTER(c_int32)),
        n_tokens=len(tokens),
        state=state.ctypes.data_as(POINTER(c_float)),
        noise=noise.ctypes.data_as(POINTER(c_float)),
    )
    return held, [frames, images, tokens, state, noise]


def unpatched(patches: NDArray[np.float32], grids: NDArray[np.int64]) -> NDArray[np.float32]:
    """The views `(V, 3, side, side)` that N1.7's patches, of which 2 x 2 follow each other, were cut from."""
    ((_, rows, columns),) = np.unique(grids, axis=0)
    side = round((patches.shape[1] / 6) ** 0.5)  # a patch has three colours, twice
    cut = patches.reshape(-1, rows // 2, columns // 2, 2, 2, 3, 2, side, side)[:, :, :, :, :, :, 0]
    views: NDArray[np.float32] = cut.transpose(0, 5, 1, 3, 6, 2, 4, 7).reshape(
        -1, 3, rows * side, columns * side
    )
    return views


def chunk(
    library: Any, model: int, prepared: tuple[Inputs, list[Any]], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """One call; normalised actions `(horizon, action_dim)`."""
    actions, number = POINTER(c_float)(), c_int64()
    status = library.vla_predict(model, byref(prepared[0]), byref(actions), byref(number))
    if status != 0:
        raise RuntimeError(f"vla_predict failed with status {status}")
    try:
        return np.ctypeslib.as_array(actions, (number.value,)).reshape(shape).copy()
    finally:
        library.vla_free_actions(actions)
