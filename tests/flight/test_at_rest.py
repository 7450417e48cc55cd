"""A vehicle that stands still, and an estimate that does not: nothing takes off by it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import TimedOut
from perchctl.flight import GroundCriteria, lockstep_feed
from perchctl.flight.criteria import DRIFT_M, REST_S, STANDING_MPS
from perchctl.flight.preflight import GroundTurn, still_waiting_for
from perchctl.link import MockLink
from perchctl.mission import OperatorRequest, Outcome
from perchctl.profile import Profile, load_profile
from perchctl.sim import SimulatedVehicle, draw_capture, draw_scenario
from perchctl.vehicle import ExternalPosition, PositionSetpoint, Telemetry
from tests.helpers.loop_rig import PROFILE, Rig, Vehicle
from tests.helpers.mission import BY_TARGET, MOCAP, READY, telemetry

RATES_MPS = [0.05, 0.3, 1.0]
SLOPE_RAD = math.radians(PROFILE.safety.start_tilt_deg - 1.0)


def stands(t_s: float) -> Telemetry:
    return telemetry(t_s, 0.0, thrust=0.0, supervisor=READY)


def runs_away(sample: Telemetry, mps: float, since_s: float = -10.0) -> Telemetry:
    """Along x, with a speed that says so."""
    way_m = mps * max(0.0, sample.t_s - since_s)
    return replace(sample, position_m=(way_m, 0.0, 0.0), velocity_mps=(mps, 0.0, 0.0))


def problem(alter: Callable[[Telemetry], Telemetry], profile: Profile = PROFILE) -> str:
    samples = [alter(stands(0.01 * k)) for k in range(201)]
    found = GroundCriteria.moving_estimate(samples, profile)
    return "" if found is None else found.sentence


@pytest.mark.parametrize("mps", RATES_MPS)
@pytest.mark.parametrize("profile", [PROFILE, MOCAP, BY_TARGET], ids=["deck", "mocap", "target"])
def test_an_estimate_that_runs_away_at_rest_is_named(profile: Profile, mps: float) -> None:
    said = problem(lambda s: runs_away(s, mps), profile)
    assert f"moved {REST_S * mps:.2f} m in 1.9 s, but at most 0.07 m is allowed" in said
    assert "keep the vehicle still; if it was still, check its positioning" in said
    assert ("base stations" in said) is (profile is PROFILE)
    still = {"position_m": (0.0, 0.0, 0.0)}
    said = problem(lambda s: replace(runs_away(s, mps), **still), profile)  # type: ignore[arg-type]
    assert (f"speed was {mps:.2f} m/s" in said) is (mps > STANDING_MPS)


def test_a_number_that_is_none_does_not_stand_still() -> None:
    assert "moved nan m" in problem(lambda s: replace(s, position_m=(math.nan, 0.0, 0.0)))
    assert "speed was nan" in problem(lambda s: replace(s, velocity_mps=(math.nan, 0.0, 0.0)))


def test_a_restart_is_no_motion() -> None:
    """What the vehicle's earlier start had estimated is another world's."""
    assert not problem(lambda s: s if s.t_s > 1.0 else replace(s, position_m=(5.0, 0.0, 0.0),
                                                               start=-1))  # fmt: skip


def at_rest(profile: Profile, tilt_rad: float, seed: int = 1) -> list[Telemetry]:
    """Six seconds of a simulated vehicle on a slope, from its estimator's reset on."""
    vehicle = SimulatedVehicle(
        draw_scenario(profile, seed), None, profile.target, draw_capture(profile, seed)
    )
    vehicle.world.set_pose((0.0, 0.0, 0.0), (tilt_rad, 0.0, 0.0), hold=True)
    link = MockLink(vehicle, profile.link.telemetry_period_s)
    link.connect()
    lockstep_feed(link, profile)
    if profile.positioning.by == "target":
        link.call_every(
            1.0 / 30.0, lambda t_s: link.send_external(ExternalPosition((0.0, 0.0, 0.0)))
        )
    settled_s = link.now_s
    link.advance_to(settled_s + 6.0)
    return [sample for sample in link.telemetry() if sample.t_s > settled_s]


PLACED = {
    "deck": load_profile("rough"),
    "target": load_profile("target_only"),
    "mocap": load_profile("rough").with_({"positioning.by": "mocap"}),
}


