"""Checkpoints without torch: what they are, reading tensors, writing changed copies."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from saccade import _saccade
from saccade._arrays import Float32Array, integer, optional_integers
from saccade.config import HeadConfig, to_json
from saccade.errors import CheckpointError, InputError
from saccade.hub import resolve

if TYPE_CHECKING:
    from saccade.head import ActionHead

Source = str | os.PathLike[str]
Config = Mapping[str, Any] | str | os.PathLike[str] | None
Progress = Callable[[int, int], object] | None


@dataclass(frozen=True)
class Written:
    """What :func:`quantize`, :func:`convert` and :func:`resize` wrote."""

    files: tuple[Path, ...]
    """The files with tensors; ``config.json`` is beside them."""
    carried: tuple[Path, ...]
    """What lay beside the source's weights and was copied, such as statistics; paths in the directory."""
    left: tuple[Path, ...]
    """What lay there and was not: other weights, states of an optimizer, other checkpoints."""
    num_dropped: int
    """Tensors outside the head that were left out."""


@dataclass(frozen=True)
class QuantizeReport(Written):
    """What :func:`quantize` wrote."""

    num_quantized: int
    """Weights that are int8 now."""
    num_copied: int
    """Tensors copied bit for bit."""
    head_bytes_before: int
    """Bytes of the head's tensors in the source."""
    head_bytes_after: int
    """Bytes of the head's tensors now, scales included."""


@dataclass(frozen=True)
class ConvertReport(Written):
    """What :func:`convert` wrote."""

    num_converted: int
    """Tensors of another type than before."""
    num_rounded: int
    """Numbers that are not what they were, since their new type cannot hold them."""
    largest_error: float
    """The largest difference between a number and what it was."""
    largest_error_in: str | None
    """The tensor that it is in."""
    largest_relative_error: float
    """The largest difference over the magnitude of the number; 1 where one became zero."""
    embodiment_ids: tuple[int, ...] | None
    """The embodiments that are kept, ascending; None for all."""
    zeroed_bytes: int
    """Bytes that are zero now, of embodiments that are not kept: holes in the file, where the file system has
    them."""
    bytes_before: int
    """Bytes of all of the source's tensors."""
    bytes_after: int
    """Bytes of all tensors now, zeros included."""


@dataclass(frozen=True)
class ResizeReport(Written):
    """What :func:`resize` wrote."""

    num_before: int
    """Future tokens of the source."""
    num_after: int
    """Future tokens of the copy."""
    sources: tuple[tuple[int, ...], ...]
    """For each token of the copy, which ones of the source it stands for: one if it is a copy, several if
    they were merged."""
    future_key_bias: tuple[float, ...] | None
    """What saccade adds to the logits of the tokens' keys; None if nothing."""
    is_exact: bool
    """Whether in saccade actions stay what they were, but for rounding."""
    is_widened: bool
    """Whether the tokens are float32 now, since the type that they had cannot hold the new ones."""
    perturbation_rms: float
    """Root mean square of what was added to the copies."""


