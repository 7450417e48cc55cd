"""Whether the camera is mounted as the profile says: what a target does when the vehicle moves."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import planner
from perchctl.mission.mounting import MountWatch, Sight, explained, watched
from perchctl.mission.state import Outcome, Phase
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
    assert moved_m < 0.15
    assert abs(math.remainder(math.degrees(watch.turn_rad) - deg, 360.0)) < 15.0


@given(st.floats(-30, 30))
def test_a_mounting_that_leads_to_the_target_is_left_alone(deg: float) -> None:
    assert not flown(turned(deg))[0].wrong


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
    assert words in explained(watch)
    assert "camera.mount" in explained(watch)


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
        state, command = planner.step(state, obs, PROFILE)
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
    assert far_m < 0.15


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
        state, _ = planner.step(state, observation(t_s, target=target), PROFILE)
    assert state.setpoint is not None
    assert math.hypot(state.setpoint.x_m, state.setpoint.y_m) <= 0.25 * 0.3 + 1e-9


def test_a_target_below_the_vehicle_is_not_believed() -> None:
    """A mounting that is upside down in the profile: nothing is on the ceiling below."""
    state = state_in(Phase.ALIGN)
    for i in range(1, 30):
        t_s = 10.0 + 0.02 * i
        target = target_at(t_s, (0.0, 0.0, -0.2))
        state, _ = planner.step(state, observation(t_s, target=target), PROFILE)
    assert state.row == "mounting"
    assert "camera.mount does not look up" in state.reason
