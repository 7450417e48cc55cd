"""A simulated vehicle flown through cflib's own `udp://` driver, in steps.

cflib's threads are waited for with bounded events; simulated time moves only by
`advance`, so the flights are the same every time.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import urllib.request
from collections.abc import Callable, Iterator
from typing import Any

import cflib.crtp
import cv2
import numpy as np
import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crtp.crtpstack import CRTPPacket

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim import Scenario, SimProcess

WAIT_S = 10.0
CONNECTED_S = 60.0  # all tables, where a busy machine gives it a tenth of a core
AIRBORNE_S = 2.0  # after a take-off: enough where only the supervisor is tested
CHUNK_S = 0.4  # so few packets fit into cflib's receive buffer
BLOCKS = (
    {f"stateEstimate.{n}": "float" for n in ("x", "y", "z", "vx", "vy", "vz")}
    | {"supervisor.info": "uint16_t"},
    {f"stateEstimate.{n}": "float" for n in ("roll", "pitch", "yaw")}
    | {"acc.z": "float", "stabilizer.thrust": "float", "pm.vbat": "float", "pm.state": "int8_t"},
)
READY, HL_RUNNING, HL_DONE, LOW_LEVEL, LOCKED = 0x020E, 0x011E, 0x031E, 0x021E, 0x0244
FLYING_BIT, TUMBLED_BIT, LOCKED_BIT, CRASHED_BIT, HL_BIT = 1 << 4, 1 << 5, 1 << 6, 1 << 7, 1 << 8
CAN_FLY_BIT, ARMED_BIT = 1 << 3, 1 << 1
WEIGHT_N = 0.042 * GRAVITY_MPS2


class Client:
    """One cflib connection; `connect` is bounded, unlike cflib's own."""

    def __init__(self, uri: str, cache: str | None) -> None:
        if not cflib.crtp.CLASSES:
            cflib.crtp.init_drivers()
        self.uri = uri
        self.cf = Crazyflie(rw_cache=cache)
        self.sent: list[tuple[int, int, bytes]] = []
        self._connected = threading.Event()
        self._complete = threading.Event()
        self.cf.connected.add_callback(lambda _: self._connected.set())
        self.cf.fully_connected.add_callback(lambda _: self._complete.set())
        self.cf.packet_sent.add_callback(
            lambda pk: self.sent.append((pk.port, pk.channel, bytes(pk.data)))
        )

    def connect(self, wait_s: float = CONNECTED_S) -> bool:
        self.cf.open_link(self.uri)
        return self.connected(wait_s)

    def connected(self, wait_s: float) -> bool:
        return self._connected.wait(wait_s) and self._complete.wait(wait_s)

    def close(self) -> None:
        self.cf.close_link()

    def ask(
        self, port: int, channel: int, data: bytes, wait_s: float = WAIT_S, begins: bytes = b""
    ) -> bytes | None:
        """Send one packet and wait for the next answer on its port and channel."""
        arrived = threading.Event()
        answers: list[bytes] = []

        def take(packet: Any) -> None:
            if bytes(packet.data[: len(begins)]) == begins and not arrived.is_set():
                answers.append(bytes(packet.data))
                arrived.set()

        self.cf.add_header_callback(take, port, channel)
        try:
            self.send(port, channel, data)
            return answers[0] if arrived.wait(wait_s) else None
        finally:
            self.cf.remove_header_callback(take, port, channel)

    def send(self, port: int, channel: int, data: bytes) -> None:
        packet = CRTPPacket()
        packet.set_header(port, channel)
        packet.data = data
        self.cf.send_packet(packet)

    def start_block(
        self, block: LogConfig, take: Callable[[int, dict[str, float]], None]
    ) -> LogConfig:
        """The block, started; `take` is called with each stamp in ms and its data."""
        self.cf.log.add_config(block)
        started = threading.Event()
        block.started_cb.add_callback(lambda _block, on: on and started.set())
        block.data_received_cb.add_callback(lambda stamp, data, _block: take(stamp, data))
        block.start()
        assert started.wait(WAIT_S)
        return block

    def echo(self, number: int, wait_s: float = WAIT_S) -> bool:
        """Whether the vehicle answers; by then it has served all that was sent before.

        The first byte sets it apart from cflib's own pings.
        """
        ping = struct.pack("<Bd", 1, number)
        return self.ask(15, 0, ping, wait_s, begins=ping) == ping

    def supervisor_info(self) -> int:
        """Read from the supervisor port; cflib's getters may answer from a cache."""
        answer = self.ask(9, 0, b"\x0c")
        assert answer is not None
        assert answer[0] == 0x8C
        return int.from_bytes(answer[1:3], "little")


