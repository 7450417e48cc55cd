"""Firmware facts "Raw thrust", "Thrust budget", "Setpoint modes", "Signs and units"."""

from __future__ import annotations

import math

import pytest

from perchctl.sim import REST_HEIGHT_M
from perchctl.sim.firmware.commands import (
    HlGoTo,
    HlLand,
    HlTakeoff,
    HoverCommand,
    PositionCommand,
    RawSetpoint,
    StopCommand,
    VelocityWorldCommand,
    ZDistanceCommand,
)
from perchctl.vehicle import HL_ACTIVE, HL_FINISHED
from tests.helpers.firmware_rig import PERFECT, make_rig

HERE = PositionCommand(0.0, 0.0, 0.8, 0.0)
FULL_RAW = RawSetpoint(0.0, 0.0, 0.0, 60000)


# Raw thrust -------------------------------------------------------------------------


def test_a_first_raw_burst_without_a_zero_packet_is_a_cut() -> None:
    rig = make_rig()
    rig.take_off()
    rig.hold()
    rig.firmware.low_level(FULL_RAW)
    assert rig.run_until(lambda: rig.motors_off, 0.1) <= 0.007


def test_a_zero_packet_in_flight_is_a_cut_but_unlocks() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.run(0.006)
    assert rig.motors_off
    rig.firmware.low_level(FULL_RAW)
    rig.run(0.006)
    assert not rig.motors_off


def test_unlock_without_notify_keeps_the_motors_off_in_a_take_off() -> None:
    rig = make_rig()
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.firmware.high_level(HlTakeoff(0.5, 2.0))
    rig.run(0.4)
    assert rig.info & HL_ACTIVE
    assert rig.motors_off


def test_the_unlock_is_forgotten_at_boot() -> None:
    rig = make_rig()
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.firmware.reboot()
    rig.run(0.3)
    rig.run(0.1, FULL_RAW)
    assert rig.motors_off


@pytest.mark.parametrize(
    ("sent", "flown"), [(999, 0.0), (1000, 1000.0), (30000, 30000.0), (65535, 60000.0)]
)
def test_raw_thrust_is_limited(sent: int, flown: float) -> None:
    rig = make_rig()
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.run(0.02, RawSetpoint(0.0, 0.0, 0.0, sent))
    assert rig.firmware.log_value("stabilizer.thrust") == flown


def test_the_largest_raw_burst_gains_what_was_measured() -> None:
    rig = make_rig()
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.firmware.notify_setpoint_stop()
    rig.take_off(settle_s=8.0)
    rig.world.battery_rest_v = 4.2  # the facts' battery is fresh
    rig.run(2.0)  # the compensation of the voltage has met the change
    before = rig.world.z_m
    rig.run(0.5, FULL_RAW)
    assert rig.world.z_m - before == pytest.approx(0.058, abs=0.007)
    assert rig.world.vz_mps == pytest.approx(0.25, abs=0.0125)


def test_hover_command_at_42_g() -> None:
    rig = make_rig(**PERFECT)
    rig.take_off(settle_s=8.0)
    assert rig.firmware.log_value("stabilizer.thrust") == pytest.approx(56200, rel=0.005)


def test_a_position_setpoint_above_the_ceiling_presses_harder_than_a_raw_burst() -> None:
    forces = []
    for command in (PositionCommand(0.0, 0.0, 1.5, 0.0), FULL_RAW):
        rig = make_rig(ceiling_z_m=1.0, no_target=True, **PERFECT)
        rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
        rig.firmware.notify_setpoint_stop()
        rig.take_off(0.9)
        rig.run(2.0, command)
        forces.append(rig.world.state().ceiling_force_n)
    assert forces[0] > forces[1] + 0.02
    assert forces[1] > 0.01


# Setpoint modes ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass_kg", "command", "dip_to_m", "within_m"),
    [
        (0.042, HoverCommand(0.0, 0.0, 0.0, 0.8), 0.47, 0.0235),
        # Both modes reset the same loops and hold the height in the same way, so one
        # dip lies between the two that were measured.
        (0.042, ZDistanceCommand(0.0, 0.0, 0.0, 0.8), 0.45, 0.045),
        (0.030, HoverCommand(0.0, 0.0, 0.0, 0.8), 0.74, 0.01),
    ],
)
def test_changing_mode_from_position_dips(
    mass_kg: float, command: HoverCommand | ZDistanceCommand, dip_to_m: float, within_m: float
) -> None:
    rig = make_rig(mass_kg=mass_kg)
    rig.take_off()
    rig.hold(3.0)
    assert min(rig.run(3.0, command)) == pytest.approx(dip_to_m, abs=within_m)


def test_hover_to_velocity_falls_to_the_floor() -> None:
    rig = make_rig()
    rig.take_off()
    rig.run(6.0, HoverCommand(0.0, 0.0, 0.0, 0.8))
    assert rig.world.z_m > 0.7
    heights = rig.run(3.0, VelocityWorldCommand(0.0, 0.0, 0.0, 0.0))
    assert min(heights) < REST_HEIGHT_M + 0.005


def test_high_level_to_position_does_not_dip() -> None:
    rig = make_rig()
    rig.take_off(settle_s=5.0)
    before = rig.world.z_m
    assert min(rig.run(1.0, HERE)) > before - 0.03


def test_the_level_out_resets_as_well() -> None:
    rig = make_rig()
    rig.take_off()
    rig.hold(3.0)
    before = rig.world.z_m
    assert min(rig.run(1.4)) < before - 0.1


