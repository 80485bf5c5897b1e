"""Changed copies of checkpoints: quantised, converted, merged with an adapter, with more or fewer tokens."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import integer, optional_integers, text
from saccade._internal.files import sha256_of
from saccade._internal.hub import resolve
from saccade._internal.hub_files import WHOLE
from saccade.checkpoints.calibration import Calibration, remove, round_layers
from saccade.checkpoints.description import CALIBRATION, Config, Source
from saccade.errors import InputError
from saccade.head.config import to_json

Progress = Callable[[int, int], object] | None


@dataclass(frozen=True)
class Written:
    """What :func:`quantize`, :func:`convert` and :func:`resize` wrote."""

    files: tuple[Path, ...]
    """The files with tensors. ``config.json`` is in the same directory."""
    carried: tuple[Path, ...]
    """Other files that were copied, such as statistics; paths in the new directory."""
    left: tuple[Path, ...]
    """Files of the source's directory that were not copied: other weights, optimizer states, other
    checkpoints."""
    num_dropped: int
    """Number of tensors outside the head that were left out."""


@dataclass(frozen=True)
class QuantizeReport(Written):
    """What :func:`quantize` wrote."""

    num_quantized: int
    """Number of weights that were converted to int8 or int4; with int4 also the token embeddings, to int8."""
    num_calibrated: int
    """How many of them were rounded for the observations of a calibration."""
    rounding: Mapping[str, Mapping[str, float]] | None
    """What rounding changed in each layer, by the name of its first weight; None without calibration. Sums
    over its outputs on the observations of the calibration: their squared error if each weight were rounded
    to the nearest (``plain``) and as they were rounded (``rounded``), and their squares (``outputs``). Each
    counts what the rounding minimises: a hundredth of the square of each input for itself besides."""
    num_copied: int
    """Number of tensors that were copied bit for bit."""
    head_bytes_before: int
    """Size of the head's tensors in the source, in bytes."""
    head_bytes_after: int
    """Size of the head's tensors in the copy, scales included, in bytes."""
    num_quantized_backbone: int
    """How many of the weights that were converted are a backbone's."""
    backbone_bytes_before: int
    """Size of the backbone's tensors in the source, in bytes; 0 if no backbone was quantised."""
    backbone_bytes_after: int
    """Size of the backbone's tensors in the copy, scales included, in bytes."""
    backbone_copied: str | None
    """Why the tensors outside the head were copied bit for bit; None if they are those of a backbone that
    was quantised, or if there are none."""


@dataclass(frozen=True)
class ConvertReport(Written):
    """What :func:`convert` wrote."""

    num_merged: int
    """Number of weights that an adapter was added to."""
    num_replaced: int
    """Number of tensors that an adapter replaced (``modules_to_save``)."""
    num_converted: int
    """Number of tensors whose dtype changed."""
    num_rounded: int
    """Number of values that changed, because the new dtype cannot represent them."""
    largest_error: float
    """The largest absolute difference of a value."""
    largest_error_in: str | None
    """The tensor with this value."""
    largest_relative_error: float
    """The largest relative difference of a value; 1 if a value became zero."""
    embodiment_ids: tuple[int, ...] | None
    """The embodiments that were kept, in ascending order; None for all."""
    zeroed_bytes: int
    """Size of the layers of the other embodiments, which are zero now. They are holes in the file, if the
    file system supports holes."""
    bytes_before: int
    """Size of all tensors of the source, in bytes."""
    bytes_after: int
    """Size of all tensors of the copy, zeros included, in bytes."""


@dataclass(frozen=True)
class ResizeReport(Written):
    """What :func:`resize` wrote."""

    num_before: int
    """Number of future tokens of the source."""
    num_after: int
    """Number of future tokens of the copy."""
    sources: tuple[tuple[int, ...], ...]
    """For each token of the copy, the tokens of the source that it represents: one if it is a copy, several
    if they were merged."""
    future_key_bias: tuple[float, ...] | None
    """What saccade adds to the logits of the tokens' keys; None if nothing."""
    is_exact: bool
    """Whether the actions of the copy in saccade equal those of the source up to rounding."""
    is_widened: bool
    """Whether the tokens are float32 now, because their dtype cannot represent the new values."""
    perturbation_rms: float
    """Root mean square of the noise that was added to the copied tokens."""


