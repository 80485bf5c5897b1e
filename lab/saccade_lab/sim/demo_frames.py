"""Records what `saccade demo` shows: a moment of each task of the bundled policy, and the expert's actions.

    python -m saccade_lab.sim.demo_frames OUT.npz

The scripted expert drives for ``BEFORE`` control steps, undisturbed. Then the policy's cameras and the state
are recorded, and the expert's next actions. The layout is one of those kept for evaluation, on which the
policy was not trained. The file in the wheel is what this program wrote.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from saccade._internal.files import write_atomically
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.experts import Expert
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig
from saccade_lab.sim.tasks import DEMO_TASKS

#: Control steps of the expert before the moment: the hand is on its way.
BEFORE = 12
#: Recorded actions of the expert, as many as a chunk of the bundled policy has.
HORIZON = 16
#: Layout and wording; an evaluation seed.
SEED = 1


def record(task: str, config: SimulationConfig) -> dict[str, Any]:
    """A moment of one task.

    Returns:
        ``instruction``, a string; ``images (cameras, H, W, 3)`` uint8; ``state (4,)`` float32; and from then
        on ``actions (HORIZON, 4)`` float32 of the expert.
    """
    environment = TaskEnvironment(task, image_size=config.image_size, cameras=config.cameras)
    try:
        environment.restart(SEED)
        expert = Expert(environment)
        for _ in range(BEFORE):
            environment.advance(expert.action())
        seen = environment.observe()
        actions = []
        for _ in range(HORIZON):
            actions.append(expert.action())
            environment.advance(actions[-1])
    finally:
        environment.close()
    return {
        "instruction": seen["instruction"],
        "images": np.stack([seen["images"][camera.name] for camera in config.cameras]),
        "state": seen["proprio"],
        "actions": np.stack(actions).astype(np.float32),
    }


def main(arguments: list[str]) -> int:
    """Writes the file; the exit status."""
    if len(arguments) != 1:
        print(__doc__, file=sys.stderr)
        return 2
    config = SimulationConfig.from_file(DEMO_CHECKPOINT / CONFIG_FILE)
    found = [record(task.name, config) for task in DEMO_TASKS]
    arrays = {name: np.stack([one[name] for one in found]) for name in found[0]}
    arrays["task"] = np.array([task.name for task in DEMO_TASKS])
    arrays["camera"] = np.array([camera.name for camera in config.cameras])
    with write_atomically(Path(arguments[0])) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
