"""The live page as a browser lays it out. Without a Chromium these are skipped."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.display.page.live import LivePage
from tests.helpers.recording import camera

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((name for name in BROWSERS if shutil.which(name)), "")
RED_BGR, OLD_BGR, GOOD_BGR = (0x1C, 0x16, 0xC4), (0x00, 0x4A, 0x7A), (0x37, 0x7F, 0x1A)
HEIGHT_PX, GAP_PX = 700, 12


def photograph(page: LivePage, width_px: int, folder: Path, wait_ms: int) -> np.ndarray:
    shot = folder / f"{width_px}.png"
    subprocess.run(
        [
            BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            f"--user-data-dir={folder / 'profile'}", f"--window-size={width_px},{HEIGHT_PX}",
            f"--timeout={wait_ms}", f"--screenshot={shot}", page.url,
        ],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    return np.asarray(cv2.imread(str(shot)))


@pytest.mark.skipif(not BROWSER, reason="no Chromium is installed")
@pytest.mark.parametrize("width_px", [400, 1280])
def test_stop_hangs_on_the_window_whatever_the_rows_say(width_px: int, tmp_path: Path) -> None:
    """A row that wraps must not move it from under a finger."""
    page = LivePage(camera(), "perchctl fly sim://", on_stop=lambda: None)
    told = [["held", "word " * 300]]
    page.tell(lambda: {"phase": "ASCEND", "rows": told, "note": "note " * 40}, live=False)
    try:
        for wait_ms in (1500, 8000):  # a busy machine may need longer to get to the first poll
            shot = photograph(page, width_px, tmp_path, wait_ms)
            rows, columns = np.nonzero((shot == RED_BGR).all(axis=2))
            if rows.size:
                break
    finally:
        page.close()
    assert shot.shape[:2] == (HEIGHT_PX, width_px)
    assert HEIGHT_PX - GAP_PX <= rows.max() < HEIGHT_PX - 1
    assert np.ptp(rows) + 1 == 64
    column_px = width_px if width_px < 960 else 2 * width_px / 5
    assert np.ptp(columns) > column_px - 50


def coloured_px(shot: np.ndarray, bgr: tuple[int, int, int]) -> int:
    return int((shot == bgr).all(axis=2).sum())


@pytest.mark.skipif(not BROWSER, reason="no Chromium is installed")
def test_a_page_without_news_says_so_by_itself(tmp_path: Path) -> None:
    page = LivePage(camera(), "perchctl fly sim://", on_stop=lambda: None)
    page.tell(lambda: {"phase": "ASCEND", "rows": []})  # and never again
    try:
        for wait_ms in (4000, 12000):
            shot = photograph(page, 1280, tmp_path, wait_ms)
            if coloured_px(shot, OLD_BGR):
                break
    finally:
        page.close()
    assert coloured_px(shot, OLD_BGR) > 10_000  # the whole line


@pytest.mark.skipif(not BROWSER, reason="no Chromium is installed")
def test_a_flight_that_is_over_shows_its_card(tmp_path: Path) -> None:
    page = LivePage(camera(), "perchctl fly sim://", on_stop=lambda: None)
    page.tell(lambda: {"phase": "PERCHED", "rows": [], "over": True}, live=False)
    page.end({"outcome": "PERCHED", "good": True, "reason": "hanging", "rows": [["miss", "2 mm"]]})
    try:
        for wait_ms in (1500, 8000):
            shot = photograph(page, 400, tmp_path, wait_ms)
            if coloured_px(shot, GOOD_BGR):
                break
    finally:
        page.close()
    assert coloured_px(shot, GOOD_BGR) > 1_000  # its frame
    assert not coloured_px(shot, RED_BGR)  # nothing is left to stop
