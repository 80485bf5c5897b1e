"""What training adds to the head: the distribution of times, the loss, and unused parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from saccade.head.config import HeadConfig
from saccade_lab.reference.layers import TABLE_STD

MASK_TOKEN = "mask_token"  # N1.6: replaces a state that training drops
LOG_SIGMA = "task_log_sigma."  # the fork: learned weights of its decoders' losses


@dataclass(frozen=True)
class TimeDistribution:
    """The distribution of flow times in training: ``scale * (1 - b)`` with ``b ~ Beta(alpha, beta)``.

    This is the form of the later releases. Times are in [0, scale], and most are near 0, where the actions
    are mostly noise.
    """

    alpha: float = 1.5
    beta: float = 1.0
    scale: float = 0.999

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> "TimeDistribution":
        """Reads ``noise_beta_alpha``, ``noise_beta_beta`` and ``noise_s``, by default the released values."""
        head = config.get("action_head_cfg", config)
        return cls(
            alpha=float(head.get("noise_beta_alpha", cls.alpha)),
            beta=float(head.get("noise_beta_beta", cls.beta)),
            scale=float(head.get("noise_s", cls.scale)),
        )

    def draw(self, batch: int, generator: torch.Generator | None = None) -> np.ndarray:
        """Draws ``(batch,)`` float64 times."""
        # torch's Beta accepts no generator, so the generator seeds NumPy's.
        seed = int(torch.randint(2**63 - 1, (), generator=generator))
        drawn = np.random.default_rng(seed).beta(self.alpha, self.beta, size=batch)
        return self.scale * (1.0 - drawn)


def flow_matching_error(
    predicted: Tensor, actions: Tensor, noise: Tensor, action_mask: Tensor | None
) -> Tensor:
    """The mean squared error of a velocity, which should be ``actions - noise``.

    Args:
        predicted, actions, noise: ``(B, T, action_dim)``.
        action_mask: Weights, broadcast to ``(B, T, action_dim)``; None weighs all equally.

    Returns:
        A scalar.
    """
    error = (predicted - (actions - noise)).square()  # (B, T, action_dim)
    if action_mask is None:
        return error.mean()
    mask = action_mask.expand_as(error)
    return (error * mask).sum() / mask.sum()


def is_unused(name: str) -> bool:
    """Whether only the released training uses a checkpoint's parameter of this name."""
    return name == MASK_TOKEN or name.startswith(LOG_SIGMA)


def hold_unused(head: nn.Module, name: str, config: HeadConfig) -> None:
    """Adds a parameter that only the released training uses to a head, with that code's initial value."""
    if name == MASK_TOKEN:
        head.register_parameter(MASK_TOKEN, nn.Parameter(torch.randn(1, 1, config.width).mul_(TABLE_STD)))
    else:
        sigmas = getattr(head, "task_log_sigma", nn.ParameterDict())
        sigmas[name.removeprefix(LOG_SIGMA)] = nn.Parameter(torch.zeros(()))
        head.task_log_sigma = sigmas
