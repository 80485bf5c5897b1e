"""How the trials of a protocol begin: from which state, and after which draws of the random generator."""

from __future__ import annotations

from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.protocols import EVERY_EPISODE, Protocol

#: How often lerobot has loaded the model before it seeds its first episode. It loads it once more for each
#: trial, and again where a layout had no room for all objects, which is not counted: a trial depends on its
#: number only.
LEROBOT_LOADS = 2


class Starts:
    """The environment of a task, whose trials begin as those of a protocol, in any order.

    Args:
        environment: The environment.
        protocol: The protocol.
    """

    def __init__(self, environment: LiberoEnvironment, protocol: Protocol) -> None:
        self.environment = environment
        self.protocol = protocol
        self._next = 0  # the trial whose reset would be the next of the released program

    def begin(self, trial: int) -> None:
        """Begins a trial, without drawing an observation; see ``LiberoEnvironment.restart``."""
        states = self.environment.initial_states
        state = None if states is None else trial % len(states)
        seed = self.protocol.seed(trial)
        if self.protocol.seeding == EVERY_EPISODE:
            loads = LEROBOT_LOADS + trial if self.protocol.lerobot_form else 1
            self.environment.restart(state, seed, loads=loads)
            return
        # Either the program's own reset, after those of the trials between, or all of them from the seed.
        goes_on = 0 < self._next <= trial
        resets = 1 + trial - (self._next if goes_on else 0)
        self._next = 0  # all of them next time, should this one be interrupted
        self.environment.restart(state, None if goes_on else seed, resets=resets)
        self._next = trial + 1

    def close(self) -> None:
        """Closes the environment."""
        self.environment.close()