class Pilot(Client):
    """A client that logs everything it needs and moves the simulated time."""

    def __init__(self, sim: SimProcess, cache: str | None) -> None:
        super().__init__(sim.uri, cache)
        self.sim = sim
        self.t_s = 0.0
        self.samples: list[tuple[float, dict[str, float]]] = []
        self._stamps: list[float] = []
        self._due: list[float] = []
        self._periods_s: list[float] = []
        self._news = threading.Condition()

    def start_log(self) -> None:
        for variables in BLOCKS:
            self._start(variables)

    @contextlib.contextmanager
    def logging(self, variables: dict[str, str], period_ms: int = 10) -> Iterator[None]:
        """These are logged meanwhile, too; begun at a multiple of the period."""
        block = self._start(variables, period_ms)
        try:
            yield
        finally:
            block.stop()
            block.delete()
            self._stamps.pop()
            self._periods_s.pop()

    def _start(self, variables: dict[str, str], period_ms: int = 10) -> LogConfig:
        index = len(self._stamps)
        self._stamps.append(-1.0)
        self._periods_s.append(period_ms / 1000.0)
        return self.start_block(
            log_block(f"rig{index}", variables, period_ms),
            lambda stamp, data: self._take(index, stamp, data),
        )

    def fresh(self, *, settle_s: float = 0.6, **scenario: Any) -> Pilot:
        """A new vehicle on the floor, its raw thrust unlocked as the facts advise."""
        self.sim.replace_vehicle(Scenario(**scenario))
        self.t_s = 0.0
        self.samples = []
        self._stamps = [-1.0] * len(self._stamps)
        self.advance(settle_s)
        return self

    def unlock(self) -> None:
        self.cf.commander.send_setpoint(0, 0, 0, 0)
        self.cf.commander.send_notify_setpoint_stop()

    def take_off(self, height_m: float, duration_s: float = 2.0, settle_s: float = 4.0) -> None:
        self.unlock()
        self.cf.high_level_commander.takeoff(height_m, duration_s)
        self.advance(duration_s + settle_s)

    def fly_to(self, height_m: float, hold_s: float = 2.0, settle_s: float = 4.0) -> None:
        """Take off and hold a position setpoint: one mode from then on.

        Still in height after the default; on its way there after `AIRBORNE_S`.
        """
        self.take_off(height_m, settle_s=settle_s)
        self.stream(hold_s, lambda: self.hold(height_m))

    def hold(self, height_m: float) -> None:
        self.cf.commander.send_position_setpoint(0, 0, height_m, 0)

    def perch(self) -> None:
        """Hang on the magnet: take off, rise, press, as the floor to beat does."""
        self.fly_to(1.6, 0.5, AIRBORNE_S)
        self.stream(4.0, lambda: self.hold(2.5))
        assert self.sim.truth()["magnet_engaged"]

    def advance(self, dt_s: float) -> None:
        """Let time pass, and wait until the log data up to then have arrived."""
        left_s = dt_s
        while left_s > 1e-9:
            part_s = min(CHUNK_S, left_s)
            self.sim.advance(part_s)
            self.t_s = round(self.t_s + part_s, 6)
            left_s -= part_s
            self._sync()

    def stream(self, dt_s: float, send: Callable[[], None], period_s: float = 0.02) -> None:
        """Send a command periodically while time passes."""
        for _ in range(round(dt_s / period_s)):
            send()
            self.advance(period_s)

    def until(self, done: Callable[[dict[str, Any]], bool], limit_s: float) -> float:
        """Step until the truth fulfils `done`; how long that took.

        By 2 ms, where a second or more is allowed by 10 ms.
        """
        step_s = 0.002 if limit_s < 1.0 else 0.010
        for step in range(round(limit_s / step_s) + 1):
            if done(self.sim.truth()):
                self._sync()
                return step * step_s
            self.sim.advance(step_s)
            self.t_s = round(self.t_s + step_s, 6)
        raise AssertionError(f"not within {limit_s} s: {self.sim.truth()}")

    def log(self, name: str, since_s: float = -1.0) -> list[tuple[float, float]]:
        """(time, value) of a logged variable."""
        return [(t, data[name]) for t, data in self.samples if name in data and t >= since_s]

    def now(self, name: str) -> float:
        return self.log(name)[-1][1]

    @property
    def info(self) -> int:
        return int(self.now("supervisor.info"))

    def motors_off(self) -> bool:
        return bool(max(self.sim.truth()["motors"]) == 0)

    def _take(self, index: int, stamp_ms: int, data: dict[str, float]) -> None:
        with self._news:
            self.samples.append((stamp_ms / 1000.0, data))
            if index < len(self._stamps):
                self._stamps[index] = stamp_ms / 1000.0
            if self._has_arrived():
                self._news.notify_all()  # and not for each packet of the way there

    def _has_arrived(self) -> bool:
        return all(stamp >= due for stamp, due in zip(self._stamps, self._due, strict=False))

    def _sync(self) -> None:
        counts = [int(self.t_s / period_s + 1e-6) for period_s in self._periods_s]
        periods = zip(counts, self._periods_s, strict=True)
        with self._news:
            self._due = [count * period_s - 1e-6 if count else -1.0 for count, period_s in periods]
            arrived = self._news.wait_for(self._has_arrived, WAIT_S)
        assert arrived, f"no log data up to {self._due} s, only {self._stamps}"


