"""What is said after a flight about latency and mounting."""

from __future__ import annotations

import inspect
import math
import re
from dataclasses import replace

import pytest

from perchctl.mission import PROFILE_ROWS, Findings
from perchctl.mission.table import TABLE
from perchctl.profile import CameraConfig
from perchctl.vision import CameraErrors


def _seen(
    delay_s: float = 0.0,
    sigma_s: float = 0.003,
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma_deg: float = 0.4,
) -> CameraErrors:
    x, y, z = (math.radians(t) for t in turn_deg)
    sigma_rad = math.radians(sigma_deg)
    return CameraErrors(delay_s, sigma_s, (x, y, z), (sigma_rad, sigma_rad, sigma_rad))


CAMERA = CameraConfig(latency_s=0.06)


@pytest.mark.parametrize(
    ("seen", "camera", "words"),
    [
        (_seen(0.032), CAMERA, "latency 92 +- 6 ms, profile says 60: set camera.latency_s"),
        (_seen(0.018), CAMERA, ""),
        (_seen(0.04, 0.0105), CAMERA, ""),  # too unsure
        (_seen(0.05), CameraConfig(latency_s="measured"), ""),
        (_seen(turn_deg=(0.5, -3.0, 6.0)), CAMERA, "-3.0 +- 0.8, 6.0 +- 0.8 deg"),
        (_seen(turn_deg=(-37.8, 0.0, 0.0), sigma_deg=15.0), CAMERA, ""),  # a flight of 3.5 s
    ],
)
def test_only_what_is_surely_beyond_its_gate_is_an_advice(
    seen: CameraErrors, camera: CameraConfig, words: str
) -> None:
    found = Findings.of(seen, camera)
    assert found.latency_s == pytest.approx(camera.start_latency_s + seen.delay_s)
    assert bool(found.advice) is bool(words)
    assert words in "".join(found.advice)
    # The scenario's camera is nobody's: it says nothing of the profile.
    dreamt = Findings.of(seen, camera, simulated=True)
    assert dreamt == replace(found, advice=())


def test_each_row_that_blames_the_profile_is_known() -> None:
    """By what its function says: a row that names keys of camera or positioning, or how to measure
    them, is one."""
    blames = {
        row.name
        for row in TABLE
        if callable(row.reason)
        and re.search(r"camera\.(mount|latency)|check --lift", inspect.getsource(row.reason))
    }
    assert blames == PROFILE_ROWS
