"""What the firmware model does beyond the rows that tests/sim/test_crtp_*.py show through cflib."""

from __future__ import annotations

import math

import pytest

from perchctl.sim.firmware.controller import Setpoint
from perchctl.sim.firmware.planner import HlLand, HlStop, HlTakeoff
from perchctl.vehicle import CAN_FLY, CRASHED, LOCKED, TUMBLED
from tests.helpers.firmware_rig import PERFECT, Rig, make_rig

READY, LOCK = 0x020E, 0x0244
HERE = Setpoint.position(0.0, 0.0, 0.8, 0.0)
FULL_RAW = Setpoint.raw(0.0, 0.0, 0.0, 60000)


def flying(**conditions: float) -> Rig:
    """Holding 0.8 m on low-level position setpoints."""
    rig = make_rig(**conditions)
    rig.take_off()
    rig.hold()
    return rig


def test_a_zero_packet_in_flight_is_a_cut_but_unlocks() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.low_level(Setpoint.raw(0.0, 0.0, 0.0, 0))
    rig.run(0.006)
    assert rig.motors_off
    rig.firmware.low_level(FULL_RAW)
    rig.run(0.006)
    assert not rig.motors_off


def test_the_unlock_is_forgotten_at_boot() -> None:
    rig = make_rig()
    rig.firmware.low_level(Setpoint.raw(0.0, 0.0, 0.0, 0))
    rig.firmware.reboot()
    rig.run(0.3)
    rig.run(0.1, FULL_RAW)
    assert rig.motors_off


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


def test_velocity_is_in_world_axes_and_moves_up() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    rig.run(4.0, Setpoint.position(0.0, 0.0, 0.8, 90.0))
    rig.run(2.5, Setpoint.velocity(0.3, 0.0, 0.1, 0.0))
    assert rig.world.vx_mps == pytest.approx(0.3, abs=0.08)
    assert rig.world.vz_mps == pytest.approx(0.1, abs=0.06)


@pytest.mark.parametrize("stream", [None, HERE])
def test_nothing_locks_later_when_nothing_is_sent_after_a_disarm_in_flight(
    stream: Setpoint | None,
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


def test_stop_parameter_is_an_emergency_stop() -> None:
    rig = flying()
    rig.firmware.set_parameter("stabilizer.stop", 1)
    rig.run(0.1)
    assert rig.info == LOCK


def test_high_level_stop_cuts_the_motors() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.high_level(HlStop())
    rig.run(0.02)
    assert rig.motors_off


@pytest.mark.parametrize(("height_m", "after_s"), [(0.8, 0.45), (1.5, 0.7)])
def test_put_on_its_back_in_flight_falls_and_crashes(height_m: float, after_s: float) -> None:
    rig = make_rig()
    rig.take_off(height_m)
    here = Setpoint.position(0.0, 0.0, height_m, 0.0)
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
    rig.firmware.low_level(Setpoint())
    rig.firmware.notify_setpoint_stop()
    rig.run(0.9)
    assert not rig.info & TUMBLED
    assert rig.world.vz_mps < -5.0


def test_a_grounded_vehicle_on_its_back_cannot_fly() -> None:
    rig = make_rig()
    rig.world.set_pose((0.0, 0.0, 0.5), (3.14, 0.0, 0.0), hold=True)
    rig.run(0.3)
    assert not rig.info & CAN_FLY
    rig.run(0.5, Setpoint.hover(0.0, 0.0, 0.0, 0.5))
    assert rig.motors_off
