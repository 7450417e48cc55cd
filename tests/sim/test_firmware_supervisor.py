"""Firmware facts "Supervisor", "When setpoints stop", "Contact, tumble, crash", row by row."""

from __future__ import annotations

import math

import pytest

from perchctl.sim.firmware.commands import (
    HlStop,
    HlTakeoff,
    HoverCommand,
    PositionCommand,
    RawSetpoint,
    StopCommand,
)
from perchctl.vehicle import ARMED, CAN_FLY, CRASHED, FLYING, HL_ACTIVE, LOCKED, TUMBLED
from tests.helpers.firmware_rig import Rig, make_rig

READY, HL_RUNNING, HL_HOVER, LOW_LEVEL, LOCK = 0x020E, 0x011E, 0x031E, 0x021E, 0x0244
HERE = PositionCommand(0.0, 0.0, 0.8, 0.0)
ZERO = RawSetpoint(0.0, 0.0, 0.0, 0)


def flying(**conditions: float) -> Rig:
    """Holding 0.8 m on low-level position setpoints."""
    rig = make_rig(**conditions)
    rig.take_off()
    rig.hold()
    return rig


def test_every_state_of_the_table() -> None:
    rig = make_rig()
    assert rig.info == READY
    rig.firmware.high_level(HlTakeoff(0.5, 2.0))
    rig.run(1.0)
    assert rig.info == HL_RUNNING
    rig.run(2.0)
    assert rig.info == HL_HOVER
    rig.hold(1.0, 0.5)
    assert rig.info == LOW_LEVEL
    rig.run(2.2)
    assert rig.info == LOCK


def test_arms_itself_soon_after_boot() -> None:
    rig = make_rig(booted=False)
    assert rig.run_until(lambda: rig.info == READY, 1.0) <= 0.2


def test_updates_come_25_times_a_second() -> None:
    rig = make_rig()
    rig.firmware.arm(False)
    changes = []
    last = rig.info & CAN_FLY
    for _ in range(200):
        rig.firmware.step()
        if rig.info & CAN_FLY != last:
            last = rig.info & CAN_FLY
            changes.append(rig.firmware.t_s)
    assert len(changes) == 2
    assert (changes[1] - changes[0]) / 0.04 == pytest.approx(3.0)


def test_flying_clears_two_seconds_after_the_motors_stop() -> None:
    rig = flying()
    rig.firmware.low_level(StopCommand())
    rig.firmware.notify_setpoint_stop()
    assert rig.run_until(lambda: not rig.info & FLYING, 4.0) == pytest.approx(2.0, abs=0.06)


def test_disarm_on_the_ground_rearms() -> None:
    rig = make_rig()
    assert rig.firmware.arm(False) == (True, False)
    assert not rig.info & ARMED
    rig.run(0.042)
    assert not rig.info & CAN_FLY
    assert rig.run_until(lambda: rig.info == READY, 1.0) == pytest.approx(0.12, abs=0.03)


@pytest.mark.parametrize("stream", [None, HERE])
def test_disarm_in_flight_cuts_within_one_update_and_does_not_lock(
    stream: PositionCommand | None,
) -> None:
    rig = make_rig()
    rig.take_off()
    rig.run(0.1, stream)
    rig.firmware.arm(False)
    assert rig.run_until(lambda: rig.motors_off, 1.0) <= 0.042
    rig.run(3.0, stream)
    assert not rig.info & LOCKED


@pytest.mark.parametrize("stream", [None, HERE])
def test_nothing_locks_later_when_nothing_is_sent_after_a_disarm_in_flight(
    stream: PositionCommand | None,
) -> None:
    rig = make_rig()
    rig.take_off()
    rig.run(0.1, stream)
    rig.firmware.arm(False)
    rig.run(0.042)
    seen = set()
    for _ in range(2000):
        rig.run(0.02)
        assert rig.motors_off
        seen.add(rig.info)
    assert not any(info & LOCKED for info in seen)
    assert rig.info == READY
    assert rig.world.state().floor_contact
    rig.firmware.high_level(HlTakeoff(0.5, 2.0))
    rig.run(2.5)
    assert rig.world.z_m > 0.3