def height(pilot: Pilot) -> float:
    """Where it truly is, m."""
    return float(pilot.sim.truth()["position_m"][2])


def heights(pilot: Pilot, since_s: float) -> list[tuple[float, float]]:
    """(seconds since, estimated height), every 10 ms."""
    return [(t - since_s, z) for t, z in pilot.log("stateEstimate.z", since_s)]


def height_at(curve: list[tuple[float, float]], t_s: float) -> float:
    return min(curve, key=lambda sample: abs(sample[0] - t_s))[1]


def off(truth: dict[str, Any]) -> bool:
    """The motors are; for `Pilot.until`."""
    return bool(max(truth["motors"]) == 0)


def locked(truth: dict[str, Any]) -> bool:
    """The supervisor is; for `Pilot.until`."""
    return bool(truth["supervisor_info"] & LOCKED_BIT)


def raw(pilot: Pilot, thrust: int) -> None:
    pilot.cf.commander.send_setpoint(0, 0, 0, thrust)


def notify(pilot: Pilot) -> None:
    pilot.cf.commander.send_notify_setpoint_stop()


def parameter_update(client: Client, name: str, act: Callable[[], Any]) -> float:
    """The value that the vehicle announces for a parameter after `act`."""
    group, _, short = name.partition(".")
    arrived = threading.Event()
    values: list[str] = []

    def take(_name: str, value: str) -> None:
        values.append(value)
        arrived.set()

    client.cf.param.add_update_callback(group, short, take)
    try:
        act()
        assert arrived.wait(WAIT_S)
    finally:
        client.cf.param.remove_update_callback(group, short, take)
    return float(values[-1])


def read(pilot: Pilot, name: str) -> float:
    """From the vehicle, not from cflib's memory of it."""
    return parameter_update(pilot, name, lambda: pilot.cf.param.request_param_update(name))


def kept(pilot: Pilot, name: str, value: float) -> None:
    """An answer to something before may come first."""
    for _ in range(10):
        if read(pilot, name) == pytest.approx(value):
            return
    raise AssertionError(f"{name} is not {value:g}")


def log_block(name: str, variables: dict[str, str], period_ms: int = 10) -> LogConfig:
    block = LogConfig(name=name, period_in_ms=period_ms)
    for variable, ctype in variables.items():
        block.add_variable(variable, ctype)
    return block


@contextlib.contextmanager
def wired(uri: str) -> Iterator[socket.socket]:
    """A socket to a vehicle's link: one datagram, one packet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        mine.connect(("127.0.0.1", int(uri.rsplit(":", 1)[1])))
        mine.setblocking(False)
        yield mine


def pictures_of(url: str, count: int) -> list[np.ndarray]:
    """The first pictures of a stream, decoded."""
    pictures = []
    with urllib.request.urlopen(url, timeout=WAIT_S) as answer:
        assert answer.headers.get_content_type() == "multipart/x-mixed-replace"
        while len(pictures) < count:
            line = answer.readline()
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
                answer.readline()
                raw = np.frombuffer(answer.read(length), np.uint8)
                pictures.append(cv2.imdecode(raw, cv2.IMREAD_UNCHANGED))
    return pictures
