"""A descent by the target's pictures, while the vehicle is not heard: what they show of its motion,
and how it comes down by that."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import Observation, Phase, PlannerState, VisualInertialMotion
from perchctl.mission.belief.target import VisualVelocityFilter
from perchctl.mission.belief.thrust import HoverThrustEstimate
from perchctl.mission.planner import step_mission
from perchctl.values import replace
from perchctl.vehicle import Command, PositionSetpoint, RawThrust
from tests.helpers.mission import (
    BY_TARGET,
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    Felt,
    observation,
    remembering,
    state_in,
    target_at,
    telemetry,
)
from tests.mission.rig import BEGIN_S, TICK_S

# --- What pictures show of the motion -------------------------------------------------------------

speeds_mps = st.tuples(*[st.floats(-0.7, 0.7)] * 3)
places_m = st.tuples(*[st.floats(-0.5, 0.5)] * 2, st.floats(0.2, 2.5))


def watched(
    place_m: tuple[float, float, float],
    velocity_mps: tuple[float, float, float],
    rate_hz: float,
    lasts_s: float = 1.0,
) -> VisualVelocityFilter:
    """The motion of a vehicle that leaves `place_m` below a target at this velocity."""
    motion = VisualVelocityFilter()
    for i in range(int(lasts_s * rate_hz) + 1):
        t_s = BEGIN_S + i / rate_hz
        e_m = np.array(place_m) - np.array(velocity_mps) * (t_s - BEGIN_S)
        motion = motion.with_detection(replace(target_at(t_s), e_m=e_m))
    return motion


@given(place_m=places_m, velocity_mps=speeds_mps, rate_hz=st.sampled_from([10.0, 30.0, 60.0]))
def test_the_velocity_is_that_of_the_target_turned_round(
    place_m: tuple[float, float, float], velocity_mps: tuple[float, float, float], rate_hz: float
) -> None:
    """Wherever the target is and however often it is seen; e^-10 is left of the low pass."""
    motion = watched(place_m, velocity_mps, rate_hz)
    assert motion.is_velocity_known
    assert motion.vehicle_velocity_level_mps == pytest.approx(velocity_mps, abs=1e-3)


@given(velocity_mps=speeds_mps, step_m=st.floats(0.1, 1.0))
def test_a_step_of_the_pose_is_no_motion(
    velocity_mps: tuple[float, float, float], step_m: float
) -> None:
    """As when the small marker takes over from the large one."""
    before = watched((0.0, 0.0, 1.0), velocity_mps, 30.0)
    t_s = before.t_s + 1 / 30
    stepped = np.add(before.gear_to_target_level_m, (0.0, 0.0, step_m))
    after = before.with_detection(replace(target_at(t_s), e_m=stepped))
    assert after.vehicle_velocity_level_mps == before.vehicle_velocity_level_mps
    assert after.gear_to_target_level_m == pytest.approx(tuple(stepped))


def test_after_a_gap_the_motion_has_to_be_seen_again() -> None:
    seen = watched((0.0, 0.0, 1.0), (0.0, 0.0, -0.5), 30.0)
    again = seen.with_detection(target_at(seen.t_s + 1.1))
    assert not again.is_velocity_known
    assert again.vehicle_velocity_level_mps == (0.0, 0.0, 0.0)


# --- How it comes down by that --------------------------------------------------------------------

PICTURES_LATE_S = 0.12
DRAG_PER_S = 0.3


@dataclass
class Falling:
    """A vehicle of one dimension and a half: a height, and a way ahead in a steady wind. Its
    motors give `strength` of what is believed of them."""

    z_m: float
    climb_mps: float
    strength: float
    wind_mps: float = 0.0
    x_m: float = 0.0
    x_mps: float = 0.0
    thrust: float = HOVER_THRUST
    lean_rad: float = 0.0
    touched_mps: float | None = None
    held: bool = False
    state: PlannerState | None = None  # of the planner that flew it, at the end

    def step(self, command: Command) -> None:
        """A tick later, by a raw thrust; the floor is at 0. A held vehicle stays where it is."""
        if self.held:
            return
        if isinstance(command, RawThrust):
            share = 1.0 - math.exp(-TICK_S / 0.06)
            self.thrust += share * (command.thrust - self.thrust)
            self.lean_rad += share * (command.pitch_rad - self.lean_rad)
        lift = self.strength * self.thrust / HOVER_THRUST
        self.climb_mps += TICK_S * GRAVITY_MPS2 * (lift * math.cos(self.lean_rad) - 1.0)
        pushed = DRAG_PER_S * (self.wind_mps - self.x_mps)
        self.x_mps += TICK_S * (GRAVITY_MPS2 * lift * math.sin(self.lean_rad) + pushed)
        self.x_m += TICK_S * self.x_mps
        self.z_m += TICK_S * self.climb_mps
        if self.z_m <= 0.0:
            if self.touched_mps is None:
                self.touched_mps = self.climb_mps
            self.z_m, self.climb_mps, self.x_mps = 0.0, max(0.0, self.climb_mps), 0.0


def come_down(
    vehicle: Falling,
    lasts_s: float,
    *,
    seen: Callable[[float], bool] = lambda _: True,
    proven: bool = True,
    stands_still: Callable[[float], bool] = lambda _: False,
    **remembered: Any,
) -> list[Command]:
    """Let a landing that has not heard the vehicle for a second fly it, by pictures that are late
    and show the target while it is `seen`; its last telemetry had it hovering where it was. The
    camera is `proven` if pictures and accelerometer have agreed before. While the loop
    `stands_still`, the vehicle keeps its last command."""
    heard = telemetry(BEGIN_S - 1.1, vehicle.z_m)
    known = {"hover_thrust": HOVER_THRUST} if "hover_thrust_estimate" not in remembered else {}
    state: PlannerState = remembering(
        state_in(Phase.LANDING, z_m=vehicle.z_m), **known, **remembered
    )
    felt = VisualInertialMotion(heard.t_s, (0.0, 0.0), (0.0, 0.0), None) if proven else None
    look: Callable[[Observation], Observation] = Felt()
    late = round(PICTURES_LATE_S / TICK_S)
    past: list[tuple[float, float]] = [
        (vehicle.x_m, vehicle.z_m - vehicle.climb_mps * TICK_S * i) for i in range(late, 0, -1)
    ]
    commands: list[Command] = []
    for i in range(round(lasts_s / TICK_S)):
        t_s = BEGIN_S + TICK_S * i
        past.append((vehicle.x_m, vehicle.z_m))
        x_m, z_m = past[-1 - late]
        if stands_still(TICK_S * i):
            commands.append(commands[-1])
            vehicle.step(commands[-1])
            continue
        now = seen(TICK_S * i)
        target = target_at(
            t_s,
            body_m=(x_m, 0.0, z_m),
            last_measured_at_s=t_s - PICTURES_LATE_S,
            is_measured_in_newest_frame=now,
        )
        obs = observation(
            t_s, telemetry=heard, target=target, external_position_age_s=1.1 + TICK_S * i
        )
        obs = replace(obs, has_new_frame=now, visual_inertial_motion=felt)
        state, command = step_mission(state, look(obs), BY_TARGET)
        commands.append(command)
        vehicle.step(command)
    vehicle.state = state
    return commands


def seen_before(vehicle: Falling) -> VisualVelocityFilter:
    """What pictures have shown of the vehicle for a second before the descent begins."""
    below_m = CEILING_M - vehicle.z_m - BY_TARGET.vehicle.gear_body_m[2]
    newest_s = BEGIN_S - PICTURES_LATE_S - TICK_S
    velocity_mps = (0.0, 0.0, vehicle.climb_mps)
    return VisualVelocityFilter(newest_s, newest_s - 1.0, (0.0, 0.0, below_m), velocity_mps)


def raw_orders(commands: list[Command], begin_s: float, end_s: float) -> list[RawThrust]:
    """The raw thrusts ordered between two times."""
    ticks = commands[round(begin_s / TICK_S) : round(end_s / TICK_S)]
    return [command for command in ticks if isinstance(command, RawThrust)]


@pytest.mark.parametrize("climb_mps", [-0.4, 0.0, 0.3])
@pytest.mark.parametrize("strength", [0.95, 1.0, 1.05])
def test_it_comes_down_softly_whatever_its_motors_give(strength: float, climb_mps: float) -> None:
    """By the last telemetry it stands still in the air, and its hover thrust is wrong by 5 %."""
    vehicle = Falling(CEILING_M - 0.8, climb_mps, strength)
    come_down(vehicle, 12.0)
    assert vehicle.touched_mps is not None
    assert -0.75 < vehicle.touched_mps < 0.0


@pytest.mark.parametrize("strength", [0.95, 1.0, 1.05])
@pytest.mark.parametrize("climb_mps", [0.2, 0.4, 0.5, 0.6])
def test_a_climb_in_the_pictures_is_braked_and_is_no_floor(
    climb_mps: float, strength: float
) -> None:
    """The small thrust that brakes it, and the moment in which the vehicle turns round, looked like
    a vehicle on the floor: it dropped from 0.45 m (seed 2612015017)."""
    vehicle = Falling(0.45, climb_mps, strength)
    come_down(vehicle, 6.0, visual_velocity_filter=seen_before(vehicle))
    assert vehicle.touched_mps is not None
    assert -0.75 < vehicle.touched_mps < 0.0


@pytest.mark.parametrize("begin_s", [0.1, 0.2])
def test_a_loop_that_stood_still_takes_the_vehicle_for_no_floor(begin_s: float) -> None:
    """The vehicle kept its last thrust meanwhile, and that was enough to fly."""
    vehicle = Falling(1.5, 0.3, 1.0)
    come_down(
        vehicle,
        8.0,
        stands_still=lambda t_s: begin_s <= t_s < begin_s + 0.56,
        visual_velocity_filter=seen_before(vehicle),
    )
    assert vehicle.touched_mps is not None
    assert -0.75 < vehicle.touched_mps < 0.0


def test_a_thrust_that_was_too_small_before_the_descent_proves_no_floor() -> None:
    vehicle = Falling(1.5, 0.0, 1.0)
    seen = seen_before(vehicle)
    come_down(
        vehicle, 8.0, visual_velocity_filter=seen, thrust_too_low_to_fly_since_s=BEGIN_S - 3.0
    )
    assert vehicle.touched_mps is not None
    assert -0.75 < vehicle.touched_mps < 0.0


@pytest.mark.parametrize("sigma_fraction", [0.02, 0.12])
def test_with_an_unsure_hover_thrust_setpoints_come_first_also_with_pictures(
    sigma_fraction: float,
) -> None:
    """Just after take-off it is 15 % too small; by pictures, which are late, the vehicle dropped
    from 0.3 m (seed 2612011472)."""
    vehicle = Falling(0.3, 0.0, 1.0)
    known = HoverThrustEstimate(HOVER_THRUST, sigma_fraction)
    orders = come_down(
        vehicle, 1.6, visual_velocity_filter=seen_before(vehicle), hover_thrust_estimate=known
    )
    waits_s = TICK_S * sum(isinstance(order, PositionSetpoint) for order in orders)
    assert waits_s == pytest.approx(1.5 if sigma_fraction > 0.05 else 0.0, abs=0.05)


@pytest.mark.parametrize("known_wrong", ["is_position_diverged", "is_heading_lost"])
def test_setpoints_do_not_come_first_on_an_estimate_that_is_known_to_be_wrong(
    known_wrong: str,
) -> None:
    vehicle = Falling(1.0, 0.0, 1.0)
    unsure = HoverThrustEstimate(HOVER_THRUST, 0.12)
    orders = come_down(
        vehicle,
        1.0,
        visual_velocity_filter=seen_before(vehicle),
        hover_thrust_estimate=unsure,
        **{known_wrong: True},
    )
    assert not any(isinstance(order, PositionSetpoint) for order in orders)


@pytest.mark.parametrize("gap_s", [(8.0, 8.4), (4.5, 5.5), (5.0, 6.5), (1.0, 1.4), (1.0, 14.0)])
def test_pictures_that_are_lost_never_let_it_climb(gap_s: tuple[float, float]) -> None:
    """In the air and on the floor, for a few pictures or for good (seeds 20511149, 20511165)."""
    vehicle = Falling(1.4, 0.0, 1.0)
    begin_s, end_s = gap_s
    orders = come_down(vehicle, 14.0, seen=lambda t_s: not begin_s <= t_s < end_s)
    assert vehicle.z_m == 0.0
    after = [each.thrust for each in orders[round(5.0 / TICK_S) :] if isinstance(each, RawThrust)]
    assert max(after) <= HOVER_THRUST


@pytest.mark.parametrize("strength", [0.95, 1.0, 1.05])
def test_on_the_floor_its_thrust_goes_down_to_the_least(strength: float) -> None:
    vehicle = Falling(0.8, 0.0, strength)
    come_down(vehicle, 14.0)
    assert vehicle.z_m == 0.0
    assert vehicle.thrust < 0.5 * HOVER_THRUST


def test_without_pictures_the_same_vehicle_drops() -> None:
    """What the pictures are for: by orders alone an error of 5 % is a fall, or no way down."""
    vehicle = Falling(1.8, 0.0, 0.95)
    come_down(vehicle, 12.0, seen=lambda _: False)
    assert vehicle.touched_mps is not None
    assert vehicle.touched_mps < -0.9


@pytest.mark.parametrize("wind_mps", [-1.0, 1.0])
def test_a_speed_that_was_seen_long_ago_is_not_braked(wind_mps: float) -> None:
    """It would lean for ever against a speed that is gone."""
    orders = come_down(Falling(1.8, 0.0, 1.0, wind_mps), 3.5, seen=lambda t_s: t_s < 1.5)
    leans_rad = [each.pitch_rad for each in orders if isinstance(each, RawThrust)]
    assert max(abs(lean_rad) for lean_rad in leans_rad[: round(1.9 / TICK_S)]) > 0.01
    assert max(abs(lean_rad) for lean_rad in leans_rad[round(2.1 / TICK_S) :]) < 1e-3


@pytest.mark.parametrize("wind_mps", [-1.0, 1.0])
def test_it_brakes_what_carries_it_aside(wind_mps: float) -> None:
    """Less than half of the way that a steady wind would carry it in the same time."""
    vehicle, carried = (Falling(1.8, 0.0, 1.0, wind_mps) for _ in range(2))
    come_down(vehicle, 4.0)
    come_down(carried, 4.0, seen=lambda _: False)
    assert abs(vehicle.x_m) < 0.5 * abs(carried.x_m)


def test_a_camera_that_nothing_has_proven_does_not_brake() -> None:
    """Turned by 90 degrees it would lead aside: only the climb counts then."""
    orders = come_down(Falling(1.8, 0.0, 1.0, 1.0), 3.0, proven=False)
    assert max(abs(each.pitch_rad) for each in raw_orders(orders, 0.0, 3.0)) < 1e-3


def test_a_target_that_is_seen_again_changes_nothing_until_its_motion_is_known() -> None:
    """A third of a second of detections after a gap of more than a second."""
    orders = come_down(Falling(1.8, 0.0, 1.0), 3.0, seen=lambda t_s: not 0.6 <= t_s < 2.0)
    thrusts = [each.thrust for each in raw_orders(orders, 2.1, 2.25)]
    assert len({*thrusts}) == 1


def test_what_pictures_show_standing_on_little_thrust_stands_on_the_floor() -> None:
    vehicle = Falling(0.8, 0.0, 1.0)
    come_down(vehicle, 9.0)
    assert vehicle.state is not None
    assert vehicle.state.descent.floor_detected_at_s is not None


def test_what_hangs_right_below_the_target_does_not() -> None:
    """It may hang on the magnet, whatever its thrust is."""
    vehicle = Falling(HANG_Z_M - 0.05, 0.0, 1.0, held=True)
    come_down(vehicle, 9.0)
    assert vehicle.state is not None
    assert vehicle.state.descent.floor_detected_at_s is None


def test_pictures_that_show_it_below_its_contact_clear_that() -> None:
    """Once, and not the time since which it has been without a position."""
    vehicle = Falling(HANG_Z_M, 0.0, 1.0)
    come_down(
        vehicle,
        5.0,
        vehicle_world_z_at_last_contact_m=HANG_Z_M,
        magnet_reach_entered_at_s=BEGIN_S - 1.5,
    )
    assert vehicle.state is not None
    assert vehicle.state.belief.vehicle_world_z_at_last_contact_m is None
    assert vehicle.state.belief.dead_reckoning_began_at_s is not None
    assert vehicle.state.belief.dead_reckoning_began_at_s < BEGIN_S + 4.0
