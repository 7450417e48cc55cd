"""`CflibLink` on an unmodified cflib, against the simulated Crazyflie in real time: connected,
flown, left, and lost in flight (over a radio: `tests.link.test_radio`).

Waiting is always for the vehicle's own simulated time or state, and bounded.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tests.helpers.waiting import until

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound
from perchctl.link import CflibLink, ProbeLink, firmware
from perchctl.link.crtp import LAND_TIMES
from perchctl.link.protocol import LANDING_WAIT_S
from perchctl.mission import SentCommand
from perchctl.profile import LinkConfig
from perchctl.sim import Scenario, SimProcess
from perchctl.sim.airframe import CRAZYFLIE_21_BRUSHLESS
from perchctl.vehicle import (
    AIRFRAMES,
    ARMED,
    CAN_ARM,
    CAN_FLY,
    FLYING,
    FRESH_S,
    LOCKED,
    Arm,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    Telemetry,
    is_emergency_stopped,
    may_be_flying,
)
from tests.helpers.mission import AIRBORNE, READY, telemetry

CONFIG = LinkConfig(parameters={"stabilizer.estimator": 2})
LOW_CEILING = Scenario(mass_kg=0.036, ceiling_z_m=0.9)
BRUSHLESS = Scenario(mass_kg=0.044, ceiling_z_m=0.9, airframe=CRAZYFLIE_21_BRUSHLESS)
HIGH_LEVEL_PORT, SUPERVISOR_PORT = 8, 9
RAW_PORT = 3  # raw setpoints: attitude and thrust
COMMAND_PORTS = (RAW_PORT, 7, 8, 9)


def let_pass(sim: SimProcess, dt_s: float, meanwhile: Callable[[], None] = lambda: None) -> None:
    """Let simulated time pass."""
    end_s = sim.truth()["t_s"] + dt_s

    def over() -> bool:
        meanwhile()
        return bool(sim.truth()["t_s"] >= end_s)

    until(over)


def info(sim: SimProcess) -> int:
    return int(sim.truth()["supervisor_info"])


def motors_off(sim: SimProcess) -> bool:
    return max(sim.truth()["motors"]) == 0


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimProcess]:
    with pytest.MonkeyPatch.context() as patch, SimProcess.start(LOW_CEILING) as process:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        yield process


@contextmanager
def linked(
    sim: SimProcess, config: LinkConfig = CONFIG, landing_wait_s: float = LANDING_WAIT_S
) -> Iterator[CflibLink]:
    """A connection to a vehicle new on the floor; closed at the end if the test has not."""
    sim.replace_vehicle(LOW_CEILING)
    link = CflibLink(sim.uri, config, time.monotonic, landing_wait_s)
    until(lambda: info(sim) & CAN_FLY)
    link.connect()
    try:
        yield link
    finally:
        link.close()


def newest(link: CflibLink) -> Telemetry:
    samples: list[Telemetry] = until(link.telemetry)
    return samples[-1]


def cf(link: CflibLink) -> Any:
    """cflib's object behind an open link."""
    assert link.connection is not None
    return link.connection.cf


def commands_sent(link: CflibLink, sim: SimProcess) -> list[tuple[int, int]]:
    """Collects the port of each packet that commands the vehicle from now on, and the supervisor's
    bits when it goes out."""
    sent: list[tuple[int, int]] = []

    def note(packet: Any) -> None:
        if packet.port in COMMAND_PORTS:
            sent.append((packet.port, info(sim)))

    cf(link).packet_sent.add_callback(note)
    return sent


def told_by(link: CflibLink) -> list[SentCommand]:
    """Collects what the link sends of itself."""
    told: list[SentCommand] = []
    link.set_guard(lambda *_: None, told.append)
    return told


def take_off(link: CflibLink, sim: SimProcess) -> None:
    cf(link).high_level_commander.takeoff(0.4, 1.5)
    until(lambda: sim.truth()["position_m"][2] > 0.3)


# --- On the ground ----------------------------------------------------------------------------


def test_connecting_sets_parameters_and_idle_sends_nothing(sim: SimProcess) -> None:
    wanted = {"stabilizer.estimator": 1, "pid_rate.roll_kp": 190.5}
    with linked(sim, LinkConfig(parameters=wanted)) as link:
        assert {name: float(cf(link).param.get_value(name)) for name in wanted} == wanted
        assert link.problem(time.monotonic()) is None
        sent = commands_sent(link, sim)
        link.send(Idle())
        let_pass(sim, 0.2)
        assert sent == []