def quantize(
    source: Source,
    out: str | os.PathLike[str],
    *,
    to: str = "int8",
    config: Config = None,
    head_only: bool = False,
    keep_backbone: bool = False,
    calibration: Calibration | None = None,
    force: bool = False,
    progress: Progress = None,
) -> QuantizeReport:
    """Writes a copy of a checkpoint with int8 or int4 weights: half the bytes of bfloat16, or a quarter.

    The weights of the attention and feed-forward layers of all blocks are quantised: those of the head, and
    those of a backbone that :class:`saccade.Backbone` loads. These are the weights that precision ``"int8"``
    or ``"int4"`` computes with as integers. A row represents its integers times its scale, float32
    ``X.weight_scale (out_features,)``. The result does not depend on the instruction set. All other tensors
    are copied bit for bit, and so are the other files of the directory: statistics, processors, tokenizers.

    - int8: row-major int8 ``X.weight (out_features, in_features)`` with values from -127 to 127. The scale is
      the largest magnitude of the row / 127.
    - int4: uint8 ``X.weight (out_features, in_features / 2)``, rounded up, with two values from -7 to 7 in a
      byte: the first one in the low four bits, both in two's complement. If ``in_features`` is odd, the high
      four bits of a row's last byte are zero. The scale is the largest magnitude of the row / 7 times 1,
      11/12, ... or 5/12, whichever gives the least squared error. Each weight is rounded to the nearest
      integer; with ``calibration`` the integers are those that change the outputs of their layer least on
      the observations (GPTQ, equation 55 of ``docs/equations.md``). The files say which. The token embeddings
      of a backbone become int8 as above, which is how both precisions hold them in memory.

    :meth:`saccade.ActionHead.from_pretrained`, :meth:`saccade.Backbone.from_pretrained` and
    :meth:`saccade.Policy.from_pretrained` read the copy at every precision. At the precision ``to``, and
    without calibration, it gives the same bits as the source at that precision. At the others, the weights
    are those that the integers represent, rounded again if that precision rounds weights. No other program
    reads these weights.

    Without calibration one tensor at a time is in memory. The directory appears under its name when
    everything is written.

    Args:
        source: A directory (``config.json`` and one or more ``.safetensors`` files) or one ``.safetensors``
            file. Other files are copied only from a directory.
        out: The directory to write. Parent directories are created.
        to: ``"int8"`` or ``"int4"``.
        config: As for :meth:`saccade.ActionHead.from_pretrained`. It becomes the ``config.json`` of the copy.
        head_only: Whether to leave out tensors outside the head.
        keep_backbone: Whether to copy the tensors of a backbone bit for bit.
        calibration: Observations for which int4 weights are rounded. All of them are run in float32, once for
            each GiB of the layers' Gram matrices (9 for N1.5, in 20 minutes for 16 observations). In memory
            are the policy, one such GiB, the factor of the largest matrix in float64 (half a GiB for 8192
            inputs) and the features of all observations. Finished layers are kept in ``OUT.calibrating``
            until the copy is written, and a call that was interrupted goes on with them.
        force: Whether to replace an existing checkpoint. A directory that contains other files is never
            replaced.
        progress: Called after each tensor with the number of bytes that are done and the total number of
            bytes. If it raises an exception, nothing is written.

    Raises:
        FileNotFoundError: ``source`` or the config does not exist.
        CheckpointError: The source is damaged, does not fit the config, is quantised already, or contains NaN
            or infinity. Or ``out`` cannot be written.
        InputError: ``to`` is another precision, ``out`` exists and ``force`` is not set, or it contains other
            files or the source. Or ``calibration`` is given with int8, its policy is not that of the source
            in float32, its observations do not run all layers, ``config`` is given too, or
            ``OUT.calibrating`` has other files or layers of another calibration.
        ShapeError, DtypeError: An observation does not fit the policy.

    Example:
        >>> import saccade
        >>> report = saccade.quantize(saccade.demo_checkpoint(), "policy-int8")
        >>> report.head_bytes_after < report.head_bytes_before
        True
        >>> policy = saccade.Policy.from_pretrained("policy-int8", precision="int8")
        >>> policy.act(policy.example_observation(), seed=0)["hand"].shape
        (1, 16, 3)
    """
    rewrite = _rewrite(source, out, config, force=force, progress=progress, head_only=head_only)
    rewrite["keep_backbone"] = keep_backbone
    if calibration is None:
        return QuantizeReport(**_frozen(_saccade.quantize(rewrite, text("to", to))), rounding=None)
    if to != "int4":
        raise InputError(f"calibration: expected None unless to is 'int4', got to={to!r}")
    if not isinstance(calibration, Calibration):
        raise InputError(
            f"calibration: expected a saccade.checkpoints.Calibration, got {type(calibration).__name__}"
        )
    if config is not None:
        raise InputError("config: expected None with calibration, whose policy has that of the source")
    folder = Path(rewrite["out"])
    kept = folder.with_name(f"{folder.name}.calibrating")
    rounded = round_layers(calibration, rewrite, kept)
    rewrite["rounded"] = [os.fspath(path) for path in rounded.directories]
    rewrite["metadata"][CALIBRATION] = json.dumps(rounded.note, sort_keys=True)
    written = _saccade.quantize(rewrite, to)
    remove(rounded, kept)
    return QuantizeReport(**_frozen(written), rounding=rounded.errors)


