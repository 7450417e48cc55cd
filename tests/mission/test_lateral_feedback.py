"""Under the target the vehicle is held by its position, its velocity and its lean."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import CameraImuMismatch, Observation, OperatorRequest, Phase, PlannerState
from perchctl.mission.belief.mounting import (
    MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG,
    CameraMountingMonitor,
)
from perchctl.mission.setpoints import TILT_ACCELERATION_TO_SETPOINT_DAMPING_GAIN_S2
from perchctl.vehicle import Command, PositionSetpoint, Telemetry
from tests.helpers.mission import (
    HANG_Z_M,
    PROFILE,
    changed,
    observation,
    remembering,
    state_in,
    target_at,
    telemetry,
)
from tests.mission.rig import BEGIN_S, TICK_S, Look, Motors, fly

Z_M = HANG_Z_M - 0.3
"""Height of the vehicle: the feedback is at its full gain, and the vehicle never settles."""
STEPS = 10
"""Steps of the model in a tick."""
AGAIN = settings(max_examples=5)


def leaning(lean_rad: float, towards_rad: float, heading_rad: float, until_s: float) -> Look:
    """A vehicle on the target's axis that leans towards a world direction until a time."""

    def look(t_s: float) -> Observation:
        x = math.sin(lean_rad) * math.cos(towards_rad - heading_rad) * (t_s < until_s)
        y = math.sin(lean_rad) * math.sin(towards_rad - heading_rad) * (t_s < until_s)
        roll_rad = -math.asin(y)
        pitch_rad = math.asin(x / math.cos(roll_rad))
        sample = telemetry(
            t_s, Z_M, roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=heading_rad,
            velocity_mps=(0.0, 0.0, 1e-9 * (round(t_s * 1000) % 7)),
        )  # fmt: skip
        target = target_at(t_s, body_m=sample.position_m, world_yaw_rad=heading_rad)
        return observation(t_s, telemetry=sample, target=target)

    return look


def ascending() -> PlannerState:
    return state_in(Phase.ASCEND, z_m=Z_M)


@AGAIN
@given(
    lean_rad=st.floats(0.005, 0.06),
    towards_rad=st.floats(-3.1, 3.1),
    heading_rad=st.floats(-3.1, 3.1),
)
def test_a_lean_is_met_by_a_setpoint_on_its_other_side(
    lean_rad: float, towards_rad: float, heading_rad: float
) -> None:
    """A lean that lasts is what the wind takes, and moves no setpoint. The first sample moves the
    mean of half a second by 4 % of it."""
    at_once = fly(ascending(), leaning(lean_rad, towards_rad, heading_rad, math.inf)).command
    assert isinstance(at_once, PositionSetpoint)
    along_m = at_once.x_m * math.cos(towards_rad) + at_once.y_m * math.sin(towards_rad)
    across_m = at_once.y_m * math.cos(towards_rad) - at_once.x_m * math.sin(towards_rad)
    assert along_m == pytest.approx(
        -TILT_ACCELERATION_TO_SETPOINT_DAMPING_GAIN_S2 * GRAVITY_MPS2 * math.sin(lean_rad), rel=0.05
    )
    assert across_m == pytest.approx(0.0, abs=1e-4)
    later = fly(ascending(), leaning(lean_rad, towards_rad, heading_rad, math.inf), 4.0).command
    assert isinstance(later, PositionSetpoint)
    assert math.hypot(later.x_m, later.y_m) < 0.05 * math.hypot(at_once.x_m, at_once.y_m)


