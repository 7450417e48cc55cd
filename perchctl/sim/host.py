"""The host of the simulated vehicle, which runs in a separate process: its link, its video, and the
room's motion capture."""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perchctl.children import SharedTime
from perchctl.geometry import rotation_from_quaternion, rpy_from_rotation
from perchctl.link import Packet
from perchctl.sim.capture import MotionCaptureServer, SimCapture
from perchctl.sim.crtp import CrtpServer
from perchctl.sim.optics import Picture
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.vehicle import SimulatedVehicle

Address = tuple[str, int]
TRUTH_EVERY = 10  # control periods between two lines of the truth file
_RECEIVED_PACKETS_BYTES = 1 << 20
_NULL_HEADER = 0xFF
_EPS_S = 1e-9


class VehicleHost:
    """One vehicle, its CRTP endpoint, its video stream and its motion-capture server.

    The endpoint is a socket on loopback, with one CRTP packet per UDP datagram, as sent by cflib's
    `udp://` driver. Answers go to the address from which the request came.

    Args:
        link: further arguments of `CrtpServer`.
        truth_file: file for the true state, as 50 JSON lines per simulated second.
        parts: further arguments of `SimulatedVehicle`, for each vehicle.
    """

    def __init__(
        self,
        scenario: Scenario,
        link: dict[str, Any] | None = None,
        truth_file: Path | None = None,
        **parts: Any,
    ) -> None:
        self._parts = parts
        self._steps = 0
        self._peer: Address | None = None
        self._silent_s = (math.inf, math.inf)
        self._bursts = scenario.radio_bursts()
        self.vehicle = SimulatedVehicle(scenario, **parts)
        self.server = CrtpServer(self.vehicle.firmware, **(link or {}))
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVED_PACKETS_BYTES)
        self.socket.bind(("127.0.0.1", 0))
        self.uri = f"udp://127.0.0.1:{self.socket.getsockname()[1]}"
        self.stream = None if self.vehicle.camera is None else MjpegServer()
        capture = self.vehicle.capture
        self.positions = None if capture is None else MotionCaptureServer(capture.settings.names)
        self._truth = None if truth_file is None else truth_file.open("w", encoding="utf-8")

    @property
    def addresses(self) -> tuple[str, str, tuple[str, str] | None]:
        """The `uri`, `stream_url` and `capture` of `SimProcess`."""
        stream_url = "" if self.stream is None else self.stream.url
        positions = self.positions
        capture = None if positions is None else (SimCapture.SYSTEM, positions.host)
        return self.uri, stream_url, capture

    @property
    def elapsed_s(self) -> float:
        """Simulated time since the start. A reboot does not reset it."""
        return self._steps * CONTROL_PERIOD_S

    def serve(self) -> None:
        """Answer the packets that have arrived, but do not advance time. Log data waits for the
        next step."""
        while True:
            try:
                datagram, address = self.socket.recvfrom(64)
            except (BlockingIOError, InterruptedError):
                return
            packet = Packet.decode(datagram)
            if packet is None or not self._passes():
                continue
            if datagram[0] != _NULL_HEADER:
                self._peer = address
            self._send(self.server.handle(packet), address)

    def step(self) -> None:
        """Answer the packets that have arrived, advance by a control period, and send the log data
        that is due."""
        self.serve()
        vehicle = self.vehicle
        vehicle.step()
        if vehicle.camera is not None and self.stream is not None:
            for picture in vehicle.camera.take()[-1:]:
                self.stream.publish(picture.image)
        if vehicle.capture is not None and self.positions is not None:
            for frame in vehicle.capture.take():
                self.positions.publish(frame)
        self._steps += 1
        if self._peer is not None:
            self._send(self.server.due_packets(), self._peer)
        if self._truth is not None and self._steps % TRUTH_EVERY == 0:
            self._truth.write(json.dumps(self.truth()) + "\n")
            self._truth.flush()

    def advance(self, dt_s: float) -> float:
        """Advance by `dt_s`; return the simulated time since the start."""
        for _ in range(round(dt_s / CONTROL_PERIOD_S)):
            self.step()
        return self.elapsed_s

    def call_method(self, name: str, *arguments: Any, **named: Any) -> Any:
        """Call the method `name` of this host, or of its server, world, battery or motion
        capture."""
        world = self.vehicle.world
        parts = (self, self.server, world, world.powertrain.cell, self.vehicle.capture)
        of = next((part for part in parts if hasattr(part, name)), self)
        return getattr(of, name)(*arguments, **named)

    def silence_link(self, duration_s: float) -> None:
        """Stop the link from receiving and sending for `duration_s` of simulated time."""
        self._silent_s = (self.elapsed_s, self.elapsed_s + duration_s)

    def truth(self) -> dict[str, Any]:
        """The true state, SI and radians, and firmware outputs, by name."""
        world, firmware = self.vehicle.world, self.vehicle.firmware
        ceiling_n, floor = world.push_n_and_on_floor()
        return {
            "t_s": self.elapsed_s,
            "position_m": (world.x_m, world.y_m, world.z_m),
            "velocity_mps": (world.vx_mps, world.vy_mps, world.vz_mps),
            "rpy_rad": rpy_from_rotation(rotation_from_quaternion(world.quaternion)),
            "specific_force_mps2": (world.fx_mps2, world.fy_mps2, world.fz_mps2),
            "battery_v": world.battery_v,
            "motors": tuple(map(int, firmware.motors)),
            "supervisor_info": firmware.supervisor_info,
            "floor_contact": floor,
            "ceiling_force_n": ceiling_n,
            "magnet_engaged": world.magnet_engaged,
            "gear_miss_m": world.gear_miss_m(),
        }

    def replace_vehicle(self, scenario: Scenario) -> None:
        """Replace the vehicle with a new one. The connection and log blocks are kept."""
        self.vehicle = SimulatedVehicle(scenario, **self._parts)
        self.server.replace_firmware(self.vehicle.firmware)

    def close(self) -> None:
        """Free the ports and close the files."""
        for part in (self.socket, self.stream, self._truth):
            if part is not None:
                part.close()

    def _send(self, packets: Iterable[Packet], address: Address) -> None:
        for packet in packets:
            if self._passes():
                with contextlib.suppress(OSError):  # lost, as over the air
                    self.socket.sendto(packet.encode(), address)

    def _passes(self) -> bool:
        t_s = self.elapsed_s + _EPS_S
        if self._silent_s[0] <= t_s < self._silent_s[1]:
            return False
        return self._bursts is None or not self._bursts.is_lost(self.elapsed_s)


