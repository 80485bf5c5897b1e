"""Step 6 of :meth:`saccade.Policy.act`: actions in the robot's units and the observation's format."""

from __future__ import annotations

from typing import Any

import numpy as np

from saccade._internal.arrays import Array
from saccade.observations import ParsedState
from saccade.policy.reading import Batch
from saccade.robots import Normalizer


def restore_units(actions: Array, batch: Batch[ParsedState], normalizer: Normalizer) -> Any:
    """Normalised actions ``(rows, ..., horizon, action_dim)``, each in the format of its observation."""
    restored = np.asarray(normalizer.actions(actions, batch.state))
    found, start = [], 0
    for parsed in batch:
        rows = restored[start : start + len(parsed)]
        by_key = {
            key: np.ascontiguousarray(rows[..., where]) for key, where in normalizer.action_slices.items()
        }
        found.append(parsed.format.write_actions(by_key, parsed))
        start += len(parsed)
    return found[0] if batch.is_single else found
