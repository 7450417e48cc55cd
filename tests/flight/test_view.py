"""Where the target is the positioning system, nothing takes off that would lose it on the way up,
and what is in its way is said in the vehicle's own directions."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight import fly_lockstep, view_problem
from perchctl.flight.preflight import (
    LEAN_DEG,
    GroundTurn,
    still_waiting_for,
    target_view_from,
)
from perchctl.geometry import Place, rot_z
from perchctl.positioning import FeedStatus
from perchctl.positioning.feed import UNSEEN
from perchctl.vehicle import ExternalPosition, Telemetry
from perchctl.vision import CameraModel
from tests.helpers.flights import short_profile
from tests.helpers.mission import READY, changed, telemetry

CAMERA = CameraModel(
    (640, 480), np.array([[380.0, 0.0, 319.5], [0.0, 380.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5)
)
TARGET = short_profile({"positioning": "target"}, base="sim")
FAR_APPROACH = changed({"planner.approach_xy_m": (2.0, 0.0)}, TARGET)
REST = telemetry(1.0, 0.0, thrust=0.0, supervisor=READY)
FEET = (0.0, 0.0, 0.0)
TOP_M = TARGET.planner.takeoff_height_m
LATE_S = TARGET.safety.estimator_wait_s + 0.1
angles = st.floats(-math.pi, math.pi)


def place(x: float, y: float, z: float = 2.0, yaw_rad: float = 0.0) -> Place:
    return Place(np.array([x, y, z]), yaw_rad)


# --- The way up -----------------------------------------------------------------------------


@pytest.mark.parametrize("target", [
    place(0.0, 0.0), place(0.14, -0.14, 2.0, 0.4), place(0.28, -0.28, 2.0, 0.4),
    place(0.03, 0.0, TOP_M + 0.125),  # 12 cm under it only the small marker is whole
])  # fmt: skip
def test_straight_up_under_the_target_it_stays_in_view(target: Place) -> None:
    assert view_problem(target, FEET, 0.0, TARGET, CAMERA) is None


@settings(max_examples=60, deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(1.2, 3.0), angles, angles)
def test_put_where_the_refusal_says_it_flies(
    x: float, y: float, z: float, yaw_rad: float, target_yaw: float
) -> None:
    """In whatever heading it stands, and the higher the vehicle, the less it sees."""
    target = place(x, y, z, target_yaw)
    problem = view_problem(target, FEET, yaw_rad, TARGET, CAMERA)
    over = target_view_from((0.0, 0.0, TOP_M), yaw_rad, target, TARGET, CAMERA)
    leant_m = over.height_m * math.tan(math.radians(LEAN_DEG))
    # Farther aside of the camera, which is beside the body's axis, is as good as leaning.
    away = rot_z(yaw_rad)[:2, :2] @ over.aside_m / max(math.hypot(*over.aside_m), 1e-6)
    leaning = place(*(target.position_m[:2] + leant_m * away), z, target_yaw)
    swayed = target_view_from((0.0, 0.0, TOP_M), yaw_rad, leaning, TARGET, CAMERA)
    assert (problem is None) is (over.has_marker and swayed.has_marker)
    if problem is None:
        assert target_view_from(FEET, yaw_rad, target, TARGET, CAMERA).has_marker
        return
    ways = re.findall(r"([\d.]+) m (forward|back|to the left|to the right)", problem.advice)
    signs = {"forward": (1, 0), "back": (-1, 0), "to the left": (0, 1), "to the right": (0, -1)}
    way = sum((float(m) * np.array(signs[name]) for m, name in ways), np.zeros(2))
    there = rot_z(yaw_rad)[:2, :2] @ way
    assert view_problem(target, (*there, 0.0), yaw_rad, TARGET, CAMERA) is None


def test_an_approach_out_of_sight_is_refused_with_the_reason() -> None:
    near = changed({"planner.approach_xy_m": (0.3, -0.2)}, TARGET)
    assert view_problem(place(0.1, 0.05), FEET, 0.0, near, CAMERA) is None
    words = r"from x 2\.00, y 0\.00 m .* would not see it.* m from the camera's axis.*remove "
    with pytest.raises(SafetyAbort, match=words):
        fly_lockstep(FAR_APPROACH, 1)


# --- Waiting for it -------------------------------------------------------------------------


def waits(waited_s: float = 0.0, telemetry: Telemetry = REST, **seen: Any) -> str:
    """What is waited for by a vehicle at rest that has pictures."""
    samples = [replace(REST, t_s=REST.t_s - 0.1 * k) for k in range(20, 0, -1)]
    given = {"samples": [*samples, telemetry], "feed": FeedStatus(problem=UNSEEN)} | seen
    return still_waiting_for(GroundTurn(TARGET, waited_s, **given))


BESIDE = FeedStatus(problem="by the target the vehicle is 0.40 m from its estimate")


@pytest.mark.parametrize(("seen", "words"), [
    ({}, f"view of the target.*{UNSEEN}"),
    # Who carries it, or has no camera, has no use for where the target is.
    ({"telemetry": replace(REST, roll_rad=0.4)}, "to be level"),
    ({"telemetry": replace(REST, acc_z_g=1.3)}, "to be at rest"),
    ({"picture_problem": "none has arrived", "unseen_s": math.inf}, "a good picture"),
    ({"feed": BESIDE}, r"view of the target.*0\.40 m from its estimate"),
])  # fmt: skip
def test_what_keeps_a_target_from_being_measured_is_named_first_things_first(
    seen: dict[str, Any], words: str
) -> None:
    assert waits(1.0, **seen)
    with pytest.raises(TimedOut, match=words) as refused:
        waits(LATE_S, **seen)
    assert "motion capture" not in str(refused.value)


def test_a_target_in_view_is_waited_for_no_longer() -> None:
    placed, off = ExternalPosition(FEET), ExternalPosition((0.4, 0.0, 0.0))
    assert waits(feed=FeedStatus(0.05, None, 20, placed, 30.0, placed)) == ""
    told = waits(feed=FeedStatus(0.05, None, 20, off, 30.0, off))
    assert "the state estimate to agree with the view of the target" in told
