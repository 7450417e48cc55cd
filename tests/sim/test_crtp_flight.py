"""Thrust, setpoint modes, signs, battery, hand-over, take-off and landing: rows of
docs/firmware.md, seen through cflib.

Each docstring quotes its row; a number in it that is not the one asserted was measured
on the real firmware, and the tolerance is what the model misses it by at most.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from tests.helpers.crtp_rig import (
    HL_BIT,
    HL_DONE,
    LOCKED_BIT,
    LOW_LEVEL,
    READY,
    WEIGHT_N,
    Pilot,
    height,
    height_at,
    heights,
    notify,
    off,
    raw,
)

PACKET_S = 0.004  # a silence that swallows what is sent at its start
LIFTED_M = 0.022  # 1 cm over the floor


def lose(pilot: Pilot, send: Callable[[], None]) -> None:
    """One packet (or one burst of them) that never arrives."""
    pilot.sim.silence_link(PACKET_S)
    send()
    pilot.advance(0.01)


def land(pilot: Pilot, height_m: float, duration_s: float) -> None:
    """As `perchctl` lands: the heading is kept."""
    pilot.cf.high_level_commander.land(height_m, duration_s, yaw=None)


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


def test_the_thrust_budget(pilot: Pilot) -> None:
    """Rows "hover at 42 g is a command of about 56,200 of 65,535" (fresh battery) and "The largest
    raw thrust: a 0.5 s burst gained 5.8 cm and 0.25 m/s"."""
    pilot.take_off(0.8)
    pilot.sim.set_rest_v(4.2)
    pilot.stream(4.0, lambda: pilot.hold(0.8))  # the compensation has met the change
    values = [v for _, v in pilot.log("stabilizer.thrust", pilot.t_s - 1.0)]
    assert sum(values) / len(values) == pytest.approx(56_200, rel=0.01)
    before_m = height(pilot)
    pilot.stream(0.5, lambda: raw(pilot, 60000))
    assert height(pilot) - before_m == pytest.approx(0.058, abs=0.01)
    assert pilot.sim.truth()["velocity_mps"][2] == pytest.approx(0.25, abs=0.02)


# --- Setpoint modes ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("mass_kg", "mode", "lowest_m", "within_m"),
    [
        (0.042, "hover", 0.47, 0.025),
        pytest.param(0.030, "hover", 0.74, 0.01, marks=pytest.mark.long),
        pytest.param(0.042, "zdistance", 0.45, 0.045, marks=pytest.mark.long),
        (0.042, "position", 0.8, 0.05),
    ],
)
def test_position_to_another_mode_dips(
    pilot: Pilot, mass_kg: float, mode: str, lowest_m: float, within_m: float
) -> None:
    """Rows "position -> hover dips to 0.47 m" at 42 g, 0.74 m at 30 g; "-> zdistance 0.45 m"; "HL
    -> position does not dip"."""
    pilot.fresh(mass_kg=mass_kg)
    since_s = 0.0
    if mode == "position":
        pilot.take_off(0.8)
        since_s = pilot.t_s
        pilot.stream(4.0, lambda: pilot.hold(0.8))
        assert pilot.info == LOW_LEVEL
    else:
        pilot.fly_to(0.8, 4.0)
        since_s = pilot.t_s
        send = getattr(pilot.cf.commander, f"send_{mode}_setpoint")
        pilot.stream(3.0, lambda: send(0, 0, 0, 0.8))
    lowest = min(z for _, z in heights(pilot, since_s))
    assert lowest == pytest.approx(lowest_m, abs=within_m)


@pytest.mark.long
def test_hover_to_velocity_falls_to_the_floor(pilot: Pilot) -> None:
    """Row "hover -> velocity_world(0) falls to the floor"."""
    pilot.take_off(0.8)
    pilot.stream(6.0, lambda: pilot.cf.commander.send_hover_setpoint(0, 0, 0, 0.8))
    assert height(pilot) > 0.7
    pilot.stream(4.0, lambda: pilot.cf.commander.send_velocity_world_setpoint(0, 0, 0, 0))
    assert height(pilot) < 0.05


