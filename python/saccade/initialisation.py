"""How the released code draws a head's tensors before any training, and how far a tensor is from that.

The constructors: ``nn.Linear`` draws weight and bias uniformly from ±1 / sqrt(inputs); the layers of the
embodiments draw their weights from a normal distribution of standard deviation 0.02 and set biases to zero;
future tokens and positions are normal with 0.02; norms begin at one and zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

#: Standard deviation of what is drawn from a normal distribution.
NORMAL_STD = 0.02

#: Numbers of a tensor that its distribution is judged by, evenly spaced.
SAMPLE = 1 << 16

#: A smaller sample tells a normal distribution from a uniform one too rarely: weights are larger, most biases
#: are not.
LEAST_SAMPLE = 2048

#: The distance that one draw in a thousand exceeds is this over the square root of the sample (Kolmogorov).
CRITICAL = 1.95

#: What rounding to bfloat16 can add: 2^-9 of a value, times the density there, at most.
ROUNDING = 0.001

_GRID = np.linspace(-6.0, 6.0, 6001)
_NORMAL_CDF = np.array([0.5 * (1.0 + math.erf(x / math.sqrt(2.0))) for x in _GRID])

Array = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Draw:
    """A distribution.

    Attributes:
        kind: ``"normal"`` (mean zero), ``"uniform"`` (around zero) or ``"constant"``.
        scale: its standard deviation, its bound, or the constant.
    """

    kind: str
    scale: float

    @property
    def std(self) -> float:
        """Its standard deviation."""
        return {"normal": self.scale, "uniform": self.scale / math.sqrt(3.0), "constant": 0.0}[self.kind]

    def cdf(self, values: Array) -> Array:
        """The share of draws below each value; not of constants."""
        if self.kind == "uniform":
            return np.asarray(np.clip((values / self.scale + 1.0) / 2.0, 0.0, 1.0))
        return np.asarray(np.interp(values / self.scale, _GRID, _NORMAL_CDF))


def draw(name: str, inputs: int) -> Draw:
    """How a tensor of the head is drawn.

    Args:
        name: without prefix.
        inputs: of the linear layer that it belongs to; not used for others.
    """
    if name.endswith(".W") or name in ("future_tokens.weight", "position_embedding.weight"):
        return Draw("normal", NORMAL_STD)
    if name.endswith(".b"):
        return Draw("constant", 0.0)
    if is_norm(name):
        return Draw("constant", 1.0 if name.endswith(".weight") else 0.0)
    return Draw("uniform", 1.0 / math.sqrt(inputs))


def is_norm(name: str) -> bool:
    """Whether it is a layer norm's weight or bias; ``norm1.linear`` of a block is a linear layer."""
    module = name.rpartition(".")[0]
    return module.rpartition(".")[2] in ("vlln", "norm1", "norm3")


def sample(values: Array) -> Array:
    """Up to `SAMPLE` numbers of a tensor, evenly spaced, in float64."""
    flat = values.reshape(-1)
    return flat[:: max(1, -(-flat.size // SAMPLE))].astype(np.float64)


def distance(values: Array, drawn: Draw) -> float:
    """The largest difference between the shares of numbers below a value, in a sample and in the distribution
    (Kolmogorov and Smirnov's statistic): 0 to 1. Of a constant, the share of numbers that are another.
    """
    if drawn.kind == "constant":
        return float(np.mean(values != drawn.scale))
    ordered = np.sort(values)
    expected = drawn.cdf(ordered)
    steps = np.arange(ordered.size + 1) / ordered.size
    return float(max(np.max(steps[1:] - expected), np.max(expected - steps[:-1])))


def is_as_drawn(values: Array, drawn: Draw) -> bool | None:
    """Whether a sample is what the constructor draws, as far as its distribution tells: 999 of 1000 fresh
    tensors are. None where there are too few numbers.
    """
    if drawn.kind == "constant":
        return distance(values, drawn) == 0.0
    if values.size < LEAST_SAMPLE:
        return None
    return distance(values, drawn) <= CRITICAL / math.sqrt(values.size) + ROUNDING
