"""The changes of one input at a time: what an observation becomes. ``docs/diagnose.md`` lists them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.observations import ParsedObservation

Kind: TypeAlias = Literal["main", "natural", "removal"]
Frames: TypeAlias = Mapping[str, UInt8Array]

MOST_COMMON = 0.5  # an instruction that replaces another has less of its words

#: A view of a camera with several frames in an observation.
VIEW = re.compile(r"(?P<camera>.*)\[(?P<time>[0-9]+)\]", re.DOTALL)


@dataclass(frozen=True)
class Change:
    """A change of one input.

    Attributes:
        input: ``"instruction"``, ``"camera.<name>"``, ``"state"`` or ``"history"``.
        name: What is done, such as ``"replaced"``.
        kind: ``"main"``, ``"natural"`` or ``"removal"``: how the verdict takes it.
    """

    input: str
    name: str
    kind: Kind

    def __str__(self) -> str:
        return f"{self.input}: {self.name}"


@dataclass(frozen=True, eq=False)
class Neighbours:
    """What the inputs of an observation are replaced by.

    Attributes:
        first: The first observation of the episode.
        partner: An observation of another episode; None if there is no other.
        instructions: All instructions of the episodes, and the number of tokens of each.
        spread: Standard deviation of the state, ``(state_width,)``.
        rng: For the order of words.
    """

    first: ParsedObservation
    partner: ParsedObservation | None
    instructions: Mapping[str, int]
    spread: Float32Array
    rng: np.random.Generator


def changed(
    observation: ParsedObservation, near: Neighbours
) -> Iterator[tuple[Change, ParsedObservation | None]]:
    """Every change of an observation, always in the same order; None where it would change nothing."""
    yield from _instructions(observation, near)
    yield from _cameras(observation, near)
    yield from _states(observation, near)
    yield from _history(observation)


def camera_of(view: str, views: Sequence[str]) -> str:
    """The camera of a view: its name without the time, if every view has one."""
    found = [VIEW.fullmatch(name) for name in views]
    own = VIEW.fullmatch(view)
    return own["camera"] if own is not None and all(found) else view


def replacement(text: str, instructions: Mapping[str, int]) -> str | None:
    """The instruction that a diagnosis tells instead: other words, and if possible as many tokens.

    Of the others with less than half of the words in common (without such, of all), the one with the nearest
    number of tokens, then the fewest words in common. So the prompt keeps its length where it can.

    Args:
        text: The instruction.
        instructions: All instructions, and the number of tokens of each.

    Example:
        >>> told = {"open the door": 9, "open the window": 9, "push a red button": 10, "reach it": 8}
        >>> replacement("open the door", told), replacement("reach it", told)
        ('push a red button', 'open the door')
    """
    others = {other: _common(text, other) for other in instructions if other != text}
    apart = [other for other, common in others.items() if common < MOST_COMMON] or list(others)

    def order(other: str) -> tuple[int, float]:
        return abs(instructions[other] - instructions[text]), others[other]

    return min(apart, key=order, default=None)


def _common(one: str, other: str) -> float:
    """The share of their words that two texts have in common."""
    first, second = set(one.lower().split()), set(other.lower().split())
    return len(first & second) / max(1, len(first | second))


def _instructions(
    observation: ParsedObservation, near: Neighbours
) -> Iterator[tuple[Change, ParsedObservation | None]]:
    (text,) = observation.instructions
    if text is None:
        return
    words = text.split()
    shuffled = " ".join(words[place] for place in near.rng.permutation(len(words)))
    if shuffled == text and len(words) > 1:
        shuffled = " ".join([*words[1:], words[0]])
    given: tuple[tuple[str, Kind, str | None], ...] = (
        ("replaced", "main", replacement(text, near.instructions)),
        ("emptied", "removal", ""),
        ("shuffled", "removal", shuffled),
    )
    for name, kind, told in given:
        is_new = told is not None and told != text
        yield (
            Change("instruction", name, kind),
            replace(observation, instructions=(told,)) if is_new else None,
        )


def _cameras(
    observation: ParsedObservation, near: Neighbours
) -> Iterator[tuple[Change, ParsedObservation | None]]:
    (frames,) = observation.frames
    views = list(frames)
    for camera in dict.fromkeys(camera_of(view, views) for view in views):
        own = [view for view in views if camera_of(view, views) == camera]
        black = {view: np.zeros_like(frames[view]) for view in own}
        others: tuple[tuple[str, Kind, Frames | None], ...] = (
            ("swapped", "main", None if near.partner is None else near.partner.frames[0]),
            ("frozen", "natural", near.first.frames[0]),
            ("blanked", "removal", black),
        )
        for name, kind, source in others:
            yield Change(f"camera.{camera}", name, kind), _with_views(observation, source, own)


def _with_views(
    observation: ParsedObservation, source: Frames | None, views: Sequence[str]
) -> ParsedObservation | None:
    """The observation with some views of other frames; None if there are none, or if they are the same."""
    (frames,) = observation.frames
    if source is None or any(view not in source for view in views):
        return None
    if all(np.array_equal(source[view], frames[view]) for view in views):
        return None
    return replace(observation, frames=({**frames, **{view: source[view] for view in views}},))


def _states(
    observation: ParsedObservation, near: Neighbours
) -> Iterator[tuple[Change, ParsedObservation | None]]:
    state = observation.state
    others: tuple[tuple[str, Kind, Float32Array | None], ...] = (
        ("swapped", "main", None if near.partner is None else near.partner.state),
        ("frozen", "natural", near.first.state),
        ("shifted", "natural", state + near.spread),
    )
    for name, kind, other in others:
        after = None
        if other is not None and not np.array_equal(other, state):
            after = replace(observation, state=other)
        yield Change("state", name, kind), after


def _history(observation: ParsedObservation) -> Iterator[tuple[Change, ParsedObservation | None]]:
    """Earlier frames and states replaced by the newest; nothing if the observation has none."""
    (frames,) = observation.frames
    views = list(frames)
    newest = {camera_of(view, views): view for view in views}  # views are in the order of time
    if len(newest) == len(views) and observation.state.shape[1] == 1:
        return
    now = {view: frames[newest[camera_of(view, views)]] for view in views}
    state = np.repeat(observation.state[:, -1:], observation.state.shape[1], axis=1)
    same = all(np.array_equal(now[view], frames[view]) for view in views)
    is_new = not (same and np.array_equal(state, observation.state))
    found = replace(observation, frames=(now,), state=state) if is_new else None
    yield Change("history", "repeated", "main"), found
