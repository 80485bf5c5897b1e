"""A whole checkpoint as a policy of LIBERO: what the environment shows in, its actions out.

Needs no simulator: an observation is ``{"images": {"image", "wrist_image"}, "state", "instruction"}``, as
``LiberoEnvironment`` shows it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.errors import InputError
from saccade.robots import LANGUAGE_KEY
from saccade_lab.libero.execution import execute_steps
from saccade_lab.libero.gripper import gripper_rule
from saccade_lab.libero.layout import ACTION_DIM, ACTION_GROUPS, STATE_DIM, STATE_GROUPS
from saccade_lab.libero.protocols import AUTO, Protocol, choose_protocol

#: Names that released checkpoints have for the two cameras of the environment.
CAMERAS = {"image": ("image",), "wrist_image": ("wrist_image", "image2")}
#: Whose steps prepare frames and words, by ``Processor.preprocessing``.
PROGRAMS = {"isaac": "Isaac-GR00T's", "lerobot": "lerobot's"}


@dataclass(frozen=True)
class Chunk:
    """Actions and the time that they took.

    Attributes:
        actions: ``(steps, 7)`` float32, as the environment takes them.
        seconds: Time of ``encode`` (frames and words) and ``sample`` (actions).
    """

    actions: Float32Array
    seconds: Mapping[str, float]


class LiberoPolicy:
    """A whole checkpoint under a protocol.

    Args:
        whole: The policy.
        checkpoint: The directory that it was loaded from.
        asked: A name of ``saccade_lab.libero.protocols.PROTOCOLS``, or ``"auto"``.

    Attributes:
        whole: The policy.
        protocol: The protocol.
        reason: Why it is this one.
        gripper: What is done with the gripper's number, and why.
        execute_steps: Actions of a chunk that are executed.

    Raises:
        InputError: The protocol is unknown, or keys, cameras, statistics or the length of a chunk do not fit
            LIBERO or the protocol. The message names what does not.
        CheckpointError: ``n_action_steps`` of lerobot's config is damaged.

    Example:
        >>> def first_actions(checkpoint: Path, seen: dict) -> np.ndarray:
        ...     policy = LiberoPolicy(saccade.Policy.from_pretrained(checkpoint), checkpoint)
        ...     return policy.act(seen, seed=0).actions[: policy.execute_steps]
    """

    def __init__(self, whole: saccade.Policy, checkpoint: Path, asked: str = AUTO) -> None:
        self.whole = whole
        from_lerobot = whole.normalizer.pipeline is not None
        self.protocol, self.reason = choose_protocol(
            asked, whole.head.config.version, from_lerobot=from_lerobot
        )
        if whole.head.config.version == "n1.5" and not from_lerobot and whole.normalizer.data_config is None:
            raise InputError(
                "--data-config: the checkpoint does not say how it was trained. Isaac-GR00T's examples took "
                "examples.Libero.custom_data_config:LiberoDataConfig for libero_spatial, libero_object and "
                "libero_90, and examples.Libero.custom_data_config:LiberoDataConfigMeanStd for libero_goal "
                "and libero_10"
            )
        self._is_raw = not from_lerobot
        ordered = self.protocol.lerobot_form
        self._action_places = action_places(whole, ordered=ordered)
        check_state(whole, ordered=ordered)
        self._names = camera_names(whole, self.protocol)
        self.gripper = gripper_rule(whole, self.protocol, by_statistics=asked == AUTO)
        self.execute_steps, self._execute_reason = execute_steps(whole, checkpoint, self.protocol)

    @property
    def num_steps(self) -> int:
        """Denoising steps."""
        return self.protocol.num_steps or self.whole.head.config.num_steps

    def record(self, suites: list[str]) -> dict[str, Any]:
        """The protocol as results have it: ``Protocol.record``, and what depends on the checkpoint."""
        assert self.whole.processor is not None
        record = self.protocol.record(suites)
        preprocessing = self.whole.processor.preprocessing
        program = record["program"].format(version=self.whole.head.config.version.upper())
        remark = record["remark"]
        if self.protocol.lerobot_form and self._is_raw:
            program += ", with saccade's plugin (--policy.type=saccade)"
            remark += (
                f" Frames and words are prepared by {PROGRAMS[preprocessing]} steps, as the plugin does with "
                "checkpoints of this layout; lerobot's own groot policy has other steps."
            )
        return {
            **record,
            "program": program,
            "remark": remark,
            "preprocessing": preprocessing,
            "chosen": self.reason,
            "execute_steps": self.execute_steps,
            "execute_steps_reason": self._execute_reason,
            "denoising_steps": self.num_steps,
            "gripper": {"rule": self.gripper.rule, "reason": self.gripper.reason},
            "cameras": dict(self._names),
            "instruction": "task.language of the suite; the perturbed one where the suite has one",
        }

    def observation(self, seen: Mapping[str, Any]) -> dict[str, Any]:
        """What the environment shows, in the form of the protocol's program, without a batch axis.

        Args:
            seen: ``images`` by camera ``(H, W, 3)`` uint8, ``state (8,)`` float32, ``instruction``.

        Raises:
            InputError: A camera or a number of the state is missing.
        """
        state = np.asarray(seen["state"], dtype=np.float32)
        if state.shape != (STATE_DIM,):
            raise InputError(f"state: expected ({STATE_DIM},), got {state.shape}")
        missing = [camera for camera in CAMERAS if camera not in seen["images"]]
        if missing:
            raise InputError(f"images: expected {', '.join(CAMERAS)}, {', '.join(missing)} is missing")
        frames = {name: np.asarray(seen["images"][camera]) for camera, name in self._names.items()}
        if self.protocol.lerobot_form:
            return {
                **{f"observation.images.{name}": as_floats(frame) for name, frame in frames.items()},
                "observation.state": state,
                "task": seen["instruction"],
            }
        parts = np.split(state, np.cumsum(list(STATE_GROUPS.values()))[:-1])
        named = dict(zip(STATE_GROUPS, parts, strict=True))
        return {
            **{f"video.{name}": frame[None] for name, frame in frames.items()},
            **{f"state.{name}": part[None] for name, part in named.items()},
            self.whole.requirements.language_key or LANGUAGE_KEY: [seen["instruction"]],
        }

    def act(self, seen: Mapping[str, Any], *, seed: int) -> Chunk:
        """Computes a chunk of actions.

        Args:
            seen: See ``observation``.
            seed: Seed of the noise.

        Raises:
            InputError, ShapeError, DtypeError: As ``saccade.Policy.act``.
        """
        observation = self.observation(seen)
        begun = time.perf_counter()
        context = self.whole.encode(observation)
        encoded = time.perf_counter()
        answer = self.whole.sample(context, observation, seed=seed, num_steps=self.num_steps)
        sampled = time.perf_counter()
        seconds = {"encode": encoded - begun, "sample": sampled - encoded}
        return Chunk(self.gripper.applied(self._joined(answer)), seconds)

    def _joined(self, answer: Any) -> Float32Array:
        """The actions of an answer in the environment's order, ``(steps, 7)``."""
        if self.protocol.lerobot_form:
            joined = np.asarray(answer, dtype=np.float32)
        else:
            keys = [group.key for group in self.whole.normalizer.action_groups]
            joined = np.concatenate([answer[f"action.{key}"] for key in keys], axis=-1)
        found: Float32Array = joined[:, self._action_places]
        return found


