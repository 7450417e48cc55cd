"""The simulated vehicle behind its link, its video and the room's motion capture: what runs in a
process of its own."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import sys
import threading
from collections.abc import Callable, Iterable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, TextIO

import cv2
import numpy as np

from perchctl.errors import ConnectionFailed
from perchctl.geometry import Array, rpy_from_rotation
from perchctl.sim.bursts import Bursts, radio_bursts
from perchctl.sim.capture import CaptureServer, SimCapture
from perchctl.sim.crtp.codec import Packet
from perchctl.sim.crtp.server import CrtpServer, LinkOptions
from perchctl.sim.optics import Picture
from perchctl.sim.process.handle import HostSetup
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.vehicle import PastPoses, SimulatedVehicle
from perchctl.sim.world import World

TRUTH_EVERY = 10  # control periods between two lines of the truth file
_PAST_S = 1.0  # how far the picture may lag behind the physics
_WAKE_EVERY = 5  # control periods between two wake-ups of the renderer


class VehicleHost:
    """One vehicle, its CRTP endpoint, its video stream and the server of a motion capture.

    `live` moves the rendering into a thread of its own, so that a picture never holds
    up the physics; otherwise pictures are rendered within the steps, exactly in order.
    """

    def __init__(self, setup: HostSetup, *, live: bool) -> None:
        self._setup = setup
        self._live = live
        self._steps = 0
        self.vehicle = self._new_vehicle(setup.scenario)
        self.server = CrtpServer(self.vehicle.firmware, setup.link)
        with contextlib.ExitStack() as opened:
            use = opened.enter_context
            bursts = radio_bursts(setup.scenario)
            self.endpoint = use(contextlib.closing(UdpEndpoint(setup.port, setup.link, bursts)))
            self.stream: MjpegServer | None = None
            if setup.camera is not None:
                self.stream = use(contextlib.closing(MjpegServer(setup.http_port)))
            self.positions: CaptureServer | None = None
            if setup.capture is not None:
                server = CaptureServer(setup.capture.names, setup.capture_port)
                self.positions = use(contextlib.closing(server))
            self._truth: TextIO | None = None
            if setup.truth_file is not None:
                self._truth = use(setup.truth_file.open("w", encoding="utf-8"))
            self._heard: TextIO | None = None
            if setup.heard_file is not None:
                self._heard = use(setup.heard_file.open("w", encoding="utf-8"))
                self.endpoint.heard = self._write_heard
            self._opened = opened.pop_all()
        self._feed = self._new_feed()

    @property
    def uri(self) -> str:
        return f"udp://127.0.0.1:{self.endpoint.port}"

    @property
    def capture(self) -> tuple[str, str] | None:
        """The motion capture's kind, as `motioncapture` calls it, and its address."""
        return None if self.positions is None else (SimCapture.SYSTEM, self.positions.host)

    @property
    def elapsed_s(self) -> float:
        """Simulated time since the start; unlike the firmware's, no reboot resets it."""
        return self._steps * CONTROL_PERIOD_S

    @property
    def picture_late_s(self) -> float:
        """Simulated time that has passed since the renderer last began; 0 without a thread."""
        return 0.0 if self._feed is None else self._feed.late_s

    def serve(self) -> None:
        """Answer what has arrived, without time passing; log data waits for the next step."""
        self.endpoint.serve(self.server, self.elapsed_s)

    def step(self) -> None:
        """Packets that have arrived, one control period, then what is due to be sent."""
        self.endpoint.serve(self.server, self.elapsed_s)
        if self._feed is not None:
            self.vehicle.step_blindly()
            self._feed.add(self.vehicle.world)
        else:
            self.vehicle.step()
            self._publish_arrived()
        self._publish_seen()
        self._steps += 1
        self.endpoint.send_due(self.server, self.elapsed_s)
        if self._truth is not None and self._steps % TRUTH_EVERY == 0:
            self._truth.write(json.dumps(self.truth()) + "\n")
            self._truth.flush()

    def advance(self, dt_s: float) -> None:
        for _ in range(round(dt_s / CONTROL_PERIOD_S)):
            self.step()

    def truth(self) -> dict[str, Any]:
        """The true state, SI and radians, and the firmware's outputs: no Crazyflie reports it."""
        world, firmware = self.vehicle.world, self.vehicle.firmware
        state = world.state()
        return {
            "t_s": self.elapsed_s,
            "position_m": tuple(state.position_m.tolist()),
            "velocity_mps": tuple(state.velocity_mps.tolist()),
            "rpy_rad": rpy_from_rotation(state.R_world_body),
            "specific_force_mps2": tuple(state.specific_force_mps2.tolist()),
            "battery_v": world.battery_v,
            "motors": tuple(int(firmware.log_value(f"motor.m{i}")) for i in (1, 2, 3, 4)),
            "supervisor_info": firmware.supervisor_info,
            "floor_contact": state.floor_contact,
            "ceiling_force_n": state.ceiling_force_n,
            "magnet_engaged": state.magnet_engaged,
            "gear_miss_m": world.gear_miss_m(),
        }

    def replace_vehicle(self, scenario: Scenario) -> None:
        """A new vehicle under the same link: connection and log blocks stay."""
        self._close_feed()
        self.vehicle = self._new_vehicle(scenario)
        self.server.replace_firmware(self.vehicle.firmware, keep_blocks=True)
        self._feed = self._new_feed()

    def close(self) -> None:
        """Free the ports and close the files."""
        self._close_feed()
        self._opened.close()

    def _write_heard(self, t_s: float, address: Address, datagram: bytes) -> None:
        assert self._heard is not None
        heard = {"t_s": t_s, "from": f"{address[0]}:{address[1]}", "packet": datagram.hex()}
        self._heard.write(json.dumps(heard) + "\n")
        self._heard.flush()

    def _publish_arrived(self) -> None:
        if self.vehicle.camera is None or self.stream is None:
            return
        arrived = self.vehicle.camera.take()
        if arrived:
            self.stream.publish(arrived[-1].image)

    def _publish_seen(self) -> None:
        if self.vehicle.capture is None or self.positions is None:
            return
        for frame in self.vehicle.capture.take():
            self.positions.publish(frame)

    def _new_vehicle(self, scenario: Scenario) -> SimulatedVehicle:
        setup = self._setup
        return SimulatedVehicle(scenario, setup.camera, setup.target, setup.capture)

    def _new_feed(self) -> _PictureFeed | None:
        if not self._live or self.vehicle.camera is None or self.stream is None:
            return None
        return _PictureFeed(self.vehicle, self.stream)

    def _close_feed(self) -> None:
        if self._feed is not None:
            self._feed.close()


