"""A head in the robot's units: what the robot is and does, in place of normalised numbers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from saccade._arrays import Array, ArrayLike, integer
from saccade.chunking import Chunking
from saccade.errors import InputError
from saccade.normalizer import Normalizer, padded

if TYPE_CHECKING:
    from saccade.head import ActionHead, Context


class Policy:
    """An action head between the two halves of a :class:`saccade.Normalizer`: backbone features and the
    robot's state to the robot's actions. Made by :meth:`saccade.ActionHead.policy`.

    Args:
        head: The action head.
        normalizer: Of the robot; or what :meth:`saccade.Normalizer.load` reads it from. Default: the
            checkpoint that the head was loaded from.
        embodiment: Tag or id of the robot, where the statistics are of several. An id also says which of the
            head's embodiments to use where the statistics do not.

    Attributes:
        head: As given.
        normalizer: As given, or as read.
        embodiment_id: Which of the head's embodiments is used.

    Raises:
        FileNotFoundError, CheckpointError: as :meth:`saccade.Normalizer.load`.
        InputError: the normalizer does not fit the head, or nothing says which embodiment is meant.

    Example:
        The demo policy's head on the features of one observation, hand at x, y, z and a gripper:

        >>> import importlib.resources
        >>> import numpy as np, saccade
        >>> head = saccade.ActionHead.load(importlib.resources.files("saccade") / "sim" / "demo")
        >>> policy = head.policy()
        >>> features = np.zeros((1, 57, head.config.context_dim), np.float32)
        >>> policy(features, np.array([[0.0, 0.6, 0.2, 1.0]]), seed=0).shape
        (1, 16, 4)
    """

    def __init__(
        self,
        head: ActionHead,
        normalizer: Normalizer | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment: str | int | None = None,
    ) -> None:
        config = head.config
        if not isinstance(normalizer, Normalizer):
            source = head._source if normalizer is None else normalizer
            if source is None:
                raise InputError(
                    "normalizer: this head was not loaded from a checkpoint; expected a Normalizer"
                )
            normalizer = Normalizer.load(
                source, embodiment, state_dim=config.state_dim, action_dim=config.encoder_action_dim
            )
        elif isinstance(embodiment, str) and embodiment != normalizer.embodiment:
            raise InputError(
                f"embodiment: given {embodiment!r}, but the normalizer is of {normalizer.embodiment!r}"
            )
        if normalizer.state_dim != config.state_dim or normalizer.action_width > config.action_dim:
            raise InputError(
                f"normalizer: gives states of {normalizer.state_dim} and takes at least "
                f"{normalizer.action_width} numbers an action; the head takes states of {config.state_dim} "
                f"and gives {config.action_dim} numbers an action"
            )
        self.head = head
        self.normalizer = normalizer
        self.embodiment_id = _embodiment_id(head, normalizer, embodiment)

    def __call__(
        self,
        backbone_features: ArrayLike,
        state: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
        **options: Any,
    ) -> Array:
        """:meth:`saccade.ActionHead.encode`, then :meth:`sample`."""
        context = self.head.encode(
            backbone_features, attention_mask=attention_mask, image_mask=image_mask, drop_vl=drop_vl
        )
        return self.sample(context, state, **options)

    def sample(
        self,
        context: Context,
        state: ArrayLike,
        *,
        previous_chunk: ArrayLike | None = None,
        chunking: Chunking | None = None,
        **options: Any,
    ) -> Array:
        """A chunk of the robot's actions.

        Args:
            context: From the head's ``encode``.
            state: ``(batch, state_width)`` or ``(batch, state_history, state_width)``, in the robot's units.
            previous_chunk: The chunk that the robot is following, as it came from here, ``(batch, horizon,
                action_width)`` in the robot's units; see :meth:`saccade.ActionHead.sample`. Where actions are
                relative to the state, it is taken relative to the new one. The head's padding beyond the
                robot's numbers is taken for zeros, as in training.
            chunking: What of it stays; both or neither. Its ``horizon`` is by default the normalizer's
                ``action_horizon``.
            options: ``noise``, ``seed``, ``num_steps``, ``integrator``, ``num_samples``, ``future_refresh``
                and ``intervention`` of :meth:`saccade.ActionHead.sample`.

        Returns:
            ``(batch, horizon, action_width)`` float32 in the robot's units, with ``num_samples`` an axis of
            that size after batch; torch if the features were. The horizon is the normalizer's
            ``action_horizon``, if it has one.

        Raises:
            ShapeError, DtypeError, InputError: as ``ActionHead.sample`` and :class:`saccade.Normalizer`.
        """
        if "out" in options:
            raise InputError("out: expected none, since the head's normalised actions would be written to it")
        if previous_chunk is not None:
            previous = np.asarray(self.normalizer.previous_chunk(previous_chunk, state))
            options["previous_chunk"] = padded(previous, self.head.config.encoder_action_dim)
        horizon = self.normalizer.action_horizon
        if isinstance(chunking, Chunking) and chunking.horizon is None and horizon is not None:
            chunking = replace(chunking, horizon=min(horizon, self.head.config.action_horizon))
        if chunking is not None:
            options["chunking"] = chunking
        normalised = self.head.sample(context, self.normalizer.state(state), self.embodiment_id, **options)
        return self.normalizer.actions(normalised, state)

    def __repr__(self) -> str:
        return (
            f"<saccade.Policy embodiment_id={self.embodiment_id} head={self.head!r} "
            f"normalizer={self.normalizer!r}>"
        )


def _embodiment_id(head: ActionHead, normalizer: Normalizer, embodiment: str | int | None) -> int:
    """The head's embodiment: what the statistics say, else what was asked for, else the only one."""
    chosen = normalizer.embodiment_id
    if embodiment is not None and not isinstance(embodiment, str):
        asked = integer("embodiment", embodiment, least=0)
        if chosen is not None and asked != chosen:
            raise InputError(f"embodiment: given {asked}, but the normalizer is of {chosen}")
        chosen = asked
    if chosen is None and len(head.embodiment_ids) == 1:
        chosen = head.embodiment_ids[0]
    if chosen not in head.embodiment_ids:
        listed = ", ".join(map(str, head.embodiment_ids))
        raise InputError(
            f"embodiment: expected the id of one of the head's embodiments ({listed}), got "
            f"{'nothing that says which' if chosen is None else chosen}"
        )
    return chosen