@pytest.mark.long
def test_rearms_after_30_s_on_the_ground() -> None:
    rig = make_rig(booted=False)
    rig.run_until(lambda: rig.info == READY, 1.0)
    down_s = rig.run_until(lambda: not rig.info & CAN_FLY, 40.0)
    assert down_s == pytest.approx(30.0, abs=0.1)
    assert rig.run_until(lambda: rig.info == READY, 1.0) == pytest.approx(0.12, abs=0.005)


def test_rearms_five_seconds_after_a_landing() -> None:
    rig = flying()
    rig.firmware.low_level(StopCommand())
    rig.firmware.notify_setpoint_stop()
    rig.run(2.3)
    assert rig.info == READY
    assert rig.run_until(lambda: not rig.info & CAN_FLY, 9.0) == pytest.approx(2.7, abs=0.1)
    assert rig.run_until(lambda: rig.info == READY, 1.0) == pytest.approx(0.12, abs=0.005)


def test_arming_is_refused_when_checks_are_not_passed() -> None:
    rig = flying()
    rig.firmware.emergency_stop()
    rig.run(0.2)
    assert rig.firmware.arm(True) == (False, False)


# When setpoints stop ----------------------------------------------------------------


def test_silence_levels_out_then_cuts_and_locks_until_a_reboot() -> None:
    rig = flying()
    rig.run(0.3, PositionCommand(1.0, 0.0, 0.8, 0.0))
    last_s = rig.firmware.t_s - 0.02  # of the last packet
    assert rig.firmware.log_value("stateEstimate.pitch") < -3.0  # leaning forward
    rig.run(0.48)
    assert rig.firmware.flown_setpoint.mode[0] == 1
    rig.run_until(lambda: rig.firmware.flown_setpoint.mode[0] == 0, 0.1)
    assert rig.firmware.t_s - last_s == pytest.approx(0.52, abs=0.03)
    rig.run(0.6)
    assert abs(rig.firmware.log_value("stateEstimate.pitch")) < 1.5
    assert rig.info == LOW_LEVEL
    rig.run_until(lambda: rig.motors_off, 2.0)
    assert rig.firmware.t_s - last_s == pytest.approx(2.0, abs=0.05)
    rig.run(0.1)
    assert rig.info == LOCK
    rig.run(10.0, HERE)
    assert rig.info == LOCK
    assert rig.motors_off
    rig.firmware.reboot()
    rig.run(0.3)
    assert rig.info == READY


def test_silence_of_1200_ms_recovers() -> None:
    rig = flying(mass_kg=0.03)
    rig.run(1.2)
    rig.hold(5.0)
    assert rig.info == LOW_LEVEL
    assert rig.world.z_m == pytest.approx(0.8, abs=0.05)


def test_level_out_keeps_the_height() -> None:
    rig = flying(mass_kg=0.03)
    heights = rig.run(1.9)
    assert min(heights) > 0.65  # the reset costs some height; the loop holds the rest


def test_stop_and_then_silence_cuts_at_once_and_locks() -> None:
    rig = flying()
    rig.firmware.low_level(StopCommand())
    assert rig.run_until(lambda: rig.motors_off, 0.1) <= 0.007
    assert rig.run_until(lambda: bool(rig.info & LOCKED), 3.0) == pytest.approx(2.04, abs=0.05)


def test_stop_and_then_silence_locks_on_the_ceiling_too() -> None:
    rig = flying()
    rig.world.set_pose((0.0, 0.0, 2.17))
    rig.run(0.1, PositionCommand(0.0, 0.0, 2.4, 0.0))
    rig.firmware.low_level(StopCommand())
    rig.run(2.2)
    assert rig.world.magnet_engaged
    assert rig.info & LOCKED