def as_floats(frame: UInt8Array) -> Float32Array:
    """A frame ``(H, W, 3)`` uint8 as lerobot hands it on, ``(3, H, W)`` float32 from 0 to 1."""
    return np.moveaxis(frame, -1, 0).astype(np.float32) / np.float32(255)


def action_places(policy: saccade.Policy, *, ordered: bool) -> list[int]:
    """For each of ``ACTION_GROUPS`` its place in the action of a policy.

    ``ordered`` is whether they must be in this order, because the protocol's program does not look at keys.

    Raises:
        InputError: The action has other keys.
    """
    sizes = {group.key: group.size for group in policy.normalizer.action_groups}
    if sizes == ACTION_GROUPS and (not ordered or tuple(sizes) == tuple(ACTION_GROUPS)):
        return [list(sizes).index(key) for key in ACTION_GROUPS]
    if list(sizes.values()) == [ACTION_DIM] and policy.normalizer.pipeline is not None:
        return list(range(ACTION_DIM))
    raise InputError(
        f"checkpoint: expected the actions of LIBERO in this order, {', '.join(ACTION_GROUPS)}, or lerobot's "
        f"action of {ACTION_DIM}, got {_listed(sizes)}"
    )


def check_state(policy: saccade.Policy, *, ordered: bool) -> None:
    """Checks that the state has a key for each of ``STATE_GROUPS``, or is lerobot's one of 8 numbers.

    ``ordered`` is as for ``action_places``.

    Raises:
        InputError: It is neither.
    """
    sizes = dict(policy.requirements.state)
    is_named = sizes == STATE_GROUPS and (not ordered or tuple(sizes) == tuple(STATE_GROUPS))
    if not is_named and (list(sizes.values()) != [STATE_DIM] or policy.normalizer.pipeline is None):
        raise InputError(
            f"checkpoint: expected the state of LIBERO in this order, {_listed(STATE_GROUPS)}, or lerobot's "
            f"of {STATE_DIM}, got {_listed(sizes)}"
        )


def _listed(sizes: Mapping[str, int]) -> str:
    return ", ".join(f"{key} ({size})" for key, size in sizes.items())


def camera_names(policy: saccade.Policy, protocol: Protocol) -> dict[str, str]:
    """The name that the policy has for each camera of the environment.

    Both are always shown, as the released clients do.

    Raises:
        InputError: The checkpoint does not name its cameras, or wants one that is none of them.
    """
    needs = policy.requirements
    if needs.cameras is None:
        raise InputError(
            "checkpoint: cameras: expected names, but it does not say which it was trained with, and in "
            "which order"
        )
    renamed = dict(needs.rename_map) if protocol.lerobot_form else {}
    prefix = "observation.images."
    wanted = {camera.name for camera in needs.cameras}
    known = {name for names in CAMERAS.values() for name in names}
    given = {renamed.get(prefix + name, prefix + name).removeprefix(prefix) for name in known}
    unknown = sorted(wanted - given)
    if unknown:
        raise InputError(
            f"checkpoint: expected cameras called {', '.join(sorted(known))}, got {', '.join(unknown)}: "
            "which of LIBERO's two cameras is that?"
        )
    accepted = wanted | {camera.alias for camera in needs.cameras if camera.alias}
    usual = {"image": "image", "wrist_image": "image2" if protocol.lerobot_form else "wrist_image"}
    found = {}
    for camera, names in CAMERAS.items():
        fitting = [
            name
            for name in names
            if renamed.get(prefix + name, prefix + name).removeprefix(prefix) in accepted
        ]
        found[camera] = usual[camera] if usual[camera] in fitting or not fitting else fitting[0]
    return found
