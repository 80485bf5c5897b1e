"""Progress of a test run in several processes: a line for each file that has ended, and what is running.

pytest-xdist prints a dot for each test in the order in which they end, which does not say where a run is.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Generator
from typing import Any

import pytest

#: Number of running files that a line names.
SHOWN = 3


class Progress:
    """A pytest plugin of the process that hands out the tests.

    Args:
        config: That of the run.
    """

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.tests: Counter[str] = Counter()  # of each file
        self.ended: Counter[str] = Counter()
        self.outcomes: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self.began: dict[str, float] = {}

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        """Every process collects all tests; that of the first one counts."""
        if not self.tests:
            self.tests.update(map(file_of, ids))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A test begins."""
        self.began.setdefault(file_of(nodeid), time.monotonic())

    @pytest.hookimpl(wrapper=True)
    def pytest_report_teststatus(self) -> Generator[None, tuple[str, Any, Any], tuple[str, Any, Any]]:
        """No dots."""
        category, _, word = yield
        return category, "", word

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A phase of a test has ended; writes a line if it was the last one of its file, or if it failed."""
        file = file_of(report.nodeid)
        if report.failed:
            self.write(f"FAILED {report.nodeid}", red=True)
        if report.failed or report.when == "call" or report.skipped:
            self.outcomes[file][report.outcome] += 1
        if report.when != "teardown":
            return
        self.ended[file] += 1
        if self.ended[file] == self.tests[file]:
            self.write(self.line(file))

    def write(self, line: str, **style: bool) -> None:
        """Writes a line by pytest's own reporter."""
        reporter: Any = self.config.pluginmanager.get_plugin("terminalreporter")
        if reporter is not None:
            reporter.ensure_newline()
            reporter.write_line(line, **style)

    def line(self, file: str) -> str:
        """The line of a file that has ended."""
        seconds = time.monotonic() - self.began.pop(file)
        outcomes = ", ".join(f"{count} {outcome}" for outcome, count in sorted(self.outcomes[file].items()))
        done = sum(self.ended[name] == count for name, count in self.tests.items())
        running = sorted(self.began)
        more = f" and {len(running) - SHOWN} more" if len(running) > SHOWN else ""
        now = f"; running {', '.join(running[:SHOWN])}{more}" if running else ""
        return f"[{done}/{len(self.tests)}] {file}: {outcomes} in {seconds:.0f} s{now}"


def file_of(nodeid: str) -> str:
    """The file of a test."""
    return nodeid.partition("::")[0]
