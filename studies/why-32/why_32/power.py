"""The power of the confirmatory tests, by simulating the analysis itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from saccade.errors import InputError
from saccade_lab.study.sign_flip import sign_flip_p
from saccade_lab.study.statistics import CONFIDENCE, holm
from why_32.contrasts import CONFIRMATORY, CORE


def power(
    *,
    run_deviation: float,
    correlation: float,
    rate: float,
    episodes: int,
    num_seeds: int,
    effects: Sequence[float],
    draws: int = 2000,
    seed: int = 0,
) -> Mapping[str, float]:
    """The chance that each confirmatory test rejects, after Holm's correction, at the 5 % level.

    The true success rate of a policy is `rate` plus the effect of its N plus a normal deviation of its
    training; policies of one training seed share a part of it. Its episodes are independent draws at that
    rate. Episodes on equal layouts are in fact positively correlated between policies, which makes the
    differences more precise than they are here.

    Args:
        run_deviation: Standard deviation of the true success rate between training seeds.
        correlation: Correlation of that deviation between policies of one training seed, 0 to 1.
        rate: Mean true success rate where the effect is 0.
        episodes: Episodes of each policy.
        num_seeds: Training seeds of each N.
        effects: True effects of N = 0, 4, 32 on the success rate.
        draws, seed: Number of simulated studies and seed of the random generator.

    Returns:
        A share for each test of `CONFIRMATORY`, by its name.

    Raises:
        InputError: an argument is out of range.

    Example:
        Twelve training seeds, 100 episodes, and a gain of 20 points between N = 0 and N = 32:

        >>> found = power(run_deviation=0.06, correlation=0.3, rate=0.4, episodes=100, num_seeds=12,
        ...               effects=(0.0, 0.15, 0.2))
        >>> {name: round(share, 1) for name, share in found.items()}
        {'n-32 minus n-0': 1.0, 'n-32 minus n-4': 0.3, 'slope over log2(N + 1), N = 0, 4, 32': 1.0}
    """
    if not (0 <= rate <= 1 and 0 <= correlation <= 1 and run_deviation >= 0 and min(episodes, draws) >= 1):
        raise InputError(
            f"rate, correlation, run_deviation, episodes, draws: given {rate}, {correlation}, "
            f"{run_deviation}, {episodes}, {draws}; expected two fractions, a number of at least 0 and two "
            "of at least 1"
        )
    if len(effects) != len(CORE):
        raise InputError(f"effects: given {len(effects)}, expected one for each N of {list(CORE.values())}")
    rng = np.random.default_rng(seed)
    shared = rng.standard_normal((draws, num_seeds, 1)) * np.sqrt(correlation)
    own = rng.standard_normal((draws, num_seeds, len(CORE))) * np.sqrt(1 - correlation)
    true = np.clip(rate + np.asarray(effects) + run_deviation * (shared + own), 0.0, 1.0)
    rates = rng.binomial(episodes, true) / episodes
    names = list(CORE)
    values = [one.of(rates[..., [names.index(recipe) for recipe in one.recipes]]) for one in CONFIRMATORY]
    p_values = np.stack([sign_flip_p(of_test) for of_test in values], axis=-1)
    rejected = np.array([holm(row) for row in p_values]) <= 1 - CONFIDENCE
    return {
        contrast.name: float(share) for contrast, share in zip(CONFIRMATORY, rejected.mean(0), strict=True)
    }
