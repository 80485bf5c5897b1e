"""One observation as the head takes it: from the simulator, or from a file of backbone features."""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.checkpoints import read_tensors
from saccade.config import HeadConfig
from saccade.errors import CheckpointError, InputError, ShapeError
from saccade.maps import layout as layouts
from saccade.maps.layout import Layout
from saccade.maps.occlusion import BlankedPixels, DroppedPositions, Occluder
from saccade.sim.policy import EMBODIMENT_ID, Policy

Float32Array = npt.NDArray[np.float32]
UInt8Array = npt.NDArray[np.uint8]

REQUIRED = ("backbone_features", "state", "embodiment_id")
OPTIONAL = ("noise", "input_ids", "image_mask", "attention_mask", "images", "tokens", "drop_vl", "episode")


@dataclass(frozen=True)
class Inputs:
    """One observation.

    Attributes:
        title: What it is, on one line.
        source: The same for JSON.
        features: `(1, T_vl, context_dim)`.
        state: `(1, state_dim)` or `(1, history, state_dim)`, normalised.
        embodiment_id: Of the robot.
        noise: `(1, horizon, encoder_action_dim)`, what the chunk starts from.
        layout: What the positions are.
        images: By camera name, `(H, W, 3)`; empty if there are no pictures to draw on.
        occluder: Takes patches away.
    """

    title: str
    source: dict[str, Any]
    features: Float32Array
    state: Float32Array
    embodiment_id: int
    noise: Float32Array
    layout: Layout
    images: dict[str, UInt8Array]
    occluder: Occluder


@dataclass(frozen=True)
class LayoutOptions:
    """How to find the image tokens in a file of features.

    Attributes:
        text: A layout written by hand, see `layout.parse_layout`; it comes before what the file says.
        grid: Rows and columns of a picture.
        image_token_index: The number of the token that stands for one patch.
    """

    text: str | None = None
    grid: tuple[int, int] | None = None
    image_token_index: int = layouts.IMAGE_TOKEN_INDEX


def from_simulator(policy: Policy, task: str, seed: int, control_steps: int) -> Inputs:
    """What the policy sees after so many control steps of a rollout, with the noise of that rollout.

    Raises:
        InputError: the episode ends before that.
    """
    from saccade.sim.rollout import environment_for
    from saccade.sim.tasks import TASKS

    rng = np.random.default_rng((list(TASKS).index(task), seed))
    with contextlib.closing(environment_for(policy, task)) as environment:
        environment.restart(seed)
        steps = 0
        while True:
            observation = environment.observe()
            noise = policy.noise(rng)
            if steps == control_steps:
                break
            chunk = policy.act(observation, noise=noise)
            for action in chunk.actions[: min(policy.config.execute_steps, control_steps - steps)]:
                success = environment.advance(action).success
                steps += 1
                if steps < control_steps and (success or steps == environment.task.max_steps):
                    raise InputError(
                        f"--after: given {control_steps}, but the episode {task} {seed} ends after "
                        f"{steps} steps"
                    )
    instruction = observation["instruction"]
    cameras = [camera.name for camera in policy.config.cameras]
    return Inputs(
        title=f'{task}, seed {seed}, after {control_steps} control steps: "{instruction}"',
        source={
            "kind": "simulator",
            "task": task,
            "seed": seed,
            "control_steps": control_steps,
            "instruction": instruction,
        },
        features=policy.features(observation),
        state=policy.state(observation),
        embodiment_id=EMBODIMENT_ID,
        noise=noise,
        layout=layouts.of_policy(policy.config.backbone, cameras, policy.config.vocabulary, instruction),
        images={name: observation["images"][name] for name in cameras},
        occluder=BlankedPixels(policy, observation, noise),
    )


