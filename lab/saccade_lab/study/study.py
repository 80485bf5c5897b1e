"""The base class of studies: a study is measured cell by cell and summarised from its table."""

from __future__ import annotations

import argparse
import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from saccade.errors import InputError
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.source import Source

if TYPE_CHECKING:
    import pandas as pd

    from saccade_lab.study.section import Section
    from saccade_lab.study.table import Provenance

#: Every study by name: where its class is, ``module:class``, and one line of help. A module is imported when
#: its study is chosen. The report has its sections in this order.
STUDIES: dict[str, tuple[str, str]] = {
    "cuts": (
        "saccade_lab.study.questions.cuts:Cuts",
        "success in closed loop with parts of the head cut or replaced",
    ),
    "patching": (
        "saccade_lab.study.questions.patching:Patching",
        "actions with rows of another observation patched into the run",
    ),
    "gradients": (
        "saccade_lab.study.questions.gradients:Gradients",
        "how much of the actions' gradient the future rows carry",
    ),
    "probes": (
        "saccade_lab.study.questions.probes:Probes",
        "what linear probes read from the rows after each block",
    ),
    "n": (
        "saccade_lab.study.questions.sweeps:FutureTokens",
        "policies with different numbers of future tokens",
    ),
    "n-runtime": (
        "saccade_lab.study.questions.resized:Resized",
        "a policy's number of future tokens changed at run time, without training",
    ),
    "tvl": (
        "saccade_lab.study.questions.sweeps:VlTokens",
        "policies with different numbers of vision-language tokens",
    ),
    "vlsa": (
        "saccade_lab.study.questions.sweeps:VlSelfAttention",
        "policies with different depths of VL self-attention",
    ),
    "fast": (
        "saccade_lab.study.questions.fast:Fast",
        "what faster modes cost in actions and in success, and what they save",
    ),
}


class Study(ABC):
    """A question about an action head, and how it is measured.

    A study is a frozen dataclass: its fields say what is measured, and on what. It is pickled, so that
    ``measure`` can run in other processes.

    Attributes:
        name: Name of the study, of its command and of its table.
    """

    name: ClassVar[str]

    @classmethod
    @abstractmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Declares the study's own arguments and sets ``parser.epilog`` to examples."""

    @classmethod
    @abstractmethod
    def from_arguments(cls, args: argparse.Namespace) -> Study:
        """Creates the study from parsed arguments.

        Raises:
            SaccadeError, OSError: An argument is wrong, or a file that it names is missing.
        """

    @abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """JSON values that all rows of the table depend on. A table has only one set of settings."""

    @abstractmethod
    def cells(self) -> Sequence[Cell]:
        """All units of work, finished or not, with distinct keys."""

    @abstractmethod
    def measure(self, cell: Cell) -> Rows:
        """Measures a cell. May run in another process.

        Returns:
            Rows of the table: text, numbers, booleans or None by column.
        """

    @property
    def files(self) -> tuple[str | Path, ...]:
        """The files and directories that ``measure`` reads, as the study's fields name them.

        They are brought to other machines. Default: those of the field ``source``, if there is one.
        """
        source = getattr(self, "source", None)
        return source.files if isinstance(source, Source) else ()

    @classmethod
    @abstractmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """The study's part of the report, from its table alone."""

    def begin(self, out: Path) -> Study:
        """The study, prepared to write its own files to the directory of the tables."""
        return self

    @property
    def num_cells(self) -> int:
        """Number of cells of all stages, as far as it is known. The table is complete when they are done."""
        return len(self.cells())

    def then(self, table: pd.DataFrame) -> Study | None:
        """The next stage, for studies whose later cells depend on the results of the first ones.

        Args:
            table: Table of all cells so far.

        Returns:
            A study with the same name and settings, whose cells include those of this one; None at the end.
        """
        return None


def load_study(name: str) -> type[Study]:
    """The study of that name.

    Raises:
        InputError: There is no such study. The message lists all studies.
        TypeError: The entry of ``STUDIES`` is not a study.
    """
    if name not in STUDIES:
        raise InputError(f"study: unknown name {name!r}, expected one of {', '.join(STUDIES)}")
    module, _, attribute = STUDIES[name][0].partition(":")
    found = getattr(importlib.import_module(module), attribute)
    if not (isinstance(found, type) and issubclass(found, Study)):
        raise TypeError(f"{module}.{attribute}: expected a subclass of Study")
    if found.name != name:
        raise TypeError(f"{module}.{attribute}: named {found.name!r}, expected {name!r}")
    return found
