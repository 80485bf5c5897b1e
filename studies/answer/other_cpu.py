"""How many episodes end differently here: judges policies of the core again, and compares with the table.

    python studies/answer/other_cpu.py --seeds 0 1 2 --jobs 2

The table's episodes of these policies were run on a Zen 3, by an earlier commit. The unchanged policies run
the same episodes with the same noise, so a difference is one of rounding: of another CPU, kernel or code.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed

import saccade
from saccade._files import checkpoint_identity
from saccade.sim import environment_cache
from saccade.study.answer.arms import judge
from saccade.study.answer.plan import CORE_STAGE, PLAN, SEEDS
from saccade.study.questions.sweeps_results import PLAIN
from saccade.study.table import read_table, truths

HERE = Path(__file__).parent
DIRECTORY = HERE / "answer" / "policies"


def ends(policy: str, task: str) -> list[tuple[bool, int]]:
    """Success and number of control steps of each episode of a policy here."""
    episodes = [judge(str(DIRECTORY / policy), task, seed, None) for seed in PLAN.seeds]
    environment_cache.close()
    return [(episode.success, episode.steps) for episode in episodes]


def main() -> None:
    """Prints this machine, a row for each policy and task, and the sums."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], choices=SEEDS, help="training seeds of the core"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    args = parser.parse_args()
    here = saccade.show_config("dicts")
    print(*(here[name] for name in ("family", "isa", "saccade")), sep=", ")
    table = read_table(HERE / "answer.csv")
    hashes = table[table["kind"] == "training"].set_index("policy")["checkpoint_sha256"]
    plain = table[(table["kind"] == "episodes") & (table["arm"] == PLAIN)]
    plain = plain.set_index(["policy", "task", "seed"])
    policies = [policy.name for policy in PLAN.policies(CORE_STAGE) if policy.seed in args.seeds]
    for policy in policies:
        if checkpoint_identity(DIRECTORY / policy)["sha256"] != hashes[policy]:
            parser.error(f"{DIRECTORY / policy}: is not the policy of the table")
    units = [(policy, task) for policy in policies for task in PLAN.tasks]
    again = Parallel(n_jobs=args.jobs)(delayed(ends)(policy, task) for policy, task in units)
    rows = []
    for (policy, task), found in zip(units, again, strict=True):
        before = plain.loc[(policy, task)].loc[list(PLAN.seeds)]
        old = list(zip(truths(before["success"]), before["control_steps"].astype(int), strict=True))
        rows.append(
            {
                "policy": policy,
                "task": task,
                "episodes": len(found),
                "successes in the table": sum(success for success, _ in old),
                "successes here": sum(success for success, _ in found),
                "success differs": sum(one[0] != other[0] for one, other in zip(old, found, strict=True)),
                "steps differ": sum(one[1] != other[1] for one, other in zip(old, found, strict=True)),
            }
        )
    frame = pd.DataFrame(rows)
    print(frame.to_string(index=False))
    print(frame.drop(columns=["policy", "task"]).sum().to_string())


if __name__ == "__main__":
    main()
