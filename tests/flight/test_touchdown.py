"""How a flight met the floor: felt, true of the vehicle, and told whoever flew the way down."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from perchctl.mission import ImuMotion, Observation, OperatorRequest, Phase, Touchdown
from perchctl.mission.belief.motion import Impact
from perchctl.mission.belief.reckoning import DeadReckoningState, advance_dead_reckoning
from perchctl.mission.report import MIN_HARD_TOUCHDOWN_SPEED_MPS, find_touchdown
from perchctl.profile import load_profile
from perchctl.vehicle import PositionSetpoint, RawThrust, Telemetry
from tests.helpers.hangs import hang_in_the_camera
from tests.helpers.loop_rig import HANG_AT_S, PROFILE, Guarded, Rig
from tests.helpers.mission import context_at, observation, remembering, state_in

HARD = Touchdown(0.9, 3.1)
# --- True of the vehicle ---------------------------------------------------------------------


def dropped(seed: int, share: float, blind: bool) -> tuple[float, Touchdown | None]:
    """The vehicle comes down on a share of the thrust that it hovers on. Returns its true speed
    at the floor, and what was felt."""
    from perchctl.link import MockLink, Radio
    from perchctl.sim import SimulatedVehicle, draw_scenario
    from tests.helpers.flights import DATA_SHEET

    profile = load_profile("sim")
    scenario = replace(draw_scenario(profile, seed), **DATA_SHEET)
    vehicle = SimulatedVehicle(scenario)
    link = MockLink(vehicle, profile.link.telemetry_period_s, Radio(scenario.radio_bursts()))
    link.connect()
    motion, carried, last = ImuMotion(), DeadReckoningState(), None
    t_s, dropped_s, hit_s, speed_mps, sink_mps = 1.0, math.inf, math.inf, 0.0, 0.0
    place = (0.0, 0.0, 0.0)
    while t_s < min(9.0, hit_s + 0.6):
        if t_s < 5.0:
            link.send(PositionSetpoint(place[0], place[1], place[2] + min(0.5, 0.3 * t_s), 0.0))
        else:
            dropped_s = min(dropped_s, t_s)
            link.send(RawThrust(int(share * motion.mean_raw_thrust_per_g)))
        for _ in range(10):
            t_s += 0.002
            link.advance_to(t_s)
            if dropped_s < t_s < hit_s and vehicle.world.push_n_and_on_floor()[1]:
                hit_s, speed_mps = t_s, sink_mps
            sink_mps = -vehicle.world.vz_mps
        for sample in link.telemetry():
            if last is None:
                place = sample.position_m
            motion = motion.with_sample(last, sample)
            believed = not blind or t_s < dropped_s
            carried, last = (
                advance_dead_reckoning(carried, motion, sample, is_estimate_trusted=believed),
                sample,
            )
    assert last is not None
    obs = Observation(last.t_s, last, imu=motion)
    blind_s = dropped_s if blind else None
    state = remembering(
        state_in(Phase.LANDED, z_m=0.0), dead_reckoning=carried, dead_reckoning_began_at_s=blind_s
    )
    return speed_mps, find_touchdown(context_at(state, obs, profile))


@pytest.mark.parametrize("blind", [False, True])
@pytest.mark.parametrize(
    "share",
    [
        pytest.param(0.96, marks=pytest.mark.long),
        0.85,
        pytest.param(0.5, marks=pytest.mark.long),
    ],
)
def test_the_felt_speed_is_the_true_one(share: float, blind: bool) -> None:
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    truth_mps, felt = dropped(3, share, blind)
    assert truth_mps > 0.4
    assert felt is not None
    assert felt.speed_mps == pytest.approx(truth_mps, abs=0.15 if blind else 0.08)
    assert felt.is_hard is (truth_mps > MIN_HARD_TOUCHDOWN_SPEED_MPS)
    assert felt.peak_g > 2.0


# --- A blow, sample by sample ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "blow", "told"),
    [
        ({}, Impact(9.0, -0.9, 0.0, 3.1), True),
        ({}, Impact(4.0, -0.9, 0.0, 3.1), False),  # long before
        ({}, Impact(9.0, -0.9, 0.0, 3.1, 0.8), False),  # in the air
        ({"phase": Phase.PERCHED}, Impact(9.0, -0.9, 0.0, 3.1), False),
        ({}, Impact(), False),
    ],
)
def test_only_the_floor_is_a_touchdown(state: dict[str, object], blow: Impact, told: bool) -> None:
    ended = remembering(state_in(Phase.LANDED, z_m=0.0), **state)  # type: ignore[arg-type]
    obs = observation(10.0, 0.0, imu=ImuMotion(t_s=10.0, newest_impact=blow))
    assert find_touchdown(context_at(ended, obs, PROFILE)) == (HARD if told else None)


# --- Whoever flew the way down -------------------------------------------------------------------


def striking() -> Callable[[Telemetry], Telemetry]:
    """Samples of a vehicle that comes down at 0.9 m/s and meets the floor."""
    before: list[Telemetry] = []
    struck: list[float] = []

    def changed(sample: Telemetry) -> Telemetry:
        z_m = sample.position_m[2]
        last_m = before[-1].position_m[2] if before else 0.0
        before.append(sample)
        if z_m < last_m - 1e-6 and z_m > 0.0:
            return replace(sample, velocity_mps=(0.0, 0.0, -0.9))
        if z_m == 0.0 and last_m > 0.0:
            struck.append(sample.t_s)
        if struck and sample.t_s < struck[0] + 0.025:
            return replace(sample, acc_z_g=3.1)
        return sample

    return changed


@pytest.mark.parametrize("hung", [False, True])
def test_the_report_has_it_whether_the_planner_or_the_watchdog_brought_it_down(hung: bool) -> None:
    link = Guarded(striking())
    rig = Rig(link)
    if hung:
        hang_in_the_camera(link, rig.camera, HANG_AT_S, 12.0)
    else:
        rig.operator = lambda: OperatorRequest.LAND if link.now_s > 4.0 else OperatorRequest.NONE
    report = rig.fly()
    assert bool(link.own) is hung
    assert report.phase is Phase.LANDED
    assert report.touchdown == HARD
