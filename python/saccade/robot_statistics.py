"""What a checkpoint says of a robot: the statistics of its states and actions, in every published layout."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._arrays import Float32Array, integer
from saccade.errors import CheckpointError, InputError, ShapeError, printable
from saccade.hub import resolve

#: How the numbers of a group may be normalised.
MODES = ("min_max", "q99", "mean_std", "binary", "sin_cos", "none")
#: The statistics that a mode takes.
STATISTICS = {"min_max": ("min", "max"), "q99": ("q01", "q99"), "mean_std": ("mean", "std")}
ALL_STATISTICS = frozenset(name for names in STATISTICS.values() for name in names)
#: Embodiments of GR00T N1 and N1.5: what the code bases call them, and their slice of the head's layers.
EMBODIMENTS = {
    "new_embodiment": 31,
    "agibot_genie1": 26,
    "genie1_gripper": 26,
    "gr1": 24,
    "oxe_droid": 17,
    "unitree_g1": 3,
    "so100": 2,
}
#: Files of statistics, in the order in which they are looked for.
FILES = (
    "policy_preprocessor.json",
    "processor_config.json",
    "experiment_cfg/metadata.json",
    "config.json",
)
#: No robot's statistics are larger, and what a name points to is read whole.
MOST_BYTES = 1 << 26
#: No head is wider: config.rs has the same bound.
MOST_WIDTH = 1 << 20

#: What is computed from statistics of more could be beyond float32, and an action infinite.
MOST = 1e30
#: What is divided by less could be beyond float32, too.
LEAST = 1e-30

Statistics: TypeAlias = "npt.NDArray[np.floating[Any]]"


@dataclass(frozen=True, eq=False)
class Group:
    """Neighbouring numbers of a state or an action that are normalised alike: a modality key of
    Isaac-GR00T's.

    Attributes:
        key: Its name, such as ``"left_arm"``.
        size: How many numbers the robot has for it.
        mode: One of ``"min_max"``, ``"q99"``, ``"mean_std"``, ``"binary"``, ``"sin_cos"`` and ``"none"``.
        first: Minimum, 1 % quantile or mean, ``(size,)``, or ``(horizon, size)`` where each step of a chunk
            has its own; None where the mode takes none.
        second: Maximum, 99 % quantile or standard deviation, like ``first``.
        moving: Where the two tell a scale; elsewhere the dimension is constant.
        keeps_constant: Constant dimensions go to the head as they are, not as 0.
        clips: What goes to the head is cut off at -1 and 1.
        clips_back: What comes from the head is cut off at -1 and 1 first.
        reference: Actions only: the key of the state that they are relative to.
    """

    key: str
    size: int
    mode: str
    first: Statistics | None = None
    second: Statistics | None = None
    moving: npt.NDArray[np.bool_] | None = None
    keeps_constant: bool = False
    clips: bool = False
    clips_back: bool = False
    reference: str | None = None

    @property
    def width(self) -> int:
        """How many numbers the head has for it: sine and cosine are two."""
        return 2 * self.size if self.mode == "sin_cos" else self.size

    def to_head(self, values: Float32Array) -> Float32Array:
        """``(..., size)`` in the robot's units to ``(..., width)``."""
        if self.mode == "none":
            return values
        if self.mode == "binary":
            return (values > 0.5).astype(np.float32)
        if self.mode == "sin_cos":
            return np.concatenate([np.sin(values), np.cos(values)], axis=-1)
        first, second, moving = self._rows(values)
        span = np.where(moving, second if self.mode == "mean_std" else second - first, 1.0)
        # In the order in which the released code computes it, so that float32 gives the same bits.
        scaled = ((values - first) / span.astype(first.dtype)).astype(np.float32)
        if self.mode != "mean_std":
            scaled = 2 * scaled - 1
        normalised = np.where(moving, scaled, values if self.keeps_constant else np.float32(0))
        return np.clip(normalised, -1.0, 1.0) if self.clips else normalised

    def to_robot(self, values: Float32Array) -> Float32Array:
        """The inverse; what was cut off stays cut off."""
        if self.mode == "none":
            return values
        if self.mode == "binary":
            return (values > 0.5).astype(np.float32)
        if self.mode == "sin_cos":
            raise InputError(f"{self.key}: sine and cosine do not tell how often an angle went around")
        first, second, moving = self._rows(values)
        if self.mode == "mean_std":
            robot = values * second + first
            return np.where(moving, robot, values if self.clips_back else robot).astype(np.float32)
        if self.clips_back:
            values = np.clip(values, -1.0, 1.0)
        return ((values + 1) / 2 * (second - first) + first).astype(np.float32)

    def _rows(self, values: Float32Array) -> tuple[Statistics, Statistics, npt.NDArray[np.bool_]]:
        """The statistics, one row for each step of a chunk where each step has its own."""
        assert self.first is not None
        assert self.second is not None
        assert self.moving is not None
        if self.first.ndim == 1:
            return self.first, self.second, self.moving
        steps = values.shape[-2] if values.ndim > 1 else 0
        if not 1 <= steps <= len(self.first):
            raise ShapeError(
                f"actions: {self.key} has statistics of {len(self.first)} steps, expected a chunk of at most "
                f"as many, got {values.shape}"
            )
        return self.first[:steps], self.second[:steps], self.moving[:steps]