def test_stop_with_notify_is_ready_again_and_can_take_off() -> None:
    rig = flying()
    rig.firmware.low_level(StopCommand())
    rig.firmware.notify_setpoint_stop()
    rig.run(0.01)
    assert rig.motors_off
    rig.run(2.1)
    assert rig.info == READY
    rig.run(1.0)
    rig.firmware.high_level(HlTakeoff(0.5, 2.0))
    rig.run(0.5)
    assert not rig.motors_off


@pytest.mark.parametrize(("after_s", "locks"), [(1.0, True), (4.0, False)])
def test_closing_the_link_while_perched(after_s: float, locks: bool) -> None:
    rig = flying()
    rig.world.set_pose((0.0, 0.0, 2.17))
    rig.run(0.1, PositionCommand(0.0, 0.0, 2.4, 0.0))
    rig.firmware.low_level(StopCommand())
    rig.firmware.notify_setpoint_stop()
    rig.run(after_s)
    rig.firmware.low_level(ZERO)  # what close_link() sends
    rig.run(3.0)
    assert bool(rig.info & LOCKED) is locks


def test_closing_the_link_in_the_air_falls_and_locks() -> None:
    rig = flying()
    rig.firmware.low_level(ZERO)
    assert rig.run_until(lambda: rig.motors_off, 0.1) <= 0.007
    rig.run(2.2)
    assert rig.info & LOCKED


def test_high_level_hover_never_times_out() -> None:
    rig = make_rig()
    rig.take_off()
    rig.run(8.0)
    assert rig.info == HL_HOVER
    assert rig.world.z_m == pytest.approx(0.8, abs=0.06)


def test_emergency_stop() -> None:
    rig = flying()
    rig.firmware.emergency_stop()
    assert rig.run_until(lambda: rig.motors_off, 0.1) <= 0.042
    rig.run(0.1, HERE)
    assert rig.info == LOCK


def test_emergency_stop_ends_a_high_level_flight_as_well() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.emergency_stop()
    rig.run(0.2)
    assert rig.info == LOCK


def test_stop_parameter_is_an_emergency_stop() -> None:
    rig = flying()
    rig.firmware.set_parameter("stabilizer.stop", 1)
    rig.run(0.1)
    assert rig.info == LOCK


def test_watchdog_starts_with_its_first_packet_and_cuts_after_a_gap() -> None:
    rig = flying()
    rig.hold(2.0)
    for _ in range(4):
        rig.firmware.emergency_stop_watchdog()
        rig.hold(0.9)
    assert rig.info == LOW_LEVEL
    rig.hold(0.2)
    assert rig.motors_off
    assert rig.info & LOCKED


def test_high_level_without_notify_is_accepted_but_not_flown() -> None:
    rig = flying()
    rig.firmware.high_level(HlTakeoff(1.2, 2.0))
    rig.run(0.3)
    assert rig.info & HL_ACTIVE
    assert rig.firmware.flown_setpoint.z_m == 0.8
    rig.run(2.0)
    assert rig.info == LOCK


def test_high_level_with_notify_flies() -> None:
    rig = flying()
    rig.firmware.notify_setpoint_stop()
    rig.firmware.high_level(HlTakeoff(1.0, 2.0))
    heights = rig.run(4.0)
    assert min(heights) > 0.75
    assert rig.info == HL_HOVER
    assert rig.world.z_m == pytest.approx(1.0, abs=0.06)


def test_high_level_stop_cuts_the_motors() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.high_level(HlStop())
    rig.run(0.02)
    assert rig.motors_off


# Contact, tumble, crash -------------------------------------------------------------


