"""Embodiments whose state does not act, in checkpoints of GR00T-H.

Its class keeps how often training sets the state of each embodiment to zero, and at inference sets those to
zero for which training always did.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from saccade.errors import CheckpointError

STATE_DROPOUT = "dropout_prob_by_embodiment"  # the tensor, (num_embodiments,)
CONFIG_KEY = "state_dropout_prob_per_embodiment"  # what the class makes it from, by tag
ALWAYS = 0.999  # a state is set to zero at inference if the probability is above this


def drops_states(config: Mapping[str, Any], is_there: bool) -> bool:
    """Whether the tensor acts: if it is in the file, unless the config of the head says that there is none.

    Raises:
        CheckpointError: The config says that states are set to zero, but the tensor is missing.
    """
    given = config.get(CONFIG_KEY, is_there)
    by_tag = given.values() if isinstance(given, Mapping) else ()
    if not is_there and any(probability > ALWAYS for probability in by_tag):
        raise CheckpointError(f"{STATE_DROPOUT} is missing, but {CONFIG_KEY} is {given} in the config")
    return is_there and bool(given)


def check_probabilities(probabilities: Tensor) -> None:
    """Raises CheckpointError unless all probabilities are finite."""
    if not bool(torch.isfinite(probabilities).all()):
        raise CheckpointError(f"{STATE_DROPOUT}: expected finite numbers, got {probabilities.tolist()}")


def seen_state(state: Tensor, probabilities: Tensor, embodiment_id: int | Tensor) -> Tensor:
    """``state (B, rows, width)`` with zeros for the embodiments that training always dropped it for."""
    dropped = probabilities.float()[embodiment_id] > ALWAYS  # () or (B,)
    return torch.where(dropped.reshape(-1, 1, 1), torch.zeros_like(state), state)