@dataclass(frozen=True, eq=False)
class Robot:
    """What a checkpoint says of one robot.

    Attributes:
        embodiment: The robot's tag, such as ``"new_embodiment"``; None where the statistics have no name.
        embodiment_id: Its slice of the head's layers; None where nothing says it.
        state_groups: The state, in the order in which its numbers lie.
        action_groups: The action.
        state_dim: Width of the state that the head takes.
        action_dim: Width of the action that the head denoises.
        action_horizon: Steps of a chunk that were trained for this robot; None for all.
        zero_state: The head was trained without a state: it gets zeros.
    """

    embodiment: str | None
    embodiment_id: int | None
    state_groups: tuple[Group, ...]
    action_groups: tuple[Group, ...]
    state_dim: int
    action_dim: int
    action_horizon: int | None = None
    zero_state: bool = False


@dataclass(frozen=True)
class Options:
    """What :meth:`saccade.Normalizer.load` was asked for."""

    embodiment: str | int | None
    state_dim: int | None
    action_dim: int | None
    state_keys: tuple[str, ...] | None
    action_keys: tuple[str, ...] | None
    modes: str | Mapping[str, str] | None

    def refuse_keys(self, where: str) -> None:
        """Raises where the checkpoint itself says what the state is made of."""
        given = [name for name in ("state_keys", "action_keys", "modes") if getattr(self, name) is not None]
        if given:
            raise InputError(f"{', '.join(given)}: {where} says that itself; expected None")

    def choose(self, tags: Sequence[str], ids: Mapping[str, int], where: str) -> str:
        """The tag that was asked for."""
        wanted = self.embodiment
        listed = ", ".join(f"{tag} ({ids[tag]})" if tag in ids else tag for tag in tags)
        if wanted is None:
            found = list(tags) if len(tags) == 1 else []
        elif isinstance(wanted, str):
            found = [tag for tag in tags if tag == wanted]
        else:
            found = [tag for tag in tags if ids.get(tag) == integer("embodiment", wanted, least=0)]
        if len(found) != 1:
            raise InputError(f"embodiment: given {wanted!r}, expected one of those in {where}: {listed}")
        return found[0]

    def agrees(self, found: str | None, found_id: int | None, where: str) -> None:
        """Raises if another embodiment was asked for than the only one that is there."""
        if self.embodiment is not None and self.embodiment not in (found, found_id):
            raise InputError(
                f"embodiment: given {self.embodiment!r}, expected {found!r} ({found_id}), the "
                f"only one in {where}"
            )


