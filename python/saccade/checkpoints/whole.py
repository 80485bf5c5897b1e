"""What a whole checkpoint holds besides its head: the backbone, its processor, the robots and cameras."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import PRECISIONS
from saccade._internal.small_files import read_json
from saccade.backbone.config import BackboneConfig
from saccade.errors import CheckpointError, SaccadeError
from saccade.observations import Requirements, read_requirements
from saccade.processor import Processor
from saccade.robots import DataConfigLike, Normalizer
from saccade.robots.reading import OWN_DATA_CONFIG, processor_folder


@dataclass(frozen=True)
class RobotFindings:
    """One robot of a checkpoint's statistics."""

    embodiment: str | None
    """Its tag."""
    embodiment_id: int | None = None
    """Its id in the head."""
    needs: Requirements | None = None
    """What an observation of it must contain; None if the statistics cannot be used as they are."""
    actions: tuple[tuple[str, int], ...] = ()
    """Key and width of each part of the action."""
    problem: str | None = None
    """Why the statistics cannot be used as they are."""
    warning: str | None = None
    """What is not known about them, although they can be used."""
    data_config: str | None = None
    """The data config that was given, as text; None for none, or where the files say it."""


@dataclass(frozen=True)
class BackboneFindings:
    """The backbone of a checkpoint, and what is needed to use it."""

    config: BackboneConfig | None = None
    """Its sizes; None if it is not one that saccade loads."""
    problem: str | None = None
    """Why it is not."""
    memory: dict[str, int] = field(default_factory=dict)
    """Size of the loaded weights by precision, in bytes."""
    processor: str | None = None
    """How images and instruction are prepared by default; None if something is missing."""
    processor_problem: str | None = None
    """What is missing: which files of which published id are needed."""


def backbone_of(source: Path, config: str | None) -> BackboneFindings:
    """The backbone of a checkpoint that has tensors outside its head. Reads no tensor.

    ``config`` is JSON, or None for the checkpoint's ``config.json``.
    """
    try:
        published = _saccade.BackboneCheckpoint.open(str(source), config)
    except SaccadeError as error:
        return BackboneFindings(problem=str(error))
    processor, problem = None, None
    try:
        shown = repr(Processor.from_pretrained(source))
        processor = shown.removeprefix("<saccade.Processor ").removesuffix(">")
    except (SaccadeError, FileNotFoundError) as error:
        problem = str(error)
    return BackboneFindings(
        config=BackboneConfig(**published.config()),
        memory={precision: published.nbytes(precision) for precision in PRECISIONS},
        processor=processor,
        processor_problem=problem,
    )


def robots_of(
    source: Path, state_history: int, data_config: DataConfigLike | None = None
) -> list[RobotFindings]:
    """The robots whose statistics a checkpoint holds, with what an observation of each must contain.

    ``state_history`` is the number of states that its head takes.
    """
    try:
        tags = _tags(source)
    except (OSError, SaccadeError) as error:
        return [RobotFindings(None, problem=str(error))]
    return [_robot_of(source, tag, state_history, data_config) for tag in tags]


def _robot_of(
    source: Path, tag: str | None, state_history: int, data_config: DataConfigLike | None
) -> RobotFindings:
    """One robot: what can be used, or why not."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            normalizer = Normalizer.from_pretrained(source, tag, data_config=data_config)
            needs = read_requirements(source, normalizer)
        except (SaccadeError, FileNotFoundError) as error:
            return RobotFindings(tag, problem=str(error))
    needs = replace(needs, state_history=normalizer.state_history or state_history)
    actions = tuple((group.key, group.size) for group in normalizer.action_groups)
    warning = str(caught[0].message) if caught else None
    named = None if normalizer.data_config is None else str(data_config or OWN_DATA_CONFIG)
    return RobotFindings(tag, normalizer.embodiment_id, needs, actions, None, warning, named)


def _tags(source: Path) -> list[str | None]:
    """The tags of the robots, from the first file that has statistics; None for robots without a tag.

    Raises:
        CheckpointError: A file cannot be read.
    """
    for name, tags in TAGS.items():
        folder = processor_folder(source) if name == "processor_config.json" else source
        if not (folder / name).is_file():
            continue
        try:
            found = tags(read_json(folder / name))
        except (AttributeError, TypeError, ValueError) as error:
            if isinstance(error, SaccadeError):
                raise
            raise CheckpointError(f"{folder / name}: statistics of an unknown form ({error!r})") from error
        if found:
            return found
    return []


def _processor_tags(values: Mapping[str, Any]) -> list[str | None]:
    return list((values.get("processor_kwargs") or {}).get("modality_configs") or {})


def _metadata_tags(values: Mapping[str, Any]) -> list[str | None]:
    return [tag for tag, entry in values.items() if isinstance(entry, Mapping) and "statistics" in entry]


def _lerobot_tags(values: Mapping[str, Any]) -> list[str | None]:
    return [None] if values.get("steps") else []


#: Files with statistics, in the order in which `Normalizer.from_pretrained` tries them, and how their
#: robots are listed.
TAGS: dict[str, Callable[[Mapping[str, Any]], list[str | None]]] = {
    "policy_preprocessor.json": _lerobot_tags,
    "processor_config.json": _processor_tags,
    "experiment_cfg/metadata.json": _metadata_tags,
}
