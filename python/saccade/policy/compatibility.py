"""Checks that an action head and the statistics of a robot fit each other."""

from __future__ import annotations

from saccade._internal.arrays import integer
from saccade.errors import InputError
from saccade.policy.interfaces import Head
from saccade.robots import Normalizer
from saccade.robots.embodiments import resolved


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
