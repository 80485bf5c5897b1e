"""The answer to `get_modality_config`: keys and steps of cameras, states, actions and words.

All releases send the same request, and read the answer differently: N1.5 wants each `ModalityConfig` as JSON
text with prefixed keys (``video.front``), N1.6 and N1.7 want a map with plain keys.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal.json import dumps
from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError
from saccade.policy.loading import returned_horizon
from saccade.robots import LANGUAGE_KEY
from saccade.robots.building import is_list_of
from saccade.robots.reading import processor_folder

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

MODALITIES = ("video", "state", "action", "language")

Configs = dict[str, dict[str, Any]]


def form_of(version: str) -> str:
    """The format that the released clients of a version of :class:`saccade.HeadConfig` read."""
    return "text" if version in ("n1", "n1.5") else "map"


def answers(policy: Policy) -> dict[str, Any]:
    """The answer in both formats: as ``"text"`` for N1.5, and as ``"map"`` for N1.6 and later.

    Raises:
        CheckpointError: A file of the checkpoint is damaged.
    """
    # N1.5's and N1.6's clients know the first mark, N1.7's the second.
    marks = {"__ModalityConfig_class__": True, "__ModalityConfig__": True}
    forms: dict[str, Any] = {"text": {}, "map": {}}
    for name, config in (_of_checkpoint(policy) or _of_policy(policy)).items():
        # N1.5's class has two fields, and keys with the modality, which those of words have already.
        prefix = "" if name == "language" else f"{name}."
        keys = [prefix + key for key in config["modality_keys"]]
        text = dumps({"delta_indices": config["delta_indices"], "modality_keys": keys})
        forms["text"][name] = {**marks, "as_json": text}
        forms["map"][name] = {**marks, "as_json": config}
    return forms


def _of_checkpoint(policy: Policy) -> Configs | None:
    """The configs that N1.6's and N1.7's checkpoints contain, as they are."""
    source, embodiment = policy.head.source, policy.requirements.embodiment
    if source is None or embodiment is None:
        return None
    path = processor_folder(Path(source)) / "processor_config.json"
    if not path.is_file():
        return None
    values = read_json(path)
    if "processor_kwargs" not in values:  # the processor of another transformers model
        return None
    try:
        robot = values["processor_kwargs"]["modality_configs"][embodiment]
        found = {name: dict(robot[name]) for name in MODALITIES if name in robot}
        for config in found.values():
            for field, kind in (("delta_indices", int), ("modality_keys", str)):
                given = config[field]
                if not is_list_of(kind, given):
                    raise ValueError(f"expected a list of {kind.__name__}, got {given!r:.100}")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: modality_configs of an unknown form ({error!r})") from error
    return found


def _of_policy(policy: Policy) -> Configs:
    """Configs made from what the policy knows; with a data config, those that it states."""
    needs, normalizer = policy.requirements, policy.normalizer
    seen, acted = needs.observation_indices, needs.action_indices
    horizon = returned_horizon(policy.head, normalizer)
    keys = {
        "video": [camera.name for camera in needs.cameras or ()],
        "state": [group.key for group in normalizer.state_groups],
        "action": [group.key for group in normalizer.action_groups],
        "language": list(needs.language_keys) or [LANGUAGE_KEY],
    }
    steps = {
        "video": range(1 - (needs.video_horizon or 1), 1) if seen is None else seen,
        "state": range(1 - needs.state_history, 1) if seen is None else seen,
        "action": range(horizon) if acted is None else acted[:horizon],
        "language": range(1) if seen is None else seen,
    }
    return {
        name: {"delta_indices": list(steps[name]), "modality_keys": keys[name]}
        for name in MODALITIES
        if keys[name]
    }
