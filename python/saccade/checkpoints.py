"""Checkpoints without torch: what they are, reading tensors, writing copies."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saccade import _saccade
from saccade._arrays import Float32Array
from saccade.config import to_json
from saccade.hub import resolve


@dataclass(frozen=True)
class QuantizeReport:
    """What :func:`quantize` wrote."""

    files: tuple[Path, ...]
    """The files with tensors; ``config.json`` is beside them."""
    num_quantized: int
    """Weights that are int8 now."""
    num_copied: int
    """Tensors copied bit for bit."""
    num_dropped: int
    """Tensors outside the head that were left out."""
    head_bytes_before: int
    """Bytes of the head's tensors in the source."""
    head_bytes_after: int
    """Bytes of the head's tensors now, scales included."""


def quantize(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
    head_only: bool = False,
    force: bool = False,
    progress: Callable[[int, int], object] | None = None,
) -> QuantizeReport:
    """Writes a copy of a checkpoint whose large weights are int8: a quarter of float32's size, half of
    bfloat16's.

    The weights of the attention and feed-forward layers of all blocks, those that precision ``"int8"`` runs
    in int8, become row-major int8 ``X.weight (out_features, in_features)``, from -127 to 127, beside float32
    ``X.weight_scale (out_features,)``: a row stands for its integers times its scale, which is the row's
    largest magnitude / 127. This depends on no instruction set. All other tensors are copied bit for bit,
    those outside the head (a backbone's) too unless ``head_only``.

    :meth:`saccade.ActionHead.load` reads the result at every precision. At ``"int8"`` it gives the same bits
    as the source does at ``"int8"``; at the others the weights are what the integers stand for.

    One tensor is in memory at a time. The directory appears under its name when all is written.

    Args:
        source: A directory (``config.json`` beside one or more ``.safetensors``) or one ``.safetensors``
            file.
        out: The directory to write; its parents are made.
        config: As for :meth:`saccade.ActionHead.load`; it becomes the ``config.json``.
        head_only: Leave out what is not the head's.
        force: Replace a checkpoint that is there. A directory with other files in it is never replaced.
        progress: Called with bytes done and bytes in all after each tensor; what it raises stops the work.

    Raises:
        FileNotFoundError: ``source`` or the config is not there.
        CheckpointError: the source is broken, does not fit the config, is quantised already or holds NaN or
            infinity in a weight to quantise; ``out`` cannot be written.
        InputError: ``out`` is there and ``force`` is not given, it holds other files, or the source.
    """
    text = None if config is None else to_json(config)
    path = Path(source)
    metadata = {"format": "pt", "saccade": _saccade.__version__}
    if path.exists():
        metadata["source_sha256"] = source_sha256(path)
    written = _saccade.quantize(
        os.fspath(source), os.fspath(out), text, head_only, force, metadata, None, progress
    )
    return QuantizeReport(**{**written, "files": tuple(Path(file) for file in written["files"])})


def source_sha256(source: Path) -> str:
    """Hash of a checkpoint: of ``config.json`` beside it, if any, and then of its tensors' files, by name."""
    directory = source if source.is_dir() else source.parent
    files = [directory / "config.json"] if (directory / "config.json").is_file() else []
    files += sorted(directory.glob("*.safetensors")) if source.is_dir() else [source]
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            while piece := file.read(1 << 24):
                digest.update(piece)
    return digest.hexdigest()


def describe(
    source: str | os.PathLike[str],
    config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
) -> dict[str, Any]:
    """What a checkpoint is, by its ``config.json`` and the headers of its files; no tensor is read.

    Args:
        source: As for :meth:`saccade.ActionHead.load`.
        config: As there.

    Returns:
        Numbers, strings, lists and dicts as JSON has them:

        - ``source``: the path; ``layout``: who wrote it, ``"nvidia"``, ``"isaac"`` (a fine-tune by
          Isaac-GR00T's trainer), ``"lerobot"``, ``"fork"`` (lerobot's with several action decoders) or
          ``"saccade"``; ``prefix``: what the head's tensors begin with.
        - ``version``: ``"n1"``, ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``; ``evidence``: what tells it.
        - ``config``: the fields of :class:`saccade.HeadConfig`; ``head_config``: the same in the released
          key names, with what ``config.json`` leaves out.
        - ``files``: ``path`` and ``nbytes`` of each with tensors; ``tensors``: ``name``, ``dtype``, ``shape``
          and ``nbytes`` of each, those outside the head too.

    Raises:
        FileNotFoundError, CheckpointError: as :meth:`saccade.ActionHead.load`, except that single tensors
            need not fit the config.
    """
    return facts(open_published(source, config), source)


def open_published(
    source: str | os.PathLike[str],
    config: Mapping[str, Any] | str | os.PathLike[str] | None = None,
) -> _saccade.Published:
    """An open checkpoint, its layout, version and config recognised; raises as :func:`describe`."""
    return _saccade.Published.open(os.fspath(resolve(source)), None if config is None else to_json(config))


def facts(published: _saccade.Published, source: str | os.PathLike[str]) -> dict[str, Any]:
    """What :func:`describe` returns."""
    config = published.config()
    return {
        "source": os.fspath(source),
        "layout": published.layout,
        "prefix": published.prefix,
        "version": config["version"],
        "evidence": published.evidence,
        "config": config,
        "head_config": json.loads(published.config_json),
        "files": [{"path": str(file), "nbytes": file.stat().st_size} for file in published.files],
        "tensors": [
            {"name": name, "dtype": dtype, "shape": shape, "nbytes": nbytes}
            for name, dtype, shape, nbytes in published.tensors()
        ],
    }


def read_tensors(source: str | os.PathLike[str], prefix: str = "") -> dict[str, Float32Array]:
    """Reads the tensors whose names begin with ``prefix``, as float32; the prefix is cut off the names.

    Args:
        source: One ``.safetensors`` file, or a directory with one or more of them, with or without an index.
        prefix: For instance ``"backbone."``.

    Returns:
        Name to array, sorted by name. float16 and bfloat16 are widened, which is exact; int8 is multiplied by
        its scales.

    Raises:
        FileNotFoundError: there is no such path.
        CheckpointError: the file is broken, or a tensor is not F32, BF16, F16 or I8 with
            scales.
    """
    return _saccade.read_tensors(os.fspath(resolve(source)), prefix)
