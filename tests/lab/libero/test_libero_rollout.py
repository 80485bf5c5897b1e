"""The closed loop, on an environment without physics."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.episode import Episode, Noise
from saccade_lab.libero.policy import LiberoPolicy
from saccade_lab.libero.protocols import PROTOCOLS, Protocol
from saccade_lab.libero.rollout import run_episode
from saccade_lab.libero.starts import Starts
from tests.helpers.libero_runs import StandIn, checkpoint, seen, whole


def starts_of(stand_in: StandIn, protocol: Protocol) -> Starts:
    return Starts(cast(LiberoEnvironment, stand_in), protocol)


def begun(name: str, trials: list[int]) -> list[tuple[int | None, int | None, int, int | None]]:
    """State, seed, resets and loads of the starts of these trials."""
    stand_in = StandIn(PROTOCOLS[name], None)
    starts = starts_of(stand_in, PROTOCOLS[name])
    for trial in trials:
        starts.begin(trial)
    return stand_in.starts


def test_lerobot_seeds_every_episode() -> None:
    assert begun("lerobot", [0, 1, 7, 50]) == [
        (0, 1000, 1, 2),
        (1, 1001, 1, 3),
        (7, 1007, 1, 9),
        (0, 1050, 1, 52),
    ]
    assert begun("lerobot", [7]) == [(7, 1007, 1, 9)]


def test_n17_begins_in_random_layouts() -> None:
    assert begun("isaac-n17", [0, 1, 7]) == [(None, 0, 1, 1), (None, 1, 1, 1), (None, 7, 1, 1)]


def resets_of(starts: list[tuple[int | None, int | None, int, int | None]]) -> list[int]:
    """How many resets since the seed each start is, from what it asks for."""
    found: list[int] = []
    for _, seed, resets, loads in starts:
        assert loads is None  # 1 with a seed; otherwise those that there were, failed attempts included
        if seed is None:
            found.append(found[-1] + resets)
        else:
            assert seed == 0
            found.append(resets)
    return found


@pytest.mark.parametrize("trials", [[0, 1, 2, 3], [4], [0, 3, 4, 1, 2], [2, 2, 49, 0]])
def test_n15_resets_once_for_each_trial(trials: list[int]) -> None:
    starts = begun("isaac-n15", trials)
    assert [state for state, *_ in starts] == trials
    assert resets_of(starts) == [1 + trial for trial in trials]


def test_trials_in_order_need_one_reset_each() -> None:
    assert [resets for _, _, resets, _ in begun("isaac-n15", [0, 1, 2, 3])] == [1, 1, 1, 1]


def test_after_an_interrupted_start_all_resets_are_made_again() -> None:
    class Interrupted(StandIn):
        def restart(
            self, state: int | None, seed: int | None, *, resets: int = 1, loads: int | None = None
        ) -> None:
            super().restart(state, seed, resets=resets, loads=loads)
            if len(self.starts) == 2:
                raise KeyboardInterrupt

    stand_in = Interrupted(PROTOCOLS["isaac-n15"], None)
    starts = starts_of(stand_in, PROTOCOLS["isaac-n15"])
    starts.begin(0)
    with pytest.raises(KeyboardInterrupt):
        starts.begin(1)
    starts.begin(1)
    starts.begin(2)
    assert stand_in.starts == [(0, 0, 1, None), (1, None, 1, None), (1, 0, 2, None), (2, None, 1, None)]


@pytest.mark.parametrize(
    ("name", "version", "executed", "lasts"),
    [("isaac-n17", "n1.7", 8, 11), ("isaac-n15", "n1.5", 1, 3), ("lerobot", "n1.7", 8, 11)],
)
def test_an_episode_ends_with_its_first_success(name: str, version: str, executed: int, lasts: int) -> None:
    policy = LiberoPolicy(whole(version), checkpoint(version), name)
    stand_in = StandIn(policy.protocol, lasts)
    noise, steps = Noise(3), []
    chunk_starts = list(range(0, lasts, executed))

    def on_step(environment: Any, episode: Episode) -> None:
        """Where the policy looks, a video finds the pictures drawn, so that it takes no time of theirs."""
        steps.append(episode.steps)
        looked = [step for step in (*chunk_starts, lasts) if step <= episode.steps]
        assert stand_in.looks == looked

    episode = run_episode(
        starts_of(stand_in, policy.protocol), policy, ("libero_object", 2, 5), noise, on_step
    )
    assert (episode.success, episode.steps, episode.key) == (True, lasts, ("libero_object", 2, 5))
    assert stand_in.looks == [*chunk_starts, lasts]
    assert (
        stand_in.last_observation["state"].tolist()
        == seen(policy.protocol.image_size, lasts)["state"].tolist()
    )
    assert episode.chunks == len(chunk_starts)
    assert steps == list(range(lasts + 1))
    expected = []
    for chunk, looked in enumerate(chunk_starts):
        seed = noise.of(Episode("libero_object", 2, 5, chunks=chunk))
        shown = seen(policy.protocol.image_size, looked)
        expected += list(policy.act(shown, seed=seed).actions[:executed])
    assert np.array_equal(stand_in.actions, expected[:lasts])
    assert set(episode.seconds) == {"reset", "draw", "encode", "sample", "physics"}
    assert all(spent > 0 for spent in episode.seconds.values())


def test_an_episode_ends_at_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = LiberoPolicy(whole("n1.7"), checkpoint("n1.7"), "lerobot")
    short = {**PROTOCOLS["lerobot"].limits, "libero_object": 10}
    monkeypatch.setattr(
        policy, "protocol", type(policy.protocol)(**{**vars(policy.protocol), "limits": short})
    )
    stand_in = StandIn(policy.protocol, lasts=None)
    episode = run_episode(starts_of(stand_in, policy.protocol), policy, ("libero_object_lan", 0, 0), Noise())
    assert (episode.success, episode.steps, episode.chunks) == (False, 10, 2)


def test_noise_differs_between_episodes_and_chunks() -> None:
    episodes = [
        Episode(suite, task, trial, chunks=chunk)
        for suite in ("libero_object", "libero_goal")
        for task in (0, 1)
        for trial in (0, 1)
        for chunk in (0, 1)
    ]
    assert len({Noise(0).of(one) for one in episodes}) == len(episodes)
    assert {Noise(0).of(one) for one in episodes}.isdisjoint({Noise(1).of(one) for one in episodes})
    assert {Noise(4, is_common=True).of(one) for one in episodes} == {4, 5}
    # Kept for results that exist: a change would give other episodes under the same name.
    assert Noise(0).of(Episode("libero_object", 0, 0)) == 1942650938001108740