@dataclass
class Builder:
    """Makes groups of what a file holds, and collects what is wrong with it."""

    where: str
    dtype: type[np.floating[Any]]
    is_close: bool = False  # N1.6 and later take nearly equal bounds for constant
    problems: list[str] = field(default_factory=list)

    def group(self, key: str, statistics: Any, mode: str, **switches: Any) -> Group | None:
        """A group of this mode, or None with a problem noted."""
        if not isinstance(statistics, Mapping):
            self.problems.append(f"{key}: no statistics")
            return None
        names = STATISTICS.get(mode, ())
        found = {
            name: self._row(key, name, statistics[name]) for name in statistics if name in ALL_STATISTICS
        }
        sizes = {values.shape for values in found.values() if values is not None}
        missing = [name for name in names if name not in found]
        if missing:
            self.problems.append(f"{key}: {mode} needs {' and '.join(missing)}")
        if len(sizes) != 1:
            self.problems.append(f"{key}: expected statistics of one shape, got {sorted(sizes)}")
        if missing or len(sizes) != 1 or any(values is None for values in found.values()):
            return None
        size = sizes.pop()[-1]
        if not names:
            return Group(key, size, mode, **switches)
        first, second = (found[name] for name in names)
        assert first is not None
        assert second is not None
        if mode == "mean_std":
            moving = second != 0
        else:
            moving = ~np.isclose(second, first) if self.is_close else second != first
        if (second < (0 if mode == "mean_std" else first)).any():
            self.problems.append(f"{key}: {names[1]} below {'0' if mode == 'mean_std' else names[0]}")
        spans = second if mode == "mean_std" else second - first
        if (moving & (spans < LEAST)).any():
            self.problems.append(
                f"{key}: {names[1]} is less than {LEAST:g} above {'0' if mode == 'mean_std' else names[0]}"
            )
        keeps = mode == "mean_std" or (mode == "q99" and not self.is_close)
        return Group(key, size, mode, first, second, moving, keeps, **switches)

    def _row(self, key: str, name: str, values: Any) -> Statistics | None:
        """One statistic, or None with a problem noted."""
        try:
            with np.errstate(over="ignore"):  # infinity is told below
                row = np.atleast_1d(np.asarray(values, dtype=self.dtype))
        except (TypeError, ValueError, OverflowError):
            row = np.empty(0)
        if row.ndim > 2 or not row.size or not (np.abs(row) <= MOST).all():  # NaN is not, either
            self.problems.append(f"{key}: {name} is not a row of finite numbers up to {MOST:g}")
            return None
        return row

    def check(self, groups: Iterable[Group | None]) -> tuple[Group, ...]:
        """The groups, if nothing is wrong."""
        if self.problems:
            raise CheckpointError(f"{self.where}: " + "; ".join(dict.fromkeys(self.problems)))
        return tuple(group for group in groups if group is not None)


def read(source: str | os.PathLike[str] | Mapping[str, Any], options: Options) -> Robot:
    """The robot that `source` describes, see :meth:`saccade.Normalizer.load`."""
    where = "source" if isinstance(source, Mapping) else str(resolve(source))
    try:
        if isinstance(source, Mapping):
            return _from_values(source, options, where)
        return _from_path(Path(where), options)
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        # A file may hold anything where an object is expected: so it says where instead of how.
        raise CheckpointError(f"{where}: statistics of an unknown form ({error!r})") from error


def _from_path(path: Path, options: Options) -> Robot:
    """What a file says, or the first of `FILES` in a folder that has statistics."""
    if not os.path.isdir(path):  # noqa: PTH112 (of a name that is too long Path.is_dir raises OSError)
        return _from_values(read_json(path), options, str(path))
    for name in FILES:
        if (path / name).is_file():
            found = _from_file(path, name, options)
            if found is not None:
                return found
    raise CheckpointError(f"{path}: no statistics of states and actions; looked for {', '.join(FILES)}")


