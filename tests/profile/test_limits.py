"""Keys that must fit each other: each pair that dooms every flight is refused, and says why."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pytest
from pydantic import ValidationError

from perchctl.profile import DOUBTFUL, Profile
from perchctl.profile.limits import IMPOSSIBLE, Limit
from tests.helpers.flights import short_profile

BROKEN: tuple[Mapping[str, Any], ...] = (
    {"planner.search.max_height_m": 3.1},
    {"planner.takeoff_height_m": 1.4},
    {"planner.takeoff_speed_mps": 0.02},
    {"camera.latency_s": 0.4},
    {"link.telemetry_period_s": 0.1},
    {"link.telemetry_period_s": 0.05, "safety.telemetry_hold_s": 0.05},
    {"link.telemetry_period_s": 0.05, "safety.telemetry_land_s": 0.05},
)
"""In the order of `IMPOSSIBLE`, each breaks one."""


@pytest.mark.parametrize(
    ("limit", "changes"), [*zip(IMPOSSIBLE, BROKEN, strict=True)], ids=lambda each: str(each)[:40]
)
def test_each_impossible_pair_is_refused_with_its_keys(
    limit: Limit, changes: Mapping[str, Any]
) -> None:
    with pytest.raises(ValidationError) as caught:
        short_profile(changes, base="sim")
    said = str(caught.value.errors()[0]["ctx"]["error"])
    assert limit.consequence in said
    assert all(key in said for key in limit.keys)
    assert "\n" not in said


@pytest.mark.parametrize("changes", [
    {"planner.search.max_height_m": 3.0}, {"planner.takeoff_height_m": 1.3},
    {"camera.latency_s": 0.39},
], ids=str)  # fmt: skip
def test_what_just_fits_is_taken(changes: Mapping[str, Any]) -> None:
    assert isinstance(short_profile(changes, base="sim"), Profile)


def test_a_measured_latency_counts_as_where_the_flight_begins() -> None:
    measured = {"camera.latency_s": "measured", "safety.max_frame_age_s": 0.11}
    assert isinstance(short_profile(measured, base="sim"), Profile)
    with pytest.raises(ValidationError, match=r"camera.latency_s \(0.1 s\) < "):
        short_profile(measured | {"safety.max_frame_age_s": 0.09}, base="sim")


@pytest.mark.parametrize(
    "limit", [limit for limits in (IMPOSSIBLE, *DOUBTFUL.values()) for limit in limits],
    ids=lambda limit: limit.consequence,
)  # fmt: skip
def test_a_limit_that_does_not_hold_shows_each_key_with_its_value_and_unit(limit: Limit) -> None:
    profile = short_profile({}, base="sim")
    assert limit.holds(profile)
    said = limit.violation_text(profile)
    for key in limit.keys:
        assert re.search(rf"{re.escape(key)} \([0-9.e-]+( [a-zA-Z/^0-9]+)?\)", said), said
    assert said.endswith(f"does not hold: {limit.consequence}")