# --- The child process: runs the vehicle that the parent describes ---


LOOP_PATIENCE_S = 2.0
"""Wall-clock time for which the simulator waits for a flight loop that does not respond, s."""


def serve_parent(
    channel: Connection, shared: SharedTime, pace: str, scenario: Scenario, settings: dict[str, Any]
) -> None:
    """Run the vehicle until the parent closes the channel or ends. First send the parent the host's
    addresses; if the vehicle fails, send the error as text."""
    os.setsid()  # detached from the terminal
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)  # rendering must not slow down the physics
    try:
        with contextlib.closing(VehicleHost(scenario, **settings)) as host:
            channel.send(host.addresses)
            HostRunner(host, channel, realtime=pace == "realtime", shared=shared).run()
    except Exception as error:
        with contextlib.suppress(OSError):
            channel.send(f"{type(error).__name__}: {error}")


# --- How time passes in the simulated vehicle's process, and when it ends ---
# - real time: paced by the wall clock; catches up after a hiccup, never runs ahead. While a flight
#   sets `SharedTime.limit_s`, the simulator waits for the flight's loop instead;
# - stepped: only the parent's `advance` lets time pass; between two calls, packets on the link are
#   answered, so that cflib can connect while simulated time stands still.


MAX_LAG_S = 1.0
"""Delay above which the simulator skips time instead of catching up, s, for example after the
computer was suspended."""
_IDLE_S = 0.25
_CATCH_UP_STEPS = 50  # steps between two polls of the control connection while catching up


