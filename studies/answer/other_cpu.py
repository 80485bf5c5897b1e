"""How many episodes end otherwise on another CPU: judges policies of the core again.

    python studies/answer/other_cpu.py --seeds 0 1 2 --jobs 2

The unchanged policies run the episodes of the table with the same noise. Rounding differs between CPUs, in
the head and in the pictures, and an episode may end otherwise.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd

from saccade.sim import environment_cache
from saccade.study.answer.arms import judge
from saccade.study.answer.plan import CORE_STAGE, PLAN
from saccade.study.questions.sweeps_results import PLAIN
from saccade.study.table import read_table

HERE = Path(__file__).parent


def successes(checkpoint: str, task: str) -> list[bool]:
    """Whether each episode of a policy succeeds here."""
    found = [judge(checkpoint, task, seed, None).success for seed in PLAN.seeds]
    environment_cache.close()
    return found


def main() -> None:
    """Prints a row for each policy and task, and what all of them give."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="training seeds of the core")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    table = read_table(HERE / "answer.csv")
    plain = table[(table["kind"] == "episodes") & (table["arm"] == PLAIN)]
    plain = plain.set_index(["policy", "task", "seed"])
    policies = [policy.name for policy in PLAN.policies(CORE_STAGE) if policy.seed in args.seeds]
    units = [(policy, task) for policy in policies for task in PLAN.tasks]
    directories = [str(HERE / "answer" / "policies" / policy) for policy, _ in units]
    with ProcessPoolExecutor(args.jobs) as pool:
        again = list(pool.map(successes, directories, [task for _, task in units]))
    rows = []
    for (policy, task), found in zip(units, again, strict=True):
        before = plain.loc[(policy, task), "success"].loc[list(PLAN.seeds)].astype(bool).to_numpy()
        differ = int((before != np.array(found)).sum())
        rows.append((policy, task, len(found), int(before.sum()), sum(found), differ))
    columns = ("policy", "task", "episodes", "successes in the table", "successes here", "end otherwise")
    frame = pd.DataFrame(rows, columns=columns)
    print(frame.to_string(index=False))
    print(frame[list(columns[2:])].sum().to_string())


if __name__ == "__main__":
    main()