@pytest.mark.parametrize(
    ("name", "value", "error", "words"),
    [
        ("no.such", 1, NotFound, "no parameter no.such"),
        ("stabilizer.estimator", 2.5, InvalidValue, "stabilizer.estimator"),
    ],
)
def test_wrong_parameters_are_refused(
    sim: SimProcess, name: str, value: float, error: type[Exception], words: str
) -> None:
    config = LinkConfig(parameters={name: value})
    with pytest.raises(error, match=words), linked(sim, config):
        pass
    assert motors_off(sim)


def test_telemetry_is_si_right_handed_and_in_the_loop_s_time(sim: SimProcess) -> None:
    """Firmware facts, "Signs and units": the Crazyflie's pitch is nose up, ours nose down."""
    with linked(sim) as link:
        assert newest(link).has_bit(CAN_FLY)
        let_pass(sim, 0.5)
        times = [sample.t_s for sample in link.telemetry()]
        assert len(times) > 20
        assert times == sorted(times)
        assert max(times) <= time.monotonic()
        sim.set_pose((0.1, -0.2, 0.5), (0.15, 0.25, 0.6), hold=True)
        true = until(lambda: sim.truth())

        def arrived() -> bool:
            sample = newest(link)
            return (
                math.dist(sample.position_m, true["position_m"]) < 0.02
                # The estimate of a vehicle turned by hand follows slowly, but the right way.
                and 0.03 < sample.roll_rad < 0.18
                and 0.06 < sample.pitch_rad < 0.28
                and 0.12 < sample.yaw_rad < 0.65
            )

        until(arrived)
        sample = newest(link)
        assert sample.battery_v == pytest.approx(true["battery_v"], abs=0.02)
        assert sample.motor_duty == (0, 0, 0, 0)  # it stands still, which is not unknown
        assert sample.acc_z_g == pytest.approx(true["specific_force_mps2"][2] / 9.81, abs=0.1)


# --- In the air, and left ---------------------------------------------------------------------


def test_connecting_arms_nothing_and_closing_disarms(sim: SimProcess) -> None:
    """A vehicle that does not arm itself turns its propellers from its arming on."""
    sim.replace_vehicle(BRUSHLESS)
    until(lambda: info(sim) & CAN_ARM)
    link = CflibLink(sim.uri, CONFIG, time.monotonic)
    link.connect()
    sent = commands_sent(link, sim)
    let_pass(sim, 0.3)
    assert info(sim) & (CAN_ARM | ARMED) == CAN_ARM
    assert motors_off(sim)
    link.send(Arm(True))
    until(lambda: info(sim) & CAN_FLY)
    assert not motors_off(sim)
    link.close()
    assert info(sim) & (CAN_ARM | ARMED) == CAN_ARM
    assert motors_off(sim)
    assert {port for port, _ in sent} == {SUPERVISOR_PORT, RAW_PORT}  # and the farewell


