"""What the heads of the study's policies cost on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from saccade.study.cell import Rows
from saccade.study.questions.sweeps_cost import cost
from saccade.study.runs import read_run

#: The stage. It is the last one and a single cell, so that nothing else of the study runs beside it.
TIMES = "times"


def latencies(checkpoints: Sequence[Path]) -> Rows:
    """Times the heads of policies alternately, on one thread.

    Args:
        checkpoints: Directories of the policies; ratios are to the first.

    Returns:
        A row for each, as `saccade.study.questions.sweeps_cost.cost` returns it.
    """
    return cost([read_run(directory, ()) for directory in checkpoints])
