"""Real-time chunking: how a chunk continues the previous one."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade_lab.reference.checks import check_shape

SLOWEST_RAMP = 1e-9  # a slower ramp is straight to nine digits as well, and could underflow


def start_of(
    noise: Tensor, previous: Tensor | None, chunking: Chunking | None, config: HeadConfig
) -> tuple[Tensor, Tensor | None]:
    """What a chunk starts from, and the factor of its velocity: the noise and None without a previous chunk.

    Returns:
        ``continued (B, T, encoder_action_dim)`` and ``velocity_strength (T, 1)``.

    Raises:
        ShapeError: The previous chunk has the wrong shape.
        InputError: One of ``previous`` and ``chunking`` is given without the other, or they do not fit the
            head.
    """
    if (previous is None) != (chunking is None):
        given, missing = ("chunking", "previous_chunk") if chunking else ("previous_chunk", "chunking")
        raise InputError(f"previous_chunk, chunking: expected both or neither, got {given} without {missing}")
    if previous is None or chunking is None:
        return noise, None
    start = continued(noise, previous, chunking, config)  # first, since it checks that they fit the head
    strength = torch.from_numpy(velocity_strength(chunking, config.action_horizon)).to(noise)
    return start, strength[:, None]


def continued(start: Tensor, previous: Tensor, chunking: Chunking, config: HeadConfig) -> Tensor:
    """Noise whose first actions are replaced by the end of the previous chunk.

    Args:
        start: The noise, ``(B, T, encoder_action_dim)``.
        previous: The previous chunk, ``(B, rows, action_dim)`` or ``(B, rows, encoder_action_dim)``.
        chunking: How many actions are replaced, and where they are in the previous chunk.
        config: Config of the head.

    Returns:
        ``(B, T, encoder_action_dim)``.

    Raises:
        ShapeError: The previous chunk has another shape.
        InputError: Overlap or horizon do not fit the head.
    """
    horizon = config.action_horizon if chunking.horizon is None else chunking.horizon
    if not chunking.overlap <= horizon <= config.action_horizon:
        raise InputError(
            f"chunking: expected overlap <= horizon <= {config.action_horizon}, got overlap "
            f"{chunking.overlap} and horizon {horizon}"
        )
    dims = config.action_dim if previous.shape[-1] == config.action_dim else config.encoder_action_dim
    rows = previous.shape[1] if previous.ndim == 3 else None
    rows = rows if rows in range(horizon, config.action_horizon) else config.action_horizon
    check_shape("previous_chunk", previous, (len(start), rows, dims))
    previous = F.pad(previous, (0, config.encoder_action_dim - dims))
    tail = previous[:, horizon - chunking.overlap : horizon]  # (B, overlap, encoder_action_dim)
    return torch.cat((tail, start[:, chunking.overlap :]), dim=1)


def velocity_strength(chunking: Chunking, action_horizon: int) -> np.ndarray:
    """The factor of the velocity of each action of a chunk that continues the previous one.

    Args:
        chunking: Frozen actions do not change, and the rest of the overlap is released gradually.
        action_horizon: Number of actions in a chunk.

    Returns:
        ``(action_horizon,)`` float64: 0 for the f frozen actions; then, up to the overlap o, for action j
        (1 - exp(-a r)) / (1 - exp(-a)) with r = (j - f + 1) / (o - f + 1) and a = ``ramp_rate``; then 1.
    """
    frozen, overlap = chunking.frozen, chunking.overlap
    strength = np.ones(action_horizon)
    strength[:frozen] = 0.0
    r = np.arange(1, overlap - frozen + 1) / (overlap - frozen + 1)
    rate = max(chunking.ramp_rate, SLOWEST_RAMP)
    strength[frozen:overlap] = np.expm1(-rate * r) / np.expm1(-rate)
    return strength