def from_file(path: Path, config: HeadConfig, *, row: int, options: LayoutOptions, seed: int) -> Inputs:
    """One observation of a file of backbone features.

    Args:
        path: `.npz` or `.safetensors`, see `read_arrays`.
        config: of the head that will take them.
        row: which of the file's observations.
        options: where its image tokens are.
        seed: of the noise, if the file has none.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: arrays are missing, or the layout cannot be told.
        ShapeError: sizes that do not fit the head or each other.
    """
    arrays = read_arrays(path)
    given = head_inputs(path, arrays, config)
    batch, num_tokens, _ = given.features.shape
    if not 0 <= row < batch:
        raise InputError(f"--row: given {row}, {path} has rows 0 to {batch - 1}")

    def of_row(name: str, shape: tuple[int, ...]) -> npt.NDArray[Any] | None:
        """The row of an array `(batch, *shape)`; -1 is any size. One row may leave out the batch axis."""
        if name not in arrays:
            return None
        array = np.asarray(arrays[name])
        if batch == 1 and array.ndim == len(shape):
            array = array[None]
        sizes = (batch, *shape)
        if array.ndim != len(sizes) or any(
            size not in (-1, given) for given, size in zip(array.shape, sizes, strict=True)
        ):
            shown = ", ".join("any" if size < 0 else str(size) for size in sizes)
            raise ShapeError(f"{path}: {name}: shape {array.shape}, expected ({shown})")
        chosen: npt.NDArray[Any] = array[row]
        return chosen

    names = of_row("tokens", (num_tokens,))
    layout = _layout(
        num_tokens,
        options,
        input_ids=of_row("input_ids", (num_tokens,)),
        image_mask=as_mask(path, "image_mask", of_row("image_mask", (num_tokens,))),
        attention_mask=as_mask(path, "attention_mask", of_row("attention_mask", (num_tokens,))),
        names=None if names is None else [str(name) for name in names],
        path=path,
    )
    pictures = of_row("images", (len(layout.cameras), -1, -1, 3))
    if pictures is not None and pictures.dtype != np.uint8:
        raise InputError(f"{path}: images: expected uint8, got {pictures.dtype}")
    dropped = as_mask(path, "drop_vl", of_row("drop_vl", (num_tokens,)))
    if dropped is not None and dropped.any():
        raise InputError(f"{path}: drop_vl: maps are of all positions, expected none dropped in row {row}")
    chosen = slice(row, row + 1)
    embodiment_id = int(given.embodiment_ids[row])
    features, state = given.features[chosen], given.state[chosen]
    if given.noise is None:
        shape = (1, config.action_horizon, config.encoder_action_dim)
        noise = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
    else:
        noise = np.asarray(given.noise[chosen], np.float32)
    return Inputs(
        title=f"{path.name}, row {row} of {batch}, embodiment {embodiment_id}",
        source={
            "kind": "features",
            "file": path.name,
            "row": row,
            "embodiment_id": embodiment_id,
            "noise": "from the file" if "noise" in arrays else f"seed {seed}",
        },
        features=features,
        state=state,
        embodiment_id=embodiment_id,
        noise=noise,
        layout=layout,
        images={}
        if pictures is None
        else {camera.name: picture for camera, picture in zip(layout.cameras, pictures, strict=True)},
        occluder=DroppedPositions(features, state, embodiment_id, noise),
    )


@dataclass(frozen=True)
class HeadInputs:
    """All observations of a file, as the head takes them.

    Attributes:
        features: `(batch, T_vl, context_dim)`.
        state: `(batch, state_dim)` or `(batch, history, state_dim)`.
        embodiment_ids: `(batch,)`.
        noise: `(batch, horizon, encoder_action_dim)`, or None.
    """

    features: npt.NDArray[Any]
    state: npt.NDArray[Any]
    embodiment_ids: npt.NDArray[np.int64]
    noise: npt.NDArray[Any] | None


def head_inputs(path: Path, arrays: Mapping[str, npt.NDArray[Any]], config: HeadConfig) -> HeadInputs:
    """What the head takes of a file that `read_arrays` read.

    Raises:
        InputError, ShapeError: sizes or embodiments that do not fit the head or each other.
    """
    features = np.asarray(arrays["backbone_features"])
    if features.ndim != 3 or features.shape[2] != config.context_dim:
        raise ShapeError(
            f"{path}: backbone_features: shape {features.shape}, the checkpoint expects (batch, T_vl, "
            f"{config.context_dim})"
        )
    batch = len(features)
    if not features.size:
        raise InputError(f"{path}: backbone_features: shape {features.shape}, expected no empty axis")
    embodiments = np.asarray(arrays["embodiment_id"])
    if embodiments.dtype.kind not in "iu" or embodiments.size not in (1, batch):
        raise InputError(f"{path}: embodiment_id: expected an integer, or one for each of {batch} rows")
    if not 0 <= int(embodiments.min()) <= int(embodiments.max()) < config.num_embodiments:
        raise InputError(
            f"{path}: embodiment_id: given {embodiments.min()} to {embodiments.max()}, the checkpoint has 0 "
            f"to {config.num_embodiments - 1}"
        )
    state = np.asarray(arrays["state"])
    shapes: list[tuple[int, ...]] = [(batch, config.state_history, config.state_dim)]
    if config.state_history == 1:
        shapes.insert(0, (batch, config.state_dim))
    if state.shape not in shapes:
        expected = " or ".join(map(str, shapes))
        raise ShapeError(f"{path}: state: shape {state.shape}, expected {expected}")
    noise = None
    if "noise" in arrays:
        shape = (batch, config.action_horizon, config.encoder_action_dim)
        noise = np.asarray(arrays["noise"])
        if batch == 1 and noise.ndim == 2:
            noise = noise[None]
        if noise.shape != shape:
            raise ShapeError(f"{path}: noise: shape {noise.shape}, expected {shape}")
    embodiment_ids = np.broadcast_to(embodiments.reshape(-1).astype(np.int64), batch)
    return HeadInputs(features, state, embodiment_ids, noise)


