"""A vehicle that does not arm itself (docs/firmware.md, "Arming"), through cflib's `udp://`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from perchctl.link.firmware import read_device_type
from perchctl.sim.airframe import CRAZYFLIE_21_BRUSHLESS
from tests.helpers.crtp_rig import (
    ARMED_BIT,
    CAN_FLY_BIT,
    FLYING_BIT,
    LOCKED_BIT,
    Pilot,
    height,
    notify,
    raw,
)

WAITS, READY = 0x0201, 0x020A  # to be armed; armed, and ready to fly
IDLE_PWM = 7000
SPIN_UP_S, GIVES_UP_S = CRAZYFLIE_21_BRUSHLESS.spin_up_s, 2.0
PREFLIGHT_S, LANDED_S = 30.0, 3.0
BLOCKED = replace(CRAZYFLIE_21_BRUSHLESS, spin_up_s=60.0)


@pytest.fixture
def brushless(shared_pilot: Pilot) -> Pilot:
    return shared_pilot.fresh(airframe=CRAZYFLIE_21_BRUSHLESS)


def motors(pilot: Pilot) -> tuple[int, ...]:
    return tuple(pilot.sim.truth()["motors"])


def arm(pilot: Pilot, do_arm: bool = True) -> None:
    pilot.cf.supervisor.send_arming_request(do_arm)
    pilot.advance(0.02)


def armed(pilot: Pilot) -> Pilot:
    arm(pilot)
    pilot.advance(SPIN_UP_S + 0.2)
    assert pilot.info == READY
    return pilot


def test_it_waits_to_be_armed_with_its_motors_still(brushless: Pilot) -> None:
    brushless.advance(2.0)
    assert brushless.info == WAITS
    assert brushless.motors_off()
    brushless.unlock()
    brushless.stream(0.5, lambda: brushless.hold(0.5))
    assert brushless.motors_off()
    assert brushless.info == WAITS


def test_armed_its_propellers_idle_on_the_ground_until_it_is_disarmed(brushless: Pilot) -> None:
    arm(brushless)
    brushless.advance(0.1)
    assert brushless.info & ARMED_BIT
    assert not brushless.info & CAN_FLY_BIT  # its motors start
    assert motors(brushless) == (IDLE_PWM,) * 4
    brushless.advance(SPIN_UP_S)
    assert brushless.info == READY  # and does not count as flying
    assert motors(brushless) == (IDLE_PWM,) * 4
    assert height(brushless) < 0.05
    arm(brushless, False)
    brushless.advance(0.2)
    assert brushless.info == WAITS
    assert brushless.motors_off()


def test_after_30_s_on_the_ground_it_disarms_and_stays_so(brushless: Pilot) -> None:
    armed(brushless)
    brushless.advance(PREFLIGHT_S - SPIN_UP_S - 0.5)
    assert brushless.info == READY
    brushless.advance(2.0)
    assert brushless.info == WAITS
    assert brushless.motors_off()


def test_motors_that_do_not_start_are_given_up_after_2_s(shared_pilot: Pilot) -> None:
    pilot = shared_pilot.fresh(airframe=BLOCKED)
    arm(pilot)
    pilot.advance(GIVES_UP_S - 0.2)
    assert pilot.info & ARMED_BIT
    pilot.advance(0.4)
    assert pilot.info == WAITS
    assert pilot.motors_off()


def test_flown_and_stopped_its_propellers_idle_until_it_disarms_itself(brushless: Pilot) -> None:
    """A stop is no standstill: 2 s of the flying bit, and 3 s after the landing."""
    armed(brushless)
    brushless.fly_to(0.5, 1.0)
    assert height(brushless) == pytest.approx(0.5, abs=0.1)
    assert brushless.info & FLYING_BIT
    brushless.stream(4.0, lambda: brushless.hold(-0.1))
    brushless.cf.commander.send_stop_setpoint()
    notify(brushless)
    brushless.advance(1.0)
    assert motors(brushless) == (IDLE_PWM,) * 4
    brushless.advance(1.5)
    assert brushless.info == READY  # the motors were above idle 2 s ago
    brushless.advance(LANDED_S)
    assert brushless.info == WAITS
    assert brushless.motors_off()


def test_disarmed_in_flight_it_falls_unlocked_and_is_not_armed_again(brushless: Pilot) -> None:
    armed(brushless)
    brushless.fly_to(0.4, 0.5)
    arm(brushless, False)
    brushless.advance(0.1)
    assert brushless.motors_off()
    brushless.advance(2.0)
    assert not brushless.info & (LOCKED_BIT | ARMED_BIT)


def test_the_least_raw_thrust_leaves_the_propellers_idling(brushless: Pilot) -> None:
    armed(brushless)
    brushless.unlock()
    brushless.stream(0.5, lambda: raw(brushless, 1000))
    assert motors(brushless) == (IDLE_PWM,) * 4


@pytest.mark.parametrize("airframe", [{}, {"airframe": CRAZYFLIE_21_BRUSHLESS}])
def test_it_names_its_airframe(airframe: dict[str, Any], shared_pilot: Pilot) -> None:
    pilot = shared_pilot.fresh(**airframe)
    name = airframe["airframe"].device_type if airframe else "Crazyflie 2.1"
    assert pilot.ask(13, 1, b"\x02") == b"\x02" + name.encode() + b"\0"
    assert read_device_type(pilot.cf) == name
