"""The HTML page in a headless browser: what is picked is what is drawn, and the numbers are the trace's."""

from __future__ import annotations

import base64
import dataclasses
import io
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from saccade_lab.maps.page import render_page, write_page
from saccade_lab.maps.record import CAVEAT, OCCLUSION, Maps
from tests.helpers.maps_cases import one_hot_maps

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    BROWSER is None or DRIVER is None, reason="needs Debian's chromium and chromium-driver"
)


def mixed_maps() -> Maps:
    """The maps made by hand, with random ones in step 0, so that every choice shows something else."""
    maps = one_hot_maps()
    rng = np.random.default_rng(0)
    attention = dict(maps.attention)
    for block in (0, 1):
        shape = attention[0, block].shape
        attention[0, block] = rng.dirichlet(np.full(shape[-1], 0.5), size=shape[:2]).astype(np.float32)
    object.__setattr__(maps, "attention", attention)
    return maps


class Page:
    """The page in a browser."""

    def __init__(self, driver: webdriver.Chrome, path: Path) -> None:
        self.driver = driver
        driver.get(path.as_uri())
        WebDriverWait(driver, 30).until(lambda _: self.script("return document.body.dataset.ready === 'yes'"))

    def script(self, text: str) -> Any:
        return self.driver.execute_script(text)

    def pick(self, name: str, text: str) -> None:
        Select(self.driver.find_element(By.ID, name)).select_by_visible_text(text)

    def press(self, *keys: str) -> None:
        for key in keys:
            self.driver.find_element(By.TAG_NAME, "body").send_keys(key)

    def text(self, name: str) -> str:
        return self.driver.find_element(By.ID, name).text

    def bars(self, name: str) -> dict[str, float]:
        """Values by their labels; the last one for equal labels."""
        values = self.driver.find_elements(By.CSS_SELECTOR, f"#{name} [data-value]")
        return {str(v.get_attribute("data-name")): float(str(v.get_attribute("data-value"))) for v in values}

    def pixels(self, canvas: str) -> NDArray[np.int64]:
        url = self.script(f"return document.getElementById('{canvas}').toDataURL()")
        with Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))) as image:
            return np.asarray(image.convert("RGB"), dtype=np.int64)


@pytest.fixture(scope="module")
def driver() -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.add_argument("--window-size=1400,1600")
    options.binary_location = str(BROWSER)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    started = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    yield started
    started.quit()


@pytest.fixture
def page(driver: webdriver.Chrome, tmp_path: Path) -> Page:
    write_page(mixed_maps(), tmp_path / "page.html")
    return Page(driver, tmp_path / "page.html")


def test_nothing_in_the_page_refers_to_the_network() -> None:
    text = render_page(one_hot_maps())
    assert not re.search(r"https?:|//\w+\.\w|@import|\bfetch\(|XMLHttpRequest|WebSocket", text)
    sources = re.findall(r"(?:src|href)\s*=\s*[\"']?([^\"'>\s]+)", text)
    assert [source for source in sources if not source.startswith("data:") and source != "url;"] == []
    assert "default-src 'none'" in text
    assert "maps by hand &lt;&amp;&gt;" in text
    assert text.count("</script>") == 2  # the token named </img> ends nothing


@needs_browser
def test_the_first_view(page: Page) -> None:
    assert (
        page.text("legend")
        == "block 0 (reads vision and language), Euler step 0, mean over heads: future rows, mean of 3"
    )
    assert page.text("caveat") == f"{CAVEAT} {OCCLUSION}"
    assert "by hand" in page.text("change-text")
    assert page.driver.get_log("browser") == []  # type: ignore[no-untyped-call]