@AGAIN
@given(
    lean_rad=st.floats(0.01, 0.03),
    speed_mps=st.floats(0.03, 0.08),
    towards_rad=st.floats(-3.1, 3.1),
)
def test_a_landing_begins_without_a_step_of_the_setpoint(
    lean_rad: float, speed_mps: float, towards_rad: float
) -> None:
    """A landing feeds nothing back; what the ascent gave last stays in the integral."""
    stands = leaning(lean_rad, towards_rad, 0.0, math.inf)
    velocity_mps = (speed_mps * math.cos(towards_rad), speed_mps * math.sin(towards_rad), 0.0)

    def lands(t_s: float) -> Observation:
        obs = stands(t_s)
        operator = OperatorRequest.LAND if t_s > BEGIN_S + 1.5 * TICK_S else OperatorRequest.NONE
        moves = replace(obs.telemetry, velocity_mps=velocity_mps)
        return replace(obs, telemetry=moves, operator_request=operator)

    before, after = fly(ascending(), lands, 2 * TICK_S).ticks
    assert (before.state.phase, after.state.phase) == (Phase.ASCEND, Phase.LANDING)
    assert isinstance(before.command, PositionSetpoint)
    assert isinstance(after.command, PositionSetpoint)
    damped_m = math.hypot(before.command.x_m, before.command.y_m)
    step_m = math.dist(
        (before.command.x_m, before.command.y_m), (after.command.x_m, after.command.y_m)
    )
    assert damped_m > 0.03
    assert step_m < 0.1 * damped_m


class Hovering(Motors):
    """The level motion of a Crazyflie behind its cascade of controllers, for one axis.

    Setpoint to speed 2 /s, speed to lean 25 deg for 1 m/s, and a lean that follows with 6 /s and
    the rotors' 0.05 s (docs/firmware.md). `disturbed_mps2` is the deviation of a fluctuating level
    acceleration with a memory of 0.1 s, `late_s` the time from a setpoint to the controller, and
    `age_s` the age of the telemetry. The estimate wanders as that of a vehicle with a Flow deck: by
    `wander_m` with a memory of 0.3 s, and its velocity by 2.5 m/s per metre of it. Every second
    tick, the newest picture is 0.08 s old; `pictures` is False for one that measures no offset.
    """

    def __init__(
        self,
        disturbed_mps2: float,
        late_s: float,
        begin_m: float = 0.0,
        age_s: float = 0.0,
        *,
        wander_m: float = 0.0,
        pictures: bool = True,
    ) -> None:
        super().__init__()
        self._wander_m, self._pictures, self._off_m, self._off_mps = wander_m, pictures, 0.0, 0.0
        self._shown: deque[tuple[float, float]] = deque(maxlen=round(0.08 / (2 * TICK_S)) + 1)
        self._samples: deque[Telemetry] = deque(maxlen=round(age_s / TICK_S) + 1)
        self.x_m, self.speed_mps, self.lean_rad, self.rate_radps = begin_m, 0.0, 0.0, 0.0
        self.path_m: list[float] = []
        self._push_mps2, self._disturbed_mps2 = 0.0, disturbed_mps2
        self._random = np.random.default_rng(20261130)
        self._wandering = np.random.default_rng(20261201)
        self._sent = deque([0.0] * round(late_s / TICK_S + 1))

    def look(self, t_s: float, state: PlannerState) -> Observation:
        del state
        dt_s = TICK_S / STEPS
        keeps = math.exp(-dt_s / 0.1)
        for _ in range(STEPS):
            kick = self._disturbed_mps2 * math.sqrt(1.0 - keeps * keeps)
            self._push_mps2 = keeps * self._push_mps2 + kick * self._random.standard_normal()
            wanted_mps = 2.0 * (self._sent[0] - self.x_m)
            wanted_rad = math.radians(25.0 * (wanted_mps - self.speed_mps))
            self.rate_radps += (6.0 * (wanted_rad - self.lean_rad) - self.rate_radps) * dt_s / 0.05
            self.lean_rad += self.rate_radps * dt_s
            pull_mps2 = GRAVITY_MPS2 * self.lean_rad + self._push_mps2
            self.speed_mps += pull_mps2 * dt_s
            self.x_m += self.speed_mps * dt_s
        self.path_m.append(self.x_m)
        self._off_m, self._off_mps = (
            math.exp(-TICK_S / memory_s) * old
            + sigma * math.sqrt(1.0 - math.exp(-2.0 * TICK_S / memory_s)) * self._wandering.normal()
            for old, memory_s, sigma in (
                (self._off_m, 0.3, self._wander_m),
                (self._off_mps, 0.1, 2.5 * self._wander_m),
            )
        )
        sample = telemetry(
            t_s, position_m=(self.x_m + self._off_m, 0.0, Z_M), pitch_rad=self.lean_rad,
            velocity_mps=(self.speed_mps + self._off_mps, 0.0, 0.0),
        )  # fmt: skip
        self._samples.append(sample)
        oldest = self._samples[0]
        target = target_at(t_s, body_m=oldest.position_m)
        if self._wander_m:
            if len(self.path_m) % 2:
                self._shown.append((t_s, self.x_m))
            shown_s, shown_m = self._shown[0]
            offset_m = np.array([-shown_m, 0.0, 0.0]) if self._pictures else None
            target = replace(
                target, last_measured_at_s=shown_s, measured_gear_to_target_world_m=offset_m
            )
        return observation(t_s, telemetry=oldest, target=target)

    def obey(self, state: PlannerState, command: Command) -> None:
        del state
        assert isinstance(command, PositionSetpoint)
        self._sent.append(command.x_m)
        self._sent.popleft()

    def spread_m(self, begin_s: float, end_s: float) -> float:
        """Root mean square of the distance from the target's axis between two times."""
        part = self.path_m[round(begin_s / TICK_S) : round(end_s / TICK_S)]
        return float(np.sqrt(np.mean(np.square(part))))


