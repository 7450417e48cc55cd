"""docs/firmware.md, "Setpoint modes" and "Contact, tumble, crash", row by row through `udp://`.

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
    READY,
    WEIGHT_N,
    Pilot,
    height,
    height_at,
    heights,
    notify,
    off,
)

PACKET_S = 0.004  # a silence that swallows what is sent at its start
LIFTED_M = 0.022  # 1 cm over the floor
PRESSED_M = 2.5  # a setpoint above the ceiling at 2.2 m


def lose(pilot: Pilot, send: Callable[[], None]) -> None:
    """One packet (or one burst of them) that never arrives."""
    pilot.sim.silence(PACKET_S)
    send()
    pilot.advance(0.01)


def land(pilot: Pilot, height_m: float, duration_s: float) -> None:
    """As `perchctl` lands: the heading is kept."""
    pilot.cf.high_level_commander.land(height_m, duration_s, yaw=None)


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


def landing_curve(pilot: Pilot, *orders: Callable[[Pilot], None]) -> list[float]:
    pilot.fresh()
    pilot.fly_to(0.8, 1.0)
    since_s = pilot.t_s
    for order in orders:
        order(pilot)
    pilot.advance(3.0)
    return [z for _, z in heights(pilot, since_s)]


def test_the_order_of_land_and_notify_does_not_matter(pilot: Pilot) -> None:
    """Row "`land` then `notify` flies exactly as `notify` then `land` does (same curve)"."""

    def order(pilot: Pilot) -> None:
        land(pilot, 0.0, 3.0)

    first = landing_curve(pilot, order, notify)
    second = landing_curve(pilot, notify, order)
    assert first == pytest.approx(second, abs=0.005)
    assert first[0] > 0.75
    assert first[-1] < 0.05


@pytest.mark.parametrize("repeated", [True, False])
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
    if not repeated:
        pilot.until(off, 2.0)
        assert pilot.t_s - last_s == pytest.approx(2.0, abs=0.1)
        pilot.advance(0.2)
        assert pilot.info & LOCKED_BIT
        return
    land(pilot, 0.0, 4.0)  # refused: it lands already, but the pair is harmless
    notify(pilot)
    pilot.advance(6.0)
    assert pilot.info == READY
    assert height(pilot) < 0.05


def test_notify_before_land_with_land_lost_is_a_crash(pilot: Pilot) -> None:
    """Row "So `notify` then `land` with the second packet lost is a crash"."""
    pilot.fly_to(0.8, 1.0)
    since_s = pilot.t_s
    notify(pilot)
    pilot.advance(0.01)
    lose(pilot, lambda: land(pilot, 0.0, 3.0))
    pilot.advance(0.6)
    assert height(pilot) < 0.05
    fastest_mps = -min(v for _, v in pilot.log("stateEstimate.vz", since_s))
    assert fastest_mps > 3.0


@pytest.mark.parametrize(("yaw", "start_deg", "end_deg"), [(0.0, 92, -2), (None, 91, 92)])
def test_landing_turns_to_yaw_0_unless_it_is_to_be_kept(
    pilot: Pilot, yaw: float | None, start_deg: float, end_deg: float
) -> None:
    """Row "without `yaw=None` turn the vehicle to yaw 0": +92 -> -2 deg; with it 91 -> 92 deg."""
    pilot.fly_to(0.8, 1.0)
    pilot.stream(4.0, lambda: pilot.cf.commander.send_position_setpoint(0, 0, 0.8, 90), 0.05)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(start_deg, abs=2)
    pilot.cf.high_level_commander.land(0.0, 3.0, yaw=yaw)
    notify(pilot)
    pilot.advance(2.98)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(end_deg, abs=3)


def test_take_off_turns_to_yaw_0_unless_it_is_to_be_kept(pilot: Pilot) -> None:
    """Row "`takeoff`/`land` without `yaw=None` turn the vehicle to yaw 0 on the way"."""
    for yaw, end_deg in ((None, 60), (0.0, 0)):
        pilot.sim.set_pose((0.0, 0.0, 0.012), (0.0, 0.0, math.radians(60)))
        pilot.advance(12.0)  # the estimate is drawn to the truth slowly
        pilot.cf.high_level_commander.takeoff(0.5, 2.0, yaw=yaw)
        pilot.advance(4.0)
        assert pilot.now("stateEstimate.yaw") == pytest.approx(end_deg, abs=4)
        land(pilot, 0.0, 2.0)
        pilot.advance(8.0)


# --- Landing ----------------------------------------------------------------------


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
    [(0.042, 1.4, {2.2: 0.38, 2.8: 0.50}, 0.58), (0.030, 0.6, {2.2: 0.50}, 0.55)],
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


def test_an_ordered_take_off_needs_no_link(pilot: Pilot) -> None:
    """Row "HL take-off with the link cut 0.25 s after the order": hovers at 0.5 m, for 35 s."""
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(0.5, 2.0)
    pilot.advance(0.25)
    pilot.sim.silence(35.0)
    for _ in range(7):
        pilot.sim.advance(5.0)
        assert height(pilot) == pytest.approx(0.5, abs=0.1)
    pilot.t_s = round(pilot.t_s + 35.0, 6)
    assert height(pilot) == pytest.approx(0.5, abs=0.03)
    assert pilot.sim.truth()["supervisor_info"] == HL_DONE


@pytest.mark.parametrize(
    ("mass_kg", "start_m", "dip_m", "end_m"), [(0.042, 0.58, 0.17, 0.30), (0.030, 0.53, 0.44, 0.45)]
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


@pytest.mark.parametrize("repeats", [0, 1])
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