def _layout(
    num_tokens: int,
    options: LayoutOptions,
    *,
    input_ids: npt.NDArray[Any] | None,
    image_mask: npt.NDArray[np.bool_] | None,
    attention_mask: npt.NDArray[np.bool_] | None,
    names: Sequence[str] | None,
    path: Path,
) -> Layout:
    if options.text is not None:
        return layouts.parse_layout(options.text, num_tokens, names)
    if input_ids is not None:
        if input_ids.dtype.kind not in "iu":
            raise InputError(f"{path}: input_ids: expected integers, got {input_ids.dtype}")
        return layouts.from_input_ids(
            input_ids,
            image_token_index=options.image_token_index,
            grid=options.grid or layouts.DEFAULT_GRID,
            names=names,
            attention_mask=attention_mask,
        )
    if image_mask is not None:
        return layouts.from_image_mask(
            image_mask, grid=options.grid, names=names, attention_mask=attention_mask
        )
    raise InputError(
        f"{path}: neither input_ids nor image_mask; --layout says where the image tokens are "
        f"({layouts.GRAMMAR})"
    )


def as_mask(path: Path, name: str, array: npt.NDArray[Any] | None) -> npt.NDArray[np.bool_] | None:
    """Tokenizers write masks as integers 0 and 1."""
    if array is None:
        return None
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise InputError(f"{path}: {name}: expected booleans, or 0 and 1")
    return np.asarray(array, dtype=np.bool_)


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Reads a file of backbone features.

    It holds `backbone_features (batch, T_vl, context_dim)`, `state (batch, state_dim)`, `embodiment_id`, and
    may hold `noise (batch, horizon, action_dim)`, `input_ids`, `image_mask`, `attention_mask`, `drop_vl`
    `(batch, T_vl)`, `images (batch, cameras, H, W, 3)` uint8, `tokens (batch, T_vl)` strings and `episode
    (batch,)`; a file with one row may leave out the batch axis of the optional ones. Names may have `_in.`
    before them. In a safetensors file, which holds no strings, `tokens` is a JSON list in the metadata.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it cannot be read, or an array that is needed is not there.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if path.suffix == ".npz":
        found = _read_npz(path)
    elif path.suffix == ".safetensors":
        found = _read_safetensors(path)
    else:
        raise InputError(f"{path}: expected a file that ends in .npz or .safetensors")
    arrays = {
        name: found[key] for name in (*REQUIRED, *OPTIONAL) for key in (name, f"_in.{name}") if key in found
    }
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InputError(
            f"{path}: no {', '.join(missing)}; there are {', '.join(sorted(found)) or 'no arrays'}"
        )
    wrong = [name for name in ("backbone_features", "state", "noise") if _no_floats(arrays.get(name))]
    if wrong:
        raise InputError(f"{path}: {', '.join(wrong)}: expected floating point values")
    return arrays


def _no_floats(array: npt.NDArray[Any] | None) -> bool:
    return array is not None and array.dtype.kind != "f"


def _read_npz(path: Path) -> dict[str, npt.NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as .npz: {error}") from None


def _read_safetensors(path: Path) -> dict[str, npt.NDArray[Any]]:
    from safetensors import SafetensorError, safe_open

    found: dict[str, npt.NDArray[Any]] = {}
    try:
        with safe_open(path, framework="np") as file:
            for name in file.keys():  # noqa: SIM118
                if name.removeprefix("_in.") not in (*REQUIRED, *OPTIONAL):
                    continue  # a checkpoint that also holds inputs
                if file.get_slice(name).get_dtype() in ("F32", "F16", "BF16"):
                    found[name] = read_tensors(path, name)[""]  # NumPy has no bfloat16
                else:
                    found[name] = file.get_tensor(name)
            names = (file.metadata() or {}).get("tokens")
            if names is not None:
                found["tokens"] = np.array(json.loads(names), dtype=np.str_)
    except (SafetensorError, CheckpointError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as .safetensors: {error}") from None
    return found