@pytest.mark.parametrize(
    ("by", "tilt_rad"),
    [
        ("deck", 0.0),
        pytest.param("deck", SLOPE_RAD, marks=pytest.mark.long),
        pytest.param("target", 0.0, marks=pytest.mark.long),
        ("target", SLOPE_RAD),
        ("mocap", 0.0),
        pytest.param("mocap", SLOPE_RAD, marks=pytest.mark.long),
    ],
)
def test_a_healthy_vehicle_stands_still_whatever_places_it(by: str, tilt_rad: float) -> None:
    """Noise, biases and a slope: with half of what is allowed to spare, or a fifth on the slope.
    For 1.9 s after its reset, an estimate may still be on its way."""
    samples, share = at_rest(PLACED[by], tilt_rad), 0.8 if tilt_rad else 0.5
    for end in range(len(samples) // 2, len(samples), 50):
        window = [s for s in samples[:end] if samples[end - 1].t_s - s.t_s <= REST_S]
        moved_m = math.dist(window[0].position_m, window[-1].position_m)
        mean = [
            sum(axis) / len(window) for axis in zip(*(s.velocity_mps for s in window), strict=True)
        ]
        assert moved_m < share * DRIFT_M
        assert math.hypot(*mean) < share * STANDING_MPS


@pytest.mark.parametrize(
    "mps", [RATES_MPS[0], *(pytest.param(mps, marks=pytest.mark.long) for mps in RATES_MPS[1:])]
)
def test_a_vehicle_whose_estimate_runs_away_does_not_take_off(mps: float) -> None:
    rig = Rig(Vehicle(lambda sample: runs_away(sample, mps)))
    rig.refused(TimedOut, r"estimate to stop moving .the estimated position moved")
    assert rig.link.now_s == pytest.approx(PROFILE.safety.estimator_wait_s + REST_S, abs=0.2)


def thinned(sample: Telemetry, every: int) -> Telemetry | None:
    """The sample, up to the take-off only one of `every`; the vehicle gives none at time zero."""
    return sample if sample.t_s > 1.0 or round(100 * sample.t_s) % every == 3 else None


def first_setpoint_s(vehicle: Vehicle) -> float:
    rig = Rig(vehicle)
    rig.operator = lambda: (
        OperatorRequest.LAND if vehicle.said(PositionSetpoint) else OperatorRequest.NONE
    )
    assert rig.fly().outcome is Outcome.ENDED_BY_OPERATOR
    return vehicle.said(PositionSetpoint)[0]


def test_a_take_off_waits_until_the_vehicle_was_seen_at_rest() -> None:
    """Heard since long, at once; put down by a hand, or heard only now, from then on."""
    assert first_setpoint_s(Vehicle()) < 0.1
    carried = Vehicle(lambda s: runs_away(s, 0.5, -10.0) if s.t_s < 1.0 else s)
    assert first_setpoint_s(carried) == pytest.approx(1.0 + REST_S, abs=0.1)
    new = Vehicle(lambda s: s if s.t_s > 0.0 else None)
    assert first_setpoint_s(new) == pytest.approx(REST_S, abs=0.1)
    for every in (17, 23):  # samples of which no two are 1.9 to 2.0 s apart
        slow = Vehicle(partial(thinned, every=every))
        assert first_setpoint_s(slow) < 0.3
    started_again = Vehicle(lambda s: replace(s, start=int(s.t_s > 1.0)))
    assert first_setpoint_s(started_again) < 0.1
    started_again = Vehicle(lambda s: replace(s, start=int(s.t_s > -1.0)))
    assert first_setpoint_s(started_again) == pytest.approx(REST_S - 1.0, abs=0.1)


@pytest.mark.parametrize("way_m", [0.0, 3.0])
def test_a_time_in_which_nothing_was_heard_is_no_time_at_rest(way_m: float) -> None:
    """The vehicle may have been carried in it; what it shows afterwards counts anew."""
    before, after = stands(0.01), [stands(5.0 + 0.1 * k) for k in range(21)]
    after = [replace(sample, position_m=(way_m, 0.0, 0.0)) for sample in after]
    for heard in range(1, 20):
        assert "stop moving" in still_waiting_for(
            GroundTurn(PROFILE, 0.0, [before, *after[:heard]])
        )
    assert still_waiting_for(GroundTurn(PROFILE, 0.0, [before, *after])) == ""


def test_a_pause_of_the_positions_alone_is_no_time_at_rest() -> None:
    """Attitude goes on in its own packets, beside a position that grows old."""
    samples = [stands(0.1 * k) for k in range(31)]
    paused = [replace(s, behind_s=s.t_s - 1.0) if 1.0 < s.t_s < 2.0 else s for s in samples]
    assert still_waiting_for(GroundTurn(PROFILE, 0.0, samples)) == ""
    assert "paused for 1.0 s" in still_waiting_for(GroundTurn(PROFILE, 0.0, paused))


def test_a_silence_before_take_off_is_waited_out() -> None:
    silent = Vehicle(lambda s: s if s.t_s < -1.9 or s.t_s > 1.0 else None)
    assert first_setpoint_s(silent) == pytest.approx(1.0 + REST_S, abs=0.1)


def test_a_move_over_a_pause_is_named_by_the_check_too() -> None:
    """Its samples show that the estimate is elsewhere."""
    carried = [stands(0.01), replace(stands(5.0), position_m=(3.0, 0.0, 0.0))]
    found = GroundCriteria.moving_estimate(carried, PROFILE)
    assert found is not None
    assert "moved 3.00 m in 5.0 s" in found.sentence