def quantize(
    source: Source,
    out: str | os.PathLike[str],
    *,
    config: Config = None,
    head_only: bool = False,
    force: bool = False,
    progress: Progress = None,
) -> QuantizeReport:
    """Writes a copy of a checkpoint whose large weights are int8: a quarter of float32's size, half of
    bfloat16's.

    The weights of the attention and feed-forward layers of all blocks, those that precision ``"int8"`` runs
    in int8, become row-major int8 ``X.weight (out_features, in_features)``, from -127 to 127, beside float32
    ``X.weight_scale (out_features,)``: a row stands for its integers times its scale, which is the row's
    largest magnitude / 127. This depends on no instruction set. All other tensors are copied bit for bit,
    those outside the head (a backbone's) too unless ``head_only``, and so is what lies beside the weights:
    statistics, processors, tokenizers.

    :meth:`saccade.ActionHead.load` reads the result at every precision. At ``"int8"`` it gives the same bits
    as the source does at ``"int8"``; at the others the weights are what the integers stand for. No other
    program reads these weights.

    One tensor is in memory at a time. The directory appears under its name when all is written.

    Args:
        source: A directory (``config.json`` beside one or more ``.safetensors``) or one ``.safetensors``
            file, beside which nothing else is looked for.
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
    return QuantizeReport(
        **_paths(
            _saccade.quantize(
                _rewrite(source, out, config, force=force, progress=progress, head_only=head_only)
            )
        )
    )


def convert(
    source: Source,
    out: str | os.PathLike[str],
    *,
    config: Config = None,
    embodiment_ids: Sequence[int] | None = None,
    dtype: str | None = None,
    max_shard_bytes: int | None = None,
    head_only: bool = False,
    force: bool = False,
    progress: Progress = None,
) -> ConvertReport:
    """Writes a copy of a checkpoint with fewer embodiments, in another type, or in other files.

    What is not asked to change is copied bit for bit: tensors, ``config.json``, and what lies beside the
    weights (statistics, processors, tokenizers). A piece of a tensor is in memory at a time, and the
    directory appears under its name when all is written.

    Args:
        source, config, out, head_only, force, progress: As in :func:`quantize`. Other programs need what is
            not the head's.
        embodiment_ids: Keep only these. The layers of the others become zero and stay in place, so that the
            ids keep their numbers and every program that read the source reads the copy; saccade refuses the
            ids that are not there, by a note in the files' metadata. On file systems with holes the zeros
            take no room.
        dtype: ``"float32"``, ``"bfloat16"`` or ``"float16"``, which all floating point tensors become, those
            outside the head too; default what each is. Numbers are rounded to the nearest, and the report
            says by how much. int8 weights and their scales stay.
        max_shard_bytes: A file is closed before it grows larger; a larger tensor gets a file of its own.
            Default: one file for a source of one, else 5 GB.

    Raises:
        FileNotFoundError: ``source`` or the config is not there.
        CheckpointError: the source is broken, does not fit the config, or holds a finite number that the type
            cannot hold; ``out`` cannot be written.
        InputError: an option is out of range; ``out`` is there and ``force`` is not given, it holds other
            files, or the source.
    """
    rewrite = _rewrite(source, out, config, force=force, progress=progress, head_only=head_only)
    if max_shard_bytes is not None:
        rewrite["max_shard_bytes"] = integer("max_shard_bytes", max_shard_bytes)
    ids = optional_integers("embodiment_ids", embodiment_ids)
    found = _paths(_saccade.convert(rewrite, ids, dtype))
    kept = found["embodiment_ids"]
    return ConvertReport(**{**found, "embodiment_ids": None if kept is None else tuple(kept)})


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
    """Writes a copy of a checkpoint with another number of future tokens. Everything else is copied bit for
    bit, and the number is changed wherever ``config.json`` says it.

    Going up from N to M, token i is copied to the rows i, i + N, i + 2 N, ... Each of its r copies has ln r
    taken off the logit of its key in every self-attention block, and together they are what the one was:
    exact but for rounding (spec I2). Going down, the tokens that are most alike in direction are merged, step
    by step, into their mean, with ln of the number that they stand for added: exact for equal tokens, else an
    approximation.

    These numbers stand in saccade's own key of the config, ``"saccade": {"future_key_bias": [...]}`` (of a
    lerobot policy, whose config takes no other keys, in ``saccade.json`` beside it). Other programs do not
    know them: to those the copies weigh r times what the one did.

    Args:
        source, config, out, force, progress: As in :func:`quantize`.
        num_future_tokens: How many; 0 leaves none.
        perturbation: Root mean square of noise that is added to the copies (the rows from N on), so that
            training can tell them apart, as a part of that of all tokens. Copies are not exact then.
        seed: Of the noise, at least 0.

    Raises:
        FileNotFoundError: ``source`` or the config is not there.
        CheckpointError: the source is broken, does not fit the config, is of a version without future tokens
            or has none; ``out`` cannot be written.
        InputError: an option is out of range; ``out`` is there and ``force`` is not given, it holds other
            files, or the source.
    """
    count = integer("num_future_tokens", num_future_tokens, least=0)
    drawn = integer("seed", seed, least=0)
    try:
        amount = float(perturbation)
    except (TypeError, ValueError):
        raise InputError(f"perturbation: expected a number, got {perturbation!r}") from None
    rewrite = _rewrite(source, out, config, force=force, progress=progress)
    found = _paths(_saccade.resize(rewrite, count, amount, drawn))
    bias = found["future_key_bias"]
    found["sources"] = tuple(tuple(group) for group in found["sources"])
    return ResizeReport(**{**found, "future_key_bias": None if bias is None else tuple(bias)})


@dataclass(frozen=True)
class Change:
    """How far actions move, over all observations."""

    largest: float
    """The largest difference between two actions, in any dimension."""
    mean: float
    """The mean magnitude of the difference."""


@dataclass(frozen=True)
class ActionChanges:
    """What :func:`action_changes` measured. Actions are the head's own, normalised."""

    observations: int
    """How many there were."""
    in_saccade: Change
    """With saccade's own bias on the keys of the future tokens."""
    in_other_programs: Change
    """Without it."""
    of_other_noise: Change
    """What the source's actions change if the noise that they start from is another: for scale."""
    actions_rms: float
    """Root mean square of the source's actions."""


