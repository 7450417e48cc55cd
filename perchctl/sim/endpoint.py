"""What a simulated vehicle serves on loopback: its link on UDP, its camera's pictures on HTTP."""

from __future__ import annotations

import math
import socket
import sys
import threading
from collections.abc import Callable, Iterable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np

from perchctl.link import Packet
from perchctl.sim.bursts import Bursts
from perchctl.sim.crtp.server import CrtpServer, LinkOptions
from perchctl.sim.optics import Picture

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

    def __init__(self, options: LinkOptions, bursts: Bursts | None = None) -> None:
        """`bursts`: in which nothing passes."""
        self._options = options
        self._bursts = bursts
        self._random = np.random.default_rng([options.loss_seed, _STREAM])
        self._peer: Address | None = None
        self.heard: Callable[[float, Address, bytes], None] | None = None
        self._silent = (math.inf, math.inf)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
        self.socket.bind(("127.0.0.1", 0))
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
    """Serves the newest of the published pictures on loopback."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._image: Picture | None = None
        self._number = 0
        self.closed = False
        self._server = _HttpServer(self)
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

    def __init__(self, pictures: MjpegServer) -> None:
        self.pictures = pictures
        super().__init__(("127.0.0.1", 0), _Handler)

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