def _finished(
    where: str,
    options: Options,
    embodiment: str | None,
    embodiment_id: int | None,
    state: tuple[Group, ...],
    action: tuple[Group, ...],
    found: tuple[int | None, int | None],
    cuts_state: bool = True,
    **more: Any,
) -> Robot:
    """The robot, once the widths of robot and head are known to fit."""
    widths = [sum(group.width for group in groups) for groups in (state, action)]
    dims = []
    for name, width, given, said in zip(
        ("state_dim", "action_dim"), widths, (options.state_dim, options.action_dim), found, strict=True
    ):
        if given is not None and said is not None and given != said:
            raise InputError(f"{name}: given {given}, but {where} is for a head of {said}")
        dims.append(given or said or width)
        if dims[-1] > MOST_WIDTH:
            raise CheckpointError(f"{where}: {name} is {dims[-1]}, expected at most {MOST_WIDTH}")
    if widths[0] > dims[0] and not cuts_state:
        raise CheckpointError(
            f"{where}: the robot's state has {widths[0]} numbers, the head's only {dims[0]} (state_dim)"
        )
    if widths[1] > dims[1]:
        raise CheckpointError(
            f"{where}: the robot's action has {widths[1]} numbers, the head's only {dims[1]} (action_dim)"
        )
    return Robot(embodiment, embodiment_id, state, action, dims[0], dims[1], **more)


def _from_file(folder: Path, name: str, options: Options) -> Robot | None:
    """What one of `FILES` in a checkpoint's folder says; None if it has no statistics."""
    path = folder / name
    values = read_json(path)
    if name == "policy_preprocessor.json":
        return _from_lerobot(folder, values, options)
    if name == "processor_config.json":
        if "processor_kwargs" not in values:  # that of a plain transformers processor
            return None
        ids = read_json(folder / "embodiment_id.json") if (folder / "embodiment_id.json").is_file() else {}
        return _from_processor(
            path, values["processor_kwargs"], read_json(folder / "statistics.json"), ids, options
        )
    if name == "config.json" and "policy_cfg" not in values:
        return None
    dims: tuple[int | None, int | None] = (None, None)
    if name == "experiment_cfg/metadata.json" and (folder / "config.json").is_file():
        head = read_json(folder / "config.json").get("action_head_cfg")
        if isinstance(head, Mapping):
            dims = (_size(head.get("max_state_dim")), _size(head.get("action_dim")))
    return _from_values(values, options, str(path), dims)


def _from_values(
    values: Mapping[str, Any],
    options: Options,
    where: str,
    dims: tuple[int | None, int | None] = (None, None),
) -> Robot:
    """What a JSON file or a mapping holds."""
    if isinstance(values.get("policy_cfg"), Mapping):
        head = values.get("action_head_cfg")
        if isinstance(head, Mapping):
            dims = (_size(head.get("max_state_dim")), _size(head.get("action_dim")))
        return _from_flat(values["policy_cfg"].get("statistics"), options, where, dims, embodiment_id=0)
    entries = [entry for entry in values.values() if isinstance(entry, Mapping)]
    if entries and all("statistics" in entry and "modalities" in entry for entry in entries):
        return _from_metadata(values, options, where, dims)
    if "statistics" in values and "modalities" in values:
        tag = str(values.get("embodiment_tag", "new_embodiment"))
        return _from_metadata({tag: values}, options, where, dims)
    return _from_flat(values, options, where, dims)


