"""The picture of a flight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.analysis import plot_flight
from perchctl.errors import InvalidValue
from perchctl.record import FlightLog
from tests.helpers.told import made

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def log() -> FlightLog:
    def change(record: dict[str, Any]) -> None:
        record |= {"true_miss_m": 0.004, "battery_rest_v": record["battery_v"] + 0.05}

    return made(change)


def picture(log: FlightLog, path: Path) -> np.ndarray:
    plot_flight(log, path)
    image = cv2.imread(str(path))
    assert image is not None
    return image.astype(np.float64)


@pytest.mark.parametrize("count", [1, 2, 60])
def test_a_short_flight_without_a_target(log: FlightLog, count: int, tmp_path: Path) -> None:
    """One tick, no pose, no summary: still a picture, and no warning."""
    short = replace(log, records=log.records[:count], summary=None)
    assert picture(short, tmp_path / "f.png").std() > 1.0


def test_nothing_to_plot(log: FlightLog, tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match="no ticks"):
        plot_flight(replace(log, records=[]), tmp_path / "f.png")
