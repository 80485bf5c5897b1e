"""Which keys and steps a policy takes from a data set: from a data config, or all of them, now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from saccade.datasets.modality import Modality
from saccade.errors import InputError
from saccade.observations import Camera
from saccade.observations.pictures import ObservingPolicy
from saccade.robots import DataConfigLike
from saccade.robots.data_configs import data_config

KINDS = ("video", "state", "action", "language")

#: As :class:`saccade.Normalizer` takes it, or the modality configs of N1.6 and N1.7.
SelectionLike: TypeAlias = "DataConfigLike | Mapping[str, Any]"


@dataclass(frozen=True)
class Part:
    """Keys of one modality, and the steps that are taken of each, relative to the present one."""

    keys: tuple[str, ...]
    indices: tuple[int, ...] | None


@dataclass(frozen=True)
class Selection:
    """What a policy takes. ``indices`` of actions are None if nothing says which."""

    video: Part
    state: Part
    action: Part
    language: str | None


def read_selection(given: SelectionLike | None, modality: Modality) -> Selection:
    """The selection of a data config. Without one, all keys of the data set, and the present step.

    Args:
        given: A data config of N1.5, as :class:`saccade.Normalizer` takes it; or modality configs of N1.6 and
            N1.7, ``{"video": {"delta_indices": [0], "modality_keys": ["front"]}, ...}``.
        modality: The keys of the data set.

    Raises:
        FileNotFoundError, CheckpointError, InputError: As of ``data_config``. Or a key is not in the data
            set; the message lists all of them.
    """
    if given is None:
        found = Selection(
            Part(tuple(modality.video), (0,)),
            Part(tuple(modality.state), (0,)),
            Part(tuple(modality.action), None),
            None,
        )
    elif isinstance(given, Mapping) and given and set(given) <= set(KINDS):
        found = _from_configs(given)
    else:
        config = data_config(given)
        steps = config.observation_indices
        found = Selection(
            Part(config.keys("video"), steps),
            Part(config.keys("state"), steps),
            Part(config.keys("action"), config.action_indices),
            config.language_keys[0] if config.language_keys else None,
        )
    _check(found, modality, "data_config")
    return found


def _check(found: Selection, modality: Modality, argument: str) -> None:
    """Checks that the keys are in the data set."""
    missing = [
        f"{kind}.{key}"
        for kind, there in (("video", modality.video), ("state", modality.state), ("action", modality.action))
        for key in getattr(found, kind).keys
        if key not in there
    ]
    if found.language is not None and found.language not in modality.language:
        missing.append(found.language)
    if missing:
        names = [f"{kind}.{key}" for kind in KINDS[:3] for key in getattr(modality, kind)]
        raise InputError(
            f"{argument}: {', '.join(missing)}: not in {modality.where}, which has "
            f"{', '.join([*names, *modality.language])}"
        )


def _from_configs(given: Mapping[str, Any]) -> Selection:
    """The selection of modality configs of N1.6 and N1.7."""
    parts = {}
    for kind in KINDS:
        about = given.get(kind, {"delta_indices": [0], "modality_keys": []})
        keys = about.get("modality_keys") if isinstance(about, Mapping) else None
        steps = about.get("delta_indices") if isinstance(about, Mapping) else None
        if keys is None or not _all(keys, str) or not steps or not _all(steps, int):
            raise InputError(
                f"data_config: {kind}: expected modality_keys and delta_indices, got {about!r:.100}"
            )
        parts[kind] = Part(tuple(keys), tuple(steps))
    language = parts["language"]
    if len(language.keys) > 1 or language.indices != (0,):
        raise InputError(
            "data_config: language: expected one key and the step 0, as the released loader does"
        )
    return Selection(parts["video"], parts["state"], parts["action"], next(iter(language.keys), None))


def selection_of(policy: ObservingPolicy, modality: Modality, opened: Selection) -> Selection:
    """The keys and steps of a policy.

    Args:
        policy: The policy.
        modality: The keys of the data set.
        opened: What the data set was opened with; it says what the checkpoint does not: at which steps a
            history is, and which of several instructions counts.

    Raises:
        InputError: The data set has not the policy's keys, or the checkpoint does not say at which steps its
            history is.
    """
    needs, normalizer = policy.requirements, policy.normalizer
    if normalizer.pipeline is not None:  # lerobot's policies have the names of the data set
        cameras, states, actions = (tuple(keys) for keys in (modality.video, modality.state, modality.action))
    else:
        cameras = tuple(modality.video)
        if needs.cameras is not None and not needs.takes_extra_cameras:
            cameras = tuple(_camera(camera, modality) for camera in needs.cameras)
        states = tuple(key for key, _ in needs.state)
        actions = tuple(group.key for group in normalizer.action_groups)
    language = needs.language_key
    if len(needs.language_keys) > 1:
        raise InputError(f"policy: expected one language key, got {', '.join(needs.language_keys)}")
    if needs.any_annotation and language not in modality.language:
        language = opened.language if opened.language in modality.language else None
    found = Selection(
        Part(cameras, _steps("frames", needs.video_indices, needs.video_horizon, opened.video)),
        Part(states, _steps("states", needs.state_indices, needs.state_history, opened.state)),
        Part(actions, needs.action_indices),
        language,
    )
    _check(found, modality, "policy")
    return found


def _camera(camera: Camera, modality: Modality) -> str:
    """The name that a data set has for a camera of a policy."""
    if camera.alias is not None and camera.alias in modality.video and camera.name not in modality.video:
        return camera.alias
    return camera.name


def _steps(what: str, indices: tuple[int, ...] | None, count: int | None, opened: Part) -> tuple[int, ...]:
    """The steps of a history, which are known if there is none, or from a data config of that length."""
    if indices is not None:
        return indices
    if count not in (None, 1):
        if opened.indices is not None and len(opened.indices) == count:
            return opened.indices
        raise InputError(
            f"data_config: expected one, because the checkpoint does not say at which steps the "
            f"{count} {what} of an observation are"
        )
    return (0,)


def _all(values: Any, kind: type) -> bool:
    return (
        isinstance(values, Sequence)
        and not isinstance(values, str)
        and all(type(one) is kind for one in values)
    )
