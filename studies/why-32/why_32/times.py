"""What the heads of the study's policies cost on this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from saccade._internal.files import write_json
from saccade_lab.study.cell import Rows
from saccade_lab.study.questions.sweeps_cost import cost
from saccade_lab.study.runs import SETTINGS_FILE, read_run
from why_32.plan import Plan, PlannedPolicy, Recording

#: The stage. It is the last one and a single cell, so that nothing else of the study runs beside it.
TIMES = "times"
#: The column that says whether a policy was timed with its first weights.
UNTRAINED = "untrained"


def latencies(timed: Sequence[tuple[PlannedPolicy, Path | None]], plan: Plan) -> Rows:
    """Times the heads of policies alternately, on one thread.

    Args:
        timed: The policies and their directories; None for one whose weights are not here. It is timed with
            its first weights. Ratios are to the first.
        plan: Their plan.

    Returns:
        A row for each: its columns, those of `saccade_lab.study.questions.sweeps_cost.cost`, and
        `UNTRAINED`. One
        with first weights has no hash, since it is not the policy that was trained.
    """
    with tempfile.TemporaryDirectory() as folder:
        directories = []
        for policy, directory in timed:
            if directory is None:
                directory = Path(folder) / policy.name
                write_untrained(policy, plan.recording(policy.recording), directory)
            directories.append(directory)
        found = cost([read_run(directory, ()) for directory in directories])
    rows: Rows = []
    for (policy, directory), row in zip(timed, found, strict=True):
        untrained = directory is None
        hashed = {"checkpoint_sha256": None} if untrained else {}
        rows.append({**policy.columns, **row, **hashed, UNTRAINED: untrained})
    return rows


def write_untrained(policy: PlannedPolicy, recording: Recording, directory: Path) -> None:
    """Writes a policy of the plan with its first weights, as a run of `saccade train` that made no step.

    Its head takes the time of the trained one, since no operation depends on the values: n-32-aligned with
    its first weights took 0.99 times as long as n-32-aligned-again, which has the same settings and was
    trained. It has no statistics of demonstrations, so it cannot act.

    Args:
        policy: The policy.
        recording: Its demonstrations, which are not read.
        directory: Where to, a new one.
    """
    from saccade_lab.training.train import export, new_run, policy_config

    config = policy_config(policy.training, recording.settings, list(recording.counts))
    directory.mkdir()
    export(new_run(policy.training, config, {}), directory)
    write_json(directory / SETTINGS_FILE, policy.training.to_dict())
