"""A head in the robot's units: the robot's state in, the robot's actions out."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from saccade._arrays import Array, ArrayLike, integer
from saccade.chunking import Chunking
from saccade.config import HeadConfig
from saccade.context import Context
from saccade.errors import InputError
from saccade.options import SampleOptions
from saccade.robots import Normalizer, padded

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Head(Protocol):
    """What a policy uses of its head, which is a :class:`saccade.ActionHead`."""

    @property
    def config(self) -> HeadConfig:
        """Sizes and switches."""

    @property
    def source(self) -> str | None:
        """Path of the checkpoint, or None."""

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """The loaded embodiments."""

    def encode(
        self,
        backbone_features: ArrayLike,
        *,
        attention_mask: ArrayLike | None = None,
        image_mask: ArrayLike | None = None,
        drop_vl: ArrayLike | None = None,
    ) -> Context:
        """See :meth:`saccade.ActionHead.encode`."""

    def sample(
        self,
        context: Context,
        state: ArrayLike,
        embodiment_id: int | ArrayLike,
        **options: Unpack[SampleOptions],
    ) -> Array:
        """See :meth:`saccade.ActionHead.sample`."""


class Policy:
    """An action head with a normalizer. Created by :meth:`saccade.ActionHead.policy`.

    It takes backbone features and the robot's state, and returns the robot's actions.

    Args:
        head: The action head.
        normalizer: The normalizer of the robot, or anything that :meth:`saccade.Normalizer.load` reads one
            from. Default: the checkpoint that the head was loaded from.
        embodiment: Tag or id of the robot. Required if the statistics are of several robots. If the
            statistics do not contain the id, an id given here selects the head's embodiment.

    Attributes:
        head: The action head.
        normalizer: The normalizer.
        embodiment_id: The embodiment of the head that is used.

    Raises:
        FileNotFoundError, CheckpointError: As :meth:`saccade.Normalizer.load`.
        InputError: The normalizer does not fit the head, or the embodiment is not known.

    Example:
        The head of the bundled demo policy, on the features of one observation. The state is the position of
        the hand (x, y, z) and the opening of the gripper:

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
        head: Head,
        normalizer: Normalizer | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        embodiment: str | int | None = None,
    ) -> None:
        config = head.config
        if not isinstance(normalizer, Normalizer):
            source = head.source if normalizer is None else normalizer
            if source is None:
                raise InputError(
                    "normalizer: expected a Normalizer, got None for a head that was not loaded from a "
                    "checkpoint"
                )
            normalizer = Normalizer.load(
                source, embodiment, state_dim=config.state_dim, action_dim=config.encoder_action_dim
            )
        elif isinstance(embodiment, str) and embodiment != normalizer.embodiment:
            raise InputError(
                f"embodiment: expected that of the normalizer, {normalizer.embodiment!r}, got {embodiment!r}"
            )
        if normalizer.state_dim != config.state_dim or normalizer.action_width > config.action_dim:
            raise InputError(
                f"normalizer: expected states of width {config.state_dim} and actions of at most width "
                f"{config.action_dim}, as this head has them, got states of width {normalizer.state_dim} "
                f"and actions of width {normalizer.action_width}"
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
        **options: Unpack[SampleOptions],
    ) -> Array:
        """:meth:`saccade.ActionHead.encode` followed by :meth:`sample`.

        Args:
            backbone_features, attention_mask, image_mask, drop_vl: As in ``encode``.
            state: As in :meth:`sample`.
            **options: Keyword arguments of :meth:`sample`.
        """
        context = self.head.encode(
            backbone_features, attention_mask=attention_mask, image_mask=image_mask, drop_vl=drop_vl
        )
        return self.sample(context, state, **options)

    def sample(self, context: Context, state: ArrayLike, **options: Unpack[SampleOptions]) -> Array:
        """Samples chunks of the robot's actions.

        Args:
            context: From ``encode`` of the head.
            state: ``(batch, state_width)`` or ``(batch, state_history, state_width)``, in the robot's units.
            **options: Keyword arguments of :meth:`saccade.ActionHead.sample` except ``out``, with these
                differences:

                - ``previous_chunk``: the chunk that the robot is executing, as this method returned it,
                  ``(batch, horizon, action_width)`` in the robot's units. Actions relative to the state are
                  converted to the new state. The padding beyond the robot's action is zero, as in training.
                - ``chunking``: its ``horizon`` is the normalizer's ``action_horizon`` by default.

        Returns:
            ``(batch, horizon, action_width)`` float32 in the robot's units, with an axis of ``num_samples``
            after batch if that is given. A torch tensor if the features were torch. The horizon is the
            normalizer's ``action_horizon``, if it has one, else that of the head.

        Raises:
            ShapeError, DtypeError, InputError: As :meth:`saccade.ActionHead.sample` and
                :class:`saccade.Normalizer`.
        """
        if "out" in options:
            raise InputError("out: expected none, since it would contain the normalised actions of the head")
        previous, chunking = options.get("previous_chunk"), options.get("chunking")
        if previous is not None:
            normalised = np.asarray(self.normalizer.previous_chunk(previous, state))
            options["previous_chunk"] = padded(normalised, self.head.config.encoder_action_dim)
        horizon = self.normalizer.action_horizon
        if isinstance(chunking, Chunking) and chunking.horizon is None and horizon is not None:
            options["chunking"] = replace(chunking, horizon=min(horizon, self.head.config.action_horizon))
        actions = self.head.sample(context, self.normalizer.state(state), self.embodiment_id, **options)
        return self.normalizer.actions(actions, state)

    def __repr__(self) -> str:
        return (
            f"<saccade.Policy embodiment_id={self.embodiment_id} head={self.head!r} "
            f"normalizer={self.normalizer!r}>"
        )


def _embodiment_id(head: Head, normalizer: Normalizer, embodiment: str | int | None) -> int:
    """The head's embodiment: from the statistics, else as requested, else the only one that is loaded."""
    chosen = normalizer.embodiment_id
    if embodiment is not None and not isinstance(embodiment, str):
        asked = integer("embodiment", embodiment, least=0)
        if chosen is not None and asked != chosen:
            raise InputError(f"embodiment: expected that of the normalizer, {chosen}, got {asked}")
        chosen = asked
    if chosen is None and len(head.embodiment_ids) == 1:
        chosen = head.embodiment_ids[0]
    if chosen not in head.embodiment_ids:
        listed = ", ".join(map(str, head.embodiment_ids))
        raise InputError(
            f"embodiment: expected the id of one of the head's embodiments ({listed}), got {chosen}"
        )
    return chosen
