"""Data configs of Isaac-GR00T N1 and N1.5: which keys a policy uses, in which order, and how.

A checkpoint of N1.5 does not contain its data config. It is passed by the name that the released code gives
it, or as a JSON file or mapping with the fields of ``DataConfig``.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError, InputError
from saccade.robots.rotations import SIZES

#: A name of ``RELEASED``, the path of a JSON file, or its contents.
DataConfigLike: TypeAlias = "str | os.PathLike[str] | Mapping[str, Any] | DataConfig"

#: What may be done with a key. Keys without a mode are passed on unchanged.
MODES = ("min_max", "q99", "mean_std", "scale", "binary", "sin_cos")

#: Isaac-GR00T's usual key of the instruction.
LANGUAGE_KEY = "annotation.human.action.task_description"

#: Keys have one dot: the modality, and a name.
KEY = re.compile(r"[^.]+\.[^.]+")


@dataclass(frozen=True)
class DataConfig:
    """The data config of a policy.

    Attributes:
        video_keys: Cameras in the order of the prompt, such as ``video.ego_view``.
        state_keys: Parts of the state in the order in which the head takes them, such as ``state.left_arm``.
        action_keys: Parts of the action in the order in which the head returns them.
        language_keys: The key of the instruction. It is not enforced: the released N1.5 takes any key with
            ``annotation`` in its name.
        observation_indices: Steps of the frames and states of an observation, relative to now; the last is 0.
        action_indices: Steps of the actions of a chunk. The head denoises as many.
        state_modes, action_modes: One of ``MODES`` by key. ``sin_cos`` is for states, ``scale`` too.
        target_rotations: The representation that the head has of a rotation, by key. Metadata says which one
            the robot has.
    """

    video_keys: tuple[str, ...]
    state_keys: tuple[str, ...]
    action_keys: tuple[str, ...]
    language_keys: tuple[str, ...]
    observation_indices: tuple[int, ...]
    action_indices: tuple[int, ...]
    state_modes: Mapping[str, str]
    action_modes: Mapping[str, str]
    target_rotations: Mapping[str, str]

    def keys(self, kind: str) -> tuple[str, ...]:
        """Keys of ``"video"``, ``"state"`` or ``"action"``, without the prefix."""
        names: tuple[str, ...] = getattr(self, f"{kind}_keys")
        return tuple(name.partition(".")[2] for name in names)


def data_config(given: DataConfigLike) -> DataConfig:
    """A data config by its name, from a file, or from a mapping.

    Raises:
        FileNotFoundError: It is neither a known name nor a file.
        CheckpointError: The file is no JSON object.
        InputError: A field is missing, unknown, or has a value that the released code does not take. The
            message lists every problem.

    Example:
        >>> data_config("so100_dualcam").video_keys
        ('video.front', 'video.wrist')
    """
    if isinstance(given, DataConfig):
        return given
    if isinstance(given, Mapping):
        return _from_mapping(given, "data_config")
    try:
        name = os.fspath(given)
    except TypeError:
        name = None
    if not isinstance(name, str):
        raise InputError(f"data_config: expected a name, a path or a mapping, got {type(given).__name__}")
    if name in RELEASED:
        return RELEASED[name]
    try:
        values = read_json(Path(name))
    except FileNotFoundError:
        raise FileNotFoundError(
            f"data_config: expected a released name ({', '.join(RELEASED)}) or a JSON file, got {name!r}. "
            "The released code also takes a Python class of yours (module:Class): write its keys, indices, "
            "modes and target rotations to a JSON file; docs/robots.md shows the form"
        ) from None
    except CheckpointError as error:
        raise CheckpointError(f"data_config: {error}") from None
    return _from_mapping(values, f"data_config: {name}")


def _from_mapping(values: Mapping[str, Any], where: str) -> DataConfig:
    """Reads and checks the fields."""
    names = [field.name for field in fields(DataConfig)]
    said = [name for name, value in values.items() if not says_nothing(value)]
    problems = [f"{name}: unknown, expected {', '.join(names)}" for name in said if name not in names]
    problems += [f"{name}: missing" for name in names if name not in values]
    if not problems:
        for kind in ("video", "state", "action", "language"):
            problems += _key_problems(f"{kind}_keys", values[f"{kind}_keys"], kind)
        problems += _index_problems("observation_indices", values["observation_indices"])
        problems += _index_problems("action_indices", values["action_indices"])
        problems += [] if problems else _mapping_problems(values)
    if problems:
        raise InputError(f"{where}: " + "; ".join(problems))
    return _made({name: values[name] for name in names})


def says_nothing(value: Any) -> bool:
    """Whether a value of an unknown key asks for nothing: null, false or empty."""
    return value is None or value is False or (isinstance(value, str | Sequence | Mapping) and not value)


def _key_problems(name: str, keys: Any, kind: str) -> list[str]:
    if not isinstance(keys, Sequence) or isinstance(keys, str) or not all(type(key) is str for key in keys):
        return [f"{name}: expected a list of names, got {keys!r:.100}"]
    if not keys and kind != "language":
        return [f"{name}: expected at least one, got none"]
    if len(set(keys)) != len(keys):
        return [f"{name}: expected distinct names, got {', '.join(keys)}"]
    if kind == "language":
        return []
    wrong = [key for key in keys if not key.startswith(f"{kind}.") or not KEY.fullmatch(key)]
    return [f"{name}: expected {kind}.<name> with one dot, got {key!r}" for key in wrong]


def _index_problems(name: str, given: Any) -> list[str]:
    """Both are integers; observations are evenly spaced and end now."""
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        return [f"{name}: expected a list of integers, at least one, got {given!r:.100}"]
    if not all(type(index) is int for index in given):
        return [f"{name}: expected integers, got {given!r:.100}"]
    if name == "action_indices":
        return []
    steps = {after - before for before, after in pairwise(given)}
    if len(steps) > 1 or any(step < 1 for step in steps) or given[-1] != 0:
        return [f"{name}: expected ascending, evenly spaced integers up to 0, got {list(given)!r:.100}"]
    return []


def _mapping_problems(values: Mapping[str, Any]) -> list[str]:
    problems = []
    for name, kinds, allowed in (
        ("state_modes", ("state",), MODES),
        ("action_modes", ("action",), tuple(mode for mode in MODES if mode != "sin_cos")),
        ("target_rotations", ("state", "action"), tuple(SIZES)),
    ):
        found = values[name]
        if not isinstance(found, Mapping):
            problems.append(f"{name}: expected a mapping of keys, got {found!r:.100}")
            continue
        known = [key for kind in kinds for key in values[f"{kind}_keys"]]
        for key, value in found.items():
            if key not in known:
                problems.append(f"{name}: {key}: expected one of {', '.join(map(str, known))}")
            elif not isinstance(value, str) or value not in allowed:
                problems.append(f"{name}: {key}: expected one of {', '.join(allowed)}, got {value!r:.100}")
    return problems


def _made(values: Mapping[str, Any]) -> DataConfig:
    """A data config of checked fields."""
    taken: dict[str, Any] = {
        name: dict(value) if isinstance(value, Mapping) else tuple(value) for name, value in values.items()
    }
    return DataConfig(**taken)


#: The released data configs of N1.5 by name, then N1's old names, then the classes of the released examples.
RELEASED: Mapping[str, DataConfig] = {
    name: _made(values)
    for name, values in json.loads(
        Path(__file__).with_name("released_data_configs.json").read_text(encoding="utf-8")
    ).items()
}
