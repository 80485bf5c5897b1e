"""The results of single episodes in a directory, so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from saccade._internal import run_settings
from saccade._internal.files import write_atomically, write_json
from saccade._internal.small_files import read_json
from saccade.errors import InputError

Record = TypeVar("Record")
SETTINGS = "settings.json"
NAMES = "names.json"


class EpisodeFiles(Generic[Record]):
    """Records of episodes, dataclasses of numbers and arrays, in ``DIR/episodes``.

    Args:
        folder: DIR.
        kind: The dataclass.
        check: Raises ``ValueError`` for a record that is not one of this run.
    """

    def __init__(
        self, folder: Path, kind: type[Record], check: Callable[[Record], None] | None = None
    ) -> None:
        assert is_dataclass(kind)
        self.folder = folder / "episodes"
        self.kind = kind
        self.check = check

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Writes the settings of a run, or checks that the directory has results of the same settings.

        Raises:
            InputError: It has results of others, or without settings; lists the settings that differ.
            OSError: It cannot be written.
        """
        file = self.folder / SETTINGS
        if not self.is_begun() and self.places():
            raise InputError(f"{file}: no such file, but results of episodes beside it: delete {self.folder}")
        self.folder.mkdir(parents=True, exist_ok=True)
        run_settings.begin(file, settings, self.folder.parent)

    def is_begun(self) -> bool:
        """Whether the directory has settings of a run."""
        return (self.folder / SETTINGS).is_file()

    def settings(self) -> dict[str, Any]:
        """The settings of the results.

        Raises:
            FileNotFoundError: There are no results.
            InputError: The file is damaged.
        """
        file = self.folder / SETTINGS
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such file; expected the directory of an earlier run")
        return read_json(file, InputError)

    def write_names(self, names: Mapping[str, str]) -> None:
        """Keeps what readers call the checkpoint and the recordings, which may change between two runs."""
        write_json(self.folder / NAMES, names)

    def names(self) -> dict[str, str]:
        """What readers call them; empty if that was not kept.

        Raises:
            InputError: The file is damaged.
        """
        file = self.folder / NAMES
        found = read_json(file, InputError) if file.is_file() else {}
        if not all(isinstance(name, str) for name in found.values()):
            raise InputError(f"{file}: expected an object of texts, got {found!r:.60}")
        return found

    def path(self, episode: int) -> Path:
        """The file of an episode."""
        return self.folder / f"{episode:06d}.npz"

    def save(self, episode: int, record: Record) -> None:
        """Writes the record of an episode."""
        values = {field.name: getattr(record, field.name) for field in fields(record)}  # type: ignore[arg-type]
        with write_atomically(self.path(episode)) as temporary:
            np.savez(temporary, **values)

    def load(self, episode: int) -> Record | None:
        """The record of an episode, or None if there is none.

        Raises:
            InputError: The file is damaged.
        """
        path = self.path(episode)
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as arrays:
                values = {name: arrays[name] for name in arrays.files}
            found = self.kind(
                **{name: value.item() if not value.ndim else value for name, value in values.items()}
            )
            if found.episode != episode:  # type: ignore[attr-defined]
                raise ValueError(f"it is of episode {found.episode}")  # type: ignore[attr-defined]
            if self.check is not None:
                self.check(found)
            return found
        except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: cannot be read: {error}; delete it to compute it again") from None

    def places(self) -> list[int]:
        """The episodes that have a record."""
        return sorted(int(path.stem) for path in self.folder.glob("[0-9]*.npz") if path.stem.isdecimal())