class _PictureFeed:
    """Renders in its own thread from the states that the physics leaves behind."""

    def __init__(self, vehicle: SimulatedVehicle, stream: MjpegServer) -> None:
        assert vehicle.camera is not None
        self._camera = vehicle.camera
        self._stream = stream
        self._past = PastPoses(_PAST_S)
        self._changed = threading.Condition()
        self._closed = False
        self._waiting = 0
        self._thread = threading.Thread(target=self._run, name="picture-feed", daemon=True)
        self._thread.start()

    @property
    def late_s(self) -> float:
        return self._waiting * CONTROL_PERIOD_S

    def add(self, world: World) -> None:
        with self._changed:
            self._past.add(world)
            self._waiting += 1
            if self._waiting >= _WAKE_EVERY:
                self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while (t_s := self._next_time()) is not None:
            self._camera.advance(t_s, self._pose_at)
            self._camera.develop()  # while it is under way: its latency is the whole way's
            arrived = self._camera.take()
            if arrived:
                self._stream.publish(arrived[-1].image)

    def _next_time(self) -> float | None:
        """Waits for the physics to go on; None when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting >= _WAKE_EVERY)
            self._waiting = 0
            return None if self._closed else self._past.newest_s

    def _pose_at(self, t_s: float) -> Array:
        with self._changed:
            return self._past(t_s)


# --- The link's carrier: one CRTP packet a UDP datagram, as cflib's `udp://` driver sends them ---


_STREAM = 90  # this part's own stream of the seed
_RECEIVE_BYTES = 1 << 20
_NULL_HEADER = 0xFF
_EPS_S = 1e-9

Address = tuple[str, int]


class UdpEndpoint:
    """The socket of a simulated vehicle, bound to loopback.

    Answers go to the requesting address. What the vehicle sends by itself goes to the
    peer: the last address that sent anything but a scan's probe. `heard` is called with each
    datagram that is a packet, before anything is made of it: time, sender, bytes.
    """

    def __init__(self, port: int, options: LinkOptions, bursts: Bursts | None = None) -> None:
        """`port` 0 lets the operating system choose; `bursts`: in which nothing passes. Raises
        ConnectionFailed when taken."""
        self._options = options
        self._bursts = bursts
        self._random = np.random.default_rng([options.loss_seed, _STREAM])
        self._peer: Address | None = None
        self.heard: Callable[[float, Address, bytes], None] | None = None
        self._silent = (math.inf, math.inf)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.setblocking(False)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
            self.socket.bind(("127.0.0.1", port))
        except OSError as error:
            self.socket.close()
            raise _taken("UDP", port, error) from None
        self.port = int(self.socket.getsockname()[1])

    def close(self) -> None:
        self.socket.close()

    def silence(self, from_s: float, duration_s: float) -> None:
        """Receive and send nothing for a while of simulated time."""
        self._silent = (from_s, from_s + duration_s)

    def serve(self, server: CrtpServer, t_s: float) -> None:
        """Handle every datagram that has arrived. `t_s`: simulated time, for the silence."""
        while True:
            try:
                datagram, address = self.socket.recvfrom(64)
            except (BlockingIOError, InterruptedError):
                return
            except ConnectionError:  # a former peer's port is closed (Windows)
                continue
            if self._is_silent(t_s) or self._is_lost(t_s):
                continue
            packet = Packet.decode(datagram)
            if packet is None:
                continue
            if self.heard is not None:
                self.heard(t_s, address, datagram)
            if datagram[0] != _NULL_HEADER:
                self._peer = address
            self._send(server.handle(packet), address, t_s)

    def send_due(self, server: CrtpServer, t_s: float) -> None:
        """Send what the vehicle sends by itself; nothing is kept for a missing peer."""
        if self._peer is not None:
            self._send(server.due(), self._peer, t_s)

    def _send(self, packets: Iterable[Packet], address: Address, t_s: float) -> None:
        for packet in packets:
            if self._is_silent(t_s) or self._is_lost(t_s):
                continue
            try:
                self.socket.sendto(packet.encode(), address)
            except OSError:  # full buffer or a peer that is gone: lost like over the air
                continue

    def _is_silent(self, t_s: float) -> bool:
        return self._silent[0] - _EPS_S <= t_s < self._silent[1] - _EPS_S

    def _is_lost(self, t_s: float) -> bool:
        if self._bursts is not None and self._bursts.lost(t_s):
            return True
        rate = self._options.loss_rate
        return rate > 0.0 and float(self._random.random()) < rate


# --- The simulated camera's picture over HTTP, as a network camera would send it ---------------
# One part of a multipart answer is one JPEG; a slow client skips frames, the newest wins.


PATH = "/stream.mjpg"
JPEG_QUALITY = 92
_BOUNDARY = "perchctlframe"
_WAIT_S = 0.5
_CLIENT_TIMEOUT_S = 5.0


class MjpegServer:
    """Serves the newest of the published pictures on loopback.

    `port` 0 lets the operating system choose. Raises ConnectionFailed when it is taken.
    """

    def __init__(self, port: int = 0) -> None:
        self._changed = threading.Condition()
        self._image: Picture | None = None
        self._number = 0
        self.closed = False
        try:
            self._server = _HttpServer(port, self)
        except OSError as error:
            raise _taken("TCP", port, error) from None
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}{PATH}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        self._thread.start()

    def publish(self, image: Picture) -> None:
        """Grey uint8 (h, w). Costs nothing while nobody watches."""
        with self._changed:
            self._image = image
            self._number += 1
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, Picture] | None:
        """The newest picture and its number if that is above `number`; None when none came for a
        while."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._number > number, _WAIT_S)
            if self._image is None or self._number <= number:
                return None
            return self._number, self._image

    def close(self) -> None:
        """End all streams and free the port."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _HttpServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, port: int, pictures: MjpegServer) -> None:
        self.pictures = pictures
        super().__init__(("127.0.0.1", port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away is no error."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
    server: _HttpServer

    def do_GET(self) -> None:
        if self.path.split("?", 1)[0] != PATH:
            self.send_error(404, f"the stream is at {PATH}")
            return
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.flush()
        pictures, number = self.server.pictures, 0
        while not pictures.closed:
            newer = pictures.after(number)
            if newer is None:
                continue
            number, image = newer
            _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            jpeg = encoded.tobytes()
            head = (
                f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            )
            self.wfile.write(head.encode() + jpeg + b"\r\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not worth a line on the terminal."""


def _taken(kind: str, port: int, error: OSError) -> ConnectionFailed:
    return ConnectionFailed(
        f"{kind} port {port} on 127.0.0.1 cannot be used ({error.strerror}): choose another"
    )
