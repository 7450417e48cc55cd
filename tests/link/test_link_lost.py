"""Leaving a link of which nothing is known any more, and opening a lost one again (over a radio:
`tests.link.test_radio`)."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import ConnectionFailed
from perchctl.link import CflibLink, MockLink
from perchctl.link.cflib_link import EstimateLink
from perchctl.link.connection import Connection
from perchctl.sim import SimProcess, SimulatedVehicle
from perchctl.vehicle import FLYING, FRESH_S, LOCKED, EmergencyStop, Land, is_cut, may_fly
from tests.helpers.mission import AIRBORNE, READY, telemetry
from tests.link.test_cflib_link import (
    CONFIG,
    LOW_CEILING,
    cf,
    commands_sent,
    info,
    let_pass,
    linked,
    newest,
    sent_raw,
    take_off,
    until,
)


@pytest.fixture(scope="module")
def sim(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimProcess]:
    with pytest.MonkeyPatch.context() as patch, SimProcess.start(LOW_CEILING) as process:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        yield process


# --- evidence --------------------------------------------------------------------------------

OLD_S = FRESH_S + 0.01


def test_what_is_unknown_flies() -> None:
    standing = telemetry(10.0, 0.0, supervisor=READY, thrust=0.0)
    assert may_fly(None, 10.0)
    assert may_fly(standing, 10.0 + OLD_S)
    assert not may_fly(standing, 10.1)
    assert not is_cut(None, 10.0)
    locked = telemetry(10.0, supervisor=LOCKED, thrust=0.0)
    assert is_cut(locked, 10.1)
    assert not is_cut(locked, 10.0 + OLD_S)


def test_motors_off_for_less_than_two_seconds_is_no_flight_but_no_farewell_either() -> None:
    hanging = telemetry(10.0, 2.0, supervisor=AIRBORNE, thrust=0.0)
    assert may_fly(hanging, 10.0)


# --- leaving ---------------------------------------------------------------------------------


@pytest.mark.long
def test_closing_sends_no_zero_setpoint_when_nothing_is_known_any_more(sim: SimProcess) -> None:
    """The last sample shows a vehicle on the ground; what it does since then is unknown."""
    with linked(sim, landing_wait_s=0.5) as link:
        assert not newest(link).has(FLYING)
        raw = sent_raw(link, sim)
        sim.silence(2.5)
        until(lambda: link.problem(time.monotonic()))
        link.close()
        assert raw == []
    let_pass(sim, 1.0)  # for who comes next


def test_a_failed_look_at_the_estimate_commands_nothing(sim: SimProcess) -> None:
    sent: list[list[int]] = []

    class Failing(EstimateLink):
        def _prepare(self, connection: Connection) -> None:
            super()._prepare(connection)
            sent.append(commands_sent(self))
            raise ConnectionFailed("by the test")

    link = Failing(sim.uri, CONFIG, time.monotonic)
    with pytest.raises(ConnectionFailed, match="by the test"):
        link.connect()
    assert sent == [[]]


# --- started anew ----------------------------------------------------------------------------


def test_a_vehicle_that_has_started_anew_is_known_by_its_samples(sim: SimProcess) -> None:
    """By its stamps over the radio; simulated in lockstep, by the firmware's own clock."""
    with linked(sim) as link:
        let_pass(sim, 2.0)
        assert newest(link).start == 0
        sim.reboot()
        until(lambda: any(sample.start == 1 for sample in link.telemetry()))
    vehicle = SimulatedVehicle(LOW_CEILING)
    mock = MockLink(vehicle)
    mock.advance_to(0.5)
    assert mock.telemetry()[-1].start == 0
    vehicle.firmware.reboot()
    mock.advance_to(1.0)
    assert mock.telemetry()[-1].start == 1


# --- lost in flight --------------------------------------------------------------------------


def lose(link: CflibLink) -> None:
    """As a driver ends."""
    cf(link).link.link_error_callback("unplugged")
    assert link.problem(time.monotonic()) == "unplugged"


@pytest.mark.long
def test_a_lost_link_is_opened_again_for_the_landing_and_for_the_stop(sim: SimProcess) -> None:
    with linked(sim) as link:
        take_off(link, sim)
        lose(link)
        link.send(Land(-0.05, 1.5))
        until(lambda: sim.truth()["floor_contact"] and max(sim.truth()["motors"]) == 0)
        assert not info(sim) & LOCKED
        until(lambda: link.problem(time.monotonic()) is None)
        until(lambda: time.monotonic() - newest(link).t_s < 0.3)  # the blocks go on
        take_off(link, sim)
        lose(link)
        link.send(EmergencyStop())
        until(lambda: info(sim) & LOCKED)


def test_a_link_that_cannot_be_opened_again_holds_up_nobody(
    sim: SimProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cflib.crtp

    def gone(*_: object) -> object:
        raise OSError("no dongle")

    with linked(sim, landing_wait_s=0.2) as link:
        monkeypatch.setattr(cflib.crtp, "get_link_driver", gone)
        lose(link)
        began_s = time.monotonic()
        link.send(Land(-0.05, 1.5))
        assert time.monotonic() - began_s < 0.2
        assert link.problem(time.monotonic()) == "unplugged"
