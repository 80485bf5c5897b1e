"""How long a chunk takes in each mode, timed alternately."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from saccade.head.head import ActionHead
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.random_checkpoint import head as random_head
from saccade_lab.study.cell import Rows
from saccade_lab.study.questions.fast_modes import Calibration, Mode, encode, sample

OWN, FULL = "own", "n1.5"  # sizes at which a chunk is timed
FULL_TOKENS = 296  # one camera of N1.5
FEWEST_ROUNDS, MOST_ROUNDS = 3, 40
ROUNDS_SECONDS = 120.0  # not exceeded after the first `FEWEST_ROUNDS`


def times_at_full_size(modes: Sequence[Mode], calibration: Calibration) -> Rows:
    """Times of a head of N1.5's size with random weights.

    Which tokens are dropped does not change the time, so they are chosen at random.
    """
    with tempfile.TemporaryDirectory() as name:
        random_head.write_head(Path(name), random_head.config_of_size(FULL))
        loaded = {
            precision: ActionHead.from_pretrained(name, precision=precision)
            for precision in dict.fromkeys(mode.precision for mode in modes)
        }
    config = next(iter(loaded.values())).config
    rng = np.random.default_rng(0)
    one = HeadInputs.random(config, FULL_TOKENS, rng)
    mass = Calibration(calibration.times, tuple(rng.random(FULL_TOKENS)))
    return times_of(modes, loaded, mass, one)


def times_of(
    modes: Sequence[Mode],
    loaded: Mapping[str, ActionHead],
    calibration: Calibration,
    observation: HeadInputs,
) -> Rows:
    """Milliseconds of ``encode`` and ``sample`` in each mode, in rounds with a random order of modes.

    Args:
        modes: Modes to time.
        loaded: The head of each precision.
        calibration: What calibrated modes depend on.
        observation: A single one, with noise.

    Returns:
        A row for each mode: medians over the rounds, and the quartiles of the whole chunk.
    """

    def timed(mode: Mode) -> tuple[float, float]:
        head = loaded[mode.precision]
        start = time.perf_counter()
        context = encode(head, mode, calibration, observation)
        encoded = time.perf_counter()
        sample(head, mode, calibration, context, observation)
        return 1e3 * (encoded - start), 1e3 * (time.perf_counter() - encoded)

    for mode in modes:
        timed(mode)  # the first call of a size allocates
    spent: dict[Mode, list[tuple[float, float]]] = {mode: [] for mode in modes}
    rng, begin = np.random.default_rng(0), time.perf_counter()
    for number in range(MOST_ROUNDS):
        if number >= FEWEST_ROUNDS and (time.perf_counter() - begin) * (number + 1) / number > ROUNDS_SECONDS:
            break
        for place in rng.permutation(len(modes)):
            spent[modes[place]].append(timed(modes[place]))
    rows = []
    for mode, found in spent.items():
        each = np.array(found)
        low, middle, high = np.quantile(each.sum(axis=1), (0.25, 0.5, 0.75))
        rows.append(
            {
                "mode": mode.name,
                "encode_ms": float(np.median(each[:, 0])),
                "sample_ms": float(np.median(each[:, 1])),
                "chunk_ms": float(middle),
                "chunk_ms_low": float(low),
                "chunk_ms_high": float(high),
                "rounds": len(each),
                "num_threads": loaded[mode.precision].num_threads,
                "isa": loaded[mode.precision].isa,
                "num_vl_tokens": observation.num_vl_tokens,
            }
        )
    return rows
