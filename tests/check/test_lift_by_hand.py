"""A lift by hand shows in the position that the vehicle reports."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from perchctl.check import vehicle
from perchctl.check.row import Finding
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


def lifted(heights_m: Sequence[float], moves_g: float = 0.2) -> tuple[Finding, float]:
    """The finding, and for how long it was watched, s."""
    waits: list[float] = []
    link = Scripted(heights_m, moves_g)
    seen = vehicle.watch_lift(link, waits.append, 3.0)  # type: ignore[arg-type]
    return vehicle.lift_finding(seen), sum(waits)


@pytest.mark.parametrize(("heights_m", "moves_g", "verdict", "words"), [
    ([0.01, 0.3, 0.4, 0.01], 0.2, "pass", "rose by 0.39 m"),
    ([0.01] * 30, 0.0, "skipped", "not moved"),
    ([0.01] * 30, 0.3, "fail", "it moved, and the position"),
    ([0.01, 0.1, 0.01], 0.2, "skipped", "not enough to tell"),
    ([0.0, 0.4, 0.25], 0.2, "warn", "then +0.25 m"),
    ([], 0.0, "skipped", "no telemetry"),
])  # fmt: skip
def test_a_lift_makes_its_row(
    heights_m: list[float], moves_g: float, verdict: str, words: str
) -> None:
    finding, _ = lifted(heights_m, moves_g)
    assert finding.verdict == verdict, finding
    assert words in finding.found


def test_it_ends_once_the_vehicle_is_back() -> None:
    assert lifted([0.0, 0.3, 0.0, *[0.0] * 50])[1] < 0.5
    assert lifted([0.0] * 50)[1] == pytest.approx(3.0)
