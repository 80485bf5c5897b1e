"""A head that stands before another one, for studies that record or change what it computes."""

from __future__ import annotations

from saccade.head.config import HeadConfig
from saccade.policy.interfaces import Head


class WrappedHead:
    """What a ``saccade.policy.interfaces.Head`` says of itself, taken from another head. Subclasses compute.

    Args:
        head: The head behind it.
    """

    def __init__(self, head: Head) -> None:
        self._wrapped = head

    @property
    def config(self) -> HeadConfig:
        """See ``Head``."""
        return self._wrapped.config

    @property
    def source(self) -> str | None:
        """See ``Head``."""
        return self._wrapped.source

    @property
    def embodiment_ids(self) -> tuple[int, ...]:
        """See ``Head``."""
        return self._wrapped.embodiment_ids

    @property
    def num_threads(self) -> int:
        """See ``Head``."""
        return self._wrapped.num_threads

    @property
    def nbytes(self) -> int:
        """See ``Head``."""
        return self._wrapped.nbytes