def _from_flat(
    values: Any,
    options: Options,
    where: str,
    dims: tuple[int | None, int | None],
    embodiment_id: int | None = None,
) -> Robot:
    """Statistics of the whole state and the whole action."""
    options.refuse_keys(where)
    builder = Builder(where, np.float32)
    groups = []
    for kind, other in (("state", "observation.state"), ("action", "action")):
        found = values.get(kind, values.get(other)) if isinstance(values, Mapping) else None
        has_bounds = isinstance(found, Mapping) and {"min", "max"} <= set(found)
        groups.append(builder.group(kind, found, "min_max" if has_bounds else "mean_std"))
    state, action = builder.check(groups)
    # Where nothing says whose statistics these are, the caller does.
    tag, asked = None, options.embodiment
    if embodiment_id is None and asked is not None:
        if isinstance(asked, str):
            tag, embodiment_id = asked, EMBODIMENTS.get(asked)
        else:
            embodiment_id = integer("embodiment", asked, least=0)
    options.agrees(tag, embodiment_id, where)
    return _finished(where, options, tag, embodiment_id, (state,), (action,), dims)


def _from_metadata(
    values: Mapping[str, Any], options: Options, where: str, dims: tuple[int | None, int | None]
) -> Robot:
    """Isaac-GR00T N1 and N1.5: `experiment_cfg/metadata.json`."""
    tag = options.choose(list(values), EMBODIMENTS, where)
    builder = Builder(f"{where}: {tag}", np.float32)
    entry = values[tag]
    made: dict[str, list[Group | None]] = {}
    for kind, chosen in (("state", options.state_keys), ("action", options.action_keys)):
        statistics, modalities = entry["statistics"].get(kind, {}), entry["modalities"].get(kind, {})
        keys = list(statistics) if chosen is None else [key.removeprefix(f"{kind}.") for key in chosen]
        unknown = [key for key in keys if key not in statistics]
        if unknown:
            listed = ", ".join(statistics)
            raise InputError(f"{kind}_keys: {', '.join(unknown)}: expected some of {listed} in {where}")
        made[kind] = []
        for key in keys:
            about = modalities.get(key)
            mode = _mode(options.modes, kind, key, about if isinstance(about, Mapping) else {}, builder)
            # N1.5 clips what it scales by quantiles.
            made[kind].append(builder.group(key, statistics[key], mode, clips=mode == "q99"))
    _check_modes(
        options.modes, {f"{kind}.{key}" for kind in made for key in entry["statistics"].get(kind, {})}
    )
    for kind, groups in made.items():
        if not groups:
            builder.problems.append(f"no statistics of the {kind}")
    checked = builder.check(group for groups in made.values() for group in groups)
    state, action = checked[: len(made["state"])], checked[len(made["state"]) :]
    return _finished(where, options, tag, EMBODIMENTS.get(tag), state, action, dims)


def _mode(
    modes: str | Mapping[str, str] | None,
    kind: str,
    key: str,
    about: Mapping[str, Any],
    builder: Builder,
) -> str:
    """How a key of `metadata.json` is normalised."""
    given = modes if isinstance(modes, str) else (modes or {}).get(f"{kind}.{key}")
    if given is None and about.get("rotation_type") is not None:
        builder.problems.append(
            f"{kind}.{key} is a rotation ({about['rotation_type']}), which a data config may turn "
            f"into another representation; where it does not, say so with modes={{'{kind}.{key}': 'min_max'}}"
        )
        return "none"
    mode = given or ("min_max" if about.get("continuous", True) else "binary")
    if mode not in MODES or (mode == "sin_cos" and kind == "action"):
        expected = ", ".join(name for name in MODES if kind == "state" or name != "sin_cos")
        raise InputError(f"modes: {kind}.{key}: given {mode!r}, expected one of {expected}")
    return mode


def _check_modes(modes: str | Mapping[str, str] | None, keys: set[str]) -> None:
    unknown = [] if modes is None or isinstance(modes, str) else [key for key in modes if key not in keys]
    if unknown:
        raise InputError(f"modes: {', '.join(unknown)}: expected keys out of {', '.join(sorted(keys))}")


