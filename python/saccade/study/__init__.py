"""Studies: what the parts of an action head do, measured on a policy and reported with intervals.

Each study is a module with the same few names (see :class:`Study`). It works through cells, small units that
are kept as soon as they are done (:mod:`saccade.study.cells`), and leaves one tidy table. The report is made
from the tables alone (:mod:`saccade.study.report`).
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from saccade.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from saccade.study.cells import OnDone
    from saccade.study.section import Section
    from saccade.study.tables import Provenance

# Where each study lives, `module` or `module:object`, and its one line of help. They stand here so that
# nothing is imported before a study is chosen. The report has its sections in this order.
STUDIES: dict[str, tuple[str, str]] = {
    "cuts": ("saccade.study.cuts", "success in closed loop with parts of the head cut or replaced"),
    "patching": ("saccade.study.patching", "actions with rows of another observation put into the run"),
    "gradients": (
        "saccade.study.gradients",
        "how much of the actions' gradient the future rows carry",
    ),
    "probes": ("saccade.study.probes", "what linear probes read from the rows after each block"),
    "n": ("saccade.study.sweeps:N", "policies with different numbers of future tokens"),
    "n-runtime": (
        "saccade.study.resized",
        "a policy's number of future tokens changed at run time, without training",
    ),
    "tvl": ("saccade.study.sweeps:TVL", "policies with different numbers of vision-language tokens"),
    "vlsa": ("saccade.study.sweeps:VLSA", "policies with different depths of VL self-attention"),
    "fast": ("saccade.study.fast", "what faster modes cost in actions and in success, and what they save"),
}


class Study(Protocol):
    """What a study's module (or object) offers."""

    STUDY: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declares the study's own arguments and sets `parser.epilog` to examples."""

    def settings(self, args: argparse.Namespace) -> Any:
        """Its frozen `Settings` from the arguments; raises `InputError` or `UsageError` for bad ones."""

    def run(self, settings: Any, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
        """Works through the cells that are not done yet and writes `OUT/<study>.csv` and `.json`."""

    def section(self, table: pd.DataFrame, provenance: Provenance) -> Section:
        """The study's part of the report, from its table alone."""


def load_study(name: str) -> Study:
    """The study of that name.

    Raises:
        InputError: there is none; lists those there are.
    """
    if name not in STUDIES:
        raise InputError(f"study: unknown name {name!r}, expected one of {', '.join(STUDIES)}")
    module, _, attribute = STUDIES[name][0].partition(":")
    found = importlib.import_module(module)
    return cast(Study, getattr(found, attribute) if attribute else found)
