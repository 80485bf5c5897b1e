"""Examines a checkpoint: sizes, parts, memory, embodiments, future tokens, anomalies."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from saccade._internal.arrays import PRECISIONS
from saccade._internal.hub import resolve
from saccade.checkpoints.description import (
    CALIBRATION,
    Config,
    Description,
    Source,
    description_of,
    open_published,
    quantized_dtypes,
)
from saccade.checkpoints.evidence import from_noise, odd_embodiments, odd_tokens
from saccade.checkpoints.findings import Counts, Inspection, Memory
from saccade.checkpoints.resemblance import Reference
from saccade.checkpoints.survey import Survey, token_statistics
from saccade.checkpoints.whole import backbone_of, robots_of
from saccade.errors import CheckpointError, InputError
from saccade.head.config import to_json
from saccade.robots import DataConfigLike
from saccade.robots.reading import embodiment_ids


def inspect(
    source: Source,
    *,
    config: Config = None,
    reference: Source | None = None,
    data_config: DataConfigLike | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Inspection:
    """Examines every tensor of a checkpoint's head. This is what ``saccade inspect`` prints.

    One tensor, or the slice of one embodiment of it, is in memory at a time.

    Args:
        source: The checkpoint, as for :meth:`saccade.ActionHead.from_pretrained`.
        config: Its config, as for :meth:`saccade.ActionHead.from_pretrained`.
        reference: A checkpoint to compare with, tensor by tensor; for example the one that ``source`` was
            trained from.
        data_config: The data config of the robots of GR00T N1 and N1.5, as for
            :meth:`saccade.Normalizer.from_pretrained`.
        progress: Called with the number of bytes that are done and the total number of bytes.

    Returns:
        The findings, see :class:`saccade.checkpoints.findings.Inspection`. ``dataclasses.asdict`` converts
        them to JSON values.

    Raises:
        FileNotFoundError, CheckpointError: As :meth:`saccade.ActionHead.from_pretrained`, except that values
            need not be finite. Or a file with the ids of embodiments is damaged.
        InputError: ``reference`` is of another version.

    Example:
        >>> import saccade
        >>> found = saccade.inspect(saccade.demo_checkpoint())
        >>> found.layout, found.version, found.parameters
        ('nvidia', 'n1.5', 1310980)
        >>> [robot.embodiment for robot in found.robots]
        ['metaworld_sawyer']
    """
    published = open_published(source, config)
    published.check()
    description = description_of(published, source)
    head = description.config
    other = None if reference is None else Reference(reference)
    if other is not None and other.version != head.version:
        raise InputError(
            f"reference: {other.source} is of GR00T {other.version.upper()}, expected "
            f"{head.version.upper()}, the version of source"
        )
    path = resolve(source)
    outside, names = _outside(description), _embodiment_names(description)
    survey = Survey(published, head, None if other is None else other.compare, progress)
    parts = survey.parts()
    embodiments = survey.embodiments(names)
    tokens = None
    if survey.tokens is not None and len(survey.tokens) > 0:
        tokens = token_statistics(survey.tokens, head.future_key_bias)
    resemblance = None if other is None else other.resemblance()
    return Inspection(
        **vars(description),
        rounding=_rounding(description, published.metadata.get(CALIBRATION)),
        parts=parts,
        parameters=sum(part.parameters for part in parts.values()),
        outside=outside,
        backbone=backbone_of(path, None if config is None else to_json(config)) if outside else None,
        robots=robots_of(path, head.num_states, data_config),
        memory={
            precision: Memory(
                all=published.nbytes(precision, head.num_embodiments), one=published.nbytes(precision, 1)
            )
            for precision in PRECISIONS
        },
        embodiments=embodiments,
        future_tokens=tokens,
        reference=resemblance,
        odd=survey.odd + odd_tokens(tokens, description) + odd_embodiments(embodiments),
        from_noise=from_noise(head.version, parts, tokens, embodiments, resemblance),
    )


def _rounding(description: Description, calibration: str | None) -> str | None:
    """How int4 weights were rounded, by what the files say of it."""
    if "U8" not in quantized_dtypes(description):
        return None
    if calibration is None:
        return "each weight to the nearest, without calibration"
    try:
        count = json.loads(calibration)["observations"]
    except (ValueError, RecursionError, KeyError, TypeError):
        count = None
    if type(count) is not int:
        raise CheckpointError(
            f"source: {CALIBRATION} in the metadata: expected a number of observations, got "
            f"{calibration!r:.80}"
        )
    return f"for what the layers are given on {count} observations (GPTQ)"


def _outside(description: Description) -> dict[str, Counts]:
    """Tensors outside the head by the first component of their names."""
    counted: dict[str, Counts] = {}
    for tensor in description.tensors:
        if not tensor.name.startswith(description.prefix):
            counts = counted.setdefault(tensor.name.removeprefix("_groot_model.").partition(".")[0], Counts())
            counts.tensors += 1
            counts.nbytes += tensor.nbytes
    return counted


def _embodiment_names(description: Description) -> dict[int, list[str]]:
    """Names of each id, as the loader takes them."""
    path = Path(description.source)
    first = description.files[0].path if description.files else path
    folder = path if path.is_dir() else Path(first).parent
    names: dict[int, list[str]] = {}
    for name, index in embodiment_ids(folder, description.version).items():
        names.setdefault(index, []).append(name)
    return names
