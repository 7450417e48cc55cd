"""Positions from outside on their way into the vehicle: its estimate's start, and the one lock
that everything is sent through."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, PerchError, TimedOut
from perchctl.geometry import rot_z
from perchctl.link import CflibLink, check_estimator_parameters
from perchctl.link.connection import Connection, send_packets
from perchctl.link.crtp import encode_external
from perchctl.link.external_position import (
    AGREE_WITHIN_S,
    RESET_PARAMETER,
    RESETS,
    Settling,
    estimator_parameters,
)
from perchctl.positioning import FeedStatus, Placed
from perchctl.profile import LinkConfig, PositioningConfig
from perchctl.vehicle import FLYING, ExternalPosition, Telemetry

CONFIG = PositioningConfig(by="mocap", host="lab", body="cf", connect_timeout_s=2.0)
INITIAL = tuple(f"kalman.initial{part}" for part in ("X", "Y", "Z", "Yaw"))
ON_GROUND = Telemetry(
    t_s=0.0,
    position_m=(0.0, 0.0, 0.0),
    velocity_mps=(0.0, 0.0, 0.0),
    roll_rad=0.0,
    pitch_rad=0.0,
    yaw_rad=0.0,
    acc_z_g=1.0,
    thrust=0.0,
    battery_v=4.0,
    supervisor=0x020E,
)


@dataclass
class Bench:
    """A vehicle on the ground, its parameters, a capture that sees it, and their one clock.

    `deaf`: so many resets are lost on their way. Positions draw the estimate's place, and never
    its heading.
    """

    place_m: tuple[float, float, float] = (1.2, -0.7, 0.03)
    heading_rad: float = 2.0
    telemetry: Telemetry = ON_GROUND
    deaf: int = 0
    lacks: str = ""
    status_problem: str | None = None
    now_s: float = 50.0
    silent_after_s: float = math.inf
    carried_mps: float = 0.0
    values: dict[str, float] = field(default_factory=dict)
    orders: list[tuple[str, float]] = field(default_factory=list)

    # --- The parameters, as cflib has them -------------------------------------------------

    @property
    def cf(self) -> Any:
        toc = SimpleNamespace(
            get_element_by_complete_name=lambda name: None if name == self.lacks else object()
        )
        return SimpleNamespace(
            param=SimpleNamespace(
                toc=toc,
                set_value=self.set_value,
                add_update_callback=self.listen,
                remove_update_callback=lambda *what: None,
                request_param_update=lambda name: self._told(name, str(self.values[name])),
            )
        )

    def listen(self, group: str, name: str, cb: Callable[[str, str], None]) -> None:
        self._told = cb

    def set_value(self, name: str, value: str) -> None:
        self.orders.append((name, float(value)))
        self.values[name] = float(value)
        if name == RESET_PARAMETER and float(value) == 1.0:
            if self.deaf > 0:
                self.deaf -= 1
                return
            x, y, z, yaw = (self.values[name] for name in INITIAL)
            self.telemetry = replace(self.telemetry, position_m=(x, y, z), yaw_rad=yaw)

    # --- Time, telemetry and the capture ---------------------------------------------------

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s
        x, y, z = self.place_m
        self.place_m = (x + self.carried_mps * duration_s, y, z)
        self.telemetry = replace(self.telemetry, position_m=self.place_m)

    def newest(self) -> Telemetry:
        return replace(self.telemetry, t_s=min(self.now_s, self.silent_after_s))

    def status(self, now_s: float) -> FeedStatus:
        return FeedStatus(0.01, self.status_problem, 0 if self.status_problem else 9)

    def place(self) -> Placed:
        return Placed(self.now_s, np.array(self.place_m), rot_z(self.heading_rad))

    def settle(self) -> None:
        Settling(self.cf, "udp://x", CONFIG, self.newest, lambda: self.now_s, self.wait).settle(
            self
        )


def test_the_filter_starts_where_the_capture_sees_the_vehicle() -> None:
    bench = Bench()
    bench.settle()
    assert [bench.values[name] for name in INITIAL] == pytest.approx([1.2, -0.7, 0.03, 2.0])
    assert [order for order in bench.orders if order[0] == RESET_PARAMETER] == [
        (RESET_PARAMETER, 1.0),
        (RESET_PARAMETER, 0.0),
    ]
    assert bench.orders[-2:] == [(RESET_PARAMETER, 1.0), (RESET_PARAMETER, 0.0)]
    assert bench.now_s < 51.0


def test_a_reset_that_is_lost_is_ordered_again() -> None:
    bench = Bench(deaf=2)
    bench.settle()
    assert bench.orders.count((RESET_PARAMETER, 1.0)) == 3


def refused(bench: Bench, kind: type[PerchError]) -> str:
    start_s = bench.now_s
    with pytest.raises(kind) as caught:
        bench.settle()
    assert bench.now_s - start_s < CONFIG.connect_timeout_s + RESETS * (AGREE_WITHIN_S + 0.5)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_an_estimate_of_another_heading_is_not_flown_by() -> None:
    words = refused(Bench(deaf=99), TimedOut)
    assert "115 deg of heading apart" in words
    assert "motion capture at vicon:lab" in words


@pytest.mark.parametrize(
    "bench",
    [
        Bench(telemetry=replace(ON_GROUND, supervisor=0x020E | FLYING)),
        Bench(silent_after_s=49.0),  # by old telemetry it stood on the ground
    ],
)
def test_nothing_is_reset_where_the_vehicle_may_fly(bench: Bench) -> None:
    assert "may be flying" in refused(bench, ConnectionFailed)
    assert bench.orders == []


def test_a_vehicle_that_takes_off_in_between_is_not_reset_again() -> None:
    bench = Bench(deaf=99)
    plain = bench.set_value

    def lift(name: str, value: str) -> None:
        plain(name, value)
        if name == RESET_PARAMETER:
            bench.telemetry = replace(bench.telemetry, supervisor=0x020E | FLYING)

    bench.set_value = lift  # type: ignore[method-assign]
    assert "may be flying" in refused(bench, ConnectionFailed)
    assert bench.orders.count((RESET_PARAMETER, 1.0)) == 1


def test_agreement_counts_over_fresh_telemetry_only() -> None:
    bench = Bench()
    plain = bench.set_value

    def fall_silent(name: str, value: str) -> None:
        plain(name, value)
        if name == RESET_PARAMETER:
            bench.silent_after_s = bench.now_s

    bench.set_value = fall_silent  # type: ignore[method-assign]
    refused(bench, PerchError)


def test_a_hidden_body_is_named_before_anything_is_set() -> None:
    bench = Bench(status_problem="motion capture at vicon:lab does not see 'cf'; it sees wand")
    assert "within 2 s: motion capture at vicon:lab does not see 'cf'" in refused(bench, TimedOut)
    assert bench.orders == []


def test_a_vehicle_that_is_carried_is_waited_for() -> None:
    assert "it is being moved" in refused(Bench(carried_mps=0.3), TimedOut)


def test_a_firmware_without_the_filter_is_one_sentence() -> None:
    words = refused(Bench(lacks=RESET_PARAMETER), NotFound)
    assert "has no parameter kalman.resetEstimation, which positioning from outside needs" in words
    assert "update the firmware" in words


def test_the_user_s_own_parameters_may_not_contradict() -> None:
    assert estimator_parameters(PositioningConfig()) == {}
    check_estimator_parameters({"stabilizer.estimator": 2, "ctrlMel.mass": 0.03}, CONFIG)
    check_estimator_parameters({"stabilizer.estimator": 1}, PositioningConfig())
    with pytest.raises(InvalidValue, match=r"stabilizer\.estimator to 1, but .* it is 2"):
        check_estimator_parameters({"stabilizer.estimator": 1}, CONFIG)
    with pytest.raises(InvalidValue, match=r"take it out of link\.parameters"):
        check_estimator_parameters({"locSrv.extPosStdDev": 0.01}, CONFIG)


# --- Through cflib's lock ---------------------------------------------------------------------


class Driver:
    """A link of cflib's that can hang, or have no room."""

    needs_resending = False

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.out_queue: queue.Queue[Any] = queue.Queue(1)
        self.entered, self.free = threading.Event(), threading.Event()
        self.free.set()
        self.error: Exception | None = None

    def send_packet(self, packet: Any) -> None:
        if self.error is not None:
            raise self.error
        self.entered.set()
        assert self.free.wait(10.0)
        self.sent.append(bytes(packet.data))