@pytest.mark.parametrize("late_s", [0.0, 0.04, 0.08])
def test_a_late_setpoint_makes_no_oscillation(late_s: float) -> None:
    """An offset dies out within seconds. Without the lean in the feedback, it grows."""
    vehicle = Hovering(0.0, late_s, begin_m=0.01)
    fly(ascending(), vehicle, 8.0, one_phase=True)
    assert vehicle.spread_m(5.0, 8.0) < 0.1 * 0.01


@pytest.mark.parametrize("age_s", [0.04, 0.08, 0.12, 0.16, 0.2, 0.26])
def test_old_telemetry_makes_no_oscillation(age_s: float) -> None:
    """The older it is, the more the vehicle is left to its own controllers, which know nothing of
    the delay."""
    vehicle = Hovering(0.0, 0.02, begin_m=0.01, age_s=age_s)
    flight = fly(ascending(), vehicle, 8.0, one_phase=True)
    assert flight.ticks[-1].t_s > BEGIN_S + 7.9
    assert vehicle.spread_m(5.0, 8.0) < 0.2 * 0.01


def test_fluctuating_thrust_moves_the_vehicle_less_than_its_own_controller_lets_it() -> None:
    """By at least 40 %: the same disturbance on the same vehicle, with a constant setpoint."""
    fed, left = Hovering(0.1, 0.02), Hovering(0.1, 0.02)
    fly(ascending(), fed, 20.0, one_phase=True)
    for i in range(len(fed.path_m)):
        left.look(BEGIN_S + i * TICK_S, ascending())
        left.obey(ascending(), PositionSetpoint(0.0, 0.0, Z_M, 0.0))
    end_s = len(fed.path_m) * TICK_S
    assert end_s > 15.0
    assert fed.spread_m(2.0, end_s) < 0.6 * left.spread_m(2.0, end_s)


def test_pictures_and_lean_hold_the_vehicle_where_its_estimate_wanders() -> None:
    """Late pictures that measure the offset leave less than half of the distance that the state
    estimate leaves, which wanders by 2 mm."""
    spreads_m = []
    for pictures in (True, False):
        vehicle = Hovering(0.0, 0.02, wander_m=0.002, pictures=pictures)
        confirmed = remembering(
            ascending(),
            camera_mounting_monitor=CameraMountingMonitor(is_camera_mounting_confirmed=True),
        )
        flight = fly(confirmed, vehicle, 20.0, one_phase=True)
        assert flight.ticks[-1].t_s > BEGIN_S + 15.0
        spreads_m.append(vehicle.spread_m(2.0, len(vehicle.path_m) * TICK_S))
    assert spreads_m[0] < 0.5 * spreads_m[1]


