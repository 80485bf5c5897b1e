"""Statistics of the whole state and the whole action, in plain mappings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import integer
from saccade.robots.building import Builder, Dims, Options, finished
from saccade.robots.embodiments import N15_IDS
from saccade.robots.groups import Robot


def flat_robot(values: Any, options: Options, where: str, dims: Dims) -> Robot:
    """The robot of ``{"state": {...}, "action": {...}}``. lerobot's names of the two are accepted as well.

    Raises:
        CheckpointError, InputError: As :meth:`saccade.Normalizer.from_pretrained`.
    """
    options.refuse_data_config(where)
    builder = Builder(where, np.float32)
    groups = []
    for kind, other in (("state", "observation.state"), ("action", "action")):
        found = values.get(kind, values.get(other)) if isinstance(values, Mapping) else None
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
