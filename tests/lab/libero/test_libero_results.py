"""Result files and pages of runs on LIBERO."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import norm

from saccade.errors import InputError
from saccade_lab.libero.episode import PARTS, Episode
from saccade_lab.libero.page import write_page
from saccade_lab.libero.results import Results

SETTINGS: dict[str, Any] = {
    "protocol": {
        "name": "isaac-n17",
        "program": "a program",
        "start": "random layouts",
        "settle_steps": 0,
        "max_steps": {"libero_object": 720},
        "image_size": 256,
        "seeds": {"first": 0, "seeded": "every episode"},
        "remark": "",
        "chosen": "as given",
        "execute_steps": 8,
        "execute_steps_reason": "as the program",
        "denoising_steps": 4,
        "gripper": {"rule": "as given", "reason": "statistics"},
        "cameras": {"image": "image", "wrist_image": "wrist_image"},
    },
    "checkpoint": {"name": "small", "sha256": "0" * 64},
    "options": {"precision": {"backbone": "float32", "head": "float32"}},
    "noise": {"seed": 0, "is_common": False},
}
ABOUT = {
    "tasks": [{"suite": "libero_object", "task": 0, "instruction": "pick <b>up</b> & place"}],
    "engine": {"instruction_set": "avx2", "num_threads": 1},
}


def episode(task: int, trial: int, success: bool, steps: int, suite: str = "libero_object") -> Episode:
    seconds = dict.fromkeys(PARTS, 0.5 * (trial + 1))
    return Episode(suite, task, trial, success, steps, chunks=2, seconds=seconds)


def filled(settings: dict[str, Any] = SETTINGS) -> Results:
    results = Results(settings)
    for one in (
        episode(3, 0, False, 720),
        episode(0, 1, True, 90),
        episode(0, 0, True, 100),
        episode(0, 2, False, 720),
    ):
        results.add(one)
    return results


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """By its formula."""
    z, share = norm.ppf(0.975), successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * (share * (1 - share) / trials + z * z / (4 * trials**2)) ** 0.5
    return centre - half, centre + half


def test_the_file_is_as_promised(tmp_path: Path) -> None:
    filled().write(tmp_path, ABOUT)
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["protocol"]["name"] == "isaac-n17"
    assert record["episodes"] == [
        {"suite": "libero_object", "task": 0, "trial": 0, "success": True, "steps": 100},
        {"suite": "libero_object", "task": 0, "trial": 1, "success": True, "steps": 90},
        {"suite": "libero_object", "task": 0, "trial": 2, "success": False, "steps": 720},
        {"suite": "libero_object", "task": 3, "trial": 0, "success": False, "steps": 720},
    ]
    assert [cost["chunks"] for cost in record["costs"]] == [2] * 4
    assert record["seconds"] == dict.fromkeys(PARTS, 0.875)


def test_rates_have_wilsons_interval() -> None:
    first, third, suite = filled().rates()
    assert (first.suite, first.task, first.successes, first.episodes) == ("libero_object", 0, 2, 3)
    assert (third.task, third.successes, third.episodes, third.median_steps) == (3, 0, 1, None)
    assert (suite.task, suite.successes, suite.episodes, suite.median_steps) == (None, 2, 4, 95)
    for rate in (first, suite):
        assert rate.interval == pytest.approx(wilson(rate.successes, rate.episodes), abs=1e-12)
    several = filled()
    several.add(episode(0, 0, True, 50, "libero_goal"))
    assert [(rate.suite, rate.task) for rate in several.rates()] == [
        ("libero_object", 0),
        ("libero_object", 3),
        ("libero_object", None),
        ("libero_goal", 0),
        ("libero_goal", None),
        (None, None),
    ]
    assert several.rates()[-1].episodes == 5
    assert Results(SETTINGS).rates() == []
    assert Results(SETTINGS).seconds() == {}


def test_a_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    filled().write(tmp_path, ABOUT)
    found = Results.begin(tmp_path, SETTINGS)
    assert found.episodes == filled().episodes
    items = [("libero_object", 0, trial) for trial in range(5)]
    assert found.missing(items) == items[3:]
    assert found.record(ABOUT) == filled().record(ABOUT)
    assert Results.begin(tmp_path / "none", SETTINGS).episodes == {}


def test_another_suite_is_added(tmp_path: Path) -> None:
    filled().write(tmp_path, ABOUT)
    other = deepcopy(SETTINGS)
    other["protocol"] |= {
        "max_steps": {"libero_goal": 720},
        "chosen": "the checkpoint",
        "remark": "new words",
    }
    found = Results.begin(tmp_path, other)
    assert len(found.episodes) == 4
    assert found.record(ABOUT)["protocol"]["max_steps"] == {"libero_object": 720, "libero_goal": 720}


def changed(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    settings = deepcopy(SETTINGS)
    inner: Any = settings
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    return settings


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("protocol", "name"), "lerobot", "protocol.name"),
        (("protocol", "execute_steps"), 16, "protocol.execute_steps"),
        (("protocol", "gripper", "rule"), "-sign(2 g - 1)", "protocol.gripper"),
        (("protocol", "max_steps", "libero_object"), 280, r"protocol.max_steps \(libero_object\)"),
        (("checkpoint", "sha256"), "1" * 64, "checkpoint"),
        (("options", "precision"), "int8", "options"),
        (("noise", "seed"), 1, "noise"),
    ],
)
def test_episodes_of_another_run_are_refused_by_name(
    tmp_path: Path, path: tuple[str, ...], value: Any, named: str
) -> None:
    filled().write(tmp_path, ABOUT)
    with pytest.raises(InputError, match=f"another run: other {named}. Choose"):
        Results.begin(tmp_path, changed(path, value))


@pytest.mark.parametrize(
    "content", ["{}", '{"episodes": [], "costs": []}', '{"episodes": [1], "costs": [2]}', "[]"]
)
def test_a_file_of_something_else_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "results.json").write_text(content)
    with pytest.raises((InputError, ValueError), match=r"results\.json"):
        Results.begin(tmp_path, SETTINGS)


def test_the_page_needs_no_network(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "libero_object-0-1.png").write_bytes(b"\x89PNG not looked at")
    write_page(filled().record(ABOUT), tmp_path)
    text = (tmp_path / "index.html").read_text()
    assert "default-src 'none'" in text
    assert not re.search(r"https?:|src=\"(?!data:)|<script|<link|url\(", text)
    assert "pick &lt;b&gt;up&lt;/b&gt; &amp; place" in text
    assert "2/3" in text
    assert text.count("<figure>") == 1
    assert "trial 1, 90 steps" in text
    assert "isaac-n17" in text
    write_page(Results(SETTINGS).record(ABOUT), tmp_path)
    assert "No episode was completed" in (tmp_path / "index.html").read_text()
