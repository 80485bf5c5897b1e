"""Finds the statistics of a checkpoint, and passes them to the file of their layout."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from saccade._internal.arrays import integer
from saccade._internal.hub import resolve
from saccade._internal.hub_files import STATISTICS
from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError, InputError
from saccade.robots.building import Builder, Options, size_of, value_at
from saccade.robots.data_configs import data_config
from saccade.robots.embodiments import IDS, N15_IDS
from saccade.robots.isaac_metadata import metadata_robot
from saccade.robots.isaac_processor import CLASSES, checked_ids, processor_robot
from saccade.robots.lerobot import lerobot_robot, pipeline_ids
from saccade.robots.robot import Dims, Robot, finished

#: Where a training leaves the processor's files, if not next to the weights.
PROCESSOR_FOLDER = "processor"

#: The data config of a policy that saccade trained. Checkpoints of the released code have no such file.
OWN_DATA_CONFIG = "experiment_cfg/data_config.json"

#: Versions by ``model_type`` of ``config.json``, which the processor's class is called after.
MODEL_TYPES = {name.removesuffix("Processor"): version for name, version in CLASSES.items()}


def read(
    id_or_path: str | os.PathLike[str] | Mapping[str, Any], revision: str | None, options: Options
) -> Robot:
    """The robot that a checkpoint or a mapping describes; see :meth:`saccade.Normalizer.from_pretrained`."""
    if not isinstance(id_or_path, Mapping):
        where = str(resolve(id_or_path, revision, files=STATISTICS))
    elif revision is None:
        where = "id_or_path"
    else:
        raise InputError(f"revision: expected None with a mapping, got {revision!r}")
    try:
        if isinstance(id_or_path, Mapping):
            return _from_values(id_or_path, options, where)
        return _from_path(Path(where), options)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        # A file may contain anything in place of an object.
        raise CheckpointError(f"{where}: statistics of an unknown form ({error!r})") from error


def processor_folder(folder: Path) -> Path:
    """The folder of N1.6's and N1.7's processor: the checkpoint's, or ``processor/`` in it.

    The released N1.7 looks into ``processor/`` only if the checkpoint's own folder has no
    ``processor_config.json``. N1.6 leaves its files at the same places.
    """
    below = folder / PROCESSOR_FOLDER
    at_root = (folder / "processor_config.json").is_file()
    return below if not at_root and (below / "processor_config.json").is_file() else folder


def processor_version(folder: Path, values: Mapping[str, Any]) -> str | None:
    """The version of a processor: by its class, else by the checkpoint's ``model_type``; or None."""
    named = CLASSES.get(str(values.get("processor_class")))
    if named is not None or not (folder / "config.json").is_file():
        return named
    return MODEL_TYPES.get(str(read_json(folder / "config.json").get("model_type")))


def embodiment_ids(folder: Path, version: str) -> Mapping[str, int]:
    """Ids by tag as :func:`read` takes them for a checkpoint: its own, and released ones of other tags.

    Raises:
        CheckpointError: A file is damaged.
    """
    found = pipeline_ids(folder)
    return {**IDS[version], **_processor_ids(folder)} if found is None else found


def _from_path(path: Path, options: Options) -> Robot:
    """The robot of one file, or of the first of ``FILES`` in a directory that has statistics."""
    if not os.path.isdir(path):  # noqa: PTH112 (Path.is_dir raises OSError if a name is too long)
        return _from_values(read_json(path), options, str(path))
    for name, reader in FILES.items():
        folder = processor_folder(path) if reader is _processor else path
        if (folder / name).is_file():
            found = reader(path, read_json(folder / name), options)
            if found is not None:
                return found
    listed = ", ".join([*FILES, f"{PROCESSOR_FOLDER}/processor_config.json"])
    raise CheckpointError(f"{path}: no statistics of states and actions; looked for {listed}")


def _processor(path: Path, values: Mapping[str, Any], options: Options) -> Robot | None:
    """Isaac-GR00T N1.6 and N1.7. The processor of another transformers model has no ``processor_kwargs``."""
    if "processor_kwargs" not in values:
        return None
    folder = processor_folder(path)
    return processor_robot(
        str(folder / "processor_config.json"),
        processor_version(path, values),
        values["processor_kwargs"],
        read_json(folder / "statistics.json"),
        _processor_ids(path),
        options,
    )


def _processor_ids(path: Path) -> dict[str, int]:
    """The ids that are beside the processor of N1.6 and N1.7."""
    file = processor_folder(path) / "embodiment_id.json"
    return checked_ids(str(file), read_json(file)) if file.is_file() else {}


def _metadata(path: Path, values: Mapping[str, Any], options: Options) -> Robot:
    """Isaac-GR00T N1 and N1.5. The widths of the head are in the config."""
    where = str(path / "experiment_cfg" / "metadata.json")
    own = path / OWN_DATA_CONFIG
    if options.data_config is None and own.is_file():
        options = replace(options, data_config=data_config(own))
    config = read_json(path / "config.json") if (path / "config.json").is_file() else {}
    widths = [size_of(value_at(config, "action_head_cfg", name)) for name in ("max_state_dim", "action_dim")]
    return _from_values(values, options, where, (widths[0], widths[1]))


#: Files of a checkpoint that have statistics, in the order in which they are tried. A new layout is one more
#: line.
FILES: dict[str, Callable[[Path, Mapping[str, Any], Options], Robot | None]] = {
    "policy_preprocessor.json": lerobot_robot,
    "processor_config.json": _processor,
    "experiment_cfg/metadata.json": _metadata,
}


def _from_values(values: Mapping[str, Any], options: Options, where: str, dims: Dims = (None, None)) -> Robot:
    """The robot of a mapping, or of the contents of a JSON file."""
    entries = [entry for entry in values.values() if isinstance(entry, Mapping)]
    if entries and all("statistics" in entry and "modalities" in entry for entry in entries):
        return metadata_robot(values, options, where, dims)
    if "statistics" in values and "modalities" in values:
        tag = str(values.get("embodiment_tag", "new_embodiment"))
        return metadata_robot({tag: values}, options, where, dims)
    return _flat(values, options, where, dims)


def _flat(values: Mapping[str, Any], options: Options, where: str, dims: Dims) -> Robot:
    """The robot of ``{"state": {...}, "action": {...}}``. lerobot's names of the two are accepted as well."""
    options.refuse_data_config(where)
    builder = Builder(where, np.float32)
    groups = []
    for kind, other in (("state", "observation.state"), ("action", "action")):
        found = values.get(kind, values.get(other))
        has_bounds = isinstance(found, Mapping) and {"min", "max"} <= set(found)
        groups.append(builder.group(kind, found, "min_max" if has_bounds else "mean_std"))
    state, action = builder.check(groups)
    # The statistics do not name a robot, so the request does.
    tag, embodiment_id, asked = None, None, options.embodiment
    if isinstance(asked, str):
        tag, embodiment_id = asked, N15_IDS.get(asked)
    elif asked is not None:
        embodiment_id = integer("embodiment", asked, least=0)
    return finished(where, options, tag, embodiment_id, (state,), (action,), dims)
