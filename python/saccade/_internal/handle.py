"""Base class of objects that belong to something loaded, such as the keys and values of one head."""

from __future__ import annotations

from typing import Any, ClassVar, NoReturn, TypeVar

from saccade.errors import DtypeError

HandleT = TypeVar("HandleT", bound="Handle")


class Handle:
    """An immutable object of the engine. A copy of it is the object itself, and it cannot be pickled."""

    #: Why it cannot be pickled, and what to do instead.
    _not_pickled: ClassVar[str]

    def __copy__(self: HandleT) -> HandleT:
        return self

    def __deepcopy__(self: HandleT, memo: dict[int, Any]) -> HandleT:
        return self

    def __reduce__(self) -> NoReturn:
        raise DtypeError(self._not_pickled)