def test_pressing_the_ceiling_is_no_fault() -> None:
    rig = make_rig(ceiling_z_m=1.2, no_target=True, mass_kg=0.03)
    rig.take_off()
    rig.world.set_pose((0.0, 0.0, 1.1), velocity_mps=(0.0, 0.0, 1.5))
    rig.run(3.0, PositionCommand(0.0, 0.0, 2.0, 0.0))
    assert rig.world.state().ceiling_force_n > 0.1
    assert rig.info == LOW_LEVEL
    readings = []
    for _ in range(20):
        rig.run(0.02, PositionCommand(0.0, 0.0, 2.0, 0.0))
        readings.append(rig.firmware.log_value("acc.z"))
    assert sum(readings) / 20 == pytest.approx(1.0, abs=0.02)


def test_upside_down_crashes_and_recovers_after_righting() -> None:
    rig = flying()
    rig.world.set_pose((0.0, 0.0, 0.5), (3.1, 0.0, 0.0), hold=True)
    rig.run(0.3, HERE)
    assert rig.info & CRASHED
    assert rig.info & TUMBLED
    assert rig.motors_off
    assert not rig.info & LOCKED
    assert rig.firmware.recover_from_crash() == (False, False)
    rig.world.set_pose((0.0, 0.0, 0.02))
    rig.world.let_go()
    rig.run(0.5)
    assert rig.info & CRASHED
    assert rig.firmware.recover_from_crash() == (True, True)
    assert rig.run_until(lambda: bool(rig.info & CAN_FLY), 1.0) == pytest.approx(0.12, abs=0.045)


@pytest.mark.parametrize(("height_m", "after_s"), [(0.8, 0.45), (1.5, 0.7)])
def test_put_on_its_back_in_flight_falls_and_crashes(height_m: float, after_s: float) -> None:
    rig = make_rig()
    rig.take_off(height_m)
    here = PositionCommand(0.0, 0.0, height_m, 0.0)
    rig.run(2.0, here)
    rig.world.set_pose((0.0, 0.0, height_m), (math.pi, 0.0, 0.0))
    seen_s = 0.0
    while not rig.info & CRASHED and seen_s < 2.0:
        rig.run(0.02, here)
        seen_s += 0.02
    assert seen_s == pytest.approx(after_s, abs=0.1)
    rig.run(0.5)
    assert rig.motors_off
    assert rig.world.state().R_world_body[2, 2] < -0.5
    assert not rig.info & LOCKED
    rig.world.set_pose((0.0, 0.0, 0.012))
    rig.run(0.5)
    assert rig.firmware.recover_from_crash() == (True, True)
    assert rig.run_until(lambda: bool(rig.info & CAN_FLY), 1.0) == pytest.approx(0.12, abs=0.045)
    rig.run(40.0)  # the setpoints of the flight that crashed spin nothing
    assert rig.info == READY
    assert rig.motors_off


@pytest.mark.parametrize(("roll_rad", "after_s"), [(1.2, 1.0), (2.5, 0.1)])
def test_tumble_rule(roll_rad: float, after_s: float) -> None:
    rig = flying()
    rig.world.set_pose((0.0, 0.0, 0.8), (roll_rad, 0.0, 0.0), hold=True)
    seen_s = 0.0
    while not rig.info & CRASHED and seen_s < 2.0:
        rig.run(0.02, HERE)
        seen_s += 0.02
    assert seen_s == pytest.approx(after_s + 0.05, abs=0.07)


def test_falling_is_no_tumble() -> None:
    rig = flying(ceiling_z_m=9.0)
    rig.world.set_pose((0.0, 0.0, 8.0))
    rig.firmware.low_level(StopCommand())
    rig.firmware.notify_setpoint_stop()
    rig.run(0.9)
    assert not rig.info & TUMBLED
    assert rig.world.vz_mps < -5.0


def test_a_grounded_vehicle_on_its_back_cannot_fly() -> None:
    rig = make_rig()
    rig.world.set_pose((0.0, 0.0, 0.5), (3.14, 0.0, 0.0), hold=True)
    rig.run(0.3)
    assert not rig.info & CAN_FLY
    rig.run(0.5, HoverCommand(0.0, 0.0, 0.0, 0.5))
    assert rig.motors_off
