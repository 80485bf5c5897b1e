"""Writes what ``experiment_cfg/metadata.json`` of an N1.5 checkpoint says of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def metadata(
    tag: str,
    statistics: Mapping[str, Any],
    groups: Mapping[str, Mapping[str, int]],
    video: Mapping[str, Any],
) -> dict[str, Any]:
    """The content of the file, for one robot.

    Args:
        tag: Its embodiment tag.
        statistics: By ``"state"`` and ``"action"``, group and name.
        groups: Number of joints by ``"state"`` and ``"action"``, and group.
        video: What is known of each camera.
    """
    joint = {"absolute": True, "rotation_type": None, "continuous": True}
    modalities = {
        "video": dict(video),
        **{
            kind: {name: {**joint, "shape": [width]} for name, width in groups[kind].items()}
            for kind in ("state", "action")
        },
    }
    return {tag: {"statistics": statistics, "modalities": modalities, "embodiment_tag": tag}}
