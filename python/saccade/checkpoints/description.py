"""Describes a checkpoint from its config and the headers of its files, and reads tensors without torch."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import Float32Array
from saccade._internal.hub import resolve
from saccade._internal.hub_files import WEIGHTS
from saccade.head.config import HeadConfig, to_json

#: A checkpoint: a directory, one ``.safetensors`` file, or a published id.
Source = str | os.PathLike[str]
#: A config: a mapping, the path of a JSON file, or None for the one that belongs to the checkpoint.
Config = Mapping[str, Any] | str | os.PathLike[str] | None

#: The dtypes of int8 and int4 weights, each with scales beside it: a tensor of its name and ``_scale``.
QUANTIZED = ("I8", "U8")

#: What the files' metadata say of the calibration of their weights: JSON.
CALIBRATION = "saccade_calibration"


@dataclass(frozen=True)
class File:
    """A file with tensors."""

    path: str
    nbytes: int
    """Size of the file in bytes."""


@dataclass(frozen=True)
class StoredTensor:
    """A tensor as it is stored."""

    name: str
    dtype: str
    """In the names of safetensors, such as ``"BF16"``."""
    shape: list[int]
    """The shape of its values; int4, stored as ``"U8"``, has two in a byte."""
    nbytes: int
    """Size in the file, in bytes."""


@dataclass(frozen=True)
class Description:
    """What :func:`describe` found in a checkpoint. ``dataclasses.asdict`` converts it to JSON values."""

    source: str
    """The checkpoint as it was given."""
    layout: str
    """The program that wrote it: ``"nvidia"``, ``"isaac"`` (a fine-tune by the trainer of Isaac-GR00T),
    ``"lerobot"``, ``"fork"`` (lerobot's with several action decoders) or ``"saccade"``."""
    prefix: str
    """The prefix of the names of the head's tensors."""
    version: str
    """``"n1"``, ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``."""
    evidence: list[str]
    """Sentences: what layout and version were recognised by."""
    config: HeadConfig
    """Sizes and switches of the head."""
    head_config: dict[str, Any]
    """The same under the released names, completed with what ``config.json`` does not contain."""
    files: list[File]
    """The files with tensors."""
    tensors: list[StoredTensor]
    """All tensors, those outside the head included."""


def describe(source: Source, config: Config = None) -> Description:
    """Describes a checkpoint by its ``config.json`` and the headers of its files. Reads no tensor.

    Args:
        source: The checkpoint, as for :meth:`saccade.ActionHead.from_pretrained`.
        config: Its config, as for :meth:`saccade.ActionHead.from_pretrained`.

    Raises:
        FileNotFoundError, CheckpointError: As :meth:`saccade.ActionHead.from_pretrained`, except that tensors
            need not fit the config.

    Example:
        >>> import saccade
        >>> found = describe(saccade.demo_checkpoint())
        >>> found.layout, found.version, found.config.num_layers
        ('nvidia', 'n1.5', 4)
    """
    return description_of(open_published(source, config), source)


def open_published(source: Source, config: Config = None) -> _saccade.HeadCheckpoint:
    """Opens a checkpoint and recognises its layout, version and config; raises as :func:`describe`."""
    return _saccade.HeadCheckpoint.open(
        os.fspath(resolve(source, files=WEIGHTS)), None if config is None else to_json(config)
    )


def description_of(published: _saccade.HeadCheckpoint, source: Source) -> Description:
    """The description of an open checkpoint."""
    config = HeadConfig(**published.config())
    return Description(
        source=os.fspath(source),
        layout=published.layout,
        prefix=published.prefix,
        version=config.version,
        evidence=published.evidence,
        config=config,
        head_config=json.loads(published.config_json),
        files=[File(str(file), file.stat().st_size) for file in published.files],
        tensors=[StoredTensor(*tensor) for tensor in published.tensors()],
    )


def quantized_dtypes(description: Description) -> set[str]:
    """The dtypes among ``QUANTIZED`` in which some weights are stored, with scales beside them."""
    names = {tensor.name for tensor in description.tensors}
    return {
        tensor.dtype
        for tensor in description.tensors
        if tensor.dtype in QUANTIZED and f"{tensor.name}_scale" in names
    }


def read_tensors(source: Source, prefix: str = "") -> dict[str, Float32Array]:
    """Reads the tensors whose names begin with ``prefix`` as float32.

    Args:
        source: One ``.safetensors`` file, or a directory with one or more of them, with or without an index.
        prefix: For example ``"backbone."``.

    Returns:
        Arrays by name without the prefix, sorted by name. float16 and bfloat16 are widened, which is exact.
        int8 and int4 weights are multiplied by their scales; int4 has two columns for each byte of a row.

    Raises:
        FileNotFoundError: ``source`` does not exist.
        CheckpointError: A file is damaged, or a tensor is not F32, BF16, F16, or I8 or U8 with
            scales.

    Example:
        >>> import saccade
        >>> tensors = read_tensors(saccade.demo_checkpoint(), "action_head.future_tokens.")
        >>> {name: tensor.shape for name, tensor in tensors.items()}
        {'weight': (32, 128)}
    """
    return _saccade.read_tensors(os.fspath(resolve(source, files=WEIGHTS)), prefix)
