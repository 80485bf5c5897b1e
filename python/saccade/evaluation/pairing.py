"""What two runs must share, so that their chunks are pairs: the same observation, noise and numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from saccade.errors import InputError
from saccade.evaluation.prediction import horizon_of, noise_shape

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

#: Settings of a run that must be equal, in the order in which a difference is named.
SHARED = (
    *("command", "recordings", "observation", "action_keys", "head_widths", "horizon", "noise_shape"),
    *("language_key", "stride", "seed"),
)
#: Settings of a run that say what it was, and their types.
SAID = {
    "checkpoint": dict,
    "options": dict,
    "sampling": dict,
    "saccade": str,
    "library": str,
    "instruction_set": str,
    "dot_products": list,
}


def interface_of(policy: Policy) -> dict[str, Any]:
    """What a policy is shown and what it answers, as JSON values.

    Returns:
        ``observation``: the cameras, the keys of the state, and their steps relative to now; ``action_keys``:
        key and number of values of each part, in order, and ``head_widths``: how many values the head has
        for it; ``horizon``: actions in a chunk; ``noise_shape``: that of the head's noise, ``[horizon,
        width]``.

    Raises:
        InputError: As :func:`saccade.evaluation.prediction.horizon_of`.
    """
    needs = policy.requirements
    cameras = None if needs.cameras is None else [camera.name for camera in needs.cameras]
    return {
        "observation": {
            "cameras": cameras,
            "camera_steps": _steps(needs.video_indices, needs.video_horizon),
            "state": dict(needs.state),
            "state_steps": _steps(needs.state_indices, needs.state_history),
        },
        "action_keys": [[group.key, group.size] for group in policy.normalizer.action_groups],
        "head_widths": [group.width for group in policy.normalizer.action_groups],
        "horizon": horizon_of(policy),
        "noise_shape": list(noise_shape(policy)),
    }


def check_shared(
    other: Mapping[str, Any], own: Mapping[str, Any], where: str, names: Iterable[str] = SHARED
) -> None:
    """Checks that the settings of two runs make their chunks pairs.

    Args:
        other: Settings of the run that is compared with.
        own: Settings of this run.
        where: How the message begins.
        names: What must be equal.

    Raises:
        InputError: They differ; the message names the first difference.
    """
    for name in names:
        if other.get(name) != own[name]:
            raise InputError(f"{where}: expected the {name} of this run, {own[name]}, got {other.get(name)}")


def check_said(settings: Mapping[str, Any], where: str) -> None:
    """Checks that the settings of a run from a file say what the run was.

    Raises:
        InputError: Something is missing or of another type; the message names the first.
    """
    for name, kind in SAID.items():
        if not isinstance(settings.get(name), kind):
            raise InputError(
                f"{where}: expected {name} in the settings of a run, got {settings.get(name)!r:.60}"
            )
    sha256, precision = settings["checkpoint"].get("sha256"), settings["options"].get("precision")
    if not isinstance(sha256, str):
        raise InputError(f"{where}: expected the sha256 of its checkpoint, got {sha256!r:.60}")
    parts = list(precision.values()) if isinstance(precision, dict) else [precision]
    if not parts or not all(isinstance(part, str) for part in parts):
        raise InputError(f"{where}: expected the precision of a run, got {precision!r:.60}")


def described(settings: Mapping[str, Any]) -> str:
    """Which checkpoint a run used, and how, in a few words.

    Example:
        >>> described({"checkpoint": {"name": "base"}, "options": {"precision": "int8"}, "sampling": {}})
        'base, int8'
        >>> eight = {"backbone": "int8", "head": "float32"}
        >>> about = {"checkpoint": {"name": "base"}, "options": {"precision": eight}}
        >>> described({**about, "sampling": {"num_steps": 2}})
        'base, backbone int8, head float32, num_steps 2'
    """
    precision = settings["options"]["precision"]
    parts = {"": precision} if isinstance(precision, str) else dict(precision)
    if len(set(parts.values())) == 1:
        parts = {"": next(iter(parts.values()))}
    named = [f"{part} {name}".strip() for part, name in parts.items()]
    named += [f"{name} {value}" for name, value in settings["sampling"].items()]
    return ", ".join([settings["checkpoint"]["name"], *named])


def _steps(indices: tuple[int, ...] | None, count: int | None) -> list[int] | int:
    """The steps, or their number where the checkpoint does not say which; a missing history is one step."""
    if indices is not None:
        return list(indices)
    return [0] if count is None or count == 1 else count
