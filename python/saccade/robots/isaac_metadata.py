"""Statistics of Isaac-GR00T N1 and N1.5: ``experiment_cfg/metadata.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade.errors import InputError
from saccade.robots.building import Builder, Dims, Options, finished
from saccade.robots.groups import MODES, Group, Robot

#: Embodiments of GR00T N1 and N1.5: their names in the released code, and their ids.
EMBODIMENTS = {
    "new_embodiment": 31,
    "agibot_genie1": 26,
    "genie1_gripper": 26,
    "gr1": 24,
    "oxe_droid": 17,
    "unitree_g1": 3,
    "so100": 2,
}


def metadata_robot(values: Mapping[str, Any], options: Options, where: str, dims: Dims) -> Robot:
    """The robot of a mapping of tags to ``statistics`` and ``modalities``.

    Raises:
        CheckpointError, InputError: As :meth:`saccade.Normalizer.load`.
    """
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
            raise InputError(f"{kind}_keys: expected keys in {where} ({listed}), got {', '.join(unknown)}")
        made[kind] = []
        for key in keys:
            about = modalities.get(key)
            mode = _mode(options.modes, kind, key, about if isinstance(about, Mapping) else {}, builder)
            # N1.5 clips values that it scales by quantiles.
            made[kind].append(builder.group(key, statistics[key], mode, clips=mode == "q99"))
    _check_modes(
        options.modes, {f"{kind}.{key}" for kind in made for key in entry["statistics"].get(kind, {})}
    )
    for kind, groups in made.items():
        if not groups:
            builder.problems.append(f"no statistics of the {kind}")
    checked = builder.check(group for groups in made.values() for group in groups)
    state, action = checked[: len(made["state"])], checked[len(made["state"]) :]
    return finished(where, options, tag, EMBODIMENTS.get(tag), state, action, dims)


def _mode(
    modes: str | Mapping[str, str] | None,
    kind: str,
    key: str,
    about: Mapping[str, Any],
    builder: Builder,
) -> str:
    """How a key is normalised."""
    given = modes if isinstance(modes, str) else (modes or {}).get(f"{kind}.{key}")
    if given is None and about.get("rotation_type") is not None:
        builder.problems.append(
            f"{kind}.{key} is a rotation ({about['rotation_type']}), which a data config may convert to "
            f"another representation; if yours does not, pass modes={{'{kind}.{key}': 'min_max'}}"
        )
        return "none"
    mode = given or ("min_max" if about.get("continuous", True) else "binary")
    if mode not in MODES or (mode == "sin_cos" and kind == "action"):
        expected = ", ".join(name for name in MODES if kind == "state" or name != "sin_cos")
        raise InputError(f"modes: {kind}.{key}: expected one of {expected}, got {mode!r}")
    return mode


def _check_modes(modes: str | Mapping[str, str] | None, keys: set[str]) -> None:
    unknown = [] if modes is None or isinstance(modes, str) else [key for key in modes if key not in keys]
    if unknown:
        raise InputError(f"modes: expected keys among {', '.join(sorted(keys))}, got {', '.join(unknown)}")