class HostRunner:
    """Runs one host until its parent has ended."""

    def __init__(
        self,
        host: VehicleHost,
        channel: Connection,
        *,
        realtime: bool,
        shared: SharedTime,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._host = host
        self._channel = channel
        self._realtime = realtime
        self._clock = clock
        self._shared = shared
        self._waiting_since_s: float | None = None
        self._limit_s = math.inf
        self._origin_s = clock() - host.elapsed_s

    def run(self) -> None:
        with contextlib.suppress(EOFError, ConnectionError):
            while True:
                wait_s = self.catch_up() if self._realtime else _IDLE_S
                awaited: list[Any] = [self._host.socket, self._channel]
                ready, _, _ = select.select(awaited, [], [], wait_s)
                if self._host.socket in ready:
                    self._host.serve()
                if self._channel in ready:
                    self._channel.send(self._answer(*self._channel.recv()))

    def catch_up(self) -> float:
        """Step until now in limited batches. Return the time to wait for the next step, s."""
        now_s = self._clock() - self._origin_s
        max_lag_s = MAX_LAG_S if math.isinf(self._shared.limit_s) else SharedTime.MARGIN_S
        if now_s - self._host.elapsed_s > max_lag_s:
            self._origin_s += now_s - self._host.elapsed_s - max_lag_s
            now_s = self._clock() - self._origin_s
        for _ in range(_CATCH_UP_STEPS):
            if self._host.elapsed_s + CONTROL_PERIOD_S > now_s:
                break
            if self._must_wait():
                return CONTROL_PERIOD_S
            self._host.step()
            self._shared.reached_s = self._host.elapsed_s
        next_s = self._origin_s + self._host.elapsed_s + CONTROL_PERIOD_S
        return max(0.0, next_s - self._clock())

    def _must_wait(self) -> bool:
        """True while the flight's loop lags behind, but for `LOOP_PATIENCE_S` at most."""
        limit_s, before_s = self._shared.limit_s, self._limit_s
        if self._host.elapsed_s < limit_s:
            self._waiting_since_s = None
            return False
        now_s, self._limit_s = self._clock(), limit_s
        if self._waiting_since_s is None or limit_s != before_s:
            self._waiting_since_s = now_s  # the loop has responded
        return now_s - self._waiting_since_s < LOOP_PATIENCE_S

    def _answer(self, name: str, arguments: Any, named: Any) -> tuple[bool, Any]:
        try:
            return True, self._host.call_method(name, *arguments, **named)
        except Exception as error:
            return False, f"{type(error).__name__}: {error}"


# --- The simulated camera's images over HTTP, as from a network camera ---
# Each part of a multipart answer is one JPEG. A slow client misses frames, but always gets the
# newest.


SIMULATED_JPEG_QUALITY = 92
_BOUNDARY = "perchctlframe"
_CLIENT_TIMEOUT_S = 5.0


class MjpegServer(ThreadingHTTPServer):
    """Serves the newest published image on loopback, for any path."""

    daemon_threads = True
    block_on_close = False

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self._changed = threading.Condition()
        self._newest: tuple[int, Picture] = 0, np.zeros((1, 1), np.uint8)
        self.url = f"http://127.0.0.1:{self.server_address[1]}/stream.mjpg"
        threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True).start()

    def publish(self, image: Picture) -> None:
        """Publish an image, grey uint8 (h, w)."""
        with self._changed:
            self._newest = self._newest[0] + 1, image
            self._changed.notify_all()

    def wait_for_newer(self, number: int) -> tuple[int, Picture]:
        """Wait for an image newer than `number`; return it with its number."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest[0] > number)
            return self._newest

    def close(self) -> None:
        """Free the port."""
        self.shutdown()
        self.server_close()


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
    server: MjpegServer

    def do_GET(self) -> None:
        number = 0
        with contextlib.suppress(OSError):  # error from a client that disconnects
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
            self.end_headers()
            while True:
                number, image = self.server.wait_for_newer(number)
                _, jpeg = cv2.imencode(
                    ".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, SIMULATED_JPEG_QUALITY]
                )
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}"
                self.wfile.write(f"{head}\r\n\r\n".encode() + jpeg.tobytes() + b"\r\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing, because requests should not clutter the terminal."""
