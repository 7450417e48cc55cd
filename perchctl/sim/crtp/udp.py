"""The link's carrier: one CRTP packet a UDP datagram, as cflib's `udp://` driver sends them."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable

import numpy as np

from perchctl.errors import ConnectionFailed
from perchctl.sim.bursts import Bursts
from perchctl.sim.crtp.codec import Packet
from perchctl.sim.crtp.server import CrtpServer, LinkOptions

_STREAM = 90  # this part's own stream of the seed
_RECEIVE_BYTES = 1 << 20
_NULL_HEADER = 0xFF
_EPS_S = 1e-9

Address = tuple[str, int]


class UdpEndpoint:
    """The socket of a simulated vehicle, bound to loopback.

    Answers go to the requesting address. What the vehicle sends by itself goes to the
    peer: the last address that sent anything but a scan's probe. `heard` is told of each
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
        self._silent: tuple[float, float] | None = None
        if options.silent_from_s is not None:
            self._silent = (options.silent_from_s, options.silent_from_s + options.silent_for_s)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.setblocking(False)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
            self.socket.bind(("127.0.0.1", port))
        except OSError as error:
            self.socket.close()
            raise ConnectionFailed(
                f"UDP port {port} on 127.0.0.1 cannot be used ({error.strerror}): choose another"
            ) from None
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
        return self._silent is not None and (
            self._silent[0] - _EPS_S <= t_s < self._silent[1] - _EPS_S
        )

    def _is_lost(self, t_s: float) -> bool:
        if self._bursts is not None and self._bursts.lost(t_s):
            return True
        rate = self._options.loss_rate
        return rate > 0.0 and float(self._random.random()) < rate
