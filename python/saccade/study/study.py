"""What a study is: a question put to an action head, measured cell by cell and summarised from its table."""

from __future__ import annotations

import argparse
import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from saccade.errors import InputError
from saccade.study.cell import Cell, Rows

if TYPE_CHECKING:
    import pandas as pd

    from saccade.study.section import Section
    from saccade.study.table import Provenance

#: Every study by name: where its class is, `module:class`, and one line of help. A module is imported when
#: its study is chosen. The report has its sections in this order.
STUDIES: dict[str, tuple[str, str]] = {
    "cuts": (
        "saccade.study.questions.cuts:Cuts",
        "success in closed loop with parts of the head cut or replaced",
    ),
    "patching": (
        "saccade.study.questions.patching:Patching",
        "actions with rows of another observation patched into the run",
    ),
    "gradients": (
        "saccade.study.questions.gradients:Gradients",
        "how much of the actions' gradient the future rows carry",
    ),
    "probes": (
        "saccade.study.questions.probes:Probes",
        "what linear probes read from the rows after each block",
    ),
    "n": ("saccade.study.questions.sweeps:FutureTokens", "policies with different numbers of future tokens"),
    "n-runtime": (
        "saccade.study.questions.resized:Resized",
        "a policy's number of future tokens changed at run time, without training",
    ),
    "tvl": (
        "saccade.study.questions.sweeps:VlTokens",
        "policies with different numbers of vision-language tokens",
    ),
    "vlsa": (
        "saccade.study.questions.sweeps:VlSelfAttention",
        "policies with different depths of VL self-attention",
    ),
    "fast": (
        "saccade.study.questions.fast:Fast",
        "what faster modes cost in actions and in success, and what they save",
    ),
}


class Study(ABC):
    """A question put to an action head.

    A study is a frozen dataclass: its fields say what is measured, and on what. It is pickled, so that
    `measure` can run in other processes.

    Attributes:
        name: Of the study, its command and its table.
    """

    name: ClassVar[str]

    @classmethod
    @abstractmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Declares the study's own arguments and sets `parser.epilog` to examples."""

    @classmethod
    @abstractmethod
    def from_arguments(cls, args: argparse.Namespace) -> Study:
        """The study that the arguments ask for.

        Raises:
            SaccadeError, OSError: an argument is wrong, or something that it names is missing.
        """

    @abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """What all rows of the table depend on, as JSON has it; a table holds one set of settings only."""

    @abstractmethod
    def cells(self) -> Sequence[Cell]:
        """All units of work, done or not; their keys are distinct."""

    @abstractmethod
    def measure(self, cell: Cell) -> Rows:
        """Rows of the table: names to text, numbers, booleans or None. May run in another process."""

    @classmethod
    @abstractmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """The study's part of the report, from its table alone."""

    def begin(self, out: Path) -> Study:
        """The study with what it keeps in the directory of the tables, if anything."""
        return self

    @property
    def num_cells(self) -> int:
        """Cells of all stages, as far as that is known; the table is complete when they are done."""
        return len(self.cells())

    def then(self, table: pd.DataFrame) -> Study | None:
        """The next stage, for studies whose later cells depend on the results of the first ones.

        Args:
            table: of all cells so far.

        Returns:
            A study with the same name and settings, whose cells include those of this one; None at the end.
        """
        return None


def load_study(name: str) -> type[Study]:
    """The study of that name.

    Raises:
        InputError: there is none; lists those there are.
        TypeError: what `STUDIES` names is not a study.
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
