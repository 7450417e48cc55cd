"""What is said after a flight about latency and mounting."""

from __future__ import annotations

import math

import pytest

from perchctl.mission.report import flight_findings
from perchctl.profile import CameraConfig
from perchctl.record import FlightSummary
from perchctl.vision import Consistency


def _seen(
    delay_s: float = 0.0,
    sigma_s: float = 0.003,
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma_deg: float = 0.4,
) -> Consistency:
    x, y, z = (math.radians(t) for t in turn_deg)
    sigma_rad = math.radians(sigma_deg)
    return Consistency(delay_s, sigma_s, (x, y, z), (sigma_rad, sigma_rad, sigma_rad))


CAMERA = CameraConfig(latency_s=0.06)


def test_a_drift_beyond_the_gate_is_an_advice() -> None:
    found = flight_findings(_seen(0.032), CAMERA)
    assert found.latency_s == pytest.approx(0.092)
    assert found.advice == ("latency 92 +- 6 ms, profile says 60: set camera.latency_s to 0.092",)


@pytest.mark.parametrize(
    ("delay_s", "sigma_s"), [(0.018, 0.003), (-0.018, 0.003), (0.04, 0.03), (0.04, 0.0105)]
)  # fmt: skip
def test_what_is_small_or_unsure_is_no_advice(delay_s: float, sigma_s: float) -> None:
    assert flight_findings(_seen(delay_s, sigma_s), CAMERA).advice == ()


def test_a_measured_latency_needs_no_advice_but_where_it_is_not_used_whole() -> None:
    measured = CameraConfig(latency_s="measured")
    found = flight_findings(_seen(0.05), measured)
    assert found.latency_s == pytest.approx(0.12)
    assert found.advice == ()
    (advice,) = flight_findings(_seen(0.23), measured).advice
    assert "latency 300 +- 6 ms" in advice
    assert "20 to 200 are used" in advice


def test_a_turn_is_named_by_its_axis() -> None:
    (advice,) = flight_findings(_seen(turn_deg=(0.5, -3.0, 6.0)), CAMERA).advice
    assert "-3.0 +- 0.8 deg about y" in advice
    assert "6.0 +- 0.8 deg about z" in advice
    assert "about x" not in advice
    assert "`perchctl calibrate mount`" in advice
    assert flight_findings(_seen(turn_deg=(0.0, 0.0, 4.0), sigma_deg=3.0), CAMERA).advice == ()
    unsure = _seen(turn_deg=(-37.8, 0.0, 0.0), sigma_deg=15.0)  # a flight of 3.5 s
    assert flight_findings(unsure, CAMERA).advice == ()


def test_the_summary_tells_them_with_intervals() -> None:
    found = flight_findings(_seen(0.032, turn_deg=(0.2, -0.1, 0.4)), CAMERA)
    lines = FlightSummary("perched", "hanging", findings=found).text().splitlines()
    assert "latency:   92 +- 6 ms" in lines
    assert "mounting:  turned by 0.2 +- 0.8, -0.1 +- 0.8, 0.4 +- 0.8 deg (x, y, z)" in lines
    assert f"advice:    {found.advice[0]}" in lines
    assert max(map(len, lines)) <= 80
