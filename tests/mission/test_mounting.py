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

from perchctl.mission import Outcome, Phase, planner
from perchctl.mission.mounting import MountWatch, Sight, explained, sight_of, watched
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import CEILING_M, PROFILE, observation, state_in, target_at, telemetry

FRAME_S = 1.0 / 30.0
TARGET = 0.4 + 0.2j
SPEED_MPS = 0.25

Seen = Callable[[float, complex], complex]
"""Where the target is placed at a time, from the vehicle's place."""


def turned(deg: float) -> Seen:
    """By a camera whose true mounting is turned so far from the profile's."""
    M = cmath.exp(-1j * math.radians(deg))
    return lambda t_s, p: p + M * (TARGET - p)


def flown(seen: Seen, way_m: float = 0.5, noise_m: float = 0.003) -> tuple[MountWatch, float]:
    """Half a second still, then straight on; the watch, and how far it flew until it spoke."""
    rng = np.random.default_rng(0)
    watch, t_s, moved_m = MountWatch(), 0.0, 0.0
    while moved_m < way_m and not watch.wrong:
        t_s += FRAME_S
        moved_m = max(0.0, t_s - 0.5) * SPEED_MPS
        p = moved_m * cmath.exp(0.7j)
        spoiled = seen(t_s, p) + complex(*rng.normal(0.0, noise_m, 2))
        watch = watched(watch, Sight(t_s, p, spoiled))
    return watch, moved_m


@given(st.one_of(st.floats(75, 180), st.floats(-180, -75)))
def test_a_turned_mounting_is_seen_and_measured(deg: float) -> None:
    watch, moved_m = flown(turned(deg))
    assert watch.wrong
    assert moved_m < 0.17
    assert abs(math.remainder(math.degrees(watch.turn_rad) - deg, 360.0)) < 15.0


@given(st.floats(-30, 30))
def test_a_mounting_that_leads_to_the_target_is_left_alone(deg: float) -> None:
    assert not flown(turned(deg))[0].wrong


HEIGHT_M = 1.5


def _tilting(deg: float, late_s: float = 0.0) -> MountWatch:
    """A vehicle on its place that leans by 5 deg to all sides, watched for four seconds; its
    pictures are so much later than the profile says."""
    watch, M = MountWatch(), cmath.exp(-1j * math.radians(deg))

    def lean(t_s: float) -> complex:
        reach_m = HEIGHT_M * math.tan(math.radians(5.0))
        return reach_m * complex(math.sin(4.0 * t_s), 0.8 * math.sin(5.0 * t_s + 1.0))

    for i in range(120):
        t_s = i * FRAME_S
        seen = lean(t_s) + M * (TARGET - lean(t_s - late_s))
        watch = watched(watch, Sight(t_s, 0j, seen, lean(t_s)))
    return watch


@pytest.mark.parametrize("deg", [90, 180, -90])
def test_a_turned_mounting_shows_in_the_vehicles_own_tilts(deg: int) -> None:
    """Before it has gone anywhere. Taken for a target that jumps, it would be looked at afresh
    with each tilt, while the vehicle flies on."""
    watch = _tilting(deg)
    assert watch.wrong
    assert abs(math.remainder(math.degrees(watch.turn_rad) - deg, 360.0)) < 5.0


@pytest.mark.parametrize("late_s", [-0.06, 0.0, 0.06])
def test_tilts_that_are_seen_late_are_no_turned_mounting(late_s: float) -> None:
    assert _tilting(0.0, late_s).against == 0


def test_a_lean_is_where_the_upward_axis_meets_the_target() -> None:
    """Nose down by 10 deg, heading left: the axis leans to the left."""
    tel = telemetry(
        1.0, position_m=(0.3, 0.1, 1.0), pitch_rad=math.radians(10.0), yaw_rad=math.pi / 2
    )
    sight = sight_of(1.0, tel, np.array([0.5, 0.2, 2.2]))
    assert sight.vehicle == pytest.approx(0.3 + 0.1j)
    assert sight.target == pytest.approx(0.5 + 0.2j)
    assert sight.lean == pytest.approx(1.2j * math.sin(math.radians(10.0)), rel=0.02)


def test_a_landing_for_the_mounting_stops_at_once() -> None:
    """Not where the setpoint had run to: it lies in the wrong direction."""
    state = replace(
        state_in(Phase.ALIGN),
        mount=MountWatch(against=9, turn_rad=math.pi / 2),
        setpoint=PositionSetpoint(0.3, 0.0, 1.0, 0.0),
    )
    state, command = planner.step_mission(state, observation(10.02), PROFILE)
    assert state.row == "mounting"
    assert isinstance(command, PositionSetpoint)
    assert math.hypot(command.x_m, command.y_m) < 0.02


