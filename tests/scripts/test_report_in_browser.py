"""report.html in a real browser, a Chromium without a window: what its scripts do, and that nothing leaves it."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from lipac.page.report_page import write
from lipac.scripts.dev.browser import BROWSERS, open_browser

from ..page.folder import CULLED, FULL, frame, picture, rendered, verified

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest.importorskip("playwright", reason="no playwright here: pip install 'lipac[browser]'")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if not any(map(shutil.which, BROWSERS)):
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed: the page is not opened in a browser")
    with open_browser() as one:
        yield one


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a shot with a full render beside it, and a verified frame."""
    folder = tmp_path_factory.mktemp("page")
    found = verified(folder / "out", [[0, 0]])
    rendered(folder / "out", frame(1), frame(2, certified_mean=0.008, **found))
    rendered(folder / "full", frame(1, culled=0), frame(2, culled=0), policy="none")
    picture(folder / "full" / "frame_0002.png", FULL)
    return write(folder / "out", folder / "full")


class Heard:
    """A page that is open, and what it said and asked for."""

    def __init__(self, browser: Browser, file: Path, **options: Any) -> None:
        self.page: Page = browser.new_page(viewport={"width": 1000, "height": 800}, **options)
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(file.as_uri())

    def pixels(self) -> np.ndarray:
        """What the comparison shows, (H, W, 3)."""
        shot = self.page.locator(".compare .stage").screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


@pytest.fixture
def heard(browser: Browser, file: Path) -> Iterator[Heard]:
    one = Heard(browser, file)
    yield one
    one.page.close()


def share_of_full(pixels: np.ndarray) -> float:
    """How much of a picture, from the left, is that with everything: by the middle row, whose labels are elsewhere."""
    row = pixels[len(pixels) // 2]
    full = np.abs(row - np.array(FULL)).sum(axis=1) < np.abs(row - np.array(CULLED)).sum(axis=1)
    assert full[: int(full.sum())].all()  # one piece
    return float(full.mean())


def test_nothing_is_said_and_nothing_asked_for(heard: Heard, file: Path) -> None:
    heard.page.wait_for_load_state("networkidle")
    assert heard.said == []
    assert [url for url in heard.asked if not url.startswith("data:")] == [file.as_uri()]
    broken = "[...document.images].filter(i => !i.complete || i.naturalWidth === 0).length"
    assert heard.page.evaluate(broken) == 0


def test_a_request_would_be_noticed_and_refused(browser: Browser, file: Path, tmp_path: Path) -> None:
    """What the test above finds nothing of."""
    other = tmp_path / "other.html"
    other.write_text(file.read_text().replace("</main>", '<img src="http://127.0.0.1:9/a.png" alt="a"></main>'))
    heard = Heard(browser, other)
    heard.page.wait_for_load_state("networkidle")
    assert any("Content Security Policy" in line for line in heard.said)
    heard.page.close()


def test_the_slider_moves_the_picture(heard: Heard) -> None:
    slider = heard.page.get_by_role("slider")
    assert share_of_full(heard.pixels()) == pytest.approx(0.5, abs=0.02)
    slider.focus()
    heard.page.keyboard.press("Home")
    assert share_of_full(heard.pixels()) == pytest.approx(0.0, abs=0.02)
    heard.page.keyboard.press("End")
    assert share_of_full(heard.pixels()) == pytest.approx(1.0, abs=0.02)
    for _ in range(10):
        heard.page.keyboard.press("ArrowLeft")
    assert share_of_full(heard.pixels()) == pytest.approx(0.9, abs=0.02)


def test_so_does_a_hand_on_the_picture(heard: Heard) -> None:
    stage = heard.page.locator(".compare .stage")
    stage.scroll_into_view_if_needed()
    box = stage.bounding_box()
    assert box is not None
    x, y = box["x"], box["y"] + box["height"] / 2
    heard.page.mouse.move(x + 0.5 * box["width"], y)
    heard.page.mouse.down()
    heard.page.mouse.move(x + 0.2 * box["width"], y, steps=4)
    heard.page.mouse.up()
    assert share_of_full(heard.pixels()) == pytest.approx(0.2, abs=0.02)
    heard.page.mouse.move(x + 0.8 * box["width"], y)
    assert share_of_full(heard.pixels()) == pytest.approx(0.2, abs=0.02)


def test_without_scripts_both_pictures_stand_side_by_side(browser: Browser, file: Path) -> None:
    heard = Heard(browser, file, java_script_enabled=False)
    pixels = heard.pixels()
    assert share_of_full(pixels) == pytest.approx(0.5, abs=0.02)
    heights = [e.bounding_box() for e in heard.page.locator(".compare img").all()]
    assert all(box and box["width"] > 300 for box in heights)
    assert not heard.page.locator(".compare input").is_visible()
    heard.page.close()


def test_on_paper_both_pictures_stand_side_by_side(heard: Heard) -> None:
    heard.page.keyboard.press("End")
    heard.page.emulate_media(media="print")
    assert share_of_full(heard.pixels()) == pytest.approx(0.5, abs=0.02)
    assert not heard.page.locator(".compare input").is_visible()


@pytest.mark.parametrize("width", [360, 1600])
def test_nothing_is_wider_than_the_window(heard: Heard, width: int) -> None:
    heard.page.set_viewport_size({"width": width, "height": 800})
    assert heard.page.evaluate("document.documentElement.scrollWidth") <= width


def test_text_stands_out_from_what_is_behind_it(heard: Heard) -> None:
    """Contrast of at least 4.5 to 1, as WCAG 2.2 (1.4.3) asks: of all text on the page's own plain grounds."""
    ratios = heard.page.evaluate(CONTRAST)
    assert len(ratios) > 30
    assert min(ratio for ratio, _ in ratios) >= 4.5, min(ratios)


CONTRAST = """() => {
  const rgb = text => text.match(/[\\d.]+/g).map(Number);
  const linear = c => c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4;
  const light = c => 0.2126 * linear(c[0]) + 0.7152 * linear(c[1]) + 0.0722 * linear(c[2]);
  const found = [];
  const texts = "p, li, td, th, dt, dd, h1, h2, h3, figcaption, caption, summary, span, b, strong";
  for (const e of document.querySelectorAll(texts)) {
    if (!e.innerText || e.closest("svg") || e.closest(".stage")) continue;
    let behind = e;
    while (behind && rgb(getComputedStyle(behind).backgroundColor)[3] === 0) behind = behind.parentElement;
    const ground = behind ? rgb(getComputedStyle(behind).backgroundColor) : [255, 255, 255];
    const [a, b] = [light(rgb(getComputedStyle(e).color)), light(ground)].sort((x, y) => y - x);
    found.push([(a + 0.05) / (b + 0.05), e.innerText.slice(0, 40)]);
  }
  return found;
}"""
