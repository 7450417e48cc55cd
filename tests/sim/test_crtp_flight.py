"""Thrust, setpoint modes, signs and battery: docs/firmware.md, seen through cflib."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from tests.helpers.crtp_rig import HL_BIT, LOW_LEVEL, READY, Pilot, height, notify, off, raw


def lowest_after(pilot: Pilot, seconds: float, send: Callable[[], None]) -> float:
    since_s = pilot.t_s
    pilot.stream(seconds, send)
    return min(v for _, v in pilot.log("stateEstimate.z", since_s))


# --- Raw thrust -------------------------------------------------------------------


def test_first_raw_burst_in_flight_is_a_cut(pilot: Pilot) -> None:
    """Row "Thrust is forced to 0 until one packet with thrust 0": a motor cut within 7 ms."""
    pilot.cf.high_level_commander.takeoff(0.6, 2.0)  # never unlocked
    pilot.advance(4.0)
    raw(pilot, 50000)
    assert pilot.until(off, 0.1) <= 0.007
    pilot.stream(0.3, lambda: raw(pilot, 50000))
    assert pilot.motors_off()


def test_unlock_without_notify_blocks_the_take_off(pilot: Pilot) -> None:
    """Row "without the notify, an HL take-off shows HL active but the motors stay at 0"."""
    raw(pilot, 0)
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(1.8)
    assert pilot.info & HL_BIT
    assert pilot.motors_off()
    notify(pilot)
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(3.0)
    assert height(pilot) > 0.3


def test_raw_thrust_limits(pilot: Pilot) -> None:
    """Row "Below 1000 becomes 0, above 60000 is clipped to 60000"."""
    pilot.unlock()
    pilot.sim.set_pose((0, 0, 0.5), hold=True)
    for sent, flown in ((999, 0), (1000, 1000), (30000, 30000), (60000, 60000), (65535, 60000)):
        pilot.stream(0.1, lambda sent=sent: raw(pilot, sent))
        assert pilot.now("stabilizer.thrust") == flown
    pilot.sim.let_go()


# --- Thrust budget ----------------------------------------------------------------


def test_hover_command_at_42_g(pilot: Pilot) -> None:
    """Row "hover at 42 g is a command of about 56,200 of 65,535" (fresh battery)."""
    pilot.sim.set_battery(4.2)
    pilot.take_off(0.8, settle_s=2.0)
    values = [v for _, v in pilot.log("stabilizer.thrust", pilot.t_s - 1.0)]
    assert sum(values) / len(values) == pytest.approx(56_200, rel=0.01)


def test_raw_burst_gains_little(pilot: Pilot) -> None:
    """Row "The largest raw thrust: a 0.5 s burst gained 5.8 cm and 0.25 m/s"."""
    pilot.take_off(0.8)
    pilot.sim.set_battery(4.2)
    pilot.stream(4.0, lambda: pilot.hold(0.8))  # the compensation has met the change
    before_m = height(pilot)
    pilot.stream(0.5, lambda: raw(pilot, 60000))
    assert height(pilot) - before_m == pytest.approx(0.058, abs=0.01)
    assert pilot.sim.truth()["velocity_mps"][2] == pytest.approx(0.25, abs=0.02)


def test_position_controller_pushes_harder_than_raw(pilot: Pilot) -> None:
    """Row "The onboard position controller can command 65,535"."""
    pilot.fresh(no_target=True)
    pilot.fly_to(1.6, 0.5)
    pilot.stream(3.0, lambda: pilot.hold(3.0))
    pressed_n = pilot.sim.truth()["ceiling_force_n"]
    assert pilot.now("stabilizer.thrust") == pytest.approx(65_535, abs=1)
    pilot.stream(1.0, lambda: raw(pilot, 60000))
    assert 0.0 < pilot.sim.truth()["ceiling_force_n"] < pressed_n


# --- Setpoint modes ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass_kg", "mode", "lowest_m", "within_m"),
    [
        (0.042, "hover", 0.47, 0.025),
        (0.030, "hover", 0.74, 0.01),
        (0.042, "zdistance", 0.45, 0.045),
    ],
)
def test_position_to_another_mode_dips(
    pilot: Pilot, mass_kg: float, mode: str, lowest_m: float, within_m: float
) -> None:
    """Rows "position -> hover dips to 0.47 m" at 42 g, 0.74 m at 30 g; "-> zdistance 0.45 m"."""
    pilot.fresh(mass_kg=mass_kg)
    pilot.fly_to(0.8, 4.0)
    send = getattr(pilot.cf.commander, f"send_{mode}_setpoint")
    assert lowest_after(pilot, 3.0, lambda: send(0, 0, 0, 0.8)) == pytest.approx(
        lowest_m, abs=within_m
    )


def test_hover_to_velocity_falls_to_the_floor(pilot: Pilot) -> None:
    """Row "hover -> velocity_world(0) falls to the floor"."""
    pilot.take_off(0.8)
    pilot.stream(6.0, lambda: pilot.cf.commander.send_hover_setpoint(0, 0, 0, 0.8))
    assert height(pilot) > 0.7
    pilot.stream(4.0, lambda: pilot.cf.commander.send_velocity_world_setpoint(0, 0, 0, 0))
    assert height(pilot) < 0.05


def test_hl_to_position_does_not_dip(pilot: Pilot) -> None:
    """Row "HL -> position does not dip"."""
    pilot.take_off(0.8)
    assert lowest_after(pilot, 4.0, lambda: pilot.hold(0.8)) > 0.75
    assert pilot.info == LOW_LEVEL


@pytest.mark.parametrize(("mass_kg", "lift_s"), [(0.042, 1.5), (0.030, 0.75)])
def test_take_off_lags_behind_its_plan(pilot: Pilot, mass_kg: float, lift_s: float) -> None:
    """Row "HL take-off to 0.5 m in 2 s": first lift at +1.5 s (30 g: 0.75 s)."""
    pilot.fresh(mass_kg=mass_kg)
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    assert pilot.until(lambda t: t["position_m"][2] > 0.017, 3.0) == pytest.approx(lift_s, abs=0.17)


def test_finished_is_by_the_clock(pilot: Pilot) -> None:
    """Row "0.23 m at 2.0 s; finished is by the clock, not by height"."""
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(2.04)
    assert height(pilot) == pytest.approx(0.25, abs=0.02)
    assert pilot.info == 0x031E


# --- Signs and units --------------------------------------------------------------


def test_position_setpoint_axes(pilot: Pilot) -> None:
    """Row "position setpoint x y z yaw: m, degrees, counter-clockwise positive"."""
    pilot.fly_to(0.8)
    pilot.stream(5.0, lambda: pilot.cf.commander.send_position_setpoint(0.3, -0.2, 0.8, 40))
    truth = pilot.sim.truth()
    assert truth["position_m"] == pytest.approx((0.3, -0.2, 0.8), abs=0.06)
    assert math.degrees(truth["rpy_rad"][2]) == pytest.approx(40, abs=3)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(40, abs=3)


def test_hover_setpoint_is_in_body_axes(pilot: Pilot) -> None:
    """Row "hover setpoint vx vy: body axes, +x forward, +y left; yaw rate ccw positive"."""
    hover = pilot.cf.commander.send_hover_setpoint
    pilot.fresh(mass_kg=0.030)
    pilot.take_off(0.8)
    pilot.stream(3.0, lambda: hover(0, 0, 30, 0.8))
    assert pilot.now("stateEstimate.yaw") == pytest.approx(80, abs=15)
    x0, y0, _ = pilot.sim.truth()["position_m"]
    pilot.stream(2.0, lambda: hover(0.2, 0, 0, 0.8))  # forward: world +y by now
    x1, y1, _ = pilot.sim.truth()["position_m"]
    assert y1 - y0 > 0.2
    assert abs(x1 - x0) < 0.15
    pilot.stream(2.0, lambda: hover(0, 0.2, 0, 0.8))  # left: world -x
    assert pilot.sim.truth()["position_m"][0] - x1 < -0.2


def test_raw_yaw_rate_is_clockwise(pilot: Pilot) -> None:
    """Row "send_setpoint yawrate clockwise positive (+60 for 1 s gave -48 deg)"."""
    pilot.fresh(mass_kg=0.030)
    pilot.fly_to(0.8)
    pilot.stream(1.0, lambda: pilot.cf.commander.send_setpoint(0, 0, 60, 40000))
    assert pilot.now("stateEstimate.yaw") == pytest.approx(-48, abs=2)


@pytest.mark.parametrize(
    ("angle", "roll_pitch", "estimated_deg", "axis", "sign"),
    [("pitch", (0, 10), -9.6, 0, 1), ("roll", (10, 0), 9.6, 1, -1)],
)
def test_raw_attitude_and_the_estimates_sign(
    pilot: Pilot,
    angle: str,
    roll_pitch: tuple[int, int],
    estimated_deg: float,
    axis: int,
    sign: int,
) -> None:
    """Rows "pitch +10: estimated pitch -9.6 (nose down), moves +x"; "roll +10 moves -y"."""
    pilot.fly_to(1.0)
    before = pilot.sim.truth()["position_m"]
    # The attitude loop's integral overshoots by half a degree later on.
    pilot.stream(0.36, lambda: pilot.cf.commander.send_setpoint(*roll_pitch, 0, 58000))
    truth = pilot.sim.truth()
    moved = [sign * (b - a) for a, b in zip(before, truth["position_m"], strict=True)]
    assert pilot.now(f"stateEstimate.{angle}") == pytest.approx(estimated_deg, abs=0.5)
    # Nose down is positive inside, as is a roll to the right.
    assert math.degrees(truth["rpy_rad"][1 - axis]) == pytest.approx(9.6, abs=0.5)
    assert moved[axis] > 0.03
    assert abs(moved[1 - axis]) < 0.03


def test_go_to_yaw_in_radians_and_relative_in_world_axes(pilot: Pilot) -> None:
    """Row "HL go_to yaw radians; relative=True offsets in world axes"."""
    pilot.fresh(mass_kg=0.030)
    pilot.take_off(0.8)
    pilot.cf.high_level_commander.go_to(0, 0, 0.8, math.pi / 2, 3.0)
    pilot.advance(5.0)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(90, abs=5)
    before = pilot.sim.truth()["position_m"]
    pilot.cf.high_level_commander.go_to(0.3, 0.0, 0.0, 0.0, 2.0, relative=True)
    pilot.advance(4.0)
    after = pilot.sim.truth()["position_m"]
    assert after[0] - before[0] == pytest.approx(0.3, abs=0.04)  # not along the nose (+y)
    assert after[1] - before[1] == pytest.approx(0.0, abs=0.04)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(90, abs=5)


# --- Battery and the floor to beat ------------------------------------------------


@pytest.mark.parametrize(("rest_v", "low"), [(3.30, False), (3.15, True), (2.95, True)])
def test_low_battery(pilot: Pilot, rest_v: float, low: bool) -> None:
    """Row "Battery: low 3.2 V, critical 3.0 V, 5 s delay; pm.state 3 = low power"."""
    pilot.sim.set_battery(rest_v)
    since_s = pilot.t_s
    pilot.advance(7.0)
    assert pilot.now("pm.vbat") == pytest.approx(rest_v, abs=0.05)
    reported = [t - since_s for t, v in pilot.log("pm.state", since_s) if v == 3]
    assert bool(reported) == low
    if low:
        assert 4.5 < reported[0] < 6.0


def test_a_flying_battery_sags_and_recovers(pilot: Pilot) -> None:
    """Row "Battery": the voltage sags under load and comes back at rest."""
    pilot.fly_to(0.5, 0.5)
    loaded_v = pilot.now("pm.vbat")
    pilot.cf.commander.send_stop_setpoint()
    notify(pilot)
    pilot.advance(3.0)
    assert pilot.now("pm.vbat") > loaded_v + 0.2


def test_the_minimal_perch(pilot: Pilot) -> None:
    """Row "A floor to beat": pressing by position perches, ready 3 s after stop + notify."""
    pilot.perch()
    assert pilot.sim.truth()["gear_miss_m"] < 0.01
    pilot.cf.commander.send_stop_setpoint()
    notify(pilot)
    pilot.advance(3.0)
    assert pilot.info == READY
    assert pilot.sim.truth()["magnet_engaged"]
    assert pilot.sim.truth()["position_m"][2] > 2.1