@pytest.mark.parametrize(
    ("mass_kg", "lift_s"), [(0.042, 1.5), pytest.param(0.030, 0.75, marks=pytest.mark.long)]
)
def test_take_off_lags_behind_its_plan(pilot: Pilot, mass_kg: float, lift_s: float) -> None:
    """Rows "HL take-off to 0.5 m in 2 s": first lift at +1.5 s (30 g: 0.75 s); "0.23 m at 2.0 s;
    finished is by the clock, not by height"."""
    pilot.fresh(mass_kg=mass_kg)
    pilot.unlock()
    start_s = pilot.t_s
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    assert pilot.until(lambda t: t["position_m"][2] > 0.017, 3.0) == pytest.approx(lift_s, abs=0.17)
    pilot.advance(start_s + 2.04 - pilot.t_s)
    assert pilot.info == HL_DONE
    if mass_kg == 0.042:
        assert height(pilot) == pytest.approx(0.25, abs=0.02)


# --- Signs and units --------------------------------------------------------------


@pytest.mark.long
def test_position_setpoint_axes(pilot: Pilot) -> None:
    """Row "position setpoint x y z yaw: m, degrees, counter-clockwise positive"."""
    pilot.fly_to(0.8)
    pilot.stream(5.0, lambda: pilot.cf.commander.send_position_setpoint(0.3, -0.2, 0.8, 40))
    truth = pilot.sim.truth()
    assert truth["position_m"] == pytest.approx((0.3, -0.2, 0.8), abs=0.06)
    assert math.degrees(truth["rpy_rad"][2]) == pytest.approx(40, abs=3)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(40, abs=3)


@pytest.mark.long
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


@pytest.mark.long
def test_raw_yaw_rate_is_clockwise(pilot: Pilot) -> None:
    """Row "send_setpoint yawrate clockwise positive (+60 for 1 s gave -48 deg)"."""
    pilot.fresh(mass_kg=0.030)
    pilot.fly_to(0.8)
    pilot.stream(1.0, lambda: pilot.cf.commander.send_setpoint(0, 0, 60, 40000))
    assert pilot.now("stateEstimate.yaw") == pytest.approx(-48, abs=2)


@pytest.mark.parametrize(
    ("angle", "axis", "sign"),
    [("pitch", 0, 1), pytest.param("roll", 1, -1, marks=pytest.mark.long)],
)
def test_raw_attitude_and_the_estimates_sign(
    pilot: Pilot, angle: str, axis: int, sign: int
) -> None:
    """Rows "pitch +10: estimated pitch -9.6 (nose down), moves +x"; "roll +10 moves -y"."""
    pilot.fly_to(1.0)
    before = pilot.sim.truth()["position_m"]
    roll, pitch = (0, 10) if angle == "pitch" else (10, 0)
    # The attitude loop's integral overshoots by half a degree later on.
    pilot.stream(0.36, lambda: pilot.cf.commander.send_setpoint(roll, pitch, 0, 58000))
    truth = pilot.sim.truth()
    moved = [sign * (b - a) for a, b in zip(before, truth["position_m"], strict=True)]
    assert pilot.now(f"stateEstimate.{angle}") == pytest.approx(-sign * 9.6, abs=0.5)
    # Nose down is positive inside, as is a roll to the right.
    assert math.degrees(truth["rpy_rad"][1 - axis]) == pytest.approx(9.6, abs=0.5)
    assert moved[axis] > 0.03
    assert abs(moved[1 - axis]) < 0.03


@pytest.mark.long
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


