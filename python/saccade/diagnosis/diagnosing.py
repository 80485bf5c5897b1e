"""``saccade.diagnose``: changes the inputs of recorded observations, and says which of them are used."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from saccade._internal.arrays import integer
from saccade.diagnosis.effects import measure_episode
from saccade.diagnosis.plan import default_episodes, planned
from saccade.diagnosis.report import Diagnosis, summarised
from saccade.evaluation.recordings import Recordings, chosen_episodes, fitted

if TYPE_CHECKING:
    from saccade.policy.policy import Policy


def diagnose(
    policy: Policy,
    data: Recordings,
    *,
    episodes: Sequence[int] | None = None,
    seed: int = 0,
    on_episode: Callable[[int], None] | None = None,
) -> Diagnosis:
    """Measures which inputs of a policy change its actions on recorded observations.

    What is changed, how the effect is measured, and the rules of the verdicts are in ``docs/diagnose.md``.

    Args:
        policy: A whole policy.
        data: Recorded episodes: :func:`saccade.datasets.open`, or anything with the same members. Their
            actions are not needed.
        episodes: Places of episodes in the data set. Default: at most 20, evenly spaced.
        seed: Seed of noise, partners and shuffled words.
        on_episode: Called after each episode with the number of episodes that are done.

    Raises:
        InputError, ShapeError, DtypeError: An option is out of range, or a recording does not fit the policy;
            the message then names episode and step.

    Example:
        >>> import saccade
        >>> def listens(policy: saccade.Policy, data: "saccade.datasets.Dataset") -> bool:
        ...     return saccade.diagnose(policy, data).inputs["instruction"].name == "used"
    """
    data = fitted(policy, data)
    chosen = chosen_episodes(
        data, default_episodes(len(data)) if episodes is None and len(data) else episodes
    )
    plan = planned(policy, data, chosen, integer("seed", seed, least=0))
    measured = []
    for episode in chosen:
        measured.append(measure_episode(policy, data, episode, plan, time.perf_counter))
        if on_episode is not None:
            on_episode(len(measured))
    return summarised(measured, plan, list(policy.normalizer.action_slices))
