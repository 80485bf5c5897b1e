"""The pages of evaluations and diagnoses: whole, without references to other files, loaded by a browser."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

import saccade
from saccade.cli.against import beside
from saccade.evaluation import Evaluation
from saccade_lab.recordings import pages
from saccade_lab.recordings.advice import SAME
from tests.helpers.recorded_cases import Recorded, demo_policy, made_up, still

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    BROWSER is None or DRIVER is None, reason="needs Debian's chromium and chromium-driver"
)
ABOUT: dict[str, Any] = {
    "checkpoint": {"name": "<policy>", "sha256": "0" * 64},
    "recordings": {"name": "tiny & small", "sha256": "1" * 64},
    "saccade": "0",
    "library": "0" * 12,
    "instruction_set": "portable",
    "dot_products": [],
    "against": None,
}
LENGTHS = (9, 5, 8, 3, 12)


@pytest.fixture(scope="module")
def data() -> Recorded:
    return made_up(LENGTHS)


@pytest.fixture(scope="module")
def report(data: Recorded) -> Evaluation:
    return saccade.evaluate(demo_policy(), data, stride=4)


@pytest.fixture(scope="module")
def written(data: Recorded, report: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    found = {name: tmp_path_factory.mktemp(name) for name in ("evaluation", "diagnosis")}
    other = saccade.evaluate(demo_policy(), data, stride=4, num_steps=1)
    settings = {
        **ABOUT,
        "checkpoint": {"name": "<base>", "sha256": "2" * 64},
        "options": {"precision": "float32"},
        "sampling": {"num_steps": 1},
    }
    against = beside(report.compare(other), other, settings)
    pages.evaluation_page(report, {**ABOUT, "against": against}, found["evaluation"])
    short = made_up((2, 1, 2, 1, 2))
    pages.diagnosis_page(
        saccade.diagnose(demo_policy(), short), ABOUT, demo_policy(), short, found["diagnosis"]
    )
    return found


def plain(folder: Path) -> str:
    """The words of a page."""
    return re.sub(r"<[^>]*>", " ", (folder / "index.html").read_text(encoding="utf-8"))


def test_an_input_without_a_change_is_on_the_page(tmp_path: Path) -> None:
    data = still((1, 1, 1, 1, 1))
    pages.diagnosis_page(saccade.diagnose(demo_policy(), data), ABOUT, demo_policy(), data, tmp_path)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert text.count(SAME) == 2  # the state, and the camera that is black
    assert "nan" not in re.sub(r"<[^>]*>", "", text).lower()


@pytest.mark.parametrize("name", ["evaluation", "diagnosis"])
def test_a_page_refers_to_nothing(name: str, written: dict[str, Path]) -> None:
    text = (written[name] / "index.html").read_text(encoding="utf-8")
    assert re.findall(r"""(?:src|href)=["'](?!data:image/png;base64,)[^"']*""", text) == []
    assert "http" not in re.sub(r'src="data:[^"]*"', "", text).replace("http-equiv", "")
    assert "&lt;policy&gt;" in text
    assert "tiny &amp; small" in text
    assert "nan" not in re.sub(r"<[^>]*>", "", text).lower()


def test_the_evaluations_page_has_its_numbers(
    data: Recorded, written: dict[str, Path], report: Evaluation
) -> None:
    text = (written["evaluation"] / "index.html").read_text(encoding="utf-8")
    for one in (report.errors, *report.by_key.values(), *report.baselines.values()):
        assert f"{one.mse:.6g}" in text
    assert "<h2>Against &lt;base&gt;, float32, num_steps 1</h2>" in text
    other = saccade.evaluate(demo_policy(), data, stride=4, num_steps=1)
    found = report.compare(other)
    for name, own, theirs, apart in (
        ("MSE", report.mse, other.mse, found.mse),
        ("– hand", report.by_key["hand"].mse, other.by_key["hand"].mse, found.mse_by_key["hand"]),
        ("MAE", report.mae, other.mae, found.mae),
    ):
        row = "".join(f'<td class="n">{number:.6g}</td>' for number in (own, theirs, apart.value))
        interval = f'<td class="n">{apart.low:.4g} to {apart.high:.4g}</td>'
        assert f"<tr><td>{name}</td>{row}{interval}</tr>" in text
    curves = sorted((written["evaluation"] / "curves").glob("*.png"))
    assert [path.stem for path in curves] == [f"{episode:06d}" for episode in range(len(LENGTHS))]
    with Image.open(curves[0]) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    for colour in ((0xD5, 0x5E, 0x00), (0, 0, 0)):  # predicted over recorded
        assert (pixels == colour).all(axis=-1).sum() > 50


def test_one_episode_has_no_interval(data: Recorded, tmp_path: Path) -> None:
    report = saccade.evaluate(demo_policy(), data, episodes=[2], stride=4)
    other = saccade.evaluate(demo_policy(), data, episodes=[2], stride=4, num_steps=1)
    settings = {**ABOUT, "options": {"precision": "float32"}, "sampling": {"num_steps": 1}}
    against = beside(report.compare(other), other, settings)
    pages.evaluation_page(report, {**ABOUT, "against": against}, tmp_path)
    text = plain(tmp_path)
    assert "nan" not in text.lower()
    assert "One episode has no interval." in text
    rows = re.findall(r'<td class="n">–</td>', (tmp_path / "index.html").read_text(encoding="utf-8"))
    # Of each error the interval, and for the baselines the normalised error; then of each difference.
    assert len(rows) == (3 + 2 * 3) + 4
    assert [path.name for path in (tmp_path / "curves").iterdir()] == ["000002.png"]


@pytest.mark.parametrize("name", ["evaluation", "diagnosis"])
def test_a_page_of_few_episodes_says_that_its_intervals_are_too_narrow(
    name: str, written: dict[str, Path]
) -> None:
    text = plain(written[name])
    assert re.search(r"intervals are over (\d to )?5 episodes: with fewer than 10 they are too narrow", text)


def test_the_diagnosis_page_has_every_input_with_its_frames(written: dict[str, Path]) -> None:
    text = (written["diagnosis"] / "index.html").read_text(encoding="utf-8")
    for name in ("instruction", "camera.left", "camera.right", "camera.top", "state"):
        assert f"<h2>{name}: " in text
    assert re.search(r'replaced matters most in episode \d at step \d: "[^"]+" by "', text)
    assert text.count("<figcaption>left, swapped</figcaption>") == 1
    assert text.count("<figcaption>left</figcaption>") == 3  # its own, the instruction's and the state's


@needs_browser
def test_the_pages_load_without_errors(written: dict[str, Path]) -> None:
    for driver in browser():
        for name, folder in written.items():
            driver.get((folder / "index.html").as_uri())
            broken = driver.execute_script(
                "return [...document.images].filter(one => !one.complete || !one.naturalWidth).length"
            )
            assert broken == 0, name
            assert driver.get_log("browser") == []  # type: ignore[no-untyped-call]


def browser() -> Iterator[webdriver.Chrome]:
    """A browser, which is closed at the end."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(BROWSER)
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    try:
        yield driver
    finally:
        driver.quit()
