"""Settings of the test run, and the fixtures that many test files use."""

from __future__ import annotations

import os

import hypothesis
import pytest

from saccade import _saccade
from tests.helpers.released import NAMES, Released, load_released

# pytest-xdist tells its workers the width of the terminal. The programs under test see no terminal.
os.environ.pop("COLUMNS", None)

# No deadline: the machine may be shared. On CI every run draws the same examples, so a failure is caused by
# the change and not by the draw.
hypothesis.settings.register_profile(
    "saccade",
    deadline=None,
    derandomize="CI" in os.environ,
    database=None,
    print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("saccade")


@pytest.fixture(params=NAMES)
def released(request: pytest.FixtureRequest) -> Released:
    """Each file of tests/data."""
    return load_released(request.param)


@pytest.fixture(params=_saccade.available_isas())
def isa(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each instruction set that this machine has. Heads built in the test use it."""
    monkeypatch.setenv("SACCADE_ISA", request.param)
    return str(request.param)