def _from_lerobot(folder: Path, values: Mapping[str, Any], options: Options) -> Robot | None:
    """lerobot: what the two pipelines say, and the statistics beside them."""
    where = str(folder / "policy_preprocessor.json")
    pack = _step(values, ("groot_pack_inputs", "groot_n1_7_pack_inputs"))
    if pack is None:
        return None
    options.refuse_keys(where)
    after = folder / "policy_postprocessor.json"
    unpack = _step(
        read_json(after) if after.is_file() else {},
        ("groot_action_unpack_unnormalize", "groot_n1_7_action_decode"),
    )
    if unpack is None:
        raise CheckpointError(f"{after}: no step of GR00T that turns actions into the robot's units")
    taking, giving = _config(pack), _config(unpack)
    ids = {tag: number for tag, number in taking.get("embodiment_mapping", {}).items() if type(number) is int}
    tag = str(taking.get("embodiment_tag", "new_embodiment"))
    embodiment_id = ids.get(tag, 0)  # as lerobot does with a tag that it does not know
    options.agrees(tag, embodiment_id, where)
    dims = (_size(taking.get("max_state_dim")), _size(taking.get("max_action_dim")))
    for name in ("libero_gripper_action", "action_decode_transform"):
        if giving.get(name):
            raise CheckpointError(
                f"{after}: {name} ({giving[name]}) is not supported: it changes the gripper"
            )
    if taking.get("raw_stats") and taking.get("modality_config"):
        kwargs = {
            **{name: taking.get(name) for name in ("use_percentiles", "clip_outliers")},
            "use_relative_action": giving.get("use_relative_action", False),
            "modality_configs": {tag: taking["modality_config"]},
            **dict(zip(("max_state_dim", "max_action_dim"), dims, strict=True)),
        }
        return _from_processor(Path(where), kwargs, {tag: taking["raw_stats"]}, ids, options)
    builder = Builder(where, np.float32)
    clips = str(pack["registry_name"]).startswith("groot_n1_7") and taking.get("clip_outliers", True)
    statistics = [_lerobot_statistics(folder, step) for step in (pack, unpack)]
    features = read_json(folder / "config.json") if (folder / "config.json").is_file() else {}
    sizes = (
        _feature(features.get("input_features"), "observation.state"),
        _size(giving.get("env_action_dim")) or _feature(features.get("output_features"), "action"),
    )
    groups = []
    for found, config, key, size in zip(
        statistics, (taking, giving), ("observation.state", "action"), sizes, strict=True
    ):
        name = key.rpartition(".")[2]
        if config.get("normalize_min_max", True) and key in found:
            group = builder.group(
                name,
                found[key],
                "min_max",
                clips=clips,
                clips_back=bool(config.get("clip_normalized_action")),
            )
            if group is not None and size is not None and group.size != size:
                builder.problems.append(f"{name}: {size} numbers, and statistics of {group.size}")
        elif size is None:
            builder.problems.append(f"{name}: not normalised, and nothing says how many numbers it has")
            group = None
        else:
            group = Group(name, size, "none")
        groups.append(group)
    state, action = builder.check(groups)
    return _finished(where, options, tag, embodiment_id, (state,), (action,), dims)


def _step(values: Mapping[str, Any], names: tuple[str, ...]) -> Mapping[str, Any] | None:
    """The step of a lerobot pipeline whose registered name begins with one of `names`."""
    steps = values.get("steps")
    for step in steps if isinstance(steps, list) else []:
        if isinstance(step, Mapping) and str(step.get("registry_name", "")).startswith(names):
            return step
    return None


def _config(step: Mapping[str, Any]) -> Mapping[str, Any]:
    config = step.get("config")
    return config if isinstance(config, Mapping) else {}


def _feature(features: Any, key: str) -> int | None:
    """Width of a feature in lerobot's `config.json`."""
    shape = features.get(key, {}).get("shape") if isinstance(features, Mapping) else None
    return _size(shape[-1]) if isinstance(shape, list) and shape else None


