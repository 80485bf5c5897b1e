"""``meta/modality.json`` of Isaac-GR00T: which numbers of which column a key is, and which camera a name is.

Fields are read as the released loaders do (``gr00t/data/schema.py`` and ``gr00t/data/dataset.py`` of N1.5,
``gr00t/data/dataset/lerobot_episode_loader.py`` of N1.6 and N1.7). Sections and fields that none of them
reads are ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from saccade.datasets.features import Feature
from saccade.errors import DatasetError

#: Columns of keys that do not name one.
STATE, ACTION, TASK = "observation.state", "action", "task_index"
IMAGES = "observation.images."
#: What the key of an annotation begins with.
ANNOTATION = "annotation."


@dataclass(frozen=True)
class Columns:
    """Some numbers of a column: those of one key of state or action.

    Attributes:
        column: The column of the Parquet file.
        numbers: Which of its numbers.
        is_absolute: Whether the last step is repeated after the end of an episode, and the first before its
            start; otherwise zeros stand there, as in N1.5 for keys with ``"absolute": false``.
    """

    column: str
    numbers: slice
    is_absolute: bool = True

    @property
    def width(self) -> int:
        """Number of values of a step."""
        return int(self.numbers.stop - self.numbers.start)


@dataclass(frozen=True)
class Modality:
    """The keys of a data set.

    Attributes:
        state, action: Numbers by key.
        video: Keys of features by the name of the camera.
        language: Columns by the key of the instruction, ``annotation.<...>`` or ``task``. They hold indices
            of tasks, or texts.
        where: The file, for messages.
    """

    state: Mapping[str, Columns]
    action: Mapping[str, Columns]
    video: Mapping[str, str]
    language: Mapping[str, str]
    where: str


def plain(features: Mapping[str, Feature], where: str) -> Modality:
    """The keys without a ``modality.json``: ``state``, ``action``, the cameras by name, and ``task``."""
    whole: dict[str, dict[str, Columns]] = {"state": {}, "action": {}}
    for kind, column in (("state", STATE), ("action", ACTION)):
        if column in features:
            whole[kind][kind] = Columns(column, slice(0, _width(features[column])))
    cameras = {
        key.removeprefix(IMAGES): key
        for key, feature in features.items()
        if feature.is_camera and not feature.is_depth
    }
    return Modality(whole["state"], whole["action"], cameras, {"task": TASK}, where)


def read_modality(values: Mapping[str, Any], features: Mapping[str, Feature], where: str) -> Modality:
    """The keys of a ``modality.json``.

    Raises:
        DatasetError: It has another form, or a key points to nothing. The message lists every problem.
    """
    problems: list[str] = []
    sections = {}
    for name in ("state", "action", "video", "annotation"):
        section = values.get(name)
        if section is None and name == "annotation":
            section = {}
        if not isinstance(section, Mapping) or not all(isinstance(one, Mapping) for one in section.values()):
            raise DatasetError(f"{where}: {name}: expected an object of keys, got {section!r:.60}")
        sections[name] = section
    numbers: dict[str, dict[str, Columns]] = {"state": {}, "action": {}}
    for kind, column in (("state", STATE), ("action", ACTION)):
        for key, about in sections[kind].items():
            found = _columns(f"{kind}.{key}", about, column, features)
            if isinstance(found, str):
                problems.append(found)
            else:
                numbers[kind][key] = found
    cameras = {}
    for name, about in sections["video"].items():
        # N1.5 takes the name itself for the key, N1.6 and later put `observation.images.` before it.
        given = about.get("original_key")
        keys = [f"{IMAGES}{name}", name] if given is None else [given]
        known = [key for key in keys if isinstance(key, str) and key in features and features[key].is_camera]
        if len(known) != 1:
            problems.append(
                f"video.{name}: expected one camera of info.json, got {', '.join(map(str, keys))}"
            )
        else:
            cameras[name] = known[0]
    language = {"task": TASK}
    for name, about in sections["annotation"].items():
        key = f"{ANNOTATION}{name}"
        column = about.get("original_key")
        column = key if column is None else column
        # Published data sets have annotations without a column. It must be there if the annotation is used.
        if not isinstance(column, str):
            problems.append(f"{key}: expected the name of a column, got {column!r}")
        else:
            language[key] = column
    if problems:
        raise DatasetError(f"{where}: " + "; ".join(problems))
    return Modality(numbers["state"], numbers["action"], cameras, language, where)


def _columns(
    key: str, about: Mapping[str, Any], default: str, features: Mapping[str, Feature]
) -> Columns | str:
    """The numbers of a key, or what is wrong with it."""
    column = about.get("original_key", default)
    if not isinstance(column, str) or column not in features or features[column].is_camera:
        return f"{key}: expected a column of info.json, got {column!r}"
    start, end, width = about.get("start"), about.get("end"), _width(features[column])
    if type(start) is not int or type(end) is not int or not 0 <= start < end <= width:
        return f"{key}: expected start and end in the {width} numbers of {column}, got {start!r} and {end!r}"
    is_absolute = about.get("absolute", True)
    if not isinstance(is_absolute, bool):
        return f"{key}: absolute: expected true or false, got {is_absolute!r}"
    return Columns(column, slice(start, end), is_absolute)


def _width(feature: Feature) -> int:
    """Number of values of a step; 0 for columns that are not vectors, of which no part can be taken."""
    return feature.shape[0] if len(feature.shape) == 1 else 0
