"""How many episodes end differently here: judges policies of the core again, and compares with the table.

    python studies/why-32/unpack.py --out out/why-32
    python studies/why-32/other_cpu.py out/why-32 --jobs 2

The table's episodes of these policies were run on a Zen 3, by an earlier commit. The unchanged policies run
the same episodes with the same noise, so a difference is one of rounding: of another CPU, kernel or code.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed

import saccade
from saccade_lab.files import checkpoint_identity
from saccade_lab.sim import environment_cache
from saccade_lab.study.questions.sweeps_results import PLAIN
from saccade_lab.study.table import read_table, truths
from why_32.arms import judge
from why_32.plan import CORE_STAGE, PLAN


def ends(policy: Path, task: str) -> list[tuple[bool, int]]:
    """Success and number of control steps of each episode of a policy here."""
    episodes = [judge(str(policy), task, seed, None) for seed in PLAN.seeds]
    environment_cache.close()
    return [(episode.success, episode.steps) for episode in episodes]


def main() -> None:
    """Prints this machine, a row for each policy and task, and the sums."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="where unpack.py wrote table and policies")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    args = parser.parse_args()
    here = saccade.show_config("dicts")
    print(*(here[name] for name in ("family", "isa", "saccade")), sep=", ")
    table = read_table(args.out / "answer.csv")
    hashes = table[table["kind"] == "training"].set_index("policy")["checkpoint_sha256"]
    plain = table[(table["kind"] == "episodes") & (table["arm"] == PLAIN)]
    plain = plain.set_index(["policy", "task", "seed"])
    directory = args.out / "answer" / "policies"
    planned = [directory / policy.name for policy in PLAN.policies(CORE_STAGE)]
    policies = [policy for policy in planned if policy.is_dir()]
    if not policies:
        parser.error(f"{directory}: has no policy of the core")
    for policy in policies:
        if checkpoint_identity(policy)["sha256"] != hashes[policy.name]:
            parser.error(f"{policy}: is not the policy of the table")
    units = [(policy, task) for policy in policies for task in PLAN.tasks]
    again = Parallel(n_jobs=args.jobs)(delayed(ends)(policy, task) for policy, task in units)
    rows = []
    for (policy, task), found in zip(units, again, strict=True):
        before = plain.loc[(policy.name, task)].loc[list(PLAN.seeds)]
        old = list(zip(truths(before["success"]), before["control_steps"].astype(int), strict=True))
        rows.append(
            {
                "policy": policy.name,
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