def _lerobot_statistics(folder: Path, step: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """By key, the statistics in the file that a step names."""
    name = step.get("state_file")
    if name is None:
        return {}
    if not isinstance(name, str) or not name or Path(name).name != name:
        raise CheckpointError(f"{folder}: state_file {name!r}: expected the name of a file beside it")
    found: dict[str, dict[str, Any]] = {}
    for full, values in read_small_tensors(folder / name).items():
        key, _, statistic = full.rpartition(".")
        found.setdefault(key, {})[statistic] = values
    return found


def _from_processor(
    path: Path,
    kwargs: Mapping[str, Any],
    statistics: Mapping[str, Any],
    ids: Mapping[str, Any],
    options: Options,
) -> Robot:
    """Isaac-GR00T N1.6 and N1.7: groups of `processor_config.json`, numbers of `statistics.json`."""
    options.refuse_keys(str(path))
    configs = kwargs.get("modality_configs")
    if not isinstance(configs, Mapping) or not configs:
        raise CheckpointError(f"{path}: no modality_configs")
    known = {tag: number for tag, number in ids.items() if type(number) is int}
    tags = [tag for tag in configs if tag in statistics]
    if not tags:
        raise CheckpointError(
            f"{path}: statistics of {', '.join(statistics) or 'nothing'}, groups of {', '.join(configs)}"
        )
    tag = options.choose(tags, known, str(path))
    if kwargs.get("use_tactile"):
        raise CheckpointError(f"{path}: use_tactile: tactile states are not supported")
    builder = Builder(f"{path}: {tag}", np.float64, is_close=True)
    config, numbers = configs[tag], statistics[tag]
    clips = kwargs.get("clip_outliers") is not False
    bounds = {"min": "q01", "max": "q99"} if kwargs.get("use_percentiles") else {}
    about_state, about_action = (_part(config, kind, builder) for kind in ("state", "action"))
    state = [
        _processor_group(
            builder, key, _entry(numbers, "state", key), about_state, bounds, kwargs, clips, True
        )
        for key in about_state["modality_keys"]
    ]
    action = []
    actions = about_action.get("action_configs") or [{}] * len(about_action["modality_keys"])
    if len(actions) != len(about_action["modality_keys"]):
        builder.problems.append("action: expected one of action_configs for each of modality_keys")
    for key, about in zip(about_action["modality_keys"], actions, strict=False):
        entry, reference, limits = _entry(numbers, "action", key), None, bounds
        if kwargs.get("use_relative_action") and str(about.get("rep")).lower() == "relative":
            if str(about.get("type")).lower() != "non_eef":
                builder.problems.append(f"action.{key}: relative poses of an end effector are not supported")
            # Relative actions have statistics of their own, and never quantiles for bounds.
            entry, reference = _entry(numbers, "relative_action", key), about.get("state_key") or key
            limits = {}
        group = _processor_group(builder, key, entry, about_action, limits, kwargs, clips, False, reference)
        action.append(group)
        sizes = {one.key: one.size for one in state if one is not None}
        if reference is not None and group is not None and sizes.get(reference) != group.size:
            builder.problems.append(
                f"action.{key}: {group.size} numbers relative to state.{reference}, which has "
                f"{sizes.get(reference, 'no')}"
            )
    groups = builder.check([*state, *action])
    steps = about_action.get("delta_indices")
    return _finished(
        str(path),
        options,
        tag,
        known.get(tag),
        groups[: len(state)],
        groups[len(state) :],
        (_size(kwargs.get("max_state_dim")), _size(kwargs.get("max_action_dim"))),
        cuts_state=False,
        action_horizon=len(steps) if isinstance(steps, list) and steps else None,
        zero_state=bool(kwargs.get("exclude_state") or about_state.get("exclude_state")),
    )


def _part(config: Any, kind: str, builder: Builder) -> Mapping[str, Any]:
    """What `modality_configs` say of the state or the action."""
    found = config.get(kind) if isinstance(config, Mapping) else None
    keys = found.get("modality_keys") if isinstance(found, Mapping) else None
    if not isinstance(keys, list) or not keys or not all(isinstance(key, str) for key in keys):
        raise CheckpointError(f"{builder.where}: {kind}: no modality_keys")
    assert isinstance(found, Mapping)
    return found


def _entry(numbers: Any, kind: str, key: str) -> Any:
    found = numbers.get(kind) if isinstance(numbers, Mapping) else None
    return found.get(key) if isinstance(found, Mapping) else None


def _processor_group(
    builder: Builder,
    key: str,
    statistics: Any,
    about: Mapping[str, Any],
    bounds: Mapping[str, str],
    kwargs: Mapping[str, Any],
    clips: bool,
    is_state: bool,
    reference: str | None = None,
) -> Group | None:
    """One group of N1.6 or N1.7."""
    if (
        is_state
        and kwargs.get("apply_sincos_state_encoding")
        and key in (about.get("sin_cos_embedding_keys") or ())
    ):
        return builder.group(key, statistics, "sin_cos")
    if key in (about.get("mean_std_embedding_keys") or ()):
        # Actions are cut off whatever their mode, states only where they are scaled by bounds.
        return builder.group(
            key, statistics, "mean_std", clips=clips and not is_state, clips_back=True, reference=reference
        )
    if isinstance(statistics, Mapping):
        statistics = {name: statistics.get(bounds.get(name, name)) for name in ("min", "max")}
    return builder.group(key, statistics, "min_max", clips=clips, clips_back=True, reference=reference)


def _size(value: Any) -> int | None:
    """A positive integer of a file; anything else is as if it were not there."""
    return value if type(value) is int and value > 0 else None


def checked_modes(modes: str | Mapping[str, str] | None) -> str | Mapping[str, str] | None:
    """The modes that were asked for."""
    if modes is not None and not isinstance(modes, (str, Mapping)):
        raise InputError(f"modes: expected a name, or names by key, got {type(modes).__name__}")
    return modes


def key_names(name: str, given: Sequence[str] | None) -> tuple[str, ...] | None:
    """The keys that were asked for."""
    if given is None:
        return None
    keys = () if isinstance(given, str) else tuple(given)
    if not keys or len(set(keys)) != len(keys) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"{name}: expected distinct names, at least one, got {given!r}")
    return keys


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file that holds an object.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it holds something else.
    """
    try:
        values = json.loads(_bytes(path))
    except FileNotFoundError:
        raise FileNotFoundError(printable(f"{path}: no such file")) from None
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(values, dict):
        raise CheckpointError(f"{path}: expected a JSON object, got {type(values).__name__}")
    return values


def read_small_tensors(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The tensors of a small `.safetensors` file with any dtype: lerobot keeps counts in int64.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it is broken.
    """
    kinds = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "i1"}
    kinds |= {"U8": "u1", "BOOL": "?"}
    try:
        content = _bytes(path)
        start = 8 + int.from_bytes(content[:8], "little")
        if len(content) < 8 or start > len(content):
            raise ValueError("the header is longer than the file")
        tensors = {}
        for name, about in json.loads(content[8:start]).items():
            if name == "__metadata__":
                continue
            first, last = about["data_offsets"]
            shape, kind = tuple(about["shape"]), np.dtype(kinds[about["dtype"]])
            data = content[start + first : start + last]
            if min(first, last, *shape, 0) < 0 or len(data) != math.prod(shape) * kind.itemsize:
                raise ValueError(f"{name}: data_offsets {first} to {last} do not hold {shape} of {kind}")
            tensors[name] = np.frombuffer(data, kind).reshape(shape)
    except FileNotFoundError:
        raise FileNotFoundError(printable(f"{path}: no such file")) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: no safetensors file of statistics: {error}") from None
    return tensors


def _bytes(path: Path) -> bytes:
    """A small file's content."""
    about = path.stat()
    # A pipe would be waited for, a device read without end.
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("not a regular file")
    if about.st_size > MOST_BYTES:
        raise ValueError(f"more than {MOST_BYTES} bytes")
    return path.read_bytes()