@pytest.fixture
def wired(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[CflibLink, Driver, Connection]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    link = CflibLink("udp://127.0.0.1:1", LinkConfig(), lambda: 0.0)
    driver, connection = Driver(), Connection()
    connection.cf.link, link.connection = driver, connection
    return link, driver, connection


def at(x_m: float) -> ExternalPosition:
    return ExternalPosition((x_m, 0.0, 0.5))


Wired = tuple[CflibLink, Driver, Connection]


def test_a_position_does_not_wait_behind_a_command_that_hangs(wired: Wired) -> None:
    link, driver, connection = wired
    driver.free.clear()
    hanging = threading.Thread(target=send_packets, args=(connection.cf, [encode_external(at(0))]))
    hanging.start()
    assert driver.entered.wait(10.0)
    assert [link.external(at(x)) for x in (1.0, 2.0)] == [False, False]
    driver.free.set()
    hanging.join(10.0)
    assert link.external(at(3.0)) is True
    assert driver.sent == [encode_external(at(x)).data for x in (0.0, 3.0)]


def test_a_position_does_not_wait_in_the_radio_s_queue(wired: Wired) -> None:
    link, driver, _ = wired
    driver.out_queue.put("what the radio repeats until it is acknowledged")
    assert link.external(at(1.0)) is False
    driver.out_queue.get()
    assert link.external(at(2.0)) is True
    assert driver.sent == [encode_external(at(2.0)).data]


def test_an_error_of_the_driver_leaves_the_lock_to_the_commands(wired: Wired) -> None:
    link, driver, connection = wired
    driver.error = RuntimeError("unplugged")
    assert link.external(at(1.0)) is False
    driver.error = None
    send_packets(connection.cf, [encode_external(at(2.0))])
    assert len(driver.sent) == 1


def test_nothing_goes_out_without_a_link(wired: Wired) -> None:
    link, driver, connection = wired
    connection.lost = "gone"
    assert link.external(at(1.0)) is False
    connection.lost, connection.cf.link = None, None
    assert link.external(at(1.0)) is False
    link.connection = None
    assert link.external(at(1.0)) is False
    assert link.external(at(1e300)) is False
    assert driver.sent == []