@pytest.mark.parametrize(
    ("rest_v", "low"),
    [(3.30, False), (3.15, True), pytest.param(2.95, True, marks=pytest.mark.long)],
)
def test_low_battery(pilot: Pilot, rest_v: float, low: bool) -> None:
    """Row "Battery: low 3.2 V, critical 3.0 V, 5 s delay; pm.state 3 = low power"."""
    pilot.sim.set_rest_v(rest_v)
    since_s = pilot.t_s
    pilot.advance(7.0)
    assert pilot.now("pm.vbat") == pytest.approx(rest_v, abs=0.05)
    reported = [t - since_s for t, v in pilot.log("pm.state", since_s) if v == 3]
    assert bool(reported) == low
    if low:
        assert 4.5 < reported[0] < 6.0


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


# --- The hand-over to the high-level commander ------------------------------------


def test_notify_alone_cuts_the_motors(pilot: Pilot) -> None:
    """Row "send_notify_setpoint_stop alone": off within 2 ms, 1.59 -> 1.09 m in 0.4 s."""
    pilot.take_off(1.5)
    pilot.stream(3.0, lambda: pilot.hold(1.5), 0.1)
    start_m = height(pilot)
    assert start_m == pytest.approx(1.59, abs=0.03)
    notify(pilot)
    assert pilot.until(off, 0.1) <= 0.002
    pilot.advance(0.4)
    assert pilot.motors_off()
    assert start_m - height(pilot) == pytest.approx(0.50, abs=0.1)
    land(pilot, 0.0, 3.0)
    pilot.advance(0.02)
    assert not pilot.motors_off()


@pytest.mark.long
def test_the_order_of_land_and_notify_does_not_matter(pilot: Pilot) -> None:
    """Row "`land` then `notify` flies exactly as `notify` then `land` does (same curve)"."""
    curves = []
    for notify_first in (False, True):
        pilot.fresh()
        pilot.fly_to(0.8, 1.0)
        since_s = pilot.t_s
        if notify_first:
            notify(pilot)
        land(pilot, 0.0, 3.0)
        if not notify_first:
            notify(pilot)
        pilot.advance(3.0)
        curves.append([z for _, z in heights(pilot, since_s)])
    assert curves[0] == pytest.approx(curves[1], abs=0.005)
    assert curves[0][0] > 0.75
    assert curves[0][-1] < 0.05


