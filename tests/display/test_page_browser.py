"""The live page as a browser lays it out. Without a browser these are skipped."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from perchctl.display import LivePage
from tests.helpers.browser import Browser, browsing, why_no_browser
from tests.helpers.recording import camera

RED_BGR, OLD_BGR, GOOD_BGR = (0x1C, 0x16, 0xC4), (0x00, 0x4A, 0x7A), (0x37, 0x7F, 0x1A)
HEIGHT_PX, GAP_PX = 700, 12


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if why := why_no_browser():
        pytest.skip(why)
    with browsing() as opened:
        yield opened


@pytest.mark.parametrize("width_px", [400, 1280])
def test_stop_hangs_on_the_window_whatever_the_rows_say(width_px: int, browser: Browser) -> None:
    """A row that wraps must not move it from under a finger."""
    page = LivePage(camera(), "perchctl fly sim://", on_stop=lambda: None)
    told = [["held", "word " * 300]]
    page.set_state(lambda: {"phase": "ASCEND", "rows": told, "note": "note " * 40}, live=False)
    try:
        browser.open(page.url, width_px, HEIGHT_PX)
        browser.until("document.body.innerText.includes('word word')")
        shot = browser.photograph()
        assert browser.evaluate("document.documentElement.scrollWidth") <= width_px
    finally:
        page.close()
    rows, columns = np.nonzero((shot == RED_BGR).all(axis=2))
    assert shot.shape[:2] == (HEIGHT_PX, width_px)
    assert HEIGHT_PX - GAP_PX <= rows.max() < HEIGHT_PX - 1
    assert np.ptp(rows) + 1 == 64
    column_px = width_px if width_px < 960 else 2 * width_px / 5
    assert np.ptp(columns) > column_px - 50


def coloured_px(shot: np.ndarray, bgr: tuple[int, int, int]) -> int:
    return int((shot == bgr).all(axis=2).sum())


def test_a_page_without_news_says_so_and_a_flight_that_is_over_shows_its_card(
    browser: Browser,
) -> None:
    page = LivePage(camera(), "perchctl fly sim://", on_stop=lambda: None)
    page.set_state(lambda: {"phase": "ASCEND", "rows": []})  # and never again
    card = {"outcome": "PERCHED", "good": True, "reason": "hanging", "rows": [["miss", "2 mm"]]}
    try:
        browser.open(page.url, 400, HEIGHT_PX)
        browser.until("document.body.classList.contains('old')")
        assert coloured_px(browser.photograph(), OLD_BGR) > 4_000  # the whole line
        page.set_state(lambda: {"phase": "PERCHED", "rows": [], "over": True}, live=False)
        page.end(card)
        browser.until("!document.getElementById('card').hidden")
        shot = browser.photograph()
        assert browser.evaluate("document.documentElement.scrollWidth") <= 400
    finally:
        page.close()
    assert coloured_px(shot, GOOD_BGR) > 1_000  # its frame
    assert not coloured_px(shot, RED_BGR)  # nothing is left to stop
