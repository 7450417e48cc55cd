"""What is said after a flight about latency and mounting."""

from __future__ import annotations

import math

import pytest

from perchctl.mission import ContactError, Findings
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
    found = Findings.of(_seen(0.032), CAMERA)
    assert found.latency_s == pytest.approx(0.092)
    assert found.advice == ("latency 92 +- 6 ms, profile says 60: set camera.latency_s to 0.092",)


@pytest.mark.parametrize(
    ("delay_s", "sigma_s"), [(0.018, 0.003), (-0.018, 0.003), (0.04, 0.03), (0.04, 0.0105)]
)  # fmt: skip
def test_what_is_small_or_unsure_is_no_advice(delay_s: float, sigma_s: float) -> None:
    assert Findings.of(_seen(delay_s, sigma_s), CAMERA).advice == ()


def test_a_measured_latency_needs_no_advice() -> None:
    found = Findings.of(_seen(0.05), CameraConfig(latency_s="measured"))
    assert found.latency_s == pytest.approx(0.12)
    assert found.advice == ()


def test_a_turn_beyond_the_gate_is_an_advice() -> None:
    (advice,) = Findings.of(_seen(turn_deg=(0.5, -3.0, 6.0)), CAMERA).advice
    assert "-3.0 +- 0.8, 6.0 +- 0.8 deg" in advice
    assert "`perchctl calibrate mount`" in advice
    unsure = _seen(turn_deg=(-37.8, 0.0, 0.0), sigma_deg=15.0)  # a flight of 3.5 s
    assert Findings.of(unsure, CAMERA).advice == ()


def test_the_summary_tells_them_and_the_contact_with_intervals() -> None:
    found = Findings.of(_seen(0.032, turn_deg=(0.2, -0.1, 0.4)), CAMERA)
    contact = ContactError(1.8e-3, 0.6e-3)
    summary = FlightSummary("perched", "hanging", findings=found, contact=contact)
    lines = summary.text().splitlines()
    assert "contact:   1.8 +- 0.6 mm off centre" in lines
    assert "latency:   92 +- 6 ms" in lines
    assert "mounting:  turned by 0.2 +- 0.8, -0.1 +- 0.8, 0.4 +- 0.8 deg (x, y, z)" in lines
    assert f"advice:    {found.advice[0]}" in lines
    assert max(map(len, lines)) <= 80