def action_changes(
    source: Source,
    resized: Source,
    *,
    config: Config = None,
    features: str | os.PathLike[str] | None = None,
    seed: int = 0,
    num_observations: int = 4,
    num_vl_tokens: int = 296,
    num_threads: int | None = None,
) -> ActionChanges:
    """How far actions move between a checkpoint and its copy by :func:`resize`, in float32, on equal
    observations and noise.

    Args:
        source: The checkpoint.
        resized: The copy.
        config: Of the source, as in :func:`resize`.
        features: A file of recorded observations, ``.npz`` or ``.safetensors``, as ``saccade attention
            --features`` takes it. Default: random numbers, of the first embodiment that is there, which say
            less: no robot sees them.
        seed: Of what is drawn: random observations, and noise that the file does not bring.
        num_observations, num_vl_tokens: Of random observations; 296 is what one camera makes.
        num_threads: As for :meth:`saccade.ActionHead.load`. One head is in memory at a time.

    Raises:
        FileNotFoundError, CheckpointError, InputError, ShapeError: as loading and calling the heads.
    """
    from saccade.head import ActionHead
    from saccade.intervention import Intervention

    rng = np.random.default_rng(integer("seed", seed, least=0))
    recorded = None
    if features is not None:
        from saccade.maps.inputs import read_arrays

        recorded = read_arrays(Path(features))
    kept = open_published(source, config).kept_embodiments() or [0]
    ids = kept[:1] if recorded is None else np.unique(recorded["embodiment_id"]).tolist()
    loading: dict[str, Any] = {"embodiment_ids": ids, "num_threads": num_threads}
    head = ActionHead.load(source, config=config, **loading)
    if features is None or recorded is None:
        observations = _random_observations(head, rng, num_observations, num_vl_tokens)
    else:
        observations = _recorded_observations(Path(features), recorded, head.config, rng)
    before = _chunks(head, observations)
    shape = observations[0]["noise"].shape
    noisy = [{**one, "noise": rng.standard_normal(shape, np.float32)} for one in observations]
    of_other_noise = _change(before, _chunks(head, noisy))
    del head
    head = ActionHead.load(resized, **loading)
    after = _chunks(head, observations)
    plain = after
    if head.config.future_key_bias is not None:
        tokens = _future_tokens(resized)
        plain = _chunks(head, observations, intervention=Intervention(future_tokens=tokens))
    return ActionChanges(
        observations=len(observations),
        in_saccade=_change(before, after),
        in_other_programs=_change(before, plain),
        of_other_noise=of_other_noise,
        actions_rms=float(np.sqrt(np.mean(np.square(before, dtype=np.float64)))),
    )


