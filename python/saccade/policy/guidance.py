"""Guidance: the same observations without their words, for a second context of the action head."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Literal, TypeAlias, get_args

from saccade.errors import InputError
from saccade.observations import ParsedObservation
from saccade.policy.interfaces import Head
from saccade.processor import Processor

#: What stands in place of an instruction: the released default for a missing one, or an empty text.
Without: TypeAlias = Literal["default", "empty"]


def check_without(without: object) -> None:
    """Checks what stands in place of an instruction.

    Raises:
        InputError: It is none of the known names.
    """
    if without not in get_args(Without):
        raise InputError(f"without: expected {' or '.join(map(repr, get_args(Without)))}, got {without!r}")


def check_guides(head: Head) -> None:
    """Checks that a head takes guidance.

    Raises:
        InputError: Its ``sample`` has no such arguments.
    """
    parameters = inspect.signature(head.sample).parameters
    takes_any = any(one.kind is inspect.Parameter.VAR_KEYWORD for one in parameters.values())
    if not takes_any and not {"guidance", "without"} <= set(parameters):
        raise InputError(
            "guidance: expected a head whose sample takes guidance and without, as saccade.ActionHead, got "
            f"{type(head).__name__}"
        )


@contextlib.contextmanager
def named(without: Without) -> Iterator[None]:
    """Errors about the instruction name ``without``: some releases have no default."""
    try:
        yield
    except InputError as error:
        raise InputError(f"without={without!r}: {error}") from None


def without_words(
    parsed: Iterable[ParsedObservation], without: Without, processor: Processor
) -> list[ParsedObservation]:
    """The observations without their instructions.

    Raises:
        InputError: ``without`` is unknown, an observation has no instruction, or ``"empty"`` is asked of
            lerobot's preprocessing, which has the default for an empty text.
    """
    check_without(without)
    if without == "empty" and getattr(processor, "preprocessing", None) == "lerobot":
        raise InputError(
            "without: expected 'default', since lerobot's preprocessing replaces an empty instruction by its "
            "default, got 'empty'"
        )
    found = []
    for one in parsed:
        missing = [row for row, text in enumerate(one.instructions) if text is None or not text.strip()]
        if missing:
            raise InputError(
                f"guidance: expected an instruction in each row of an observation, got none in {missing[0]}"
            )
        # The default stands in the prompt as for an observation without an instruction.
        is_empty = without == "empty"
        text = "" if is_empty else None
        told = (text,) * len(one)
        found.append(replace(one, instructions=told, is_plain=one.is_plain and is_empty))
    return found
