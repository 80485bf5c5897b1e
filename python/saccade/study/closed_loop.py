"""Episodes with something changed inside the head, beside the same episodes with nothing changed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from saccade.intervention import Intervention
from saccade.sim.policy import Float32Array, Policy
from saccade.sim.rollout import Episode, run_episode
from saccade.study.arms import episode_rng
from saccade.study.cells import Cell, Rows
from saccade.study.loaded import environment_of, learned_tokens, policy_of
from saccade.study.observations import Look, record_looks


@dataclass(frozen=True)
class ArmWork:
    """Runs one episode with one arm, and measures the arm's chunks on what the unchanged policy saw.

    A cell's key is task, seed and arm.

    Attributes:
        checkpoint, engine: The policy.
        intervention_of: What an arm does, from its name, the learned tokens `(N, width)` and the episode's
            random numbers; None changes nothing.
        why_not: Why an arm cannot be measured on a head with so many future tokens, or None.
    """

    checkpoint: str
    engine: str
    intervention_of: Callable[[str, Float32Array, np.random.Generator], Intervention | None]
    why_not: Callable[[str, int], str | None]

    def __call__(self, cell: Cell) -> Rows:
        """A row with what came of it, or with a note why it cannot be measured."""
        task, seed, arm = str(cell.key[0]), int(cell.key[1]), str(cell.key[2])
        row = {"task": task, "seed": seed, "arm": arm}
        policy = policy_of(self.checkpoint, self.engine)
        tokens = learned_tokens(self.checkpoint)
        reason = self.why_not(arm, len(tokens))
        if reason is not None:
            return [{**row, "success": None, "note": reason}]
        intervention = self.intervention_of(arm, tokens, episode_rng(task, seed))
        episode, looks = unchanged_episode(self.checkpoint, self.engine, task, seed)
        changes = [chunk_change(policy, look, intervention) for look in looks]
        if intervention is not None:
            environment = environment_of(self.checkpoint, task)
            episode = run_episode(environment, policy, seed, intervention=intervention)
        return [
            {
                **row,
                "success": episode.success,
                "steps": episode.steps,
                "chunks": episode.chunks,
                "looks": len(looks),
                "chunk_change": float(np.mean(changes)),
                "chunk_change_max": float(max(change.max() for change in changes)),
                "note": None,
            }
        ]


@functools.lru_cache(maxsize=1)
def unchanged_episode(checkpoint: str, engine: str, task: str, seed: int) -> tuple[Episode, Sequence[Look]]:
    """The episode of the arm "none" and what the head was given in it; kept for the next arm."""
    return record_looks(environment_of(checkpoint, task), policy_of(checkpoint, engine), seed)


def chunk_change(policy: Policy, look: Look, intervention: Intervention | None) -> Float32Array:
    """By how much each action of a chunk changes, `(horizon, action_dim)`, all else being equal."""
    context = policy.engine.encode(look.features)

    def actions(change: Intervention | None) -> Float32Array:
        chunk = policy.engine.sample(context, look.state, look.noise, change)[0]
        return np.clip(policy.config.action.restore(chunk), -1.0, 1.0)

    change: Float32Array = np.abs(actions(intervention) - actions(None))
    return change
