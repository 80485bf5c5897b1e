"""What an evaluation needs of recorded episodes, and how it reads them for a policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from typing import TYPE_CHECKING, Any, Protocol, overload

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import integer
from saccade.datasets.modality import ACTION
from saccade.errors import InputError, SaccadeError, ShapeError
from saccade.observations import ParsedObservation, read

if TYPE_CHECKING:
    from saccade.policy.policy import Policy


class RecordedEpisode(Protocol):
    """One recorded episode."""

    @property
    def steps(self) -> Sized:
        """Its steps."""


class Recordings(Protocol):
    """Recorded episodes, such as a :class:`saccade.datasets.Dataset`; anything else with these members."""

    @property
    def episodes(self) -> Sequence[RecordedEpisode]:
        """The episodes."""

    def __len__(self) -> int:
        """Number of episodes."""

    def observation(self, episode: int, step: int, form: str = "isaac") -> Mapping[str, Any]:
        """An observation that a policy takes; ``form`` is ``"isaac"`` or ``"lerobot"``."""

    def actions(self, episode: int, step: int, horizon: int) -> Mapping[str, npt.NDArray[Any]]:
        """The recorded actions from a step on, ``(horizon, width)`` by key, in the robot's units."""


def fitted(policy: Policy, data: Recordings) -> Recordings:
    """The recordings with the keys and the history of a policy, if they can be had by ``for_policy``.

    Raises:
        InputError: As :meth:`saccade.datasets.Dataset.for_policy`.
    """
    convert = getattr(data, "for_policy", None)
    if convert is None:
        return data
    found: Recordings = convert(policy)
    return found


def chosen_episodes(data: Recordings, episodes: Sequence[int] | None) -> tuple[int, ...]:
    """Distinct places of episodes, in increasing order; None gives all.

    Raises:
        InputError: There are none, or one is out of range.
    """
    count = len(data)
    if not count:
        raise InputError("data: expected at least one episode, got none")
    if episodes is None:
        return tuple(range(count))
    found = tuple(sorted({integer("episodes", one, least=0) for one in episodes}))
    if not found or found[-1] >= count:
        listed = ", ".join(map(str, found)) or "none"
        raise InputError(f"episodes: expected at least one of 0 to {count - 1}, got {listed}")
    return found


def length_of(data: Recordings, episode: int) -> int:
    """Number of steps of an episode.

    Raises:
        InputError: It has none.
    """
    length = len(data.episodes[episode].steps)
    if not length:
        raise InputError(f"data: episode {episode}: expected at least one step, got none")
    return length


def observation_at(policy: Policy, data: Recordings, episode: int, step: int) -> ParsedObservation:
    """The observation of one step, parsed and checked for the policy.

    Raises:
        SaccadeError: It does not fit the policy; the message names episode and step.
    """
    form = "isaac" if policy.normalizer.pipeline is None else "lerobot"
    try:
        parsed = read(data.observation(episode, step, form=form), policy.requirements)
        if len(parsed) != 1:
            raise ShapeError(f"observation: expected one, got a batch of {len(parsed)}")
    except SaccadeError as error:
        where = f"episode {episode}, step {step}: "
        raise type(error)(where + str(error)) if where not in str(error) else error from None
    return parsed


class SpacedObservations(Sequence[ParsedObservation]):
    """Observations of recordings, evenly over all steps, each read when it is asked for.

    Args:
        policy: The policy that they are parsed for.
        data: The recordings, with the policy's keys.
        count: Their number; fewer if there are not as many steps.

    Raises:
        InputError: There are no episodes, or one has no step.
    """

    def __init__(self, policy: Policy, data: Recordings, count: int) -> None:
        self._policy, self._data = policy, data
        lengths = [length_of(data, episode) for episode in chosen_episodes(data, None)]
        ends = np.cumsum(lengths)
        count = min(count, int(ends[-1]))
        steps = (2 * np.arange(count) + 1) * int(ends[-1]) // (2 * count)
        episodes = np.searchsorted(ends, steps, side="right")
        starts = ends - lengths
        self.places = [
            (int(episode), int(step - starts[episode])) for episode, step in zip(episodes, steps, strict=True)
        ]

    def __len__(self) -> int:
        return len(self.places)

    @overload
    def __getitem__(self, index: int) -> ParsedObservation: ...
    @overload
    def __getitem__(self, index: slice) -> list[ParsedObservation]: ...
    def __getitem__(self, index: int | slice) -> ParsedObservation | list[ParsedObservation]:
        if isinstance(index, slice):
            return [self[one] for one in range(*index.indices(len(self)))]
        return observation_at(self._policy, self._data, *self.places[index])


def actions_of(policy: Policy, data: Recordings, episode: int, horizon: int) -> npt.NDArray[np.floating[Any]]:
    """All recorded actions of an episode, ``(steps, action_width)`` in the policy's order of keys.

    They are read in pieces of ``horizon``, since a data set may have no more at once. float64 if they were
    recorded so, else float32. For a policy of lerobot, whose parts of the action a data set does not name,
    the one key ``action`` has all of them.

    Raises:
        InputError, ShapeError: A key is missing, has another width, or is not finite.
    """
    length = length_of(data, episode)
    pieces = [
        _joined(policy, data.actions(episode, step, count), f"episode {episode}, from step {step}", count)
        for step, count in ((step, min(horizon, length - step)) for step in range(0, length, horizon))
    ]
    found = np.concatenate(pieces)
    if not np.isfinite(found).all():
        step = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
        raise InputError(
            f"episode {episode}, step {step}: actions: expected finite numbers, got NaN or infinity"
        )
    return found


def _joined(
    policy: Policy, given: Mapping[str, npt.NDArray[Any]], where: str, length: int
) -> npt.NDArray[np.floating[Any]]:
    groups = policy.normalizer.action_groups
    names = [group.key for group in groups]
    where = f"{where}: actions"
    if policy.normalizer.pipeline is not None and list(given) == [ACTION]:
        return _checked(where, given[ACTION], length, policy.normalizer.action_width)
    missing = [name for name in names if name not in given]
    if missing:
        raise InputError(
            f"{where}: expected the keys of the policy, {', '.join(names)}, got {', '.join(given) or 'none'}"
        )
    parts = [_checked(f"{where}: {group.key}", given[group.key], length, group.size) for group in groups]
    return np.concatenate(parts, axis=-1)


def _checked(name: str, values: Any, length: int, width: int) -> npt.NDArray[np.floating[Any]]:
    array = np.asarray(values)
    if array.shape != (length, width):
        raise ShapeError(f"{name}: expected shape ({length}, {width}), got {array.shape}")
    if array.dtype != np.float64:
        array = array.astype(np.float32)
    found: npt.NDArray[np.floating[Any]] = array
    return found
