"""The answer to `get_modality_config`: keys and steps of cameras, states, actions and words.

All releases ask for it alike, and read it differently: N1.5 wants each `ModalityConfig` as JSON text with
prefixed keys (``video.front``), N1.6 and N1.7 want a map with plain keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from saccade._internal import hub
from saccade._internal.json import dumps
from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError
from saccade.robots import LANGUAGE_KEY
from saccade.robots.reading import processor_folder

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

#: The forms of the answer: that of N1.5, and that of N1.6 and later.
FORMS = ("text", "map")
MODALITIES = ("video", "state", "action", "language")

Configs = dict[str, dict[str, Any]]


def form_of(version: str) -> str:
    """The form that the released clients of a version read.

    Args:
        version: As in :class:`saccade.HeadConfig`.
    """
    return "text" if version in ("n1", "n1.5") else "map"


def answers(policy: Policy) -> dict[str, Any]:
    """The answer in each of the `FORMS`.

    Raises:
        CheckpointError: A file of the checkpoint is damaged.
    """
    configs = _of_checkpoint(policy) or _of_policy(policy)
    return {
        "text": {name: _wrapped(dumps(_prefixed(name, config))) for name, config in configs.items()},
        "map": {name: _wrapped(config) for name, config in configs.items()},
    }


def _wrapped(config: Any) -> dict[str, Any]:
    # N1.5's and N1.6's clients know the first mark, N1.7's the second.
    return {"__ModalityConfig_class__": True, "__ModalityConfig__": True, "as_json": config}


def _prefixed(modality: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """As N1.5's class has it: two fields, and keys with the modality, which those of words have."""
    keys = config["modality_keys"]
    if modality != "language":
        keys = [f"{modality}.{key}" for key in keys]
    return {"delta_indices": config["delta_indices"], "modality_keys": keys}


def _of_checkpoint(policy: Policy) -> Configs | None:
    """The configs that N1.6's and N1.7's checkpoints contain, as they are."""
    source, embodiment = policy.head.source, policy.requirements.embodiment
    if source is None or embodiment is None:
        return None
    path = processor_folder(hub.resolve(source)) / "processor_config.json"
    if not path.is_file():
        return None
    values = read_json(path)
    if "processor_kwargs" not in values:  # the processor of another transformers model
        return None
    try:
        robot = values["processor_kwargs"]["modality_configs"][embodiment]
        found = {name: dict(robot[name]) for name in MODALITIES if name in robot}
        for config in found.values():
            _check(config["delta_indices"], int)
            _check(config["modality_keys"], str)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path}: modality_configs of an unknown form ({error!r})") from error
    return found


def _of_policy(policy: Policy) -> Configs:
    """Configs made from what the policy knows; with a data config, those that it states."""
    needs, normalizer = policy.requirements, policy.normalizer
    seen, acted = needs.observation_indices, needs.action_indices
    horizon = normalizer.action_horizon or policy.head.config.action_horizon
    keys = {
        "video": [camera.name for camera in needs.cameras or ()],
        "state": [group.key for group in normalizer.state_groups],
        "action": [group.key for group in normalizer.action_groups],
        "language": list(needs.language_keys) or [LANGUAGE_KEY],
    }
    steps = {
        "video": range(1 - (needs.video_horizon or 1), 1) if seen is None else seen,
        "state": range(1 - needs.state_history, 1) if seen is None else seen,
        "action": range(horizon) if acted is None else acted,
        "language": range(1) if seen is None else seen,
    }
    return {
        name: {"delta_indices": list(steps[name]), "modality_keys": keys[name]}
        for name in MODALITIES
        if keys[name]
    }


def _check(values: Any, kind: type) -> None:
    if not isinstance(values, list) or not all(type(value) is kind for value in values):
        raise ValueError(f"expected a list of {kind.__name__}, got {values!r:.100}")
