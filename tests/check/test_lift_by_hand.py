"""A lift by hand shows in the position that the vehicle reports."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from perchctl.check import vehicle
from perchctl.vehicle import Telemetry
from tests.helpers.checks import said


class Scripted:
    """A link whose vehicle reports one height after another, and moves by so much."""

    def __init__(self, heights_m: Sequence[float], moves_g: float) -> None:
        self.heights_m, self.moves_g = list(heights_m), moves_g

    def telemetry(self) -> list[Telemetry]:
        if not self.heights_m:
            return []
        place_m = (0.0, 0.0, self.heights_m.pop(0))
        return [said(position_m=place_m, acc_z_g=1.0 + self.moves_g)]


@pytest.mark.parametrize(("heights_m", "moves_g", "verdict", "words", "most_s"), [
    ([0.01, 0.3, 0.4, 0.01, *[0.0] * 50], 0.2, "pass", "rose by 0.39 m", 0.5),
    ([0.01] * 30, 0.0, "skipped", "not moved", 3.0),
    ([0.01] * 30, 0.3, "fail", "it moved, and the position", 3.0),
    ([0.01, 0.1, 0.01], 0.2, "skipped", "not enough to tell", 3.0),
    ([0.0, 0.4, 0.25], 0.2, "warn", "then +0.25 m", 3.0),
    ([], 0.0, "skipped", "no telemetry", 3.0),
])  # fmt: skip
def test_a_lift_makes_its_row_and_ends_once_the_vehicle_is_back(
    heights_m: list[float], moves_g: float, verdict: str, words: str, most_s: float
) -> None:
    waits: list[float] = []
    link = Scripted(heights_m, moves_g)
    finding = vehicle.lift_finding(vehicle.watch_lift(link, waits.append, 3.0))  # type: ignore[arg-type]
    assert finding.verdict == verdict, finding
    assert words in finding.found
    assert sum(waits) == pytest.approx(most_s, abs=0.11)