@needs_browser
@pytest.mark.parametrize(
    ("step", "block", "head", "group", "token"),
    [
        (0, 0, 0, "future", 1),
        (0, 0, 1, "action", 0),
        (0, 1, 0, "future", 2),
        (1, 0, 0, "future", 2),
        (0, 0, 1, "state", None),
    ],
)
def test_the_numbers_are_those_of_the_trace(
    page: Page, step: int, block: int, head: int, group: str, token: int | None
) -> None:
    maps = mixed_maps()
    page.pick("block", "0 (vl)" if block == 0 else "1 (rows)")
    page.pick("step", str(step))
    page.pick("head", str(head))
    page.pick("group", group)
    if token is not None:
        page.driver.find_element(By.CSS_SELECTOR, f"#tokens button[data-token='{token}']").click()
    expected = maps.attention[step, block][head, maps.rows[group].start + (token or 0)].astype(np.float64)
    assert f"Euler step {step}, head {head}: {group}" in page.text("legend")
    logs = np.log(np.where(expected > 0, expected, 1.0))
    entropy = float(str(page.driver.find_element(By.ID, "entropy").get_attribute("data-value")))
    assert entropy == pytest.approx(-(expected * logs).sum(), abs=1e-3)
    bars, masses = page.bars("bars"), page.bars("masses")
    if block == 0:
        agreement = maps.agreement(expected.astype(np.float32))
        said = (
            "one of the two is even"
            if agreement is None
            else f"{agreement:.2f} (rank correlation, 7 patches)"
        )
        assert page.text("agreement").replace("-0.00", "0.00") == said.replace("-0.00", "0.00")
        assert bars == pytest.approx({"push": expected[0], "</img><b>": expected[8]}, abs=2e-5)
        assert masses == pytest.approx(
            {
                "left": expected[1:5].sum(),
                "top": expected[5:8].sum(),
                "text": expected[0],
                "special tokens (sinks)": expected[8],
            },
            abs=2e-5,
        )
    else:
        named = ["state", *(f"future {k}" for k in range(3)), *(f"action {k}" for k in range(2))]
        assert bars == pytest.approx(dict(zip(named, expected, strict=True)), abs=2e-5)
        assert masses["future rows"] == pytest.approx(expected[1:4].sum(), abs=2e-5)
        assert not page.driver.find_element(By.ID, "pictures").is_displayed()


@needs_browser
def test_a_map_is_painted_where_its_patches_are(page: Page) -> None:
    page.pick("step", "1")
    page.pick("head", "0")
    page.driver.find_element(By.CSS_SELECTOR, "#tokens button[data-token='0']").click()
    left = page.pixels("map-0")
    size = len(left) // 2
    colour = left[..., 0] - left[..., 2]  # red above blue where there is heat
    assert colour[size:, :size].min() > 60  # the third of 2 x 2 patches
    assert np.abs(colour[:size]).max() < 20
    assert np.abs(colour[size:, size:]).max() < 20
    page.press(Keys.ARROW_RIGHT)
    top = page.pixels("map-1")
    third = top.shape[1] // 3
    assert (top[:, third : 2 * third, 0] - top[:, third : 2 * third, 2]).min() > 60
    assert np.abs(top[:, :third, 0] - top[:, :third, 2]).max() < 20
    assert (page.pixels("map-0") != left).any()
    blue = page.pixels("occlusion-0")
    assert (
        blue[:size, size:, 2] - blue[:size, size:, 0]
    ).min() > 60  # the second patch was the one that counts


@needs_browser
def test_a_map_is_painted_on_the_part_that_tokens_see(driver: webdriver.Chrome, tmp_path: Path) -> None:
    maps = mixed_maps()
    left, top = maps.view.layout.cameras
    # The right half of the picture, and as much beside it.
    layout = dataclasses.replace(
        maps.view.layout, cameras=(dataclasses.replace(left, region=(0.5, 0.0, 1.5, 1.0)), top)
    )
    view = dataclasses.replace(maps.view, layout=layout)
    write_page(dataclasses.replace(maps, view=view), tmp_path / "page.html")
    page = Page(driver, tmp_path / "page.html")
    pixels = page.pixels("occlusion-0")
    colour, size = pixels[..., 2] - pixels[..., 0], len(pixels) // 2
    # The second of 2 x 2 patches counts, and lies beside the picture.
    assert np.abs(colour).max() < 60
    moved = dataclasses.replace(left, region=(-0.5, 0.0, 0.5, 1.0))
    view = dataclasses.replace(view, layout=dataclasses.replace(layout, cameras=(moved, top)))
    write_page(dataclasses.replace(maps, view=view), tmp_path / "page.html")
    pixels = Page(driver, tmp_path / "page.html").pixels("occlusion-0")
    colour = pixels[..., 2] - pixels[..., 0]
    assert colour[:size, :size].min() > 60
    assert np.abs(colour[:, size:]).max() < 20


