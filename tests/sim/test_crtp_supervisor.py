"""The supervisor's rows of docs/firmware.md, seen through cflib's `udp://` driver."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from tests.helpers.crtp_rig import (
    AIRBORNE_S,
    ARMED_BIT,
    CAN_FLY_BIT,
    CRASHED_BIT,
    HL_DONE,
    HL_RUNNING,
    LOCKED,
    LOCKED_BIT,
    LOW_LEVEL,
    READY,
    TUMBLED_BIT,
    Pilot,
    height,
    locked,
    notify,
    off,
    raw,
)

UPDATE_S = 0.04  # 25 Hz


# --- Supervisor -------------------------------------------------------------------


def test_values_of_the_states(pilot: Pilot) -> None:
    """Row "supervisor.info": 0x020E, 0x011E, 0x031E, 0x021E, 0x0244, on port 9 and as a log; the
    getters of cflib read the same bits."""
    assert pilot.supervisor_info() == pilot.info == READY
    states = pilot.cf.supervisor.decode_bitfield(pilot.supervisor_info())
    assert states == ["Is armed", "Is auto armed", "Can fly", "Finished HL trajectory"]
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(0.6, 2.0)
    pilot.advance(1.9)
    assert pilot.supervisor_info() == pilot.info == HL_RUNNING
    pilot.advance(2.0)
    assert pilot.supervisor_info() == pilot.info == HL_DONE
    pilot.stream(0.5, lambda: pilot.hold(0.6))
    assert pilot.supervisor_info() == pilot.info == LOW_LEVEL
    pilot.cf.supervisor.send_emergency_stop()
    pilot.advance(3.0)
    assert pilot.supervisor_info() == pilot.info == LOCKED


def test_updates_at_25_hz(pilot: Pilot) -> None:
    """Row "Updates at 25 Hz": a cut requested between two updates comes at the next one."""
    pilot.take_off(0.4, settle_s=1.0)
    pilot.advance(0.006)  # off the grid, which starts at boot
    pilot.cf.supervisor.send_emergency_stop()
    took_s = pilot.until(off, 0.1)
    assert took_s == pytest.approx(UPDATE_S - 0.006, abs=0.0041)


def test_arms_itself_and_rearms_on_the_ground(pilot: Pilot) -> None:
    """Row "arms itself ... Disarm on the ground re-arms in 0.15 s"."""
    assert pilot.info & ARMED_BIT
    assert pilot.ask(9, 1, b"\x01\x00") == b"\x81\x01\x00"
    pilot.sim.advance(0.002)
    assert not pilot.sim.truth()["supervisor_info"] & ARMED_BIT
    pilot.t_s = round(pilot.t_s + 0.002, 6)
    assert pilot.until(lambda t: t["supervisor_info"] == READY, 1.0) == pytest.approx(
        0.13, abs=0.05
    )


def test_disarm_in_flight_cuts_without_locking(pilot: Pilot) -> None:
    """Row "Disarm in flight cuts the motors within one update; it does not lock"."""
    pilot.fly_to(0.5, 0.5, AIRBORNE_S)
    since_s = pilot.t_s
    pilot.cf.supervisor.send_arming_request(False)
    assert pilot.until(off, 0.2) <= UPDATE_S + 0.002
    pilot.advance(6.0)
    assert not any(int(v) & LOCKED_BIT for _, v in pilot.log("supervisor.info", since_s))
    assert pilot.info == READY
    assert pilot.motors_off()
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(2.5)
    assert height(pilot) > 0.3


@pytest.mark.long
def test_rearms_after_30_s_on_the_ground(pilot: Pilot) -> None:
    """Row "After 30 s armed on the ground it disarms and re-arms (can-fly 0 for 120 ms)"."""
    pilot.advance(32.0)
    gone = [t for t, v in pilot.log("supervisor.info", 1.0) if not int(v) & CAN_FLY_BIT]
    assert gone[0] == pytest.approx(30.1, abs=0.2)
    assert gone[-1] - gone[0] + 0.01 == pytest.approx(0.12, abs=0.04)
    assert pilot.info == READY


def test_rearms_5_s_after_a_landing(pilot: Pilot) -> None:
    """Row "... and 5 s after a landing, it disarms and re-arms"."""
    pilot.take_off(0.4, settle_s=1.0)
    pilot.cf.high_level_commander.land(0.0, 2.0)
    pilot.until(off, 4.0)
    down_s = pilot.t_s
    pilot.advance(7.0)
    gone = [t for t, v in pilot.log("supervisor.info", down_s) if not int(v) & CAN_FLY_BIT]
    assert gone[0] - down_s == pytest.approx(5.05, abs=0.15)
    assert gone[-1] - gone[0] + 0.01 == pytest.approx(0.12, abs=0.04)


# --- When setpoints stop ----------------------------------------------------------


def test_silence_levels_out_then_cuts_and_locks(pilot: Pilot) -> None:
    """Row "Low-level stream silent": level at +0.5 s, cut at +2.0 s, locked for good."""
    pilot.fresh(mass_kg=0.030)
    pilot.fly_to(0.8, 2.0, AIRBORNE_S)
    pilot.stream(0.1, lambda: pilot.cf.commander.send_position_setpoint(1.5, 0, 0.8, 0))
    silent_s = pilot.t_s
    pilot.advance(0.3)
    assert abs(pilot.sim.truth()["rpy_rad"][1]) > math.radians(2.0)  # still under way
    pilot.advance(1.0)
    assert abs(pilot.sim.truth()["rpy_rad"][1]) < math.radians(2.0)
    assert height(pilot) > 0.6
    pilot.until(off, 1.0)
    assert pilot.t_s - silent_s == pytest.approx(2.02, abs=0.06)
    pilot.advance(1.0)
    assert pilot.info & LOCKED_BIT
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.cf.supervisor.send_arming_request(True)
    pilot.cf.supervisor.send_crash_recovery_request()
    pilot.advance(5.0)
    assert pilot.info & LOCKED_BIT
    assert pilot.motors_off()


def test_silence_of_1200_ms_recovers(pilot: Pilot) -> None:
    """Row "Silence of 1.2 s and then resuming recovers"."""
    pilot.fly_to(0.8, settle_s=AIRBORNE_S)
    pilot.advance(1.2)
    pilot.stream(5.0, lambda: pilot.hold(0.8))
    assert pilot.info == LOW_LEVEL
    assert height(pilot) == pytest.approx(0.8, abs=0.1)


def stop(pilot: Pilot) -> None:
    pilot.cf.commander.send_stop_setpoint()


def zero(pilot: Pilot) -> None:
    raw(pilot, 0)


@pytest.mark.parametrize(
    ("send", "perched"),
    [
        (stop, True),
        pytest.param(stop, False, marks=pytest.mark.long),
        pytest.param(zero, True, marks=pytest.mark.long),
        (zero, False),
    ],
)
def test_a_lone_last_packet_cuts_at_once_and_locks(
    pilot: Pilot, perched: bool, send: Callable[[Pilot], None]
) -> None:
    """Rows "send_stop_setpoint once and then silence: off within 7 ms, locked at +2.0 s",
    "close_link() sends send_setpoint(0,0,0,0): falls at once and locks", and "a zero packet in
    flight is itself a cut"."""
    if perched:
        pilot.perch()
    else:
        pilot.fly_to(0.8, 0.5, AIRBORNE_S)
    send(pilot)
    start_s = pilot.t_s
    assert pilot.until(off, 0.1) <= 0.007
    pilot.until(locked, 3.0)
    assert pilot.t_s - start_s == pytest.approx(2.06, abs=0.07)
    assert pilot.sim.truth()["magnet_engaged"] == perched
    assert pilot.sim.truth()["floor_contact"] != perched


