"""A method of a torch module that saccade computes: what every replacement has in common."""

from __future__ import annotations

import copy
import threading
import weakref
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import MethodType, ModuleType
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor, nn

from saccade.errors import DtypeError, InputError
from saccade.head.options import LoadOptions
from saccade.integrations import modules
from saccade.integrations.weights import Watch

#: What saccade has in place of the module: an action head or a backbone.
Engine = TypeVar("Engine")

#: Largest error in the check at load, relative to what the original computes. In exact arithmetic the tables
#: of the released heads cause a difference of 2e-4. bfloat16 and int8 round to 8 bits. int4 rounds to 4,
#: which costs small parts most: over five seeds of the tests' weights and inputs the check found 0.14 to
#: 0.46, and of 72 random backbones 0.50 at most. Another architecture differs by about 1.
EXACT_TOLERANCE = 1e-2
ROUNDED_TOLERANCE = 0.3
INT4_TOLERANCE = 0.6


def tolerance_of(precision: str, rounded: bool) -> float:
    """The largest error of a part in this precision; `rounded` if one of the two rounds to 8 bits."""
    if precision == "int4":
        return INT4_TOLERANCE
    return ROUNDED_TOLERANCE if rounded else EXACT_TOLERANCE


class Features(dict[str, Any]):
    """A dict with keys as attributes, as upstream expects of a BatchFeature. For the inputs of the check."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


@dataclass(frozen=True)
class Kinds:
    """What the original returns: the dtypes of its features and of a head's actions, and the class."""

    features: torch.dtype
    result: type[Any]
    actions: torch.dtype = torch.float32


class StandIn(ABC, Generic[Engine]):
    """Replaces one method of an instance of a torch module.

    A subclass converts the weights, compares the result with the original, and is called in its place. Copies
    and pickles of the module have the original method.
    """

    #: The method, what the module is called in messages, and the file that knows its structure.
    _method: ClassVar[str]
    _part: ClassVar[str]
    _structure: ClassVar[ModuleType]

    def __init__(self, module: nn.Module, options: LoadOptions) -> None:
        self._options = options
        # Weak, since the module refers to this object: a cycle would keep gigabytes until the next
        # collection.
        self._weak_module = weakref.ref(module)
        self._lock = threading.RLock()
        self._restored = False
        self._engine: Engine | None = None
        self._watch: Watch | None = None
        self._load(module)

    @abstractmethod
    def _convert(self, module: nn.Module) -> Engine:
        """A copy of the weights in saccade, compared with the original by `_kinds_of`."""

    @abstractmethod
    def _compare(self, module: nn.Module, engine: Engine, autocast: bool, *like: Tensor) -> Kinds:
        """Runs both on random inputs like these, and refuses if they differ."""

    @property
    def module(self) -> nn.Module:
        """The torch module.

        Raises:
            InputError: The original was restored, or the policy no longer exists.
        """
        module = self._live()
        if module is None:
            raise InputError(
                f"{self._part} is no longer accelerated: it was restored, or its policy no longer exists"
            )
        return module

    @property
    def is_restored(self) -> bool:
        """Whether the original is back, or the policy no longer exists."""
        return self._live() is None

    def refresh(self) -> None:
        """Copies the weights again. Needed only after a change that the comparison misses.

        Raises:
            InputError, CheckpointError: As :func:`saccade.integrations.accelerate`.
        """
        with self._lock:
            self._load(self.module)

    def restore(self) -> None:
        """Puts the original method back and frees the weights in saccade. A second call does nothing.

        Raises:
            InputError: The method has been replaced by something else in the meantime.
        """
        self._check_restorable()
        module = self._live()
        if module is None:
            return
        del module.__dict__[self._method]
        with self._lock:
            self._restored = True
            self._engine = self._watch = None

    def __repr__(self) -> str:
        name = f"saccade.integrations.{type(self).__name__}"
        if self.is_restored:
            return f"<{name}, restored>"
        return f"<{name} {type(self.module).__name__} {self._options}>"

    def __deepcopy__(self, memo: dict[int, Any]) -> MethodType:
        """A copy of the policy has the original method."""
        return copy.deepcopy(self._original(), memo)

    def __reduce__(self) -> tuple[Any, ...]:
        """So has a pickle: during unpickling, the name refers to the method of the class."""
        return getattr, (self.module, self._method)

    def _live(self) -> nn.Module | None:
        """The torch module; None if the original was restored or the policy no longer exists."""
        return None if self._restored else self._weak_module()

    def _original(self) -> MethodType:
        module = self.module
        return MethodType(getattr(type(module), self._method), module)

    def _install(self) -> None:
        """Puts this object in the place of the method."""
        self.module.__dict__[self._method] = self

    def _check_restorable(self) -> None:
        """Refuses if something else has replaced the method since."""
        module = self._live()
        now = self if module is None else vars(module).get(self._method)
        if now is not self:
            raise InputError(
                f"{self._method} was replaced since by {modules.describe(now)}: remove that first, then "
                "restore"
            )

    def _load(self, module: nn.Module) -> None:
        """Copies the weights, and compares the result with the original."""
        if torch.get_default_device().type == "meta":
            raise DtypeError(
                "accelerate: expected a default device with memory, got meta; leave `with "
                "torch.device('meta')`, or call torch.set_default_device('cpu')"
            )
        self._engine = None  # so that there are never two copies in memory
        if problems := list(self._structure.problems(module, self)):
            raise InputError(f"{type(module).__name__} cannot be accelerated: {'; '.join(problems)}")
        # Before the weights are read, so that the next call detects changes during the reading.
        self._watch = Watch(module)
        self._settings = self._structure.settings_of(module)
        self._parts = list(module.named_modules())[1:]  # without the module itself, see _weak_module
        self._kinds: dict[tuple[Any, ...], Kinds] = {}
        self._engine = self._convert(module)

    def _kinds_of(self, module: nn.Module, engine: Engine, *like: Tensor) -> Kinds:
        """What the original returns for inputs like these under the current autocast; compared when new."""
        device = like[0].device.type
        autocast = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device)
        key = (device, autocast, *(one.dtype for one in like))
        kinds = self._kinds  # another thread may replace it when weights change
        if key not in kinds:
            kinds[key] = self._compare(module, engine, bool(autocast), *like)
        return kinds[key]

    def _current(self, module: nn.Module) -> Engine:
        """The copy in saccade with the current weights."""
        # In this order, so that a load in another thread can make a current copy look stale, but not vice
        # versa.
        watch, engine = self._watch, self._engine
        settings = self._structure.settings_of(module)
        if engine is None or watch is None or self._settings != settings or watch.changed():
            with self._lock:
                # Another thread may have loaded it in the meantime.
                if self._engine is None or self._engine is engine:
                    self._load(self.module)
                engine = self._engine
        assert engine is not None
        return engine
