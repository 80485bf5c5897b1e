"""Draws where the hand goes in the task fork with one and with four Euler steps, seen from above.

python studies/fast/paths.py POLICY OUT.png
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.patches import Circle

from saccade._internal.files import write_atomically
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.rollout import Episode, run_episode
from saccade_lab.sim.scenarios import TOUCH, Fork
from saccade_lab.study import figures
from saccade_lab.study.questions.fast_engine import policy_in
from saccade_lab.study.questions.fast_modes import Calibration, Mode
from saccade_lab.study.simulator import environment_of

EPISODES = 40
MODES = {"one Euler step": "float32-euler-1", "four Euler steps": "float32-euler-4"}


def main(checkpoint: str, out: Path) -> None:
    """Runs the episodes and writes the picture."""
    environment = environment_of(checkpoint, "fork")
    picture, plots = figures.new_picture(height=3.2, columns=2)
    for axes, (title, name) in zip(plots, MODES.items(), strict=True):
        policy = policy_in(checkpoint, Mode.parse(name), Calibration())
        successes = 0
        for seed in range(EPISODES):
            path = []

            def keep(seen: TaskEnvironment, episode: Episode, path: list[np.ndarray] = path) -> None:
                path.append(100 * seen.fingertips())

            episode = run_episode(environment, policy, seed, on_step=keep)
            successes += episode.success
            x, y, _ = np.transpose(path)
            axes.plot(x, y, color=figures.COLOURS[2 if episode.success else 1], linewidth=0.8, alpha=0.7)
        scenario = environment.scenario
        assert isinstance(scenario, Fork)
        for ball in scenario.placed:  # of the last episode; the others differ by 3 cm at most
            colour = ball.rgba[:3]
            axes.add_patch(
                Circle(
                    (100 * ball.position[0], 100 * ball.position[1]), 100 * TOUCH, color=colour, alpha=0.35
                )
            )
        axes.set_title(f"{title}: {successes} of {EPISODES}", fontsize=10)
        axes.set_xlabel("aside, cm")
        axes.set_ylabel("ahead, cm")
        axes.set_aspect("equal")
    with write_atomically(out) as temporary:
        picture.savefig(temporary, format="png", dpi=130, metadata={"Software": None})


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