def convert(
    source: Source,
    out: str | os.PathLike[str],
    *,
    adapter: Source | None = None,
    config: Config = None,
    embodiment_ids: Sequence[int] | None = None,
    dtype: str | None = None,
    max_shard_bytes: int | None = None,
    head_only: bool = False,
    force: bool = False,
    progress: Progress = None,
) -> ConvertReport:
    """Writes a copy of a checkpoint: fewer embodiments, another dtype, other files, or with a LoRA adapter.

    Everything else is copied bit for bit: tensors, ``config.json``, and the other files of the directory
    (statistics, processors, tokenizers). A part of one tensor at a time is in memory. The directory appears
    under its name when everything is written.

    Args:
        source, out, config, force, progress: As in :func:`quantize`.
        adapter: The directory or id of a LoRA adapter that PEFT saved (``adapter_config.json``,
            ``adapter_model.safetensors``). ``W + scaling * B A`` takes the place of each weight ``W`` that it
            adapts, and the tensors of its ``modules_to_save`` take the place of the source's, as by PEFT's
            ``merge_and_unload`` on a model in the dtype of the copy: product and sum are computed in float32
            and rounded to that dtype. The adapter's other files (statistics, processors, lerobot's
            ``config.json``) take the place of the source's; if it has files that describe robots, those of
            the source are left out. A README of the adapter is not copied.
        embodiment_ids: The embodiments to keep. The layers of the others become zero. They keep their place,
            so that ids keep their numbers and every program that reads the source reads the copy. A note in
            the metadata of the files makes saccade refuse the ids that were removed. The zeros take no disk
            space on file systems that support holes.
        dtype: ``"float32"``, ``"bfloat16"`` or ``"float16"``, for all floating point tensors, those outside
            the head included. Default: unchanged. Values are rounded to the nearest, and the report contains
            the largest differences. int8 and int4 weights and their scales are kept.
        max_shard_bytes: Largest size of a file in bytes. A tensor that is larger gets a file of its own.
            Default: one file if the source has one, else 5 GB.
        head_only: As in :func:`quantize`. Other programs need the tensors outside the head.

    Raises:
        FileNotFoundError: ``source`` or the config does not exist.
        CheckpointError: The source is damaged, does not fit the config, or contains a finite value beyond the
            range of the dtype. Or ``out`` cannot be written. Or the adapter is of another kind (DoRA, biases,
            another type of PEFT), a tensor of it does not fit the source, or the source is quantised.
        InputError: An option is out of range, ``out`` exists and ``force`` is not set, or ``out`` contains
            other files or the source.

    Example:
        >>> import saccade
        >>> report = saccade.convert(saccade.demo_checkpoint(), "float32", dtype="float32")
        >>> report.largest_error, report.bytes_after == 2 * report.bytes_before
        (0.0, True)
    """
    folder = None if adapter is None else resolve(adapter)
    rewrite = _rewrite(
        source, out, config, force=force, progress=progress, head_only=head_only, adapter=folder
    )
    if max_shard_bytes is not None:
        rewrite["max_shard_bytes"] = integer("max_shard_bytes", max_shard_bytes)
    ids = optional_integers("embodiment_ids", embodiment_ids)
    dtype_name = None if dtype is None else text("dtype", dtype)
    place = None if folder is None else os.fspath(folder)
    return ConvertReport(**_frozen(_saccade.convert(rewrite, ids, dtype_name, place)))


