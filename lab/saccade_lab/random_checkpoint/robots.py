"""The robots that random checkpoints are for: an arm of five joints, and LIBERO's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

#: Lower and upper bound of each number of a group; None where they are drawn.
Bounds = tuple[list[float], list[float]]


@dataclass(frozen=True)
class RandomRobot:
    """A robot of a random checkpoint.

    Attributes:
        tags, ids: Its embodiment tag and the published id, by version.
        state, action: Number of values of each group.
        cameras: Names, in the order of the prompt.
        resolution: Width and height of the recorded frames.
        bounds: Bounds of the statistics by kind and group; where there are none they are drawn.
    """

    tags: Mapping[str, str]
    ids: Mapping[str, int]
    state: Mapping[str, int]
    action: Mapping[str, int]
    cameras: tuple[str, ...]
    resolution: tuple[int, int]
    bounds: Mapping[str, Mapping[str, Bounds]]

    def statistics(self, rng: np.random.Generator) -> dict[str, dict[str, dict[str, list[float]]]]:
        """Statistics by kind, group and name, with the drawn ones from ``rng``."""
        return {
            kind: {
                name: _given(*self.bounds[kind][name]) if kind in self.bounds else _drawn(rng, width)
                for name, width in groups.items()
            }
            for kind, groups in (("state", self.state), ("action", self.action))
        }


def _drawn(rng: np.random.Generator, width: int) -> dict[str, list[float]]:
    """Statistics of one group of joints."""
    centre, half = rng.standard_normal(width), 0.1 + rng.random(width)
    shares = {"max": 1.0, "min": -1.0, "mean": 0.1, "q01": -0.9, "q99": 0.9}
    return {key: (centre + share * half).tolist() for key, share in shares.items()} | {
        "std": (half / 2).tolist()
    }


def _given(low: list[float], high: list[float]) -> dict[str, list[float]]:
    """Statistics with these bounds."""
    middle = [(one + other) / 2 for one, other in zip(low, high, strict=True)]
    quarter = [(other - one) / 4 for one, other in zip(low, high, strict=True)]
    return {"max": high, "min": low, "mean": middle, "std": quarter, "q01": low, "q99": high}


_VERSIONS = ("n1.5", "n1.6", "n1.7")
_ARM = {"single_arm": 5, "gripper": 1}
_POSE = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 1)

ROBOTS: Mapping[str, RandomRobot] = {
    "arm": RandomRobot(
        tags=dict.fromkeys(_VERSIONS, "new_embodiment"),
        ids={"n1.5": 31, "n1.6": 10, "n1.7": 10},
        state=_ARM,
        action=_ARM,
        cameras=("front", "wrist"),
        resolution=(640, 480),
        bounds={},
    ),
    # Keys, ids and bounds are those of the published LIBERO checkpoints, the bounds rounded.
    "libero": RandomRobot(
        tags={"n1.5": "new_embodiment", "n1.6": "libero_panda", "n1.7": "libero_sim"},
        ids={"n1.5": 31, "n1.6": 2, "n1.7": 2},
        state={**_POSE, "gripper": 2},
        action={**_POSE, "gripper": 1},
        cameras=("image", "wrist_image"),
        resolution=(256, 256),
        bounds={
            "state": {
                "x": ([-0.483], [0.210]),
                "y": ([-0.326], [0.391]),
                "z": ([0.446], [1.333]),
                "roll": ([1.132], [3.671]),
                "pitch": ([-3.641], [3.561]),
                "yaw": ([-1.843], [1.386]),
                "gripper": ([-0.001, -0.0411], [0.0416, 0.0014]),
            },
            "action": {
                **dict.fromkeys(("x", "y", "z"), ([-0.9375], [0.9375])),
                "roll": ([-0.236], [0.300]),
                "pitch": ([-0.305], [0.294]),
                "yaw": ([-0.368], [0.375]),
                "gripper": ([0.0], [1.0]),
            },
        },
    ),
}
