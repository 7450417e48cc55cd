"""Whether the camera is mounted as the profile says: what a target does when the vehicle moves."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Observation, Outcome, Phase, PlannerState
from perchctl.mission.belief.mounting import (
    CameraMountingMonitor,
    CameraMountingSample,
    make_camera_mounting_sample,
    update_camera_mounting_monitor,
)
from perchctl.vehicle import Command, PositionSetpoint
from tests.helpers.mission import CEILING_M, remembering, state_in, target_at, telemetry
from tests.mission.rig import BEGIN_S, Motors, at, fly

FRAME_S = 1.0 / 30.0
TARGET = 0.4 + 0.2j
SPEED_MPS = 0.25

Seen = Callable[[float, complex], complex]
"""Where the target is placed at a time, from the vehicle's place."""


def turned(deg: float) -> Seen:
    """By a camera whose true mounting is turned so far from the profile's."""
    M = cmath.exp(-1j * math.radians(deg))
    return lambda t_s, p: p + M * (TARGET - p)


def flown(
    seen: Seen, way_m: float = 0.5, noise_m: float = 0.003
) -> tuple[CameraMountingMonitor, float]:
    """Half a second still, then straight on; the watch, and how far it flew until it spoke."""
    rng = np.random.default_rng(0)
    watch, t_s, moved_m = CameraMountingMonitor(), 0.0, 0.0
    while moved_m < way_m and not watch.is_camera_mounting_wrong:
        t_s += FRAME_S
        moved_m = max(0.0, t_s - 0.5) * SPEED_MPS
        p = moved_m * cmath.exp(0.7j)
        spoiled = seen(t_s, p) + complex(*rng.normal(0.0, noise_m, 2))
        watch = update_camera_mounting_monitor(watch, CameraMountingSample(t_s, p, spoiled))
    return watch, moved_m


@given(st.one_of(st.floats(75, 180), st.floats(-180, -75)))
def test_a_turned_mounting_is_seen_and_measured(deg: float) -> None:
    watch, moved_m = flown(turned(deg))
    assert watch.is_camera_mounting_wrong
    assert moved_m < 0.17
    assert abs(math.remainder(math.degrees(watch.camera_yaw_error_rad) - deg, 360.0)) < 15.0


@given(st.floats(-30, 30))
def test_a_mounting_that_leads_to_the_target_is_left_alone(deg: float) -> None:
    assert not flown(turned(deg))[0].is_camera_mounting_wrong


def _tilting(deg: float) -> CameraMountingMonitor:
    """A vehicle on its place, 1.5 m below, that leans by 5 deg to all sides for four seconds."""
    watch, reach_m = CameraMountingMonitor(), 1.5 * math.tan(math.radians(5.0))
    for i in range(120):
        t_s = i * FRAME_S
        lean = reach_m * complex(math.sin(4.0 * t_s), 0.8 * math.sin(5.0 * t_s + 1.0))
        watch = update_camera_mounting_monitor(
            watch, CameraMountingSample(t_s, 0j, turned(deg)(t_s, lean), lean)
        )
    return watch


@pytest.mark.parametrize("deg", [90, 180, -90])
def test_a_turned_mounting_shows_in_the_vehicles_own_tilts(deg: int) -> None:
    """Before it has gone anywhere. Taken for a target that jumps, it would be looked at afresh
    with each tilt, while the vehicle flies on."""
    watch = _tilting(deg)
    assert watch.is_camera_mounting_wrong
    assert abs(math.remainder(math.degrees(watch.camera_yaw_error_rad) - deg, 360.0)) < 5.0


def test_a_lean_is_where_the_upward_axis_meets_the_target() -> None:
    """Nose down by 10 deg, heading left: the axis leans to the left."""
    tel = telemetry(
        1.0, position_m=(0.3, 0.1, 1.0), pitch_rad=math.radians(10.0), yaw_rad=math.pi / 2
    )
    sight = make_camera_mounting_sample(1.0, tel, np.array([0.5, 0.2, 2.2]))
    assert sight.vehicle_world_xy_m == pytest.approx(0.3 + 0.1j)
    assert sight.target_world_xy_m == pytest.approx(0.5 + 0.2j)
    assert sight.vehicle_to_up_axis_at_target_height_world_xy_m == pytest.approx(
        1.2j * math.sin(math.radians(10.0)), rel=0.02
    )