def _random_observations(
    head: ActionHead, rng: np.random.Generator, count: int, num_vl_tokens: int
) -> list[dict[str, Any]]:
    config = head.config
    shapes = {
        "backbone_features": (1, num_vl_tokens, config.context_dim),
        "state": (1, config.state_history, config.state_dim),
        "noise": (1, config.action_horizon, config.encoder_action_dim),
    }
    return [
        {
            "embodiment_id": head.embodiment_ids[0],
            **{name: rng.standard_normal(shape, np.float32) for name, shape in shapes.items()},
        }
        for _ in range(count)
    ]


def _recorded_observations(
    file: Path, arrays: Mapping[str, Any], config: HeadConfig, rng: np.random.Generator
) -> list[dict[str, Any]]:
    from saccade.maps.inputs import as_mask, head_inputs

    given = head_inputs(file, arrays, config)
    batch, num_tokens, _ = given.features.shape
    noise = given.noise
    if noise is None:
        shape = (batch, config.action_horizon, config.encoder_action_dim)
        noise = rng.standard_normal(shape, np.float32)
    drop_vl = as_mask(file, "drop_vl", arrays.get("drop_vl"))
    dropped = None if drop_vl is None else drop_vl.reshape(batch, num_tokens)
    return [
        {
            "backbone_features": given.features[row : row + 1],
            "state": given.state[row : row + 1],
            "embodiment_id": int(given.embodiment_ids[row]),
            "noise": noise[row : row + 1],
            "drop_vl": None if dropped is None else dropped[row : row + 1],
        }
        for row in range(batch)
    ]


def _chunks(head: ActionHead, observations: Sequence[Mapping[str, Any]], **options: Any) -> Float32Array:
    return np.concatenate([np.asarray(head(**one, **options)) for one in observations])


def _change(before: Float32Array, after: Float32Array) -> Change:
    moved = np.abs(after.astype(np.float64) - before)
    return Change(largest=float(moved.max()), mean=float(moved.mean()))


def _future_tokens(source: Source) -> Float32Array:
    """The learned tokens of a checkpoint, `(N, width)`."""
    for prefix in ("_groot_model.action_head.", "action_head.", ""):
        for tokens in read_tensors(source, f"{prefix}future_tokens.").values():
            return tokens
    raise CheckpointError(f"{os.fspath(source)}: no future_tokens.weight")


def _rewrite(
    source: Source,
    out: str | os.PathLike[str],
    config: Config,
    *,
    force: bool,
    progress: Progress,
    head_only: bool = False,
) -> dict[str, Any]:
    """What all three take, for the engine."""
    path = resolve(source)
    text = None if config is None else to_json(config)
    published = _saccade.Published.open(os.fspath(path), text)
    published.check()  # a source that is refused is not hashed, which takes long
    digest = source_sha256(path, published.files)
    return {
        "source": os.fspath(path),
        "out": os.fspath(out),
        "config": text,
        "head_only": head_only,
        "force": force,
        "metadata": {"format": "pt", "saccade": _saccade.__version__, "source_sha256": digest},
        "max_shard_bytes": None,
        "progress": progress,
    }


def _paths(written: dict[str, Any]) -> dict[str, Any]:
    names = ("files", "carried", "left")
    return {**written, **{name: tuple(Path(path) for path in written[name]) for name in names}}


def source_sha256(source: Path, tensors: Sequence[Path]) -> str:
    """Hash of a checkpoint: of ``config.json`` beside it, if any, and then of its ``tensors``' files."""
    config = (source if source.is_dir() else source.parent) / "config.json"
    files = [config] if config.is_file() else []
    digest = hashlib.sha256()
    for path in [*files, *tensors]:
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
