"""Statistics of Isaac-GR00T N1.6 and N1.7: ``processor_config.json`` and ``statistics.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade.errors import CheckpointError
from saccade.robots.building import Builder, Options, finished, size_of
from saccade.robots.groups import Group, Robot


def processor_robot(
    where: str,
    kwargs: Mapping[str, Any],
    statistics: Mapping[str, Any],
    ids: Mapping[str, Any],
    options: Options,
) -> Robot:
    """The robot of a processor.

    Args:
        where: The file, for messages.
        kwargs: The ``processor_kwargs`` of ``processor_config.json``.
        statistics: The contents of ``statistics.json``: statistics by tag, modality and key.
        ids: The contents of ``embodiment_id.json``.
        options: What was requested.

    Raises:
        CheckpointError, InputError: As :meth:`saccade.Normalizer.load`.
    """
    options.refuse_keys(where)
    configs = kwargs.get("modality_configs")
    if not isinstance(configs, Mapping) or not configs:
        raise CheckpointError(f"{where}: no modality_configs")
    known = {tag: number for tag, number in ids.items() if type(number) is int}
    tags = [tag for tag in configs if tag in statistics]
    if not tags:
        raise CheckpointError(
            f"{where}: statistics of {', '.join(statistics) or 'nothing'}, groups of {', '.join(configs)}"
        )
    tag = options.choose(tags, known, where)
    if kwargs.get("use_tactile"):
        raise CheckpointError(f"{where}: use_tactile: tactile states are not supported")
    builder = Builder(f"{where}: {tag}", np.float64, is_close=True)
    config, numbers = configs[tag], statistics[tag]
    about_state, about_action = (_modality(config, kind, builder) for kind in ("state", "action"))
    state = [
        _group(builder, key, _entry(numbers, "state", key), about_state, kwargs, is_state=True)
        for key in about_state["modality_keys"]
    ]
    action = _action_groups(builder, about_action, numbers, kwargs, state)
    groups = builder.check([*state, *action])
    steps = about_action.get("delta_indices")
    return finished(
        where,
        options,
        tag,
        known.get(tag),
        groups[: len(state)],
        groups[len(state) :],
        (size_of(kwargs.get("max_state_dim")), size_of(kwargs.get("max_action_dim"))),
        cuts_state=False,
        action_horizon=len(steps) if isinstance(steps, list) and steps else None,
        zero_state=bool(kwargs.get("exclude_state") or about_state.get("exclude_state")),
    )


def _action_groups(
    builder: Builder,
    about: Mapping[str, Any],
    numbers: Any,
    kwargs: Mapping[str, Any],
    state: list[Group | None],
) -> list[Group | None]:
    """The groups of the action, absolute or relative to groups of the state."""
    found: list[Group | None] = []
    keys = about["modality_keys"]
    configs = about.get("action_configs") or [{}] * len(keys)
    if len(configs) != len(keys):
        builder.problems.append("action: expected one of action_configs for each of modality_keys")
    sizes = {one.key: one.size for one in state if one is not None}
    for key, config in zip(keys, configs, strict=False):
        reference = None
        if kwargs.get("use_relative_action") and str(config.get("rep")).lower() == "relative":
            if str(config.get("type")).lower() != "non_eef":
                builder.problems.append(f"action.{key}: relative poses of an end effector are not supported")
            reference = config.get("state_key") or key
        # Relative actions have statistics of their own, and never use quantiles.
        entry = _entry(numbers, "action" if reference is None else "relative_action", key)
        group = _group(builder, key, entry, about, kwargs, is_state=False, reference=reference)
        found.append(group)
        if reference is not None and group is not None and sizes.get(reference) != group.size:
            builder.problems.append(
                f"action.{key}: {group.size} numbers relative to state.{reference}, which has "
                f"{sizes.get(reference, 'no')}"
            )
    return found


def _modality(config: Any, kind: str, builder: Builder) -> Mapping[str, Any]:
    """What ``modality_configs`` contain of the state or the action."""
    found = config.get(kind) if isinstance(config, Mapping) else None
    keys = found.get("modality_keys") if isinstance(found, Mapping) else None
    if not isinstance(keys, list) or not keys or not all(isinstance(key, str) for key in keys):
        raise CheckpointError(f"{builder.where}: {kind}: no modality_keys")
    assert isinstance(found, Mapping)
    return found


def _entry(numbers: Any, kind: str, key: str) -> Any:
    found = numbers.get(kind) if isinstance(numbers, Mapping) else None
    return found.get(key) if isinstance(found, Mapping) else None


def _group(
    builder: Builder,
    key: str,
    statistics: Any,
    about: Mapping[str, Any],
    kwargs: Mapping[str, Any],
    *,
    is_state: bool,
    reference: str | None = None,
) -> Group | None:
    """One group of the state or the action."""
    if (
        is_state
        and kwargs.get("apply_sincos_state_encoding")
        and key in (about.get("sin_cos_embedding_keys") or ())
    ):
        return builder.group(key, statistics, "sin_cos")
    clips = kwargs.get("clip_outliers") is not False
    if key in (about.get("mean_std_embedding_keys") or ()):
        # Actions are clipped in every mode, states only if they are scaled by bounds.
        return builder.group(
            key, statistics, "mean_std", clips=clips and not is_state, clips_back=True, reference=reference
        )
    uses_quantiles = kwargs.get("use_percentiles") and reference is None
    bounds = {"min": "q01", "max": "q99"} if uses_quantiles else {"min": "min", "max": "max"}
    if isinstance(statistics, Mapping):
        statistics = {name: statistics.get(stored) for name, stored in bounds.items()}
    return builder.group(key, statistics, "min_max", clips=clips, clips_back=True, reference=reference)
