"""Where the target is the positioning system, nothing takes off that would lose it on the way up,
and what is in its way is said in the vehicle's own directions."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight import out_of_view, place_seen, target_from, world_problem
from perchctl.flight.criteria import AtRest
from perchctl.flight.preflight import (
    LEAN_DEG,
    refuse_out_of_view,
    refuse_strange,
    still_waiting_for,
)
from perchctl.geometry import Place, rot_z
from perchctl.positioning import FeedStatus
from perchctl.positioning.feed import UNSEEN
from perchctl.profile import Profile
from perchctl.vehicle import ExternalPosition
from perchctl.vision import CameraModel
from tests.helpers.flights import fly_short, short_profile
from tests.helpers.mission import READY, changed, target_at, telemetry

CAMERA = CameraModel(
    (640, 480), np.array([[380.0, 0.0, 319.5], [0.0, 380.0, 239.5], [0.0, 0.0, 1.0]]), np.zeros(5)
)
TARGET = short_profile({"positioning": "target"}, base="sim")
REST = telemetry(1.0, 0.0, thrust=0.0, supervisor=READY)
LOST = FeedStatus(problem=UNSEEN)
FEET = (0.0, 0.0, 0.0)
TOP_M = TARGET.planner.takeoff_height_m
angles = st.floats(-math.pi, math.pi)


def approaching(x: float, y: float) -> Profile:
    return changed({"planner.approach_xy_m": (x, y)}, TARGET)


# --- The way up -----------------------------------------------------------------------------


def test_straight_up_under_the_target_it_stays_in_view() -> None:
    for aside_m in (0.0, 0.2, 0.4):
        place = Place(np.array([aside_m, -aside_m, 2.0]) / math.sqrt(2.0) * [1, 1, 2**0.5], 0.4)
        assert out_of_view(place, FEET, 0.0, TARGET, CAMERA) is None


@settings(max_examples=60, deadline=None)
@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(1.2, 3.0), angles, angles)
def test_put_where_the_refusal_says_it_flies(
    x: float, y: float, z: float, yaw_rad: float, target_yaw: float
) -> None:
    """In whatever heading it stands, and the higher the vehicle, the less it sees."""
    place = Place(np.array([x, y, z]), target_yaw)
    problem = out_of_view(place, FEET, yaw_rad, TARGET, CAMERA)
    over = target_from((0.0, 0.0, TOP_M), yaw_rad, place, TARGET, CAMERA)
    leant_m = over.height_m * math.tan(math.radians(LEAN_DEG))
    # Farther aside of the camera, which is beside the body's axis, is as good as leaning.
    away = rot_z(yaw_rad)[:2, :2] @ over.aside_m / max(math.hypot(*over.aside_m), 1e-6)
    leaning = Place(np.array([*(place.position_m[:2] + leant_m * away), z]), target_yaw)
    swayed = target_from((0.0, 0.0, TOP_M), yaw_rad, leaning, TARGET, CAMERA)
    assert (problem is None) is (over.whole and swayed.whole)
    if problem is None:
        assert target_from(FEET, yaw_rad, place, TARGET, CAMERA).whole
        return
    ways = re.findall(r"([\d.]+) m (forward|back|to the left|to the right)", problem.advice)
    signs = {"forward": (1, 0), "back": (-1, 0), "to the left": (0, 1), "to the right": (0, -1)}
    way = sum((float(m) * np.array(signs[name]) for m, name in ways), np.zeros(2))
    there = rot_z(yaw_rad)[:2, :2] @ way
    assert out_of_view(place, (*there, 0.0), yaw_rad, TARGET, CAMERA) is None


def test_an_approach_out_of_sight_is_refused_with_the_reason() -> None:
    place = Place(np.array([0.1, 0.05, 2.0]), 0.0)
    assert out_of_view(place, FEET, 0.0, approaching(0.3, -0.2), CAMERA) is None
    problem = out_of_view(place, FEET, 0.0, approaching(2.0, 0.0), CAMERA)
    assert problem is not None
    assert "from planner.approach_xy_m (x 2, y 0 m) the vehicle would not see it" in problem.found
    assert "1.93 m aside of the camera's axis" in problem.found
    assert "near the target's x 0.10, y 0.05 m" in problem.advice


def test_the_loop_s_refusal_is_by_the_place_that_was_measured() -> None:
    place = Place(np.array([0.1, 0.05, 2.0]), 0.0)
    refuse_out_of_view(place, REST, TARGET, CAMERA)
    refuse_out_of_view(None, REST, approaching(2.0, 0.0), CAMERA)  # decks measure
    with pytest.raises(SafetyAbort, match=r"planner\.approach_xy_m .*leave .* out"):
        refuse_out_of_view(place, REST, approaching(2.0, 0.0), CAMERA)


def test_near_the_ceiling_the_small_marker_is_enough() -> None:
    """12 cm under it the large one is not whole."""
    low = Place(np.array([0.03, 0.0, TOP_M + 0.005 + 0.12]), 0.0)
    assert out_of_view(low, FEET, 0.0, TARGET, CAMERA) is None


def test_what_a_level_vehicle_sees_has_its_place_over_it() -> None:
    target = target_at(1.0, (0.3, -0.2, 2.0), (0.0, 0.0, 0.0))
    assert place_seen(target, TARGET).position_m == pytest.approx([0.3, -0.2, 2.0])


# --- Waiting for it -------------------------------------------------------------------------


def waits(waited_s: float = 0.0, problem: str | None = None, **seen: object) -> str:
    """What is waited for by a vehicle at rest that has pictures."""
    given = {"telemetry": REST, "has_frame": True, "target": None, "outside": LOST} | seen
    return still_waiting_for(
        given["telemetry"], given["has_frame"], problem, waited_s, TARGET,  # type: ignore[arg-type]
        given["target"], 0.0, given["outside"], CAMERA,  # type: ignore[arg-type]
    )  # fmt: skip


def test_a_target_that_is_not_in_view_is_waited_for_and_its_place_is_said() -> None:
    limit_s = TARGET.safety.estimator_wait_s
    assert "a sight of the target" in waits(limit_s)
    with pytest.raises(TimedOut) as refused:
        waits(limit_s + 0.1)
    text = str(refused.value)
    assert "not in view: put the vehicle under it: at most 3.2 m above the camera" in text
    assert "m at 1 m above it" in text
    assert "the axis points straight up" in text
    assert "motion capture" not in text
    with pytest.raises(TimedOut, match="not in view; the picture is dark"):
        waits(limit_s + 0.1, "the picture is dark")


def test_what_keeps_a_target_from_being_measured_comes_first() -> None:
    """Who carries it, or has no camera, has no use for where the target is."""
    late_s = TARGET.safety.estimator_wait_s + 0.1
    with pytest.raises(TimedOut, match="stand level"):
        waits(late_s, telemetry=replace(REST, roll_rad=0.4))
    with pytest.raises(TimedOut, match="stand still"):
        waits(late_s, telemetry=replace(REST, acc_z_g=1.3))
    with pytest.raises(TimedOut, match="a good picture"):
        waits(late_s, has_frame=False)
    with pytest.raises(TimedOut, match=r"it is seen, and was not measured at rest.*1\.00 g"):
        waits(late_s, target=target_at(1.0, (0.0, 0.0, 2.0), (0.0, 0.0, 0.0)))
    beside = FeedStatus(problem="by the target the vehicle is 0.40 m beside its estimate")
    with pytest.raises(TimedOut, match=r"sight of the target.*0\.40 m beside its estimate"):
        waits(late_s, outside=beside)


def test_a_target_in_view_is_waited_for_no_longer() -> None:
    placed = ExternalPosition(FEET)
    assert waits(outside=FeedStatus(0.05, None, 20, placed, 30.0, placed)) == ""
    off = ExternalPosition((0.4, 0.0, 0.0))
    told = waits(outside=FeedStatus(0.05, None, 20, off, 30.0, off))
    assert "the state estimate to agree with the sight of the target" in told


def test_what_is_refused_speaks_of_the_target() -> None:
    at_rest = AtRest()
    assert at_rest.strange(ExternalPosition(FEET), TARGET) is None
    moved = at_rest.strange(ExternalPosition((0.2, 0.0, 0.0)), TARGET)
    assert moved is not None
    assert "by the target the vehicle has moved by 0.20 m" in moved.sentence
    # A height or a far place cannot be another world's: there is only the vehicle's own.
    assert world_problem(ExternalPosition((0.0, 0.0, 0.4)), REST, TARGET) is None
    far = changed({"target.expected_xy_m": (4.0, 0.0)}, TARGET)
    status = FeedStatus(0.05, None, 20, None, 30.0, ExternalPosition(FEET))
    with pytest.raises(SafetyAbort, match=r"expected 4\.0 m from where the vehicle stands"):
        refuse_strange(status, REST, far, REST.t_s)


# --- The loop -------------------------------------------------------------------------------


def refused(changes: dict[str, object], **scenario: object) -> str:
    with pytest.raises((SafetyAbort, TimedOut)) as found:
        fly_short({"positioning": "target"} | changes, **scenario)
    return str(found.value)


def test_a_simulated_vehicle_stays_on_the_ground() -> None:
    """The senses' own place of the target, and the pipeline's own camera."""
    assert "the vehicle would not see it" in refused({"planner.approach_xy_m": [1.9, 0.0]})
    told = refused({"safety.estimator_wait_s": 0.6}, no_target=True)
    assert "not in view" in told
    assert "at most 3.2 m above the camera" in told
