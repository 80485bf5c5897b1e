"""A robot as groups of its state and its action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.errors import CheckpointError, InputError
from saccade.robots.building import MOST_WIDTH, Options
from saccade.robots.data_configs import DataConfig
from saccade.robots.groups import Group
from saccade.robots.lerobot_pipeline import Pipeline

#: The widths of state and action that a file says the head has.
Dims = tuple[int | None, int | None]


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot as a checkpoint describes it.

    Attributes:
        embodiment: Tag of the robot, such as ``"new_embodiment"``; None if the statistics have no name.
        embodiment_id: Its embodiment in the head; None if the checkpoint does not contain it.
        state_groups: The groups of the state, in the order of its numbers.
        action_groups: The groups of the action.
        state_dim: Width of the state that the head takes.
        action_dim: Width of the action that the head denoises.
        action_horizon: Number of steps of a chunk that are returned; None for all.
        trained_horizon: Number of steps of a chunk that were trained; None for all that are returned.
            lerobot may return more.
        denoised_horizon: Number of steps that the head must denoise; None for those of its config.
        state_history: Number of states in an observation; None if the file does not say.
        zero_state: Whether the head was trained without a state. It then gets zeros.
        offsets: True for each number of the action that the state's number at the same place is added to:
            lerobot's ``absolute_actions_processor``. None for none.
        gripper: The number of the action that becomes ``-sign(2 g - 1)``, as LIBERO's gripper has it in
            lerobot; or None.
        data_config: The data config of N1 and N1.5, or None.
        pipeline: The processors of a policy that lerobot saved, or None.
    """

    embodiment: str | None
    embodiment_id: int | None
    state_groups: tuple[Group, ...]
    action_groups: tuple[Group, ...]
    state_dim: int
    action_dim: int
    action_horizon: int | None = None
    trained_horizon: int | None = None
    denoised_horizon: int | None = None
    state_history: int | None = None
    zero_state: bool = False
    offsets: npt.NDArray[np.bool_] | None = None
    gripper: int | None = None
    data_config: DataConfig | None = None
    pipeline: Pipeline | None = None


def finished(
    where: str,
    options: Options,
    embodiment: str | None,
    embodiment_id: int | None,
    state: tuple[Group, ...],
    action: tuple[Group, ...],
    dims: Dims,
    cuts_state: bool = True,
    hint: str = "",
    **more: Any,
) -> Robot:
    """The robot, after checking that the widths of robot and head fit.

    A head may be wider than the file says: what is beyond is padding, which is zero either way. ``dims`` are
    the widths that the file says the head has, ``cuts_state`` is whether a state that is too wide is cut off,
    ``hint`` what to do about an action that is too wide, and ``more`` are the remaining fields of the robot.
    """
    widths = [sum(group.width for group in groups) for groups in (state, action)]
    found, limits = [], []
    for name, width, given, said in zip(
        ("state_dim", "action_dim"), widths, (options.state_dim, options.action_dim), dims, strict=True
    ):
        if given is not None and said is not None and given < said:
            raise InputError(f"{name}: expected at least {said}, the head's in {where}, got {given}")
        found.append(given or said or width)
        limits.append(said or given or width)
        if found[-1] > MOST_WIDTH:
            raise CheckpointError(f"{where}: {name}: expected at most {MOST_WIDTH}, got {found[-1]}")
    if widths[0] > limits[0] and not cuts_state:
        raise CheckpointError(
            f"{where}: the robot's state has {widths[0]} numbers, the head's only {limits[0]} (state_dim)"
        )
    if widths[1] > limits[1]:
        raise CheckpointError(
            f"{where}: the robot's action has {widths[1]} numbers, the head's only {limits[1]} (action_dim)"
            f"{hint}"
        )
    return Robot(embodiment, embodiment_id, state, action, found[0], found[1], **more)
