"""Data configs of Isaac-GR00T N1 and N1.5: which keys a policy uses, in which order, and how.

A checkpoint of N1.5 does not contain its data config. It is passed by the name that the released code gives
it, or as a JSON file or mapping with the fields of ``DataConfig``.
"""

from __future__ import annotations

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
    taken: dict[str, Any] = {
        name: dict(values[name]) if isinstance(values[name], Mapping) else tuple(values[name])
        for name in names
    }
    return DataConfig(**taken)


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


def _config(
    video: str,
    state: str,
    action: str | None,
    language: str,
    state_modes: str | Mapping[str, str] = "min_max",
    action_modes: str | Mapping[str, str] = "min_max",
    rotations: Mapping[str, str] | None = None,
) -> DataConfig:
    """A released config. Keys are separated by spaces; one mode is for all of them."""

    def keys(kind: str, names: str) -> tuple[str, ...]:
        return tuple(f"{kind}.{name}" for name in names.split())

    def modes(kind: str, names: str, given: str | Mapping[str, str]) -> dict[str, str]:
        if isinstance(given, str):
            return dict.fromkeys(keys(kind, names), given)
        return {f"{kind}.{name}": mode for name, mode in given.items()}

    action = state if action is None else action
    return DataConfig(
        keys("video", video),
        keys("state", state),
        keys("action", action),
        (f"annotation.{language}",),
        (0,),
        tuple(range(16)),
        modes("state", state, state_modes),
        modes("action", action, action_modes),
        rotations or {},
    )


_TASK = LANGUAGE_KEY.removeprefix("annotation.")
_SHORT, _COARSE = "human.task_description", "human.coarse_action"

_GR1_ARMS = "left_arm right_arm left_hand right_hand"
_G1_BODY = "left_leg right_leg waist left_arm right_arm left_hand right_hand"
_GENIE1 = (
    "left_arm_joint_position right_arm_joint_position left_effector_position right_effector_position "
    "head_position waist_position"
)
_XYZ = "x y z roll pitch yaw gripper"
#: Actions of single numbers of which only the gripper is scaled by its bounds.
_XYZ_MEAN_STD = {name: "min_max" if name == "gripper" else "mean_std" for name in _XYZ.split()}


def _bimanual_panda(last_camera: str, hands: tuple[str, str], mode: str) -> DataConfig:
    """Two Panda arms with grippers or hands, named by what comes after the side, in state and in action."""
    sides = ("right", "left")
    of_state, of_action = hands
    return _config(
        f"right_wrist_view left_wrist_view {last_camera}",
        " ".join(f"{side}_arm_eef_pos {side}_arm_eef_quat {side}_{of_state}" for side in sides),
        " ".join(f"{side}_arm_eef_pos {side}_arm_eef_rot {side}_{of_action}" for side in sides),
        _TASK,
        {f"{side}_{name}": "min_max" for side in sides for name in ("arm_eef_pos", of_state)},
        {f"{side}_{of_action}": mode for side in sides},
        {f"state.{side}_arm_eef_quat": "rotation_6d" for side in sides},
    )


_ARMS_WAIST = _config("ego_view", f"{_GR1_ARMS} waist", None, _COARSE, "sin_cos")
_ARMS_ONLY = _config("ego_view", _GR1_ARMS, None, _TASK, "sin_cos")
_UPPER_BODY = _config("front_view", f"{_GR1_ARMS} waist neck", None, _TASK)

#: The released data configs of N1.5 by name, then N1's old names, then the classes of the released examples.
RELEASED: Mapping[str, DataConfig] = {
    "fourier_gr1_arms_waist": _ARMS_WAIST,
    "fourier_gr1_arms_only": _ARMS_ONLY,
    "fourier_gr1_full_upper_body": _UPPER_BODY,
    "bimanual_panda_gripper": _bimanual_panda("front_view", ("gripper_qpos", "gripper_close"), "binary"),
    "bimanual_panda_hand": _bimanual_panda("ego_view", ("hand", "hand"), "min_max"),
    "single_panda_gripper": _config(
        "left_view right_view wrist_view",
        "end_effector_position_relative end_effector_rotation_relative gripper_qpos base_position "
        "base_rotation",
        "end_effector_position end_effector_rotation gripper_close base_motion control_mode",
        _TASK,
        "min_max",
        {
            "end_effector_position": "min_max",
            "end_effector_rotation": "min_max",
            "gripper_close": "binary",
            "base_motion": "min_max",
            "control_mode": "binary",
        },
        {
            "state.end_effector_rotation_relative": "rotation_6d",
            "state.base_rotation": "rotation_6d",
        },
    ),
    "so100": _config("webcam", "single_arm gripper", None, _SHORT),
    "so100_dualcam": _config("front wrist", "single_arm gripper", None, _SHORT),
    "unitree_g1": _config("rs_view", _GR1_ARMS, None, _SHORT),
    "unitree_g1_full_body": _config("rs_view", _G1_BODY, None, _SHORT),
    "oxe_droid": _config(
        "exterior_image_1 exterior_image_2 wrist_image",
        "eef_position eef_rotation gripper_position",
        "eef_position_delta eef_rotation_delta gripper_position",
        "language.language_instruction",
        {"eef_position": "min_max", "gripper_position": "min_max"},
        {"gripper_position": "binary"},
        {"state.eef_rotation": "rotation_6d", "action.eef_rotation_delta": "axis_angle"},
    ),
    "agibot_genie1": _config(
        "top_head hand_left hand_right", _GENIE1, f"{_GENIE1} robot_velocity", "language.action_text"
    ),
    "gr1_arms_waist": _ARMS_WAIST,
    "gr1_arms_only": _ARMS_ONLY,
    "gr1_full_upper_body": _UPPER_BODY,
    "examples.Libero.custom_data_config:LiberoDataConfig": _config("image wrist_image", _XYZ, None, _TASK),
    "examples.Libero.custom_data_config:LiberoDataConfigMeanStd": _config(
        "image wrist_image", _XYZ, None, _TASK, "min_max", _XYZ_MEAN_STD
    ),
    "examples.SimplerEnv.custom_data_config:FractalDataConfig": _config(
        "image", "x y z rx ry rz rw gripper", _XYZ, _TASK, "min_max", _XYZ_MEAN_STD
    ),
    "examples.SimplerEnv.custom_data_config:BridgeDataConfig": _config(
        "image_0", "x y z roll pitch yaw pad gripper", _XYZ, _TASK
    ),
}