def test_stop_and_notify_is_ready_again(pilot: Pilot) -> None:
    """Rows "stop followed by notify": off, no lock, 0x020E after 2.1 s, take-off works later, and
    "flying = a motor was above idle in the last 2.0 s"."""
    pilot.fly_to(0.3, 0.5, AIRBORNE_S)
    since_s = pilot.t_s
    pilot.cf.commander.send_stop_setpoint()
    notify(pilot)
    assert pilot.until(off, 0.1) <= 0.007
    pilot.until(lambda t: t["supervisor_info"] == READY, 4.0)
    assert pilot.t_s - since_s == pytest.approx(2.06, abs=0.1)
    pilot.advance(10.0)
    assert not any(int(v) & LOCKED_BIT for _, v in pilot.log("supervisor.info"))
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(4.0)
    assert pilot.info == HL_DONE
    assert height(pilot) > 0.4


@pytest.mark.parametrize(
    ("wait_s", "locks"), [(1.0, True), pytest.param(4.0, False, marks=pytest.mark.long)]
)
def test_the_farewell_packet_when_perched(pilot: Pilot, wait_s: float, locks: bool) -> None:
    """Row "perched, it locks when the flying bit is still set (1 s after), not 4 s after"."""
    pilot.perch()
    pilot.cf.commander.send_stop_setpoint()
    notify(pilot)
    pilot.advance(wait_s)
    raw(pilot, 0)
    pilot.advance(6.0)
    assert bool(pilot.info & LOCKED_BIT) == locks
    assert pilot.sim.truth()["magnet_engaged"]


