"""The exceptions of saccade. Each one is also a subclass of the matching built-in exception."""


class SaccadeError(Exception):
    """Base class of all errors that saccade raises itself.

    The exceptions are ``FileNotFoundError`` for a path that does not exist and ``MemoryError`` for an
    allocation that does not fit.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class ShapeError(SaccadeError, ValueError):
    """An array has the wrong number of axes or the wrong size along an axis."""


class DtypeError(SaccadeError, TypeError):
    """An argument has the wrong type, or an array has the wrong dtype or is not on the CPU."""


class InputError(SaccadeError, ValueError):
    """A value is out of range, is not finite, or belongs to another head."""


class CheckpointError(SaccadeError, ValueError):
    """A checkpoint or its config is damaged, incomplete or of an unknown kind.

    The message lists every problem that was found.
    """


class DatasetError(SaccadeError, ValueError):
    """A recorded data set is damaged, contradicts itself or is of an unknown kind.

    The message names the file, and episode and step where they are known.
    """


class MissingExtraError(SaccadeError, ModuleNotFoundError):
    """An optional dependency is not installed. The message contains a command that installs it.

    ``name`` is the missing module.
    """


def printable(message: str) -> str:
    r"""Escapes control characters, except line breaks.

    Names and values from files appear in messages and may contain anything, escape sequences of terminals
    included.

    Example:
        >>> print(printable("a\x1b[2Jb"))
        a\x1b[2Jb
    """
    return "".join(
        character if character.isprintable() or character == "\n" else ascii(character)[1:-1]
        for character in message
    )
