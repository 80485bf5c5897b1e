"""What tests of the commands that read recordings share; tests/cli/conftest.py has their fixtures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import saccade
from saccade import cli
from tests.helpers.recorded_cases import Recorded, by_the_policy, demo_policy
from tests.helpers.recorded_folder import written

#: Steps of the recorded episodes.
LENGTHS = (9, 5, 8)
DEMO = str(saccade.demo_checkpoint())


def run(*arguments: Any) -> int:
    """The exit status of a command."""
    return cli.main([str(argument) for argument in arguments])


def recorded_data() -> Recorded:
    """Recordings of the bundled policy, with a stride of 4 and seed 0."""
    return by_the_policy(demo_policy(), LENGTHS, stride=4, seed=0)


def recorded_folder(data: Recorded, root: Path) -> Path:
    """The recordings as a data set in a folder."""
    return written(data, root / "tiny")


def results(out: Path) -> dict[str, Any]:
    """What a run wrote, without the time that it took."""
    found: dict[str, Any] = json.loads((out / "results.json").read_text())
    for one in (found, found["against"]["other"]) if found["against"] else (found,):
        assert one.pop("seconds") > 0
    return found
