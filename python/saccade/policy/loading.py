"""Loads the parts of a whole policy from a checkpoint, and checks that head and statistics fit each other."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.arrays import integer
from saccade._internal.hub import locate
from saccade.backbone.backbone import Backbone
from saccade.errors import CheckpointError, InputError
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.options import optional_integer, precisions_of_parts
from saccade.observations import Camera, Requirements, read_requirements
from saccade.policy.interfaces import Head
from saccade.processor import Preprocessing, Processor
from saccade.robots import DataConfigLike, Normalizer
from saccade.robots.embodiments import resolved

#: What the names of a part's tensors begin with, in NVIDIA's and in lerobot's checkpoints.
HEAD = ("action_head.", "_groot_model.action_head.")
BACKBONE = ("backbone.", "_groot_model.backbone.")


def load_parts(
    id_or_path: str | os.PathLike[str],
    *,
    revision: str | None,
    embodiment: str | int | None,
    preprocessing: Preprocessing | None,
    tokenizer: str | os.PathLike[str] | None,
    precision: str | Mapping[str, str],
    num_threads: int | None,
    normalizer: Normalizer | Mapping[str, Any] | str | os.PathLike[str] | None,
    cameras: Sequence[str] | None,
    data_config: DataConfigLike | None,
    action_horizon: int | None,
    processor_options: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """The arguments of :class:`saccade.Policy`, from a whole checkpoint.

    What is quick to load comes first, so that a mistake is found before gigabytes are read.
    """
    precisions = precisions_of_parts(precision)
    location = locate(id_or_path, revision)
    path = location.path
    check_whole(path)
    config = HeadConfig(**_saccade.HeadCheckpoint.open(os.fspath(path), None).config())
    statistics = read_normalizer(path if normalizer is None else normalizer, embodiment, data_config, config)
    horizon = _horizon(statistics, action_horizon)
    requirements = read_requirements(path, statistics)
    if cameras is not None:
        chosen = _chosen(cameras, requirements)
        requirements = replace(requirements, cameras=chosen, takes_extra_cameras=False)
    processor = Processor.from_pretrained(
        path, preprocessing=preprocessing, tokenizer=tokenizer, options=processor_options
    )
    embodiment_id = requested_id(statistics, embodiment)
    # The larger part first: what loading needs for a while then adds to less.
    backbone = Backbone.from_pretrained(location, precision=precisions["backbone"], num_threads=num_threads)
    head = ActionHead.from_pretrained(
        location,
        embodiment_ids=None if embodiment_id is None else [embodiment_id],
        action_horizon=horizon,
        # N1.7 takes as many states as its config says; the policy checks that the robot has as many.
        num_states=None if config.version == "n1.7" else statistics.state_history,
        precision=precisions["head"],
        num_threads=num_threads,
    )
    return {
        "head": head,
        "normalizer": statistics,
        "embodiment": embodiment_id,
        "backbone": backbone,
        "processor": processor,
        "requirements": requirements,
    }


def read_normalizer(
    given: Normalizer | Mapping[str, Any] | str | os.PathLike[str],
    embodiment: str | int | None,
    data_config: DataConfigLike | None,
    config: HeadConfig,
) -> Normalizer:
    """A normalizer as it is; from anything else as it is read for a head of this config."""
    if not isinstance(given, Normalizer):
        return Normalizer.from_pretrained(
            given,
            embodiment,
            data_config=data_config,
            state_dim=config.state_dim,
            action_dim=config.encoder_action_dim,
        )
    if data_config is not None:
        raise InputError("data_config: expected None with a Normalizer, which has its own")
    return given


def _horizon(normalizer: Normalizer, requested: int | None) -> int | None:
    """Number of actions that the head denoises; None for those of its config."""
    asked = optional_integer("action_horizon", requested)
    said = normalizer.denoised_horizon
    if asked is not None and said is not None and asked != said:
        raise InputError(
            f"action_horizon: expected {said}, the number of action_indices of the data config, got {asked}"
        )
    return said if asked is None else asked


def check_whole(path: Path) -> None:
    """Checks that a checkpoint holds a head and a backbone."""
    names = _saccade.tensor_names(os.fspath(path))
    has_backbone = any(name.startswith(BACKBONE) for name in names)
    # A head alone may have no prefix.
    has_head = any(name.startswith(HEAD) for name in names) or not has_backbone
    if has_head and has_backbone:
        return
    if has_head:
        raise CheckpointError(
            f"{path}: expected a whole checkpoint, got an action head without a backbone (no tensor's name "
            f"begins with {' or '.join(BACKBONE)}): pass features of your own to "
            "saccade.Policy(saccade.ActionHead.from_pretrained(checkpoint))"
        )
    raise CheckpointError(
        f"{path}: expected a whole checkpoint, got a backbone without an action head (no tensor's name "
        f"begins with {' or '.join(HEAD)}): saccade.Backbone.from_pretrained computes its features"
    )


def _chosen(names: Sequence[str], found: Requirements) -> tuple[Camera, ...]:
    """Cameras by name, with the sizes that the checkpoint says."""
    chosen = () if isinstance(names, str) else tuple(names)
    if not chosen or len(set(chosen)) != len(chosen) or not all(isinstance(name, str) for name in chosen):
        raise InputError(f"cameras: expected distinct names, at least one, got {names!r}")
    if found.cameras is None:
        return tuple(Camera(name) for name in chosen)
    known = {camera.name: camera for camera in found.cameras}
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise InputError(
            f"cameras: expected names among those of the checkpoint ({', '.join(known)}), got "
            f"{', '.join(unknown)}"
        )
    return tuple(known[name] for name in chosen)


def returned_horizon(head: Head, normalizer: Normalizer) -> int:
    """Number of actions of a chunk in the robot's units: the robot's, at most as many as the head denoises.

    A lerobot policy may say more, where its head was loaded with fewer.
    """
    denoised = head.config.action_horizon
    return min(normalizer.action_horizon or denoised, denoised)


def check_fit(head: Head, normalizer: Normalizer) -> None:
    """Checks that a head and a robot have the same widths, and numbers of steps that fit."""
    config = head.config
    if normalizer.state_dim != config.state_dim or normalizer.action_width > config.action_dim:
        raise InputError(
            f"normalizer: expected states of width {config.state_dim} and actions of at most width "
            f"{config.action_dim}, as this head has them, got states of width {normalizer.state_dim} "
            f"and actions of width {normalizer.action_width}"
        )
    needed, least = normalizer.denoised_horizon, normalizer.action_horizon
    if needed is not None and config.action_horizon != needed:
        raise InputError(
            f"action_horizon: expected a head that denoises {needed} actions, as the data config has, got "
            f"{config.action_horizon}: load it with action_horizon={needed}"
        )
    if least is not None and normalizer.trained_horizon is None and config.action_horizon < least:
        raise InputError(
            f"normalizer: expected chunks of at most {config.action_horizon} actions, which this head "
            f"denoises, got {least}"
        )
    oneway = [group.key for group in normalizer.action_groups if group.mode in ("scale", "sin_cos")]
    if oneway:
        raise InputError(
            "data_config: action_modes: expected modes that are converted back, got scale for "
            f"{', '.join(oneway)}"
        )
    history = normalizer.state_history
    if history is not None and history != config.num_states:
        hint = "" if config.version == "n1.7" else f": load the head with num_states={history}"
        raise InputError(
            f"normalizer: expected {config.num_states} states in an observation, which this head takes, "
            f"got {history}{hint}"
        )


def check_name(embodiment: str, head: Head, normalizer: Normalizer) -> None:
    """Checks that a name is that of the normalizer's robot, as the head's release resolves it."""
    own = normalizer.embodiment
    if resolved(embodiment, head.config.version, () if own is None else (own,)) != own:
        raise InputError(f"embodiment: expected that of the normalizer, {own!r}, got {embodiment!r}")


def embodiment_of(head: Head, normalizer: Normalizer, embodiment: str | int | None) -> int:
    """The head's embodiment: from the statistics, else as requested, else the only one that is loaded."""
    chosen = requested_id(normalizer, embodiment)
    if chosen is None and len(head.embodiment_ids) == 1:
        chosen = head.embodiment_ids[0]
    listed = ", ".join(map(str, head.embodiment_ids))
    if chosen is None:
        raise InputError(
            f"embodiment: the files do not say which of the head's embodiments {normalizer.embodiment!r} is: "
            f"pass its id, one of {listed}"
        )
    if chosen not in head.embodiment_ids:
        raise InputError(
            f"embodiment: expected the id of one of the head's embodiments ({listed}), got {chosen}"
        )
    return chosen


def requested_id(normalizer: Normalizer, embodiment: str | int | None) -> int | None:
    """The embodiment's id: from the statistics, else as requested, or None. Refused if the two differ."""
    chosen = normalizer.embodiment_id
    if embodiment is None or isinstance(embodiment, str):
        return chosen
    asked = integer("embodiment", embodiment, least=0)
    if chosen is not None and asked != chosen:
        raise InputError(f"embodiment: expected that of the normalizer, {chosen}, got {asked}")
    return asked