def test_a_burst_of_lost_pictures_ends_no_ascent() -> None:
    """The vehicle waits below the target without climbing, and backs off after 1.5 s."""

    def look(t_s: float) -> Observation:
        sample = telemetry(t_s, Z_M)
        seen = target_at(
            BEGIN_S, body_m=sample.position_m, is_measured_in_newest_frame=False, tracked=False
        )
        return observation(
            t_s, telemetry=sample, target=replace(seen, t_s=t_s), has_new_frame=False
        )

    flight = fly(ascending(), look, 2.0, one_phase=True)
    assert flight.state.transition_name == "ascend-lost"
    assert flight.ticks[-1].t_s == pytest.approx(BEGIN_S + 1.5, abs=0.03)
    climbs_m = [
        tick.command.z_m for tick in flight.ticks if isinstance(tick.command, PositionSetpoint)
    ]
    assert max(climbs_m) <= climbs_m[0]


@pytest.mark.parametrize(
    ("picture_m", "estimate_m", "settles"), [(0.001, 0.007, True), (0.007, 0.001, False)]
)
def test_the_pictures_tell_whether_the_vehicle_has_settled(
    picture_m: float, estimate_m: float, settles: bool
) -> None:
    """Not the state estimate, which may have wandered since the newest picture."""
    z_m = HANG_Z_M - PROFILE.planner.ascend.standoff_m

    def look(t_s: float) -> Observation:
        sample = telemetry(t_s, z_m)
        target = target_at(
            t_s,
            body_m=(-estimate_m, 0.0, z_m),
            measured_gear_to_target_world_m=np.array(
                [picture_m, 0.0, PROFILE.planner.ascend.standoff_m]
            ),
        )
        return observation(t_s, telemetry=sample, target=target)

    flight = fly(state_in(Phase.ASCEND, z_m=z_m), look, 2.0, one_phase=True)
    assert (flight.state.phase is Phase.PERCH) is settles


def test_a_camera_that_contradicts_the_vehicle_steers_nothing() -> None:
    """Neither one whose mounting is wrong, nor one whose pictures disagree with the
    accelerometer."""
    turned = CameraMountingMonitor(
        contradicting_sighting_count=MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG
    )
    late = CameraImuMismatch(0.2, 0.0)
    for state, changes, known in (
        (ascending(), {}, True),
        (remembering(ascending(), camera_mounting_monitor=turned), {}, False),
        (ascending(), {"camera_imu_mismatch": late}, False),
    ):
        ticks = fly(state, lambda t_s, c=changes: observation(t_s, Z_M, **c), 0.5).ticks
        assert (ticks[-1].state.belief.lateral_offset_and_velocity is not None) is known


@AGAIN
@given(heading_rad=st.floats(-0.6, 0.6), ahead_m=st.floats(0.01, 0.05))
def test_a_gear_beside_the_body_turns_with_the_vehicle(heading_rad: float, ahead_m: float) -> None:
    """While the vehicle still has to turn, its gear is not where it will be: whether the pictures
    or the state estimate tell where a vehicle at rest is, its setpoint is the same."""
    profile = changed({"vehicle.gear_body_m": (ahead_m, 0.0, 0.03)})
    gear_m = (ahead_m * math.cos(heading_rad), ahead_m * math.sin(heading_rad), 0.03)
    offset_m = np.array([0.0, 0.0, HANG_Z_M - Z_M]) - np.array(gear_m)

    def setpoint(measured_offset_m: np.ndarray | None) -> PositionSetpoint:
        def look(t_s: float) -> Observation:
            sample = telemetry(t_s, Z_M, yaw_rad=heading_rad)
            target = target_at(
                t_s, body_m=(0.0, 0.0, Z_M), measured_gear_to_target_world_m=measured_offset_m
            )
            return observation(t_s, telemetry=sample, target=target)

        command = fly(ascending(), look, 0.5, profile=profile, one_phase=True).command
        assert isinstance(command, PositionSetpoint)
        return command

    shown, estimated = setpoint(offset_m), setpoint(None)
    assert (shown.x_m, shown.y_m) == pytest.approx((estimated.x_m, estimated.y_m), abs=2e-4)
