"""Base class of the models that are loaded from checkpoints: the action head and the backbone."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from saccade._internal.hub import Location, locate_published
from saccade.errors import DtypeError


class _Engine(Protocol):
    @property
    def num_threads(self) -> int: ...
    @property
    def precision(self) -> str: ...
    @property
    def isa(self) -> str: ...
    @property
    def nbytes(self) -> int: ...
    def config(self) -> dict[str, Any]: ...


EngineT = TypeVar("EngineT", bound=_Engine)
ConfigT = TypeVar("ConfigT")
LoadedT = TypeVar("LoadedT", bound="Loaded[Any, Any]")


class Loaded(Generic[EngineT, ConfigT]):
    """A model of the engine, loaded from a checkpoint or made from tensors. It is immutable.

    A loaded model is pickled as its path, or its id and commit, and its options, and is loaded again when it
    is unpickled. It then has the same bits, also if the branch it was loaded from has moved.

    Args:
        engine: The model in the engine.
        location: The checkpoint that it was loaded from; None for tensors in memory.
        options: The arguments of the engine's ``load`` after the path, by name and in their order.
    """

    #: The class of the engine.
    _engine_class: ClassVar[Any]
    #: The class of the config.
    _config_class: ClassVar[Any]
    #: Patterns of the files of a checkpoint that are needed.
    _files: ClassVar[tuple[str, ...]]

    def __init__(
        self, engine: EngineT, location: Location | None = None, options: Mapping[str, Any] | None = None
    ) -> None:
        self._engine = engine
        self._config: ConfigT = self._config_class(**engine.config())
        self._location = location
        self._options = {} if options is None else dict(options)

    @classmethod
    def _load(cls: type[LoadedT], location: Location, options: Mapping[str, Any]) -> LoadedT:
        engine = cls._engine_class.load(os.fspath(location.path), *options.values())
        return cls(engine, location, options)

    @property
    def source(self) -> str | None:
        """Absolute path of the checkpoint that it was loaded from; None after :meth:`from_tensors`."""
        return None if self._location is None else str(self._location.path.absolute())

    @property
    def num_threads(self) -> int:
        """Number of threads that a call uses."""
        return self._engine.num_threads

    @property
    def precision(self) -> str:
        """How it computes: ``"float32"``, ``"bfloat16"``, ``"int8"`` or ``"int4"``."""
        return self._engine.precision

    @property
    def isa(self) -> str:
        """Instruction set of the kernels, one of those that :func:`saccade.show_config` lists."""
        return self._engine.isa

    @property
    def nbytes(self) -> int:
        """Size of the weights in memory, in bytes."""
        return self._engine.nbytes

    def __reduce__(self) -> tuple[Any, ...]:
        name = type(self).__name__
        if self._location is None:
            raise DtypeError(
                f"a model made by {name}.from_tensors cannot be pickled or copied, because it has no file to "
                f"be loaded from: write its tensors to a checkpoint and use {name}.from_pretrained"
            )
        place = self.source if self._location.id is None else self._location.id
        return _load_again, (type(self), place, self._location.commit, self._options)


def _load_again(cls: type[LoadedT], place: str, commit: str | None, options: Mapping[str, Any]) -> LoadedT:
    """Unpickles a model by loading its checkpoint again: a path, or an id with its commit."""
    found = Location(Path(place)) if commit is None else locate_published(place, commit, files=cls._files)
    return cls._load(found, options)
