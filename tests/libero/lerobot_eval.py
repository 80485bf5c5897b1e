"""Runs ``lerobot-eval`` on libero_object: one episode of each task, in lerobot's own environment.

    python tests/libero/lerobot_eval.py CHECKPOINT OUT

runs in the environment of ``hf-libero.txt``, with the plugin installed, and prints each episode's reward and
steps. ``saccade libero CHECKPOINT --suite libero_object --protocol lerobot --same-noise --seed 0 --trials 1``
runs the same episodes. lerobot 0.4.4 draws frames of 256 pixels whatever its config says; here they are those
of 0.6.2's default, as in the protocol.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from tests.libero.released_clients import FIRST_SEED, use_installed_assets

FRAME_SIZE = 360
SUITE = "libero_object"


def main(checkpoint: Path, out: Path) -> None:
    """Runs the episodes and prints a line for each."""
    use_installed_assets(out / "config")
    from lerobot.envs.libero import LiberoEnv
    from lerobot.scripts import lerobot_eval

    import lerobot_policy_saccade  # noqa: F401  # registers the policy

    created, stepped = LiberoEnv.__init__, LiberoEnv.step
    steps: dict[int, int] = {}

    def create(self: Any, *args: Any, **options: Any) -> None:
        created(self, *args, **{**options, "observation_width": FRAME_SIZE, "observation_height": FRAME_SIZE})

    def step(self: Any, action: Any) -> Any:
        steps[self.task_id] = steps.get(self.task_id, 0) + 1
        return stepped(self, action)

    LiberoEnv.__init__, LiberoEnv.step = create, step
    sys.argv = [
        "lerobot-eval",
        "--policy.type=saccade",
        f"--policy.checkpoint={checkpoint}",
        "--policy.seed=0",
        "--policy.device=cpu",
        "--env.type=libero",
        f"--env.task={SUITE}",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--seed={FIRST_SEED}",
        f"--output_dir={out / 'eval'}",
    ]
    lerobot_eval.main()
    for task in json.loads((out / "eval" / "eval_info.json").read_text())["per_task"]:
        number = task["task_id"]
        print(f"task {number}: reward {task['metrics']['sum_rewards'][0]:g} after {steps[number]} steps")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
