"""What a checkpoint's ``config.json`` says about how its actions are executed, beyond what saccade reads."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature

import saccade
from saccade._internal.hub import resolve
from saccade._internal.small_files import read_json


@dataclass(frozen=True)
class SavedOptions:
    """Options that are saved with a checkpoint.

    Attributes:
        n_action_steps: Number of actions of a chunk that lerobot's GR00T policy executes, or None if lerobot
            did not write the checkpoint.
        chunking: How real-time chunking releases the actions of the last chunk; without numbers of actions.
        image_features: The frames of each camera, which lerobot's async inference server resizes to.
    """

    n_action_steps: int | None = None
    chunking: saccade.Chunking = field(default_factory=lambda: saccade.Chunking(overlap=0, frozen=0))
    image_features: dict[str, PolicyFeature] = field(default_factory=dict)


def saved_options(checkpoint: str) -> SavedOptions:
    """Reads the options of a checkpoint.

    Args:
        checkpoint: A directory or id, or the weights in a directory.

    Raises:
        FileNotFoundError, saccade.CheckpointError: There is no checkpoint, or an option is damaged.
        saccade.InputError: ``rtc_ramp_rate`` is out of range.
    """
    path = resolve(checkpoint)
    path = (path if path.is_dir() else path.parent) / "config.json"
    if not path.is_file():
        return SavedOptions()
    config = read_json(path)
    rate = config.get("rtc_ramp_rate")
    chunking = SavedOptions().chunking if rate is None else saccade.Chunking(0, 0, ramp_rate=rate)
    if config.get("type") != "groot":
        return SavedOptions(chunking=chunking)
    steps = config.get("n_action_steps")
    if steps is not None and (type(steps) is not int or steps < 1):
        raise saccade.CheckpointError(f"{path}: n_action_steps: expected a number from 1 on, got {steps!r}")
    return SavedOptions(steps, chunking, _image_features(config))


def _image_features(config: dict[str, Any]) -> dict[str, PolicyFeature]:
    """The cameras whose frames have a known size. Those of another form are for saccade to judge."""
    features = config.get("input_features")
    shapes = {
        key: feature.get("shape")
        for key, feature in (features if isinstance(features, dict) else {}).items()
        if isinstance(feature, dict) and feature.get("type") == FeatureType.VISUAL.value
    }
    return {
        key: PolicyFeature(type=FeatureType.VISUAL, shape=tuple(shape))
        for key, shape in shapes.items()
        if isinstance(shape, list) and len(shape) == 3 and all(type(size) is int for size in shape)
    }