@pytest.mark.parametrize("repeated", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_lost_notify_after_land_can_be_repeated(pilot: Pilot, repeated: bool) -> None:
    """Row "with its second packet lost the vehicle still has the 2 s of the setpoint watchdog"."""
    pilot.fly_to(0.8, 1.0)
    last_s = pilot.t_s
    land(pilot, 0.0, 4.0)
    pilot.advance(0.01)
    lose(pilot, lambda: notify(pilot))
    pilot.advance(1.4)
    assert pilot.info & HL_BIT
    assert height(pilot) > 0.15
    if repeated:
        land(pilot, 0.0, 4.0)  # refused: it lands already, but the pair is harmless
        notify(pilot)
        pilot.advance(6.0)
        assert pilot.info == READY
        assert height(pilot) < 0.05
    else:
        pilot.until(off, 2.0)
        assert pilot.t_s - last_s == pytest.approx(2.0, abs=0.1)
        pilot.advance(0.2)
        assert pilot.info & LOCKED_BIT


def test_notify_before_land_with_land_lost_is_a_crash(pilot: Pilot) -> None:
    """Row "So `notify` then `land` with the second packet lost is a crash"."""
    pilot.fly_to(0.8, 1.0)
    since_s = pilot.t_s
    notify(pilot)
    pilot.advance(0.01)
    lose(pilot, lambda: land(pilot, 0.0, 3.0))
    pilot.advance(0.6)
    assert height(pilot) < 0.05
    assert min(v for _, v in pilot.log("stateEstimate.vz", since_s)) < -3.0


@pytest.mark.parametrize(
    ("yaw", "end_deg"),
    [pytest.param(0.0, (0, -2), marks=pytest.mark.long), (None, (90, 92))],
)
def test_orders_turn_to_yaw_0_unless_it_is_to_be_kept(
    pilot: Pilot, yaw: float | None, end_deg: tuple[float, float]
) -> None:
    """Row "`takeoff`/`land` without `yaw=None` turn the vehicle to yaw 0": a landing of 3 s from
    +92 to -2 deg; with it 91 -> 92 deg."""
    pilot.sim.set_pose((0.0, 0.0, 0.012), (0.0, 0.0, math.radians(90)))
    pilot.advance(12.0)  # the estimate is drawn to the truth slowly
    pilot.cf.high_level_commander.takeoff(0.8, 2.0, yaw=yaw)
    pilot.advance(4.0)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(end_deg[0], abs=4)
    turn = pilot.cf.commander.send_position_setpoint
    pilot.stream(4.0, lambda: turn(0, 0, 0.8, 90), 0.05)
    pilot.cf.high_level_commander.land(0.0, 3.0, yaw=yaw)
    notify(pilot)
    pilot.advance(2.98)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(end_deg[1], abs=3)


# --- Landing ----------------------------------------------------------------------


@pytest.mark.long
def test_landing_is_hard(pilot: Pilot) -> None:
    """Row "HL land from 1.05 m in 3.1 s": peak descent 0.85 m/s, still 0.55 m/s at touchdown.

    The trajectory ends 0.05 m below the floor."""
    pilot.take_off(1.05)
    pilot.stream(12.0, lambda: pilot.hold(1.05), 0.1)
    assert height(pilot) == pytest.approx(1.05, abs=0.015)
    since_s = pilot.t_s
    land(pilot, -0.05, 3.1)
    notify(pilot)
    touched_mps = 0.0
    while not (truth := pilot.sim.truth())["floor_contact"]:
        touched_mps = -truth["velocity_mps"][2]
        pilot.advance(0.002)
    descent_mps = -min(v for _, v in pilot.log("stateEstimate.vz", since_s))
    assert descent_mps == pytest.approx(0.85, abs=0.04)
    assert touched_mps == pytest.approx(0.55, abs=0.03)


@pytest.mark.long
def test_a_landing_from_the_ceiling_runs_by_its_clock(pilot: Pilot) -> None:
    """Row "the quintic runs by its clock while the vehicle stays up": then it falls, 5.8 m/s."""
    pilot.fresh(magnet_force_n=0.73 * WEIGHT_N, ceiling_z_m=2.05)
    pilot.perch()
    top_m = height(pilot)
    land(pilot, -0.05, 5.0)
    notify(pilot)
    pilot.advance(4.96)
    assert height(pilot) > top_m - 0.005
    assert pilot.info & HL_BIT
    since_s = pilot.t_s
    pilot.advance(0.06)
    assert pilot.motors_off()
    pilot.advance(1.0)
    assert height(pilot) < 0.05
    fastest_mps = -min(v for _, v in pilot.log("stateEstimate.vz", since_s))
    assert fastest_mps == pytest.approx(5.8, abs=0.3)


# --- Take-off ---------------------------------------------------------------------


def climb(pilot: Pilot, seconds: float) -> float:
    """Position setpoints from the ground, z = 0.3 m/s x t up to 0.5 m; when it began."""
    pilot.unlock()
    pilot.advance(0.02)
    since_s = pilot.t_s
    pilot.stream(seconds, lambda: pilot.hold(min(0.5, 0.3 * (pilot.t_s - since_s))))
    return since_s


@pytest.mark.parametrize(
    ("mass_kg", "lift_s", "heights_m", "peak_m"),
    [
        (0.042, 1.4, {2.2: 0.38, 2.8: 0.50}, 0.58),
        pytest.param(0.030, 0.6, {2.2: 0.50}, 0.55, marks=pytest.mark.long),
    ],
)
def test_take_off_by_position_setpoints(
    pilot: Pilot, mass_kg: float, lift_s: float, heights_m: dict[float, float], peak_m: float
) -> None:
    """Row "Take-off by position setpoints from the ground works", at 42 g and at 30 g."""
    pilot.fresh(mass_kg=mass_kg)
    since_s = climb(pilot, 6.0)
    curve = heights(pilot, since_s)
    assert next(t for t, z in curve if z > LIFTED_M) == pytest.approx(lift_s, abs=0.1)
    for t_s, height_m in heights_m.items():
        assert height_at(curve, t_s) == pytest.approx(height_m, abs=0.02)
    assert max(z for _, z in curve) == pytest.approx(peak_m, abs=0.015)
    thrust = [v for _, v in pilot.log("stabilizer.thrust", since_s + 0.03)]
    assert min(thrust) > 30_000  # motors at once, and no mode change on the way


def test_a_take_off_whose_stream_falls_silent_stays_down(pilot: Pilot) -> None:
    """Row "silent 0.6 s after its start: never left the floor"; cut and lock within 2 s."""
    since_s = climb(pilot, 0.6)
    last_s = pilot.t_s - 0.02
    pilot.until(off, 3.0)
    assert pilot.t_s - last_s == pytest.approx(2.02, abs=0.06)
    pilot.advance(0.2)
    assert pilot.info & LOCKED_BIT
    assert max(z for _, z in heights(pilot, since_s)) < LIFTED_M


@pytest.mark.long
def test_an_ordered_take_off_needs_no_link(pilot: Pilot) -> None:
    """Rows "HL take-off with the link cut 0.25 s after the order": hovers at 0.5 m, for 35 s, and
    "HL hover never times out"."""
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(0.25)
    pilot.sim.silence_link(35.0)
    for _ in range(7):
        pilot.sim.advance(5.0)
        assert height(pilot) == pytest.approx(0.5, abs=0.1)
    pilot.t_s = round(pilot.t_s + 35.0, 6)
    assert height(pilot) == pytest.approx(0.5, abs=0.03)
    assert pilot.sim.truth()["supervisor_info"] == HL_DONE


@pytest.mark.parametrize(
    ("mass_kg", "start_m", "dip_m", "end_m"),
    [
        (0.042, 0.58, 0.17, 0.30),
        pytest.param(0.030, 0.53, 0.44, 0.45, marks=pytest.mark.long),
    ],
)
def test_the_level_out_dips(
    pilot: Pilot, mass_kg: float, start_m: float, dip_m: float, end_m: float
) -> None:
    """Row "The level-out resets the PID too": 0.58 -> 0.17 -> 0.30 m, cut at 2.0 s; 30 g 0.44 m."""
    pilot.fresh(mass_kg=mass_kg)
    climb(pilot, 5.0)
    assert height(pilot) == pytest.approx(start_m, abs=0.015)
    last_s = pilot.t_s - 0.02
    pilot.until(off, 3.0)
    assert pilot.t_s - last_s == pytest.approx(2.02, abs=0.06)
    curve = [z for t, z in heights(pilot, last_s) if t < 2.0]
    assert min(curve) == pytest.approx(dip_m, abs=0.02)
    assert curve[-1] == pytest.approx(end_m, abs=0.02)


# --- Losses -----------------------------------------------------------------------


@pytest.mark.parametrize("repeats", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_lost_notify_after_the_stop_locks_unless_repeated(pilot: Pilot, repeats: int) -> None:
    """Row "one lost `notify` after the stop locked a vehicle that hung well (2 s after)"."""
    pilot.perch()
    since_s = pilot.t_s
    pilot.cf.commander.send_stop_setpoint()
    pilot.advance(0.01)
    lose(pilot, lambda: notify(pilot))
    pilot.advance(1.5)
    for _ in range(repeats):
        pilot.cf.commander.send_stop_setpoint()
        notify(pilot)
    pilot.advance(3.0)
    locked = [t for t, v in pilot.log("supervisor.info", since_s) if int(v) & LOCKED_BIT]
    assert pilot.sim.truth()["magnet_engaged"]
    if repeats:
        assert not locked
        assert pilot.info == READY
    else:
        assert locked[0] - since_s == pytest.approx(2.06, abs=0.07)
