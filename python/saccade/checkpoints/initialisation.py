"""The distributions that a head's tensors have before training, and how far a tensor is from them.

The released constructors initialise tensors as follows. ``nn.Linear`` draws weight and bias uniformly from
±1 / sqrt(inputs). The category-specific layers draw weights from a normal distribution with standard
deviation 0.02, and their biases are zero. Future tokens and positions are normal with standard deviation
0.02. Norms start with weight one and bias zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

#: Standard deviation of all normal distributions.
NORMAL_STD = 0.02

#: Number of values of a tensor that its distribution is judged by, evenly spaced.
SAMPLE = 1 << 16

#: A smaller sample rarely distinguishes a normal distribution from a uniform one. Weights are larger, most
#: biases are smaller.
LEAST_SAMPLE = 2048

#: One draw in a thousand exceeds the distance CRITICAL / sqrt(sample size) (Kolmogorov).
CRITICAL = 1.95

#: Largest distance that rounding to bfloat16 can add: 2^-9 of a value times the density there.
ROUNDING = 0.001

_GRID = np.linspace(-6.0, 6.0, 6001)
_NORMAL_CDF = np.array([0.5 * (1.0 + math.erf(x / math.sqrt(2.0))) for x in _GRID])

Array = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Draw:
    """A distribution."""

    kind: str
    """``"normal"`` (with mean zero), ``"uniform"`` (symmetric about zero) or ``"constant"``."""
    scale: float
    """The standard deviation, the bound, or the constant."""

    def cdf(self, values: Array) -> Array:
        """Cumulative distribution function of a normal or uniform distribution."""
        if self.kind == "uniform":
            return np.asarray(np.clip((values / self.scale + 1.0) / 2.0, 0.0, 1.0))
        return np.asarray(np.interp(values / self.scale, _GRID, _NORMAL_CDF))


def draw(name: str, inputs: int) -> Draw:
    """The distribution of a tensor of the head before training, by its name without prefix.

    ``inputs`` is the number of inputs of the linear layer that it belongs to, if it is one's.
    """
    if name.endswith(".W") or name in ("future_tokens.weight", "position_embedding.weight"):
        return Draw("normal", NORMAL_STD)
    if name.endswith(".b"):
        return Draw("constant", 0.0)
    if is_norm(name):
        return Draw("constant", 1.0 if name.endswith(".weight") else 0.0)
    return Draw("uniform", 1.0 / math.sqrt(inputs))


def is_norm(name: str) -> bool:
    """Whether a tensor belongs to a layer norm. ``norm1.linear`` of a block is a linear layer."""
    module = name.rpartition(".")[0]
    return module.rpartition(".")[2] in ("vlln", "norm1", "norm3")


def sample(values: Array) -> Array:
    """Up to `SAMPLE` values of a tensor, evenly spaced, in float64."""
    flat = values.reshape(-1)
    return flat[:: max(1, -(-flat.size // SAMPLE))].astype(np.float64)


def distance(values: Array, drawn: Draw) -> float:
    """The Kolmogorov-Smirnov statistic of a sample, from 0 to 1.

    This is the largest difference between the cumulative distribution functions of sample and distribution.
    For a constant, it is the share of values that differ from it.
    """
    if drawn.kind == "constant":
        return float(np.mean(values != drawn.scale))
    ordered = np.sort(values)
    expected = drawn.cdf(ordered)
    steps = np.arange(ordered.size + 1) / ordered.size
    return float(max(np.max(steps[1:] - expected), np.max(expected - steps[:-1])))


def is_as_drawn(values: Array, drawn: Draw) -> bool | None:
    """Whether a sample may come from a distribution, as of 999 of 1000 untrained tensors; None if small."""
    if drawn.kind == "constant":
        return distance(values, drawn) == 0.0
    if values.size < LEAST_SAMPLE:
        return None
    return distance(values, drawn) <= CRITICAL / math.sqrt(values.size) + ROUNDING
