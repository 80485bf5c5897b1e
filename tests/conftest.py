"""Settings of the test run, and the fixtures that many test files use."""

from __future__ import annotations

import gc
import importlib.util
import os
import weakref
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import saccade
from saccade import _saccade
from tests.helpers.progress import Progress
from tests.helpers.released import NAMES, Released, load_released
from tests.helpers.tiers import TIERS, tier_of

# pytest-xdist tells its workers the width of the terminal. The programs under test see no terminal.
os.environ.pop("COLUMNS", None)

# LIBERO is in the environment of `make test-libero` alone, which must have it.
has_libero = "SACCADE_LIBERO" in os.environ or importlib.util.find_spec("libero") is not None
collect_ignore = [] if has_libero else ["libero"]

# No test asks the real Hub; huggingface_hub reads this when it is imported.
os.environ["HF_HUB_OFFLINE"] = "1"

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


def pytest_configure(config: pytest.Config) -> None:
    """With several processes, the one that hands out the tests says how far they are."""
    several = config.getoption("numprocesses", None) and not hasattr(config, "workerinput")
    if several and config.option.verbose <= 0:
        config.pluginmanager.register(Progress(config))


@pytest.fixture(params=NAMES)
def released(request: pytest.FixtureRequest) -> Released:
    """Each file of tests/data."""
    return load_released(request.param)


@pytest.fixture(params=_saccade.available_isas())
def isa(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each instruction set that this machine has. Heads built in the test use it."""
    monkeypatch.setenv("SACCADE_ISA", request.param)
    return str(request.param)


@pytest.fixture
def held_at_loads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many policies this process holds whenever one is loaded; none is held at first."""
    from saccade.evaluation.source import forget_policy

    load, most = saccade.Policy.from_pretrained, []
    loaded: list[weakref.ref[saccade.Policy]] = []

    def counted(*arguments: Any, **options: Any) -> saccade.Policy:
        gc.collect()
        most.append(sum(one() is not None for one in loaded))
        policy = load(*arguments, **options)
        loaded.append(weakref.ref(policy))
        return policy

    forget_policy()
    monkeypatch.setattr(saccade.Policy, "from_pretrained", counted)
    return most


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m core` or `-m "core or torch"`, modules of other tiers are not imported.

    The packages that they need may be missing.
    """
    asked = config.option.markexpr.split(" or ")
    if set(asked) <= set(TIERS) and _is_test(collection_path) and tier_of(collection_path) not in asked:
        return True
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks each test with its tier."""
    for item in items:
        if _is_test(item.path):
            item.add_marker(tier_of(item.path))


def _is_test(path: Path) -> bool:
    """Whether a path is that of a test module below this directory."""
    return (
        path.name.startswith("test_") and path.suffix == ".py" and path.is_relative_to(Path(__file__).parent)
    )