def test_a_target_that_stands_still_ends_the_watch() -> None:
    watch, _ = flown(turned(0.0))
    assert watch.fits
    assert watched(watch, Sight(9.0, 0j, 5.0 + 0j)) is watch


@given(st.floats(0.3, 2.0), st.floats(0.0, 2 * math.pi), st.sampled_from([0, 2, 5]))
def test_a_target_that_is_moved_is_no_turned_mounting(
    at_s: float, way_rad: float, frames: int
) -> None:
    """It jumps once, as fast as the filter follows, and then stands still."""
    step = 0.3 * cmath.exp(1j * way_rad)

    def moved(t_s: float, p: complex) -> complex:
        over_s = max(frames * FRAME_S, 1e-6)
        return TARGET + step * min(1.0, max(0.0, (t_s - at_s) / over_s))

    assert not flown(moved)[0].wrong


def test_a_world_that_jumps_under_both_is_no_turned_mounting() -> None:
    def flight(watch: MountWatch) -> MountWatch:
        for i in range(60):
            shift = 0.2 if i > 30 else 0.0
            watch = watched(watch, Sight(i * FRAME_S, shift + 0j, TARGET + shift))
        return watch

    assert not flight(MountWatch()).wrong


def test_a_drifting_world_is_no_turned_mounting() -> None:
    """The estimate drifts by 2 cm/s: target and vehicle, which follows it, move alike."""
    watch = MountWatch()
    for i in range(900):
        drift = 0.02 * i * FRAME_S
        watch = watched(watch, Sight(i * FRAME_S, complex(drift), TARGET + drift))
        assert not watch.wrong


@pytest.mark.parametrize(
    ("deg", "words"),
    [(92.0, "about 90 deg"), (-160.0, "about 180 deg"), (-75.0, "about -90 deg"),
     (132.0, "about 130 deg")],
)  # fmt: skip
def test_the_turn_is_named(deg: float, words: str) -> None:
    watch = MountWatch(against=9, turn_rad=math.radians(deg))
    assert words in explained(watch.turn_rad)
    assert "camera.mount" in explained(watch.turn_rad)
    assert "`perchctl calibrate mount`" in explained(watch.turn_rad)


def _mission(deg: float, hold: bool = False) -> tuple[planner.PlannerState, float]:
    """The planner in ALIGN, its vehicle wherever the setpoint is, its target as it is seen."""
    state, seen, place = state_in(Phase.ALIGN), turned(deg), 0j
    far_m = 0.0
    for i in range(1, 200):
        t_s = 10.0 + 0.02 * i
        at = seen(t_s, place)
        tel = telemetry(t_s, position_m=(place.real, place.imag, 1.0))
        target = target_at(t_s, (at.real, at.imag, CEILING_M), tel.position_m)
        late_s = 0.5 if hold else 0.0
        obs = observation(t_s, telemetry=tel, target=target, loop_late_s=late_s)
        state, command = planner.step_mission(state, obs, PROFILE)
        if state.phase is Phase.LANDING:
            break
        assert isinstance(command, PositionSetpoint)
        assert state.setpoint is not None
        place = complex(state.setpoint.x_m, state.setpoint.y_m)
        far_m = max(far_m, abs(place))
    return state, far_m


@pytest.mark.parametrize("deg", [90, 180, -90])
def test_a_turned_mounting_lands_and_says_so(deg: int) -> None:
    state, far_m = _mission(deg)
    assert state.phase is Phase.LANDING
    assert state.row == "mounting"
    assert state.outcome is Outcome.SAFETY
    assert f"turned by about {deg} deg" in state.reason
    assert far_m < 0.17


def test_a_right_mounting_flies_on() -> None:
    state, far_m = _mission(0)
    assert state.phase is not Phase.LANDING
    assert state.mount.fits
    assert far_m > 0.3


def test_the_first_decimetres_are_flown_slowly() -> None:
    """Until the mounting shows, a wrong one must not have flown far."""
    state, seen = state_in(Phase.ALIGN), turned(0.0)
    for i in range(1, 16):
        t_s = 10.0 + 0.02 * i
        at = seen(t_s, 0j)
        target = target_at(t_s, (at.real, at.imag, CEILING_M))
        state, _ = planner.step_mission(state, observation(t_s, target=target), PROFILE)
    assert state.setpoint is not None
    assert math.hypot(state.setpoint.x_m, state.setpoint.y_m) <= 0.25 * 0.3 + 1e-9


def test_a_target_below_the_vehicle_is_not_believed() -> None:
    """A mounting that is upside down in the profile: nothing is on the ceiling below."""
    state = state_in(Phase.ALIGN)
    for i in range(1, 30):
        t_s = 10.0 + 0.02 * i
        target = target_at(t_s, (0.0, 0.0, -0.2))
        state, _ = planner.step_mission(state, observation(t_s, target=target), PROFILE)
    assert state.row == "mounting"
    assert "camera.mount does not look up" in state.reason
