"""Result files and pages of runs on LIBERO."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import saccade
from saccade.errors import InputError
from saccade_lab.libero.episode import PARTS, Episode
from saccade_lab.libero.page import write_page
from saccade_lab.libero.results import Results, software

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
    "checkpoint": {"name": "small", "commit": None, "sha256": "0" * 64},
    "options": {"precision": {"backbone": "float32", "head": "float32"}},
    "option_files": {"tokenizer": {"name": "words.json", "sha256": "2" * 64}},
    "noise": {"seed": 0, "is_common": False},
    "saccade": "1.0",
    "instruction_set": "avx2",
    "dot_products": ["int8"],
    "packages": {"numpy": "2.0", "mujoco": "3.3.0"},
}
ABOUT: dict[str, Any] = {
    "tasks": [
        {
            "suite": "libero_object",
            "task": 0,
            "instruction": "pick <b>up</b> & place",
            "official_states": None,
        }
    ],
    "engine": {"num_threads": 1},
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
        (("option_files", "tokenizer", "sha256"), "1" * 64, "options.tokenizer"),
        (("option_files",), {}, "options.tokenizer"),
        (("noise", "seed"), 1, "noise"),
        (("saccade",), "1.1", "saccade"),
        (("instruction_set",), "avx512", "instruction_set"),
        (("dot_products",), [], "dot_products"),
        (("packages", "mujoco"), "3.3.1", "packages.mujoco"),
    ],
)
def test_episodes_of_another_run_are_refused_by_name(
    tmp_path: Path, path: tuple[str, ...], value: Any, named: str
) -> None:
    filled().write(tmp_path, ABOUT)
    with pytest.raises(InputError, match=f"another run: other {named}. Choose"):
        Results.begin(tmp_path, changed(path, value))


def test_records_of_before_dot_products_are_of_another_run(tmp_path: Path) -> None:
    filled().write(tmp_path, ABOUT)
    path = tmp_path / "results.json"
    record = json.loads(path.read_text())
    del record["dot_products"]
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"another run: other dot_products\. Choose"):
        Results.begin(tmp_path, SETTINGS)
    float32 = {**SETTINGS, "dot_products": []}
    assert Results.begin(tmp_path, float32).episodes == filled().episodes


def test_a_published_tokenizer_counts_where_it_was_recorded(tmp_path: Path) -> None:
    now = changed(("options", "tokenizer"), None)
    filled({**now, "option_files": {}}).write(tmp_path, ABOUT)  # as the first records have it
    assert Results.begin(tmp_path, now).episodes == filled().episodes
    filled(now).write(tmp_path, ABOUT)
    other = {**now, "option_files": {"tokenizer": {"name": "words.json", "sha256": "1" * 64}}}
    with pytest.raises(InputError, match=r"another run: other options\.tokenizer\. Choose"):
        Results.begin(tmp_path, other)


def test_names_do_not_matter_where_contents_are_equal(tmp_path: Path) -> None:
    filled().write(tmp_path, ABOUT)
    other = changed(("checkpoint", "name"), "renamed")
    other["checkpoint"]["commit"] = "a" * 40
    other["option_files"]["tokenizer"]["name"] = "elsewhere.json"
    assert Results.begin(tmp_path, other).episodes == filled().episodes


def test_software_is_what_runs_here() -> None:
    found = software({"backbone": "int8", "head": "float32"})
    assert found["saccade"] == saccade.__version__
    config = saccade.show_config("dicts")
    assert found["instruction_set"] == config["isa"]
    assert found["dot_products"] == config["dot_products"]
    assert software({"backbone": "float32", "head": "float32"}) == {**found, "dot_products": []}
    assert found["packages"]["numpy"] == np.__version__
    assert set(found) < set(SETTINGS)


@pytest.mark.parametrize(
    ("part", "name", "value", "message"),
    [
        ("episodes", "success", "no", "libero_object 0 0: success is 'no', expected true or false"),
        ("episodes", "success", 1, "success is 1, expected true or false"),
        ("episodes", "task", 10, "task is 10, expected an integer from 0 to 9"),
        ("episodes", "task", True, "task is True"),
        ("episodes", "trial", -1, "trial is -1"),
        ("episodes", "trial", 0.0, "trial is 0.0"),
        ("episodes", "trial", 1, "libero_object 0 1 is there twice"),
        ("episodes", "suite", "libero_kitchen", "given 'libero_kitchen'"),
        ("episodes", "suite", "libero_goal", "KeyError"),
        ("episodes", "steps", 721, "steps is 721, expected an integer from 1 to 720"),
        ("episodes", "steps", 0, "steps is 0"),
        ("episodes", "steps", "90", "steps is '90'"),
        ("episodes", "colour", 1, "colour"),
        ("costs", "chunks", 101, "chunks is 101, expected an integer from 1 to 100"),
        ("costs", "seconds", {}, "seconds are {}"),
        ("costs", "seconds", dict.fromkeys(PARTS, -1), "seconds are"),
        ("costs", "seconds", dict.fromkeys(PARTS, float("nan")), "seconds are"),
        ("costs", "seconds", dict.fromkeys(PARTS, "1"), "seconds are"),
    ],
)
def test_damaged_episodes_are_refused(tmp_path: Path, part: str, name: str, value: Any, message: str) -> None:
    record = filled().record(ABOUT)
    record[part][0][name] = value
    (tmp_path / "results.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=rf"results\.json has no results.*{re.escape(message)}"):
        Results.begin(tmp_path, SETTINGS)


def test_what_intervals_do_not_count_is_said(tmp_path: Path) -> None:
    assert filled().record(ABOUT)["remarks"] == []
    results = filled(changed(("noise", "is_common"), True))
    about = {**ABOUT, "tasks": [{**ABOUT["tasks"][0], "official_states": 2}]}
    noise, states = results.record(about)["remarks"]
    assert noise.startswith("The noise is the same in every episode")
    assert states.startswith("libero_object 0 has 2 official states: 1 episodes repeat one")
    write_page(results.record(about), tmp_path)
    text = (tmp_path / "index.html").read_text()
    assert noise in text
    assert states in text


def test_the_page_names_a_commit(tmp_path: Path) -> None:
    write_page(filled(changed(("checkpoint", "commit"), "a" * 40)).record(ABOUT), tmp_path)
    assert f"Commit {'a' * 12}, weights 0000" in (tmp_path / "index.html").read_text()


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
