"""Reports of flights that were flown: perched, landed by a fault, killed. As text, and as a
browser lays them out at 1280 and 400 px, without a network. Without a Chromium that is skipped."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

import cv2

from perchctl.faults.catalogue import BY_NAME, Case
from perchctl.faults.effects import FOR_EVER, CameraFault, Effect, Killed
from perchctl.faults.flight import fly_with_fault
from perchctl.faults.result import FaultResult
from perchctl.log.read import read_log
from perchctl.mission.state import Phase
from perchctl.report.told import Told
from perchctl.report.write import write_report
from perchctl.sim.draw import draw_scenario
from tests.helpers.flights import SEED, short_profile

pytestmark = pytest.mark.long

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((name for name in BROWSERS if shutil.which(name)), "")
SNOW_S = 0.7
FAULTS: dict[str, tuple[str, Phase, Effect]] = {
    "perched": ("camera-snow", Phase.ASCEND, CameraFault("snow", SNOW_S)),
    "landed": ("camera-silent", Phase.ALIGN, CameraFault("silent", FOR_EVER)),
    "killed": ("killed", Phase.ASCEND, Killed()),
}
NAMES = tuple(FAULTS)


def flown(name: str, folder: Path) -> FaultResult:
    """`perched`: snow for a while in the ascent; `landed`: the camera falls silent in the
    alignment, for ever; `killed`: the program is, in the ascent."""
    cv2.setNumThreads(1)
    profile = short_profile()
    fault, phase, effect = FAULTS[name]
    case = Case(BY_NAME[fault], phase, 0.3, (effect,))
    return fly_with_fault(profile, case, draw_scenario(profile, SEED), folder / f"{name}.jsonl")


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, FaultResult]]:
    folder = tmp_path_factory.mktemp("flights")
    results = {name: flown(name, folder) for name in NAMES}
    for name in NAMES:
        write_report([folder / f"{name}.jsonl"], folder / f"{name}.html")
    write_report([folder / f"{name}.jsonl" for name in NAMES], folder / "session.html")
    return folder, results


def told(flights: tuple[Path, dict[str, FaultResult]], name: str) -> Told:
    from perchctl.report.write import told_of

    return told_of(flights[0] / f"{name}.jsonl")


def test_snow_is_told_with_its_true_times(
    flights: tuple[Path, dict[str, FaultResult]],
) -> None:
    begin_s = flights[1]["perched"].begin_s
    assert begin_s is not None
    flight = told(flights, "perched")
    begin_s = read_log(flights[0] / "perched.jsonl").since(begin_s)
    lost = [s for s in flight.story if "lost for" in s.text or "No picture" in s.text]
    assert len(lost) == 1, flight.story
    assert lost[0].t_s == pytest.approx(begin_s, abs=0.15)
    found = re.search(r"for (\d\.\d) s", lost[0].text)
    assert found is not None
    assert float(found[1]) == pytest.approx(SNOW_S, abs=0.2)
    assert flight.outcome == "perched"
    assert flight.story[-1].text.startswith("Perched")


def test_a_silent_camera_lands_it_and_the_page_says_why(
    flights: tuple[Path, dict[str, FaultResult]],
) -> None:
    flight = told(flights, "landed")
    assert flight.outcome == "landed"
    assert any("No picture" in s.text and "it landed" in s.text for s in flight.story)
    assert {a.about for a in flight.advice} >= {"video"}


def test_a_killed_flight_has_no_end(flights: tuple[Path, dict[str, FaultResult]]) -> None:
    flight = told(flights, "killed")
    assert flight.outcome == "unfinished"
    assert "The log ends here, in ASCEND" in flight.story[-1].text


# --- in a browser ---------------------------------------------------------------------

MEASURE = (
    "<script>document.title = [document.documentElement.scrollWidth, innerWidth,"
    " document.querySelectorAll('svg').length, document.images.length].join(' ')</script></body>"
)


@pytest.mark.skipif(not BROWSER, reason="no Chromium is installed")
@pytest.mark.parametrize("width_px", [400, 1280])
@pytest.mark.parametrize("name", [*NAMES, "session"])
def test_nothing_is_wider_than_the_window(
    name: str, width_px: int, flights: tuple[Path, dict[str, FaultResult]], tmp_path: Path
) -> None:
    html = (flights[0] / f"{name}.html").read_text(encoding="utf-8")
    page = tmp_path / "page.html"
    # The page holds no script and allows none: a copy is measured.
    free = re.sub(r"<meta http-equiv=[^>]*>", "", html)
    page.write_text(free.replace("</body>", MEASURE), encoding="utf-8")
    done = subprocess.run(
        [
            BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--proxy-server=127.0.0.1:9", f"--user-data-dir={tmp_path / 'profile'}",
            f"--window-size={width_px},900", "--virtual-time-budget=3000", "--dump-dom",
            page.as_uri(),
        ],
        check=True, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    title = re.search(r"<title>(\d+) (\d+) (\d+) \d+</title>", done.stdout)
    assert title is not None
    wide_px, window_px, figures = (int(number) for number in title.groups())
    assert window_px <= max(width_px, 500)  # a Chromium's window may have a least width
    assert wide_px <= window_px
    assert figures >= 6