@needs_browser
def test_every_choice_changes_what_is_drawn(page: Page) -> None:
    page.driver.find_element(By.CSS_SELECTOR, "#tokens button[data-token='1']").click()
    one_scale = "one scale per block and head"
    for name, text, told in (
        ("head", "1", "legend"),
        ("group", "action", "legend"),
        ("scale", one_scale, "heat-text"),
        ("step", "1", "legend"),
    ):
        said, pixels = page.text(told), page.pixels("map-0")
        page.pick(name, text)
        assert (page.pixels("map-0") != pixels).any()
        assert page.text(told) != said
    page.pick("camera", "top")
    assert page.driver.find_elements(By.ID, "map-0") == []
    assert page.driver.find_element(By.ID, "map-1").is_displayed()
    page.pick("block", "1 (rows)")
    assert "reads the rows" in page.text("legend")


@needs_browser
def test_the_keyboard(page: Page) -> None:
    page.press(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert page.text("legend").endswith("future 1")
    page.press(Keys.ARROW_LEFT, Keys.ARROW_LEFT, Keys.ARROW_LEFT)
    assert page.text("legend").endswith("future rows, mean of 3")
    page.press("b", "s", "h")
    assert page.text("legend").startswith("block 1 (reads the rows), Euler step 1, head 0")
    page.press("B", "S", "H")
    assert page.text("legend").startswith(
        "block 0 (reads vision and language), Euler step 0, mean over heads"
    )
    page.press("g")
    assert page.text("legend").endswith("action rows, mean of 2")
    page.press("g")
    assert page.text("legend").endswith("state row")
    page.press("c")
    assert page.script("return document.querySelectorAll('#cameras canvas').length") == 2  # map and occlusion


@needs_browser
def test_a_click_on_the_matrix_picks_its_row(page: Page) -> None:
    matrix = page.driver.find_element(By.ID, "matrix")
    row = (
        2.5 / 6 * matrix.size["height"] - matrix.size["height"] / 2
    )  # the third of six rows, from the middle
    webdriver.ActionChains(page.driver).move_to_element_with_offset(matrix, 5, round(row)).click().perform()
    assert page.text("legend").endswith("future 1")


@needs_browser
def test_overlap_is_shown_beside_its_baselines(page: Page) -> None:
    page.pick("step", "1")
    page.pick("head", "0")
    lines = page.text("overlap").splitlines()
    assert lines[0] == "divergence cosine distinct maps of 3"
    assert "learned, head 0 1.000 0.000 3.00" in lines
    assert "redrawn, head 0 0.000 1.000 1.00" in lines
    assert "identical tokens 0.000 1.000 1.00" in lines


@needs_browser
def test_what_is_not_there_is_said(driver: webdriver.Chrome, tmp_path: Path) -> None:
    write_page(one_hot_maps(future_tokens=0, images=False), tmp_path / "page.html")
    page = Page(driver, tmp_path / "page.html")
    assert "no future tokens (N = 0)" in page.text("notes")
    assert "drawn on white" in page.text("notes")
    assert [option.text for option in Select(driver.find_element(By.ID, "group")).options] == [
        "state",
        "action",
    ]
    assert page.pixels("map-0").size > 0
    assert page.driver.get_log("browser") == []  # type: ignore[no-untyped-call]