def resize(
    source: Source,
    out: str | os.PathLike[str],
    *,
    num_future_tokens: int,
    perturbation: float = 0.0,
    seed: int = 0,
    config: Config = None,
    force: bool = False,
    progress: Progress = None,
) -> ResizeReport:
    """Writes a copy of a checkpoint with another number of future tokens.

    Everything else is copied bit for bit. ``config.json`` is updated wherever it contains the number.

    From N to a larger number M, token i is copied to the rows i, i + N, i + 2 N, ... If a token has r copies,
    ln r is subtracted from the logit of each copy's key in every self-attention block. Together the copies
    have the effect of the original; the difference is floating-point rounding. From N to a smaller number,
    the two tokens with the most similar directions are merged into their mean, repeatedly, and the logarithm
    of the number of tokens that a merged token represents is added to its logit. This is exact for equal
    tokens, and otherwise an approximation.

    These numbers are stored under saccade's own key of the config, ``"saccade": {"future_key_bias": [...]}``.
    The config of a lerobot policy accepts no other keys, so there they are in a separate ``saccade.json``.
    Other programs do not read them. In those, r copies have r times the weight of the original.

    Args:
        source, out, config, force, progress: As in :func:`quantize`.
        num_future_tokens: The new number. 0 removes all.
        perturbation: Root mean square of noise that is added to the copied tokens (the rows from N on),
            relative to the root mean square of all tokens, so that training can separate them. With noise,
            the copies are not exact.
        seed: Seed of the noise, at least 0.

    Raises:
        FileNotFoundError: ``source`` or the config does not exist.
        CheckpointError: The source is damaged, does not fit the config, belongs to a version without future
            tokens, or has none. Or ``out`` cannot be written.
        InputError: An option is out of range, ``out`` exists and ``force`` is not set, or ``out`` contains
            other files or the source.

    Example:
        >>> import saccade
        >>> saccade.ActionHead.from_pretrained(saccade.demo_checkpoint()).config.num_future_tokens
        32
        >>> report = saccade.resize(saccade.demo_checkpoint(), "more-tokens", num_future_tokens=64)
        >>> report.sources[0], report.sources[32]  # the tokens of the source that these were made from
        ((0,), (0,))
        >>> saccade.ActionHead.from_pretrained("more-tokens").config.num_future_tokens
        64
    """
    count = integer("num_future_tokens", num_future_tokens, least=0)
    drawn = integer("seed", seed, least=0)
    try:
        amount = float(perturbation)
    except (TypeError, ValueError):
        raise InputError(f"perturbation: expected a number, got {perturbation!r}") from None
    rewrite = _rewrite(source, out, config, force=force, progress=progress)
    found = _saccade.resize(rewrite, count, amount, drawn)
    return ResizeReport(**_frozen({**found, "sources": [tuple(group) for group in found["sources"]]}))


def _rewrite(
    source: Source,
    out: str | os.PathLike[str],
    config: Config,
    *,
    force: bool,
    progress: Progress,
    head_only: bool = False,
    adapter: Path | None = None,
) -> dict[str, Any]:
    """The arguments that the three functions share, for the engine."""
    path = resolve(source, files=WHOLE)
    config_text = None if config is None else to_json(config)
    published = _saccade.HeadCheckpoint.open_base(
        os.fspath(path), config_text, None if adapter is None else os.fspath(adapter)
    )
    published.check()  # before the hash, which takes long
    config_file = (path if path.is_dir() else path.parent) / "config.json"
    hashed = [config_file] if config_file.is_file() else []
    metadata = {
        "format": "pt",
        "saccade": _saccade.__version__,
        "source_sha256": sha256_of(*hashed, *published.files),
    }
    if adapter is not None:
        files = (adapter / name for name in ("adapter_config.json", "adapter_model.safetensors"))
        metadata["adapter_sha256"] = sha256_of(*filter(Path.is_file, files))
    return {
        "source": os.fspath(path),
        "out": os.fspath(out),
        "config": config_text,
        "head_only": head_only,
        "keep_backbone": False,
        "rounded": [],
        "force": force,
        "metadata": metadata,
        "max_shard_bytes": None,
        "progress": progress,
    }


def _frozen(written: dict[str, Any]) -> dict[str, Any]:
    """What the engine wrote, with paths, and tuples in place of lists."""
    paths = {name: [Path(path) for path in written[name]] for name in ("files", "carried", "left")}
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in {**written, **paths}.items()
    }
