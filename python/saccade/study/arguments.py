"""Lists with commas on the command line."""

from __future__ import annotations

from collections.abc import Iterable

from saccade.errors import InputError

UNLIMITED = 1 << 31  # for `numbers` that have no bound of their own


def names(option: str, text: str) -> tuple[str, ...]:
    """Names out of a list with commas, each once.

    Example:
        >>> names("--arms", "none, future-zeroed,none")
        ('none', 'future-zeroed')
    """
    found = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not found:
        raise InputError(f"{option}: expected at least one name")
    return found


def check_known(what: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Raises `InputError` for the first name that is not known; lists those that are."""
    known = list(known)
    for name in given:
        if name not in known:
            raise InputError(f"{what}: unknown name {name!r}, expected one of {', '.join(known)}")


def numbers(option: str, text: str | None, count: int) -> tuple[int, ...]:
    """Distinct numbers below `count` out of a list with commas, in order; None gives all of them.

    Example:
        >>> numbers("--blocks", "3,0", 4), numbers("--blocks", None, 4)
        ((0, 3), (0, 1, 2, 3))
    """
    if text is None:
        return tuple(range(count))
    try:
        found = tuple(sorted({int(word) for word in names(option, text)}))
    except ValueError:
        raise InputError(f"{option}: given {text!r}, expected numbers separated by commas") from None
    if found[0] < 0 or found[-1] >= count:
        raise InputError(f"{option}: given {text}, expected 0 to {count - 1}")
    return found
