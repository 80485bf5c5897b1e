"""Real-time chunking as lerobot's rollout asks for it, in the terms of :class:`saccade.Chunking`."""

from dataclasses import replace
from typing import Any

from torch import Tensor

import saccade


def continued(
    left_over: Any,
    inference_delay: Any,
    *,
    batch: int,
    horizon: int,
    execution_horizon: int | None,
    chunking: saccade.Chunking,
) -> dict[str, Any]:
    """The options of :meth:`saccade.Policy.sample` with which a chunk continues what the robot executes.

    The rule is that of lerobot's own GR00T policy, as of lerobot 0.6: zero rows at the end are padding. Of
    the others the last ``execution_horizon`` become the first actions of the new chunk.

    Args:
        left_over: Actions of the last chunk that were not executed yet, ``(T, D)`` for every observation or
            ``(B, T, D)``, or None.
        inference_delay: Number of these that the robot executes while the new chunk is computed, or None.
        batch: Number of observations.
        horizon: Number of actions that the head denoises.
        execution_horizon: Most actions that are continued. Default: all.
        chunking: The rule, of which the numbers of actions are replaced.

    Returns:
        ``previous_chunk`` and ``chunking``; or no options, if there is nothing to continue.

    Raises:
        saccade.DtypeError, saccade.ShapeError, saccade.InputError: An argument does not fit.
    """
    if left_over is None:
        return {}
    if not isinstance(left_over, Tensor):
        raise saccade.DtypeError(
            f"prev_chunk_left_over: expected a torch tensor, got {type(left_over).__name__}"
        )
    if left_over.numel() == 0:
        return {}
    rows = left_over.detach().cpu()
    rows = rows[None] if rows.ndim == 2 else rows
    if rows.ndim != 3 or len(rows) not in (1, batch):
        raise saccade.ShapeError(
            f"prev_chunk_left_over: expected (T, D), or (B, T, D) with B {batch}, got "
            f"{tuple(left_over.shape)}"
        )
    rows = _without_padding(rows.expand(batch, -1, -1))[:, -horizon:]
    most = rows.shape[1] if execution_horizon is None else int(execution_horizon)
    overlap = min(rows.shape[1], most)
    if overlap <= 0:
        return {}
    frozen = min(max(_delay(inference_delay), 0), overlap)
    # All rows that are given are taken over. So row j of them becomes action j of the new chunk, also where
    # each step of a chunk has statistics of its own.
    return {
        "previous_chunk": rows[:, -overlap:],
        "chunking": replace(chunking, overlap=overlap, frozen=frozen, horizon=overlap),
    }


def _without_padding(rows: Tensor) -> Tensor:
    """The rows up to the last one with a number other than zero: lerobot's engine pads with zeros."""
    used = (rows != 0).any(dim=2).any(dim=0).nonzero()
    return rows[:, : int(used[-1]) + 1] if len(used) else rows[:, :0]


def _delay(given: Any) -> int:
    """A number of actions. None is none.

    Raises:
        saccade.InputError: It is not a number.
    """
    try:
        return int(given or 0)
    except (TypeError, ValueError, OverflowError):
        raise saccade.InputError(f"inference_delay: expected a number of actions, got {given!r}") from None
