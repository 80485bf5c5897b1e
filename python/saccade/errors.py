"""The exceptions of saccade: each is also the built-in that a caller would expect."""


class SaccadeError(Exception):
    """Base of everything that saccade raises on its own, except ``FileNotFoundError`` for a path that is not
    there.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class ShapeError(SaccadeError, ValueError):
    """An array has the wrong number of axes, or the wrong size on one of them."""


class DtypeError(SaccadeError, TypeError):
    """An array holds elements of the wrong kind, or lies on another device than the CPU."""


class InputError(SaccadeError, ValueError):
    """A value is out of range, not finite, or belongs to another head."""


class CheckpointError(SaccadeError, ValueError):
    """A checkpoint or its config is broken, incomplete, or of another kind; the message lists all that is
    wrong.
    """


def printable(message: str) -> str:
    """A message that does nothing to a terminal: what stands in files, and so in names and values, may be
    anything. Lines stay lines.

    Example:
        >>> print(printable("a\\x1b[2Jb"))
        a\\x1b[2Jb
    """
    return "".join(
        character if character.isprintable() or character == "\n" else ascii(character)[1:-1]
        for character in message
    )
