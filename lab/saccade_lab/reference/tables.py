"""The two sinusoidal tables of the head, correctly rounded to float32.

Exponents are computed in float32 in the order of the released code. exp, sin and cos are computed in float64
and rounded once. The float32 exp of vector libraries differs in the last bit, which changes an angle by 6e-5
at a bucket of 900. Therefore the rounding is part of the definition, and does not depend on the library.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

LOG_10000 = np.float32(np.log(10000.0))
TIMESTEP_CHANNELS = 256


@cache
def action_frequencies(width: int, device: torch.device) -> Tensor:
    """Frequencies of the table for the action tokens, ``(width // 2,)`` float32."""
    half = width // 2
    exponents = -np.arange(half, dtype=np.float32) * (LOG_10000 / np.float32(half))
    return torch.from_numpy(np.exp(exponents.astype(np.float64)).astype(np.float32)).to(device)


@cache
def timestep_frequencies(device: torch.device) -> Tensor:
    """Frequencies of the time embedding, ``(128,)`` float32. The divisor 127 makes the last one 1/10000."""
    half = TIMESTEP_CHANNELS // 2
    exponents = (-LOG_10000 * np.arange(half, dtype=np.float32)) / np.float32(half - 1)
    return torch.from_numpy(np.exp(exponents.astype(np.float64)).astype(np.float32)).to(device)


def sin_and_cos(timestep: Tensor, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    """Sine and cosine of float32(timestep * frequency).

    Args:
        timestep: Buckets, ``(batch,)``, any number type.
        frequencies: ``(half,)`` float32.

    Returns:
        Two float32 tensors ``(batch, half)``.
    """
    angles = timestep.to(torch.float32)[:, None] * frequencies  # (batch, half), rounded to float32
    angles = angles.to(torch.float64)
    return torch.sin(angles).to(torch.float32), torch.cos(angles).to(torch.float32)


def action_time_table(timestep: Tensor, width: int) -> Tensor:
    """The vector that is appended to every action token, ``(batch, width)`` float32. Sines come first."""
    return torch.cat(sin_and_cos(timestep, action_frequencies(width, timestep.device)), dim=-1)


def timestep_table(timestep: Tensor) -> Tensor:
    """The input of the timestep encoder, ``(batch, 256)`` float32. Cosines come first."""
    sin, cos = sin_and_cos(timestep, timestep_frequencies(timestep.device))
    return torch.cat((cos, sin), dim=-1)
