"""The picture of a flight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.analysis import FlightAnalysis, plot_flight
from perchctl.analysis.plot import title_of
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.record import FlightLog
from tests.helpers.told import made

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def log() -> FlightLog:
    def change(record: dict[str, Any]) -> None:
        record |= {"true_miss_m": 0.004, "battery_rest_v": record["battery_v"] + 0.05}

    return made(change)


def picture(log: FlightLog, path: Path) -> Array:
    plot_flight(log, path)
    image = cv2.imread(str(path))
    assert image is not None
    return image.astype(np.float64)


@pytest.fixture(scope="module")
def plain(log: FlightLog, tmp_path_factory: pytest.TempPathFactory) -> Array:
    return picture(log, tmp_path_factory.mktemp("plain") / "f.png")


def share_of(image: Array, hex_colour: str) -> float:
    """Share of the pixels that have that colour (BGR image)."""
    rgb = [int(hex_colour[i : i + 2], 16) for i in (1, 3, 5)]
    return float((np.abs(image - np.array(rgb[::-1])).max(axis=2) < 12).mean())


def test_the_picture_holds_the_flight(plain: Array) -> None:
    assert plain.shape[0] > 1200
    for colour in ("#56B4E9", "#E69F00", "#0072B2", "#CC79A7", "#009E73", "#D55E00"):
        assert share_of(plain, colour) > 2e-4, colour


def test_raw_points_come_from_the_detections(log: FlightLog, plain: Array, tmp_path: Path) -> None:
    """Without the small marker's poses its colour is left in the legend only."""
    blind = [r | dict.fromkeys(("sx_m", "sy_m", "sz_m", "syaw_rad")) for r in log.records]
    without = replace(log, records=blind)
    upper = slice(0, int(0.75 * len(plain)))  # below it is a line of that colour
    full = share_of(plain[upper], "#E69F00")
    assert share_of(picture(without, tmp_path / "b.png")[upper], "#E69F00") < full / 5


def test_the_last_seconds_are_in_millimetres(log: FlightLog, plain: Array, tmp_path: Path) -> None:
    """A millimetre is seen in the last panel, and not in those of the whole flight."""
    start_s = log.records[-1]["t_s"] - 8.0
    moved = [
        r | {"ex_m": r["ex_m"] + 0.001} if r["ex_m"] is not None and r["t_s"] > start_s else r
        for r in log.records
    ]
    other = replace(log, records=moved)
    changed = plain != picture(other, tmp_path / "b.png")
    rows = changed.any(axis=2).sum(axis=1)
    last = int(0.8 * len(rows))
    assert rows[last:].sum() > 1000
    assert rows[last:].sum() > 5 * rows[:last].sum()


@pytest.mark.parametrize("count", [1, 2, 60])
def test_a_short_flight_without_a_target(log: FlightLog, count: int, tmp_path: Path) -> None:
    """One tick, no pose, no summary: still a picture, and no warning."""
    short = replace(log, records=log.records[:count], summary=None)
    assert picture(short, tmp_path / "f.png").std() > 1.0


def test_many_attempts_and_names_that_matplotlib_would_typeset(tmp_path: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        phase = ("ALIGN", "ASCEND", "PERCH", "RECOVER")[round(record["t_s"] / 0.2) % 4]
        record |= {"phase": phase, "reason": "50 $ and _more_ {"}

    log = made(change, {"outcome": "landed", "reason": "a $ in {a} reason $ with \\frac"})
    assert len(log.phases) > 50
    assert picture(log, tmp_path / "f.png").std() > 1.0


def test_title(log: FlightLog) -> None:
    assert title_of(FlightAnalysis(log)) == "profile sim, seed 7   |   perched   |   miss 3.1 mm"
    cut = replace(log, header={}, summary=None)
    assert "unknown (the log ends in PERCHED)" in title_of(FlightAnalysis(cut))


def test_nothing_to_plot(log: FlightLog, tmp_path: Path) -> None:
    empty = replace(log, records=[])
    with pytest.raises(InvalidValue, match="no ticks"):
        plot_flight(empty, tmp_path / "f.png")
    (tmp_path / "no").write_text("in the way")
    with pytest.raises(InvalidValue, match=r"no is a file, not a folder"):
        plot_flight(log, tmp_path / "no" / "folder.png")
