"""Loads the parts of a whole policy from a checkpoint."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import saccade._saccade as _saccade
from saccade._internal.hub import resolve
from saccade.backbone.backbone import Backbone
from saccade.errors import CheckpointError, InputError
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.options import optional_integer, precisions_of_parts
from saccade.observations import Camera, Requirements, read_requirements
from saccade.policy.compatibility import requested_id
from saccade.processor import Preprocessing, Processor
from saccade.robots import DataConfigLike, Normalizer

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
    path = resolve(id_or_path, revision)
    check_whole(path)
    config = HeadConfig(**_saccade.Published.open(os.fspath(path), None).config())
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
    backbone = Backbone.from_pretrained(path, precision=precisions["backbone"], num_threads=num_threads)
    head = ActionHead.from_pretrained(
        path,
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
