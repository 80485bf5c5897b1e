"""What a policy uses of its head, and which of the head's embodiments."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from saccade._internal.arrays import Array, ArrayLike, float32, integer
from saccade.errors import InputError, ShapeError
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade.head.context import Context
from saccade.head.options import SampleOptions
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

    @property
    def num_threads(self) -> int:
        """Number of threads of a call."""

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


def check_steps(head: Head, normalizer: Normalizer) -> None:
    """Checks that a head denoises and takes as many steps as the robot needs.

    Raises:
        InputError: It does not.
    """
    config = head.config
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


def requested_id(normalizer: Normalizer, embodiment: str | int | None) -> int | None:
    """The embodiment's id: from the statistics, else as requested, or None.

    Raises:
        InputError: The two differ.
    """
    chosen = normalizer.embodiment_id
    if embodiment is None or isinstance(embodiment, str):
        return chosen
    asked = integer("embodiment", embodiment, least=0)
    if chosen is not None and asked != chosen:
        raise InputError(f"embodiment: expected that of the normalizer, {chosen}, got {asked}")
    return asked


def continue_chunk(
    head: Head, normalizer: Normalizer, given: ArrayLike, state: ArrayLike, options: SampleOptions
) -> None:
    """Puts the part of the given previous chunk that goes on, as the head takes it, into the options.

    Its actions become the first of the new chunk, so they are normalised as these: each step may have
    statistics of its own.
    """
    previous, chunking = float32("previous_chunk", given), options.get("chunking")
    if isinstance(chunking, Chunking):
        most = head.config.action_horizon
        horizon = chunking.horizon or min(normalizer.action_horizon or most, most)
        if previous.ndim < 2 or previous.shape[-2] < horizon:
            raise ShapeError(
                f"previous_chunk: expected a chunk of at least {horizon} actions (horizon of chunking), got "
                f"shape {previous.shape}"
            )
        if not chunking.overlap <= horizon <= most:
            raise InputError(
                f"chunking: expected an overlap of at most {horizon} (horizon), and that to be at most "
                f"{most}, which the head denoises, got an overlap of {chunking.overlap}"
            )
        if not chunking.overlap:  # nothing goes on
            options["previous_chunk"] = options["chunking"] = None
            return
        previous = previous[..., horizon - chunking.overlap : horizon, :]
        options["chunking"] = replace(chunking, horizon=chunking.overlap)
    normalised = np.asarray(normalizer.previous_chunk(previous, state))
    options["previous_chunk"] = padded(normalised, head.config.encoder_action_dim)