def test_a_landing_for_the_mounting_stops_at_once() -> None:
    """Not where the setpoint had run to: it lies in the wrong direction."""
    ahead = PositionSetpoint(0.3, 0.0, 1.0, 0.0)
    watch = CameraMountingMonitor(contradicting_sighting_count=9, camera_yaw_error_rad=math.pi / 2)
    flight = fly(
        remembering(state_in(Phase.ALIGN), camera_mounting_monitor=watch, setpoint=ahead), at()
    )
    assert flight.state.transition_name == "mounting"
    assert isinstance(flight.command, PositionSetpoint)
    assert math.hypot(flight.command.x_m, flight.command.y_m) < 0.02


@given(st.floats(0.3, 2.0), st.floats(0.0, 2 * math.pi), st.sampled_from([0, 2, 5]))
def test_a_target_that_is_moved_is_no_turned_mounting(
    at_s: float, way_rad: float, frames: int
) -> None:
    """It jumps once, as fast as the filter follows, and then stands still."""
    step = 0.3 * cmath.exp(1j * way_rad)

    def moved(t_s: float, p: complex) -> complex:
        over_s = max(frames * FRAME_S, 1e-6)
        return TARGET + step * min(1.0, max(0.0, (t_s - at_s) / over_s))

    assert not flown(moved)[0].is_camera_mounting_wrong


@pytest.mark.parametrize(
    "frame_shift_m",
    [lambda i: 0.2 if i > 30 else 0.0, lambda i: 0.02 * i * FRAME_S],
    ids=["jumps", "drifts by 2 cm/s"],
)
def test_a_world_that_moves_under_both_is_no_turned_mounting(
    frame_shift_m: Callable[[int], float],
) -> None:
    """The estimate moves: target and vehicle, which follows it, move alike."""
    watch = CameraMountingMonitor()
    for i in range(900):
        shift = frame_shift_m(i)
        watch = update_camera_mounting_monitor(
            watch, CameraMountingSample(i * FRAME_S, complex(shift), TARGET + shift)
        )
        assert not watch.is_camera_mounting_wrong


class Follows(Motors):
    """A vehicle wherever its setpoint is, with a target as a turned camera places it."""

    def __init__(self, deg: float) -> None:
        super().__init__()
        self.seen, self.place, self.far_m = turned(deg), 0j, [0.0]

    def look(self, t_s: float, state: PlannerState) -> Observation:
        placed, body_m = self.seen(t_s, self.place), (self.place.real, self.place.imag, 1.0)
        target = target_at(t_s, (placed.real, placed.imag, CEILING_M), body_m)
        return at(obs={"target": target}, position_m=body_m)(t_s)

    def obey(self, state: PlannerState, command: Command) -> None:
        if state.setpoint is not None:
            self.place = complex(state.setpoint.x_m, state.setpoint.y_m)
        self.far_m.append(abs(self.place))


@pytest.mark.parametrize("deg", [90, 180, -90])
def test_a_turned_mounting_lands_and_says_so(deg: int) -> None:
    it = Follows(deg)
    state = fly(state_in(Phase.ALIGN), it, 4.0, one_phase=True).state
    assert (state.phase, state.transition_name, state.outcome) == (
        Phase.LANDING,
        "mounting",
        Outcome.SAFETY,
    )
    assert f"rotated by about {deg} deg" in state.transition_reason
    assert max(it.far_m) < 0.17


def test_a_right_mounting_flies_on() -> None:
    """Slowly at first: until the mounting shows, a wrong one must not have flown far."""
    it = Follows(0.0)
    state = fly(state_in(Phase.ALIGN), it, 3.98).state
    assert state.phase is not Phase.LANDING
    assert state.belief.camera_mounting_monitor.is_camera_mounting_confirmed
    assert max(it.far_m) > 0.3
    assert it.far_m[15] <= 0.25 * 0.3 + 1e-9


def test_a_target_below_the_vehicle_is_not_believed() -> None:
    """A mounting that is upside down in the profile: nothing is on the ceiling below."""
    below = target_at(BEGIN_S, (0.0, 0.0, -0.2))

    def look(t_s: float) -> Observation:
        return at(
            obs={
                "target": replace(
                    below, last_measured_at_s=t_s, small_marker_last_measured_at_s=t_s
                )
            }
        )(t_s)

    state = fly(state_in(Phase.ALIGN), look, 0.58).state
    assert state.transition_name == "mounting"
    assert "camera.mount does not point the camera up" in state.transition_reason
