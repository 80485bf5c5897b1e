"""How many actions of a chunk are executed: by the protocol, or as lerobot's groot policy computes it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from saccade import Policy
from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError, InputError
from saccade.policy.loading import returned_horizon
from saccade.robots.libero import EXECUTED_STEPS, TAG, is_isaac_libero
from saccade_lab.libero.protocols import Protocol

#: lerobot's ``chunk_size`` and ``n_action_steps`` where config.json has none, and the value that it replaces
#: by it because it is the default of N1.5.
DEFAULT_STEPS, OLD_DEFAULT = 40, 50
#: What ``base_model_path`` is where config.json has none.
DEFAULT_BASE = "nvidia/GR00T-N1.7-3B"
#: An id of the Hub. lerobot looks for files of ``base_model_path`` on this machine only, and finds none.
HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


def execute_steps(policy: Policy, checkpoint: Path, protocol: Protocol) -> tuple[int, str]:
    """How many actions of a chunk are executed, and why.

    Args:
        policy: The policy.
        checkpoint: The directory that it was loaded from.
        protocol: The protocol.

    Raises:
        InputError: A chunk has fewer than the protocol executes; or lerobot's number depends on a folder that
            is not there.
        CheckpointError: lerobot refuses the numbers in its config, or they are none.

    Example:
        >>> from saccade_lab.libero.protocols import PROTOCOLS
        >>> def executed(policy: Policy, folder: Path) -> int:
        ...     return execute_steps(policy, folder, PROTOCOLS["isaac-n17"])[0]
    """
    normalizer = policy.normalizer
    horizon = returned_horizon(policy.head, normalizer)
    trained = min(horizon, normalizer.trained_horizon or horizon)
    if protocol.execute_steps is not None:
        if trained < protocol.execute_steps:
            raise InputError(
                f"--protocol {protocol.name}: executes {protocol.execute_steps} actions of a chunk, the "
                f"checkpoint has {trained}"
            )
        return protocol.execute_steps, "as the program"
    if normalizer.pipeline is None:
        if is_isaac_libero(normalizer, policy.head.config.version):
            return min(trained, EXECUTED_STEPS), f"lerobot executes {EXECUTED_STEPS} for {TAG}"
        return trained, "all of a chunk, as lerobot does where the checkpoint does not say"
    steps, reason = lerobot_steps(checkpoint)
    doubt = f"; only {trained} were trained" if trained < min(steps, horizon) else ""
    return min(steps, horizon), reason + doubt


def lerobot_steps(checkpoint: Path) -> tuple[int, str]:
    """What lerobot's groot policy of N1.7 executes of a checkpoint that lerobot saved, and why.

    It is the least of ``n_action_steps``, the horizon in ``processor_config.json`` of ``base_model_path``,
    if that is a folder on the machine that evaluates, and, again only if it is, 8 for ``libero_sim``.

    Args:
        checkpoint: The directory, with a ``config.json``.

    Raises:
        InputError: The number depends on a folder that is not there; or lerobot executes no chunks of the
            policy, because its actions are relative.
        CheckpointError: ``n_action_steps`` or ``chunk_size`` is no number from 1 on, or the first is larger.
    """
    path = checkpoint / "config.json"
    config = read_json(path)
    if config.get("use_relative_actions"):
        raise InputError(
            f"--protocol lerobot: {path}: use_relative_actions: lerobot-eval refuses such policies, since "
            "groot's select_action does not execute their chunks"
        )
    said, chunk_size = (_number(path, config, name) for name in ("n_action_steps", "chunk_size"))
    if said > chunk_size:
        raise CheckpointError(
            f"{path}: n_action_steps: expected at most chunk_size, {chunk_size}, as lerobot does, got {said}"
        )
    base = config.get("base_model_path") or DEFAULT_BASE
    tag = config.get("embodiment_tag", "new_embodiment")
    if not isinstance(base, str):
        raise CheckpointError(f"{path}: base_model_path: expected a path or an id, got {base!r:.60}")
    if not Path(base).expanduser().is_dir():
        if said == 1:  # whatever the folder says
            return 1, "n_action_steps of the checkpoint's config"
        if HUB_ID.fullmatch(base) is None:
            raise InputError(
                f"--protocol lerobot: {path}: base_model_path: {base} is not on this machine: lerobot "
                f"executes the least of n_action_steps ({said}), the horizon in that folder's "
                f"processor_config.json, and for {TAG} {EXECUTED_STEPS}"
            )
        return said, f"n_action_steps of the checkpoint's config; lerobot looks at no file of {base}"
    horizon = _horizon(Path(base).expanduser() / "processor_config.json", tag)
    if horizon is None:
        return said, f"n_action_steps of the checkpoint's config; {base} has no horizon of {tag}"
    limits = [said, horizon, *([EXECUTED_STEPS] if tag == TAG else [])]
    named = f"n_action_steps {said}, horizon {horizon}" + (
        f", {EXECUTED_STEPS} for {TAG}" if tag == TAG else ""
    )
    return min(limits), f"the least of {named}, as lerobot does"


def _number(path: Path, config: dict[str, Any], name: str) -> int:
    value = config.get(name, DEFAULT_STEPS)
    if type(value) is not int or value < 1:
        raise CheckpointError(f"{path}: {name}: expected a number from 1 on, got {value!r:.60}")
    return DEFAULT_STEPS if value == OLD_DEFAULT else value


def _horizon(path: Path, tag: str) -> int | None:
    """The number of an embodiment's action steps in a processor's config, or None, as lerobot finds it."""
    found: Any = read_json(path) if path.is_file() else {}
    for name in ("processor_kwargs", "modality_configs", tag, "action"):
        found = found.get(name) if isinstance(found, dict) else None
    steps = found.get("delta_indices") if isinstance(found, dict) else None
    return len(steps) or None if isinstance(steps, list) else None
