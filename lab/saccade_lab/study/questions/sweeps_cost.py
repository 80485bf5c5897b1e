"""What the heads of trained policies cost: latency, timed alternately, and memory."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence

import numpy as np

from saccade.head.head import ActionHead
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.cell import Rows
from saccade_lab.study.runs import Run, describe_run
from saccade_lab.study.statistics import bootstrap

ROUNDS = 200  # each round times every policy once


def cost(runs: Sequence[Run]) -> Rows:
    """Latency and memory of each head on one thread.

    Args:
        runs: One of each point; ratios are to the first.

    Returns:
        A row for each run: medians in milliseconds, and ratios with 95 % intervals over rounds.
    """
    from saccade.processor import Processor
    from saccade_lab.sim.policy import num_vl_tokens
    from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig

    rng = np.random.default_rng(0)
    heads, inputs = [], []
    for run in runs:
        head = ActionHead.from_pretrained(run.directory, num_threads=1)
        config = SimulationConfig.from_file(run.directory / CONFIG_FILE)
        tokens = num_vl_tokens(Processor.from_pretrained(run.directory), config)
        head.warmup(tokens)
        heads.append(head)
        inputs.append(HeadInputs.random(head.config, tokens, rng))
    spent = np.zeros((2, ROUNDS, len(runs)))  # encode and sample, milliseconds
    for turn, (place, head) in itertools.product(range(ROUNDS), list(enumerate(heads))):
        start = time.perf_counter()
        context = inputs[place].encode(head)
        between = time.perf_counter()
        inputs[place].sample(head, context)
        spent[:, turn, place] = 1e3 * (between - start), 1e3 * (time.perf_counter() - between)
    rows = []
    for place, (run, head) in enumerate(zip(runs, heads, strict=True)):
        context = inputs[place].encode(head)
        row = {**describe_run(run), "head_bytes": head.nbytes, "context_bytes": context.nbytes}
        row["num_vl_tokens"] = context.num_vl_tokens
        for part, of_part in zip(("encode", "sample"), spent, strict=True):
            ratio = bootstrap(of_part[:, place] / of_part[:, 0], range(ROUNDS), np.median, draws=500)
            row |= {f"{part}_ms": float(np.median(of_part[:, place])), f"{part}_ratio": ratio.value}
            row |= {f"{part}_ratio_low": ratio.low, f"{part}_ratio_high": ratio.high}
        rows.append(row)
    return rows