def test_emergency_stop_and_its_watchdog(pilot: Pilot) -> None:
    """Rows "Emergency stop: motors off in 25 ms, locked" (within one update) and "Emergency-stop
    watchdog: starts with its first packet; a gap over 1 s locks"."""
    pilot.take_off(0.6, settle_s=1.0)
    pilot.cf.supervisor.send_emergency_stop()
    assert pilot.until(off, 0.1) <= UPDATE_S + 0.002
    pilot.advance(3.0)
    assert pilot.info == LOCKED
    pilot.fresh()
    pilot.take_off(0.6, settle_s=1.0)
    pilot.stream(3.0, pilot.cf.supervisor.send_emergency_stop_watchdog, 0.9)
    assert pilot.info == HL_DONE
    pilot.cf.supervisor.send_emergency_stop_watchdog()
    assert pilot.until(off, 2.0) == pytest.approx(1.02, abs=0.05)
    pilot.advance(3.0)
    assert pilot.info == LOCKED


@pytest.mark.parametrize("notified", [False, pytest.param(True, marks=pytest.mark.long)])
def test_hl_after_low_level_flies_only_with_notify(pilot: Pilot, notified: bool) -> None:
    """Rows "HL command after low-level without notify: HL active, not flown, locks after 2 s" and
    "With notify first it flies"."""
    pilot.fly_to(0.8, 1.0, AIRBORNE_S)
    last_s = pilot.t_s
    if notified:
        notify(pilot)
    pilot.cf.high_level_commander.go_to(0, 0, 1.2, 0, 1.5)
    pilot.advance(0.3)
    assert pilot.info == HL_RUNNING
    pilot.advance(1.4)
    if notified:
        pilot.advance(4.0)
        assert pilot.info == HL_DONE
        assert height(pilot) == pytest.approx(1.2, abs=0.08)
        return
    assert height(pilot) < 0.9
    pilot.until(off, 1.0)
    assert pilot.t_s - last_s == pytest.approx(2.0, abs=0.1)
    pilot.advance(0.2)
    assert pilot.info & LOCKED_BIT


# --- Contact, tumble, crash -------------------------------------------------------


def test_pressing_on_the_ceiling_is_no_crash(pilot: Pilot) -> None:
    """Rows "Hitting a ceiling ... and 3 s of full-thrust pressing": no tumble, no lock, +1 g, and
    "The onboard position controller can command 65,535": it presses harder than a raw burst."""
    pilot.fresh(no_target=True)
    pilot.fly_to(1.6, 0.5, AIRBORNE_S)
    since_s = pilot.t_s
    pilot.stream(2.0, lambda: pilot.hold(3.0))
    peak_g = max(abs(v) for _, v in pilot.log("acc.z", since_s))
    assert peak_g > 5.0
    pilot.stream(3.0, lambda: pilot.hold(3.0))
    assert {int(v) for _, v in pilot.log("supervisor.info", since_s)} == {LOW_LEVEL}
    pressed_n = pilot.sim.truth()["ceiling_force_n"]
    assert pilot.now("acc.z") == pytest.approx(1.0, abs=0.05)
    assert pilot.now("stabilizer.thrust") == pytest.approx(65_535, abs=1)
    pilot.stream(1.0, lambda: raw(pilot, 60000))
    assert 0.0 < pilot.sim.truth()["ceiling_force_n"] < pressed_n


def test_upside_down_crashes_and_recovers(pilot: Pilot) -> None:
    """Row "Upside down in flight": motors off, crashed within 0.7 s; recovery after righting."""
    pilot.fly_to(0.8, 0.5, AIRBORNE_S)
    start_s = pilot.t_s
    pilot.sim.set_pose((0, 0, 1.5), (math.pi, 0, 0), hold=True)
    pilot.stream(0.7, lambda: pilot.hold(0.8))
    assert pilot.info & CRASHED_BIT
    assert pilot.info & TUMBLED_BIT
    assert not pilot.info & LOCKED_BIT
    assert pilot.motors_off()
    first_s = next(t for t, v in pilot.log("supervisor.info", start_s) if int(v) & CRASHED_BIT)
    assert first_s - start_s > 0.1  # the rule: below -0.2 g for 0.1 s
    assert pilot.ask(9, 1, b"\x02") == b"\x82\x00\x00"  # not while upside down
    pilot.sim.set_pose((0, 0, 0.012))
    pilot.sim.let_go()
    pilot.advance(0.5)
    assert pilot.info & CRASHED_BIT
    pilot.cf.supervisor.send_crash_recovery_request()
    assert pilot.until(lambda t: t["supervisor_info"] == READY, 1.0) <= 0.2
    pilot.advance(5.0)
    assert pilot.motors_off()  # the setpoints of the flight that crashed spin nothing