@pytest.mark.parametrize(("mass_kg", "first_lift_s"), [(0.042, 1.5), (0.030, 0.75)])
def test_high_level_take_off_lifts_late(mass_kg: float, first_lift_s: float) -> None:
    rig = make_rig(mass_kg=mass_kg)
    rig.firmware.high_level(HlTakeoff(0.5, 2.0))
    seen_s = rig.run_until(lambda: rig.world.z_m > REST_HEIGHT_M + 0.005, 3.0)
    assert seen_s == pytest.approx(first_lift_s, abs=0.16)


def test_high_level_take_off_is_finished_by_the_clock() -> None:
    rig = make_rig()
    rig.firmware.high_level(HlTakeoff(0.5, 2.0))
    rig.run(1.95)
    assert not rig.info & HL_FINISHED
    rig.run(0.1)
    assert rig.info & HL_FINISHED
    assert rig.world.z_m == pytest.approx(0.25, abs=0.02)  # of 0.5 m, and 0.23 m at 2.0 s


def test_high_level_landing_ends_on_the_floor_with_the_motors_off() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.high_level(HlLand(0.0, 3.0))
    rig.run(3.1)
    assert rig.motors_off
    rig.run(2.2)
    assert rig.world.state().floor_contact
    assert rig.info == 0x020E


def test_a_landing_of_a_landing_and_a_take_off_in_flight_are_refused() -> None:
    rig = make_rig()
    rig.take_off()
    assert not rig.firmware.planner.command(HlTakeoff(1.0, 1.0), rig.firmware.t_s)
    assert rig.firmware.planner.command(HlLand(0.0, 3.0), rig.firmware.t_s)
    assert not rig.firmware.planner.command(HlLand(0.0, 1.0), rig.firmware.t_s)


# Signs and units --------------------------------------------------------------------


@pytest.mark.parametrize("command", [HERE, HlGoTo(0.0, 0.0, 0.8, 0.0, 2.0, False)])
def test_position_yaw_is_degrees_and_high_level_yaw_radians(
    command: PositionCommand | HlGoTo,
) -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    if isinstance(command, HlGoTo):
        rig.firmware.high_level(HlGoTo(0.3, 0.2, 0.8, 0.5, 2.0, False))
        rig.run(4.0)
    else:
        rig.run(4.0, PositionCommand(0.3, 0.2, 0.8, math.degrees(0.5)))
    assert rig.firmware.log_value("stateEstimate.yaw") == pytest.approx(28.6, abs=1.5)
    state = rig.world.state()
    assert state.position_m[:2] == pytest.approx([0.3, 0.2], abs=0.04)
    assert math.atan2(state.R_world_body[1, 0], state.R_world_body[0, 0]) > 0.4


def test_relative_go_to_offsets_in_world_axes() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    rig.firmware.high_level(HlGoTo(0.0, 0.0, 0.8, math.pi / 2, 2.0, False))
    rig.run(4.0)
    rig.firmware.high_level(HlGoTo(0.4, 0.0, 0.0, 0.0, 2.0, True))
    rig.run(4.0)
    assert rig.world.state().position_m[:2] == pytest.approx([0.4, 0.0], abs=0.05)
    assert rig.firmware.log_value("stateEstimate.yaw") == pytest.approx(90.0, abs=2.0)


def test_hover_velocity_is_in_body_axes() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    rig.run(4.0, PositionCommand(0.0, 0.0, 0.8, 90.0))
    rig.run(2.0, HoverCommand(0.3, 0.0, 0.0, 0.8))
    state = rig.world.state()
    assert state.velocity_mps[1] == pytest.approx(0.3, abs=0.08)
    assert abs(state.velocity_mps[0]) < 0.08
    rig.run(2.0, HoverCommand(0.0, 0.3, 0.0, 0.8))
    assert rig.world.vx_mps == pytest.approx(-0.3, abs=0.08)


def test_hover_yaw_rate_is_counter_clockwise_degrees() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    rig.run(1.0, HoverCommand(0.0, 0.0, 40.0, 0.8))
    assert 25.0 < rig.firmware.log_value("stateEstimate.yaw") < 42.0


def test_raw_yaw_rate_is_clockwise() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.firmware.notify_setpoint_stop()
    rig.take_off()
    rig.run(1.0, RawSetpoint(0.0, 0.0, 60.0, 41000))
    assert rig.firmware.log_value("stateEstimate.yaw") == pytest.approx(-48.0, abs=1.0)


def test_raw_pitch_and_roll_signs() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.firmware.low_level(RawSetpoint(0.0, 0.0, 0.0, 0))
    rig.firmware.notify_setpoint_stop()
    rig.take_off()
    # The attitude loop's integral overshoots by half a degree later on.
    rig.run(0.35, RawSetpoint(0.0, 10.0, 0.0, 41000))
    assert rig.firmware.log_value("stateEstimate.pitch") == pytest.approx(-9.6, abs=0.3)
    assert rig.world.vx_mps > 0.2
    rig.run(2.0, HERE)
    rig.run(0.35, RawSetpoint(10.0, 0.0, 0.0, 41000))
    assert rig.firmware.log_value("stateEstimate.roll") == pytest.approx(9.6, abs=0.3)
    assert rig.world.vy_mps < -0.15


def test_velocity_is_in_world_axes_and_moves_up() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    rig.run(4.0, PositionCommand(0.0, 0.0, 0.8, 90.0))
    rig.run(2.5, VelocityWorldCommand(0.3, 0.0, 0.1, 0.0))
    assert rig.world.vx_mps == pytest.approx(0.3, abs=0.08)
    assert rig.world.vz_mps == pytest.approx(0.1, abs=0.06)


def test_a_stop_setpoint_is_no_thrust() -> None:
    rig = make_rig()
    rig.take_off()
    rig.run(0.006, StopCommand())
    assert rig.firmware.log_value("stabilizer.thrust") == 0.0