@pytest.mark.parametrize(
    ("device_type", "words"),
    [
        ("Crazyflie Bolt", "is a Crazyflie Bolt: perchctl's"),
        ("Flapper (Bolt 1.1)", "is a Flapper"),
        ("Roadrunner 1.0", "is a Roadrunner 1.0"),
        ("", "does not report its airframe"),
        (None, "does not report"),
    ],
)
def test_another_airframe_is_not_taken_over(
    device_type: str | None, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(firmware, "read_device_type", lambda cf: device_type)
    with pytest.raises(ConnectionFailed, match=f"{re.escape(words)}.* or Crazyflie 2.1 Brushless"):
        firmware.check_airframe(None, "radio://0")


@pytest.mark.parametrize("device_type", AIRFRAMES)
def test_the_airframes_that_the_figures_are_made_for_are_flown(
    device_type: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(firmware, "read_device_type", lambda cf: device_type)
    firmware.check_airframe(None, "radio://0")


def test_a_bolt_is_refused_by_its_own_word_and_sent_nothing() -> None:
    with SimProcess.start(LOW_CEILING, link={"device_type": "Crazyflie Bolt"}) as sim:
        link = CflibLink(sim.uri, CONFIG, time.monotonic)
        with pytest.raises(ConnectionFailed, match="is a Crazyflie Bolt"):
            link.connect()
        assert link.connection is None
        probe = ProbeLink(sim.uri, CONFIG, time.monotonic)
        probe.connect()
        assert probe.device_type() == "Crazyflie Bolt"
        probe.close()


def test_a_driver_that_fails_once_has_lost_no_link(
    sim: SimProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    with linked(sim) as link:
        driver, times = cf(link).link, 2
        send_packet = driver.send_packet

        def send(packet: Any) -> None:
            nonlocal times
            if packet.port == HIGH_LEVEL_PORT and times:
                times -= 1
                raise OSError("no buffer space")
            send_packet(packet)

        monkeypatch.setattr(driver, "send_packet", send)
        sent = commands_sent(link, sim)
        link.send(Land(-0.05, 1.0))
        until(lambda: [port for port, _ in sent].count(HIGH_LEVEL_PORT) == LAND_TIMES)
        assert link.problem(time.monotonic()) is None
        assert "failed 2 times so far" in link.new_notes()[0]


def test_what_is_unknown_flies() -> None:
    """Motors off for less than two seconds are no flight, but no reason for a farewell either."""
    standing = telemetry(10.0, 0.0, supervisor=READY, thrust=0.0)
    locked = telemetry(10.0, supervisor=LOCKED, thrust=0.0)
    old_s = 10.0 + FRESH_S + 0.01
    assert may_be_flying(None, 10.0)
    assert may_be_flying(standing, old_s)
    assert not may_be_flying(standing, 10.1)
    assert may_be_flying(telemetry(10.0, 2.0, supervisor=AIRBORNE, thrust=0.0), 10.0)
    assert not is_emergency_stopped(None, 10.0)
    assert is_emergency_stopped(locked, 10.1)
    assert not is_emergency_stopped(locked, old_s)


@pytest.mark.long
def test_raw_thrust_works_and_a_perched_vehicle_is_left_unlocked(sim: SimProcess) -> None:
    """Firmware facts: raw thrust is forced to 0 until unlocked, and a first raw packet in the
    air would cut the motors; stop + notify + a close after the flying bit clears do not lock."""
    with linked(sim) as link:
        take_off(link, sim)
        let_pass(sim, 0.6, lambda: link.send(PositionSetpoint(0.0, 0.0, 0.5, 0.0)))
        link.send(RawThrust(52000))
        motors: list[int] = []

        def press() -> None:
            link.send(RawThrust(52000))
            motors.append(min(sim.truth()["motors"]))

        let_pass(sim, 0.2, press)
        assert min(motors) > 20000
        assert motors[-1] == pytest.approx(52000, abs=8000)

        def rise() -> bool:
            link.send(PositionSetpoint(0.0, 0.0, 1.2, 0.0))
            return bool(sim.truth()["magnet_engaged"])

        until(rise)
        link.send(StopMotors())
        until(lambda: motors_off(sim))
        assert info(sim) & FLYING
        sent, told = commands_sent(link, sim), told_by(link)
        link.close()
        assert [(each.sender, each.command) for each in told] == [("farewell", RawThrust(0))]
        until(lambda: sent)  # cflib's farewell: on a busy computer `close` does not wait for it
        assert not any(port == RAW_PORT and bits & FLYING for port, bits in sent)
        let_pass(sim, 2.5)
        assert not info(sim) & LOCKED
        assert sim.truth()["magnet_engaged"]


@pytest.mark.long
def test_closing_waits_for_the_landing(sim: SimProcess) -> None:
    with linked(sim) as link:
        take_off(link, sim)
        sent = commands_sent(link, sim)
        link.send(Land(-0.05, 1.0))
        link.close()
        assert not any(port == RAW_PORT and bits & FLYING for port, bits in sent)
        assert sim.truth()["floor_contact"]
        assert motors_off(sim)
        let_pass(sim, 2.2)
        assert not info(sim) & LOCKED


@pytest.mark.long
def test_a_flying_vehicle_is_neither_taken_over_nor_dropped(sim: SimProcess) -> None:
    """Firmware facts: high-level hover never times out; the zero setpoint of close_link would
    end it at once, and so neither a close that gives up waiting nor a refused connection
    may send one."""
    with linked(sim, landing_wait_s=1.0) as link:
        take_off(link, sim)
        sent, told = commands_sent(link, sim), told_by(link)
        link.close()  # nobody lands it: waits, gives up
        assert (sent, told) == ([], [])
        assert sim.truth()["position_m"][2] > 0.3
        second = CflibLink(sim.uri, CONFIG, time.monotonic)
        with pytest.raises(ConnectionFailed, match="already flying: land it"):
            second.connect()
        listener = ProbeLink(sim.uri, CONFIG, time.monotonic)
        listener.connect()
        sent = commands_sent(listener, sim)
        assert newest(listener).has_bit(FLYING)
        listener.close()
        assert sent == []
        let_pass(sim, 1.0)
        assert sim.truth()["position_m"][2] > 0.3
        assert not info(sim) & LOCKED


@pytest.mark.long
def test_closing_sends_no_zero_setpoint_when_nothing_is_known_any_more(sim: SimProcess) -> None:
    """The last sample shows a vehicle on the ground; what it does since then is unknown."""
    with linked(sim, landing_wait_s=0.5) as link:
        assert not newest(link).has_bit(FLYING)
        sent = commands_sent(link, sim)
        sim.silence_link(2.5)
        until(lambda: link.problem(time.monotonic()))
        link.close()
        assert sent == []
    let_pass(sim, 1.0)  # for who comes next
