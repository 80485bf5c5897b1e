"""Episodes of the bundled policy through a released client of Isaac-GR00T. `groot_clients` starts it.

    python groot_episode.py RELEASE PORT SEED

Prints steps, success and a hash of all commands: of episodes whose chunks come from the server at PORT, and
of the same ones in this process. SEED is the server's, which N1.5 requests get.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from saccade_lab.sim.policy import Chunk, Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.sim.settings import GROUPS

#: Tasks and layouts.
EPISODES = (("reach", 3), ("button-press-topdown", 4))


class Driver(Policy):
    """The policy, asked chunk by chunk in another way, with a seed for each chunk."""

    ask: Callable[[dict[str, Any], int], Mapping[str, Any]]
    commands: Any
    count: int

    def act(self, seen: Mapping[str, Any], **options: Any) -> Chunk:
        """The chunk that `ask` returns; noise comes from the seed."""
        answer = self.ask(self.observation(seen), self.count)
        self.count += 1
        actions = np.concatenate([np.asarray(answer[name])[0] for name in GROUPS], axis=-1)
        self.commands.update(actions.tobytes())
        return Chunk(actions, dict.fromkeys(("backbone", "encode", "sample"), 0.0))


def client_of(release: str, port: int) -> Callable[[dict[str, Any], int], Mapping[str, Any]]:
    """Asks the released client, whose sources are on the path."""
    if release == "n1.5":
        robot: Any = importlib.import_module("gr00t.eval.robot")
        early = robot.RobotInferenceClient(host="127.0.0.1", port=port)

        def ask_early(observation: dict[str, Any], seed: int) -> Mapping[str, Any]:
            return {
                name.removeprefix("action."): [part]
                for name, part in early.get_action(flat(observation)).items()
            }

        return ask_early
    server_client: Any = importlib.import_module("gr00t.policy.server_client")
    client = server_client.PolicyClient(host="127.0.0.1", port=port)
    return lambda observation, seed: client.get_action(observation, {"seed": seed})[0]


def flat(nested: dict[str, Any]) -> dict[str, Any]:
    """One observation in the form of N1.5, without a batch axis."""
    found = {f"{part}.{key}": nested[part][key][0] for part in ("video", "state") for key in nested[part]}
    return found | {key: [rows[0][0]] for key, rows in nested["language"].items()}


def main(release: str, port: int, seed: int) -> None:
    """Runs the episodes both ways."""
    own = Policy.from_pretrained(num_threads=1)

    def here(given: dict[str, Any], count: int) -> Mapping[str, Any]:
        if release != "n1.5":
            return dict(own.whole.act(given, seed=count))
        answer = own.whole.act(flat(given), seed=seed)
        return {name.removeprefix("action."): [part] for name, part in answer.items()}

    outcomes = []
    for ask in (client_of(release, port), here):
        found = []
        for task, layout in EPISODES:
            driver = Driver(own.whole, own.config, own.checkpoint)
            driver.ask, driver.commands, driver.count = ask, hashlib.sha256(), 0
            with contextlib.closing(environment_for(driver, task)) as environment:
                episode = run_episode(environment, driver, layout)
            found.append([episode.steps, episode.success, driver.commands.hexdigest()])
        outcomes.append(found)
    print(json.dumps(outcomes))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
