"""How far the actions of a trained policy follow rows of another observation."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from saccade_lab.study.cell import Rows
from saccade_lab.study.questions.patching import Pair, patched, simulated_pair
from saccade_lab.study.questions.patching_section import measured_rows, shares

#: The stage, for trained policies with tokens.
PATCHING = "patching"
#: The kind of donors, of `saccade study patching`: another layout, with the same task and instruction.
DONORS = "layout"


def measure(checkpoint: str, tasks: Sequence[str], seeds: range) -> Rows:
    """Rows of the first observation of one episode inserted into the run of another, from the same noise.

    Args:
        checkpoint: Directory of the policy.
        tasks, seeds: The receivers. Donors have the seeds that follow.

    Returns:
        A row for each group of rows and each block, and one for all blocks: `group`, `block`, `pairs`, and
        `share` and `size` of `saccade_lab.study.questions.patching_section.shares`. Rows are patched in all
        Euler steps.
    """
    from saccade_lab.study.simulator import Simulator

    source = Simulator(checkpoint, tuple(tasks), seeds)
    head, config = source.head(), source.config
    found: Rows = []
    for task, seed in source.units:
        pair = simulated_pair(source, DONORS, task, seed, seed + len(seeds))
        assert isinstance(pair, Pair)  # every task has other layouts
        columns = {"task": task, "seed": seed, **pair.labels}
        found += patched(
            head, pair, range(config.num_layers), range(config.num_steps), columns, source.action_width
        )
    rows: Rows = []
    for (group, block), of_place in measured_rows(pd.DataFrame(found)).groupby(
        ["group", "block"], sort=False
    ):
        share, size = shares(of_place)
        rows.append(
            {"group": group, "block": block, "share": share.value, "size": size, "pairs": len(of_place)}
        )
    return rows
