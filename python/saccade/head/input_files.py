"""Files of recorded inputs of an action head: reads them, and checks that they fit a head."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

import saccade._saccade as _saccade
from saccade._internal.arrays import boolean
from saccade.errors import CheckpointError, InputError, ShapeError
from saccade.head.config import HeadConfig

BoolArray: TypeAlias = npt.NDArray[np.bool_]

FLOATS = ("backbone_features", "state", "noise")
REQUIRED = ("backbone_features", "state", "embodiment_id")
MASKS = ("attention_mask", "image_mask", "drop_vl")
OPTIONAL = ("noise", "input_ids", *MASKS, "images", "tokens", "episode")


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Reads a file of backbone features.

    It contains ``backbone_features (batch, T_vl, context_dim)``, ``state (batch, state_dim)`` and
    ``embodiment_id``. It may contain ``noise (batch, action_horizon, encoder_action_dim)``; ``input_ids``,
    ``image_mask``, ``attention_mask``, ``drop_vl`` and ``tokens`` (strings), each ``(batch, T_vl)``; ``images
    (batch, cameras, H, W, 3)`` uint8; ``episode (batch,)`` integers. A file with one row may leave out the
    batch axis of the optional arrays. Names may be prefixed with ``_in.``. In a safetensors file ``tokens``
    is a JSON list in the metadata.

    Args:
        path: ``.npz`` or ``.safetensors``.

    Returns:
        The arrays by name. Whether they fit each other is not checked.

    Raises:
        FileNotFoundError: The file does not exist.
        InputError: It cannot be read, or a required array is missing or not floating point.
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
        there = ", ".join(sorted(found)) or "no arrays"
        raise InputError(f"{path}: no {', '.join(missing)}; there are {there}")
    wrong = [name for name in FLOATS if name in arrays and arrays[name].dtype.kind != "f"]
    if wrong:
        raise InputError(f"{path}: {', '.join(wrong)}: expected floating point values")
    return arrays


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
                    found[name] = _saccade.read_tensors(str(path), name)[""]  # NumPy has no bfloat16
                else:
                    found[name] = file.get_tensor(name)
            names = (file.metadata() or {}).get("tokens")
            if names is not None:
                found["tokens"] = np.array(json.loads(names), dtype=np.str_)
    except (SafetensorError, CheckpointError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as .safetensors: {error}") from None
    return found


def checked(arrays: Mapping[str, npt.NDArray[Any]], config: HeadConfig, where: str) -> dict[str, Any]:
    """The arguments of a call of a head, but for its options, from the arrays of a file; None where missing.

    Args:
        arrays: The arrays by name, as :func:`read_arrays` returns them.
        config: Config of the head.
        where: Name of the file, for messages.

    Raises:
        InputError, ShapeError: An array does not fit the head or the others, or contains NaN or infinity.
    """
    features = np.asarray(arrays["backbone_features"])
    if features.ndim != 3 or features.shape[2] != config.context_dim:
        raise ShapeError(
            f"{where}: backbone_features: shape {features.shape}, the checkpoint expects (batch, T_vl, "
            f"{config.context_dim})"
        )
    if not features.size:
        raise InputError(f"{where}: backbone_features: shape {features.shape}, expected no empty axis")
    batch, num_tokens, _ = features.shape
    states: list[tuple[int, ...]] = [(batch, config.num_states, config.state_dim)]
    if config.num_states == 1:
        states.insert(0, (batch, config.state_dim))
    noise = (batch, config.action_horizon, config.encoder_action_dim)
    fields: dict[str, Any] = {
        "backbone_features": features,
        "state": _of_shape(f"{where}: state", arrays["state"], *states),
        "embodiment_id": _embodiments(arrays["embodiment_id"], batch, config, where),
        "noise": _with_batch(f"{where}: noise", arrays.get("noise"), noise),
    }
    for name in MASKS:
        mask = as_mask(where, name, arrays.get(name))
        fields[name] = _with_batch(f"{where}: {name}", mask, (batch, num_tokens))
    for name in FLOATS:
        array = fields[name]
        for row in range(0 if array is None else len(array)):  # one by one, because the file may be large
            if not np.isfinite(array[row]).all():
                raise InputError(f"{where}: {name}: NaN or infinity in row {row}, expected finite numbers")
    _check_masks(fields, config, where)
    return fields


def _embodiments(
    given: npt.NDArray[Any], batch: int, config: HeadConfig, where: str
) -> npt.NDArray[np.int64]:
    ids = np.asarray(given)
    if ids.dtype.kind not in "iu" or ids.size not in (1, batch):
        raise InputError(f"{where}: embodiment_id: expected an integer, or one for each of {batch} rows")
    if not 0 <= int(ids.min()) <= int(ids.max()) < config.num_embodiments:
        raise InputError(
            f"{where}: embodiment_id: given {ids.min()} to {ids.max()}, the checkpoint has 0 to "
            f"{config.num_embodiments - 1}"
        )
    return np.broadcast_to(ids.reshape(-1).astype(np.int64), batch)


def _of_shape(name: str, given: npt.NDArray[Any], *shapes: tuple[int, ...]) -> npt.NDArray[Any]:
    array = np.asarray(given)
    if array.shape not in shapes:
        raise ShapeError(f"{name}: shape {array.shape}, expected {' or '.join(map(str, shapes))}")
    return array


def _with_batch(name: str, given: npt.NDArray[Any] | None, shape: tuple[int, ...]) -> npt.NDArray[Any] | None:
    """An optional array. A file with one row may leave out its axis of the batch."""
    if given is None:
        return None
    lacks_batch = shape[0] == 1 and np.ndim(given) == len(shape) - 1
    return _of_shape(name, given[None] if lacks_batch else given, shape)


def as_mask(where: str, name: str, array: npt.NDArray[Any] | None) -> BoolArray | None:
    """A mask as booleans. Tokenizers write integers 0 and 1.

    Raises:
        InputError: The array contains anything else.
    """
    if array is None:
        return None
    if array.dtype == np.bool_:
        return boolean(name, array)
    if array.dtype.kind not in "iu" or not np.isin(array, (0, 1)).all():
        raise InputError(f"{where}: {name}: expected booleans, or 0 and 1")
    return np.asarray(array, dtype=np.bool_)


def _check_masks(fields: dict[str, Any], config: HeadConfig, where: str) -> None:
    """Refuses masks that the head would refuse or ignore; leaves out those that change nothing."""
    mask, drop_vl = fields["attention_mask"], fields["drop_vl"]
    if drop_vl is not None and drop_vl.all(axis=1).any():
        raise InputError(f"{where}: drop_vl: row {int(drop_vl.all(axis=1).argmax())} drops every position")
    if config.mask_mode == "alternate":
        return
    if mask is not None and not mask.all():
        raise InputError(
            f"{where}: attention_mask: false entries, but the released head reads padding like any other "
            "token; expected no attention_mask, or drop_vl, true where a position is to be removed"
        )
    fields["attention_mask"] = fields["image_mask"] = None
