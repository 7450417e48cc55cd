"""A network camera on loopback: RTSP with Motion-JPEG (RFC 2435) in the same connection.

Every picture, pause and end is the test's.
"""

from __future__ import annotations

import contextlib
import queue
import re
import socket
import struct
import threading
from dataclasses import dataclass, field
from hashlib import md5

from tests.helpers import live
from tests.helpers.live import WAIT_S

_NONCE = "5ca1ab1e"
_SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\n"
    "m=video 0 RTP/AVP 26\r\na=control:track0\r\n"
)

Step = tuple[float, int] | threading.Event
"""A picture, by the camera's time and its grey level; or what to wait for."""


@dataclass(eq=False)
class RtspServer:
    """Plays one script a connection, then ends it. `who`: name and password that it wants."""

    path: str = "/live"
    who: tuple[str, str] | None = None
    scripts: queue.Queue[list[Step]] = field(default_factory=queue.Queue)
    plays: int = 0
    asked: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.port = self._listener.getsockname()[1]
        self.closing = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def url(self, who: str = "") -> str:
        return f"rtsp://{who}127.0.0.1:{self.port}{self.path}"

    def close(self) -> None:
        self.closing.set()
        for each in (self._listener, *self._open):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        while not self.closing.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._open.append(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rb") as lines:
                while (request := _request(lines)) is not None:
                    if self._answer(connection, *request):
                        self._play(connection)
                        return
        except OSError:
            return

    def _answer(self, connection: socket.socket, line: str, headers: dict[str, str]) -> bool:
        """Whether the pictures are wanted now."""
        method, url, _ = line.split(" ", 2)
        self.asked.append(f"{method} {headers.get('authorization', '')[:6]}".strip())
        status, more, body = "200 OK", "", ""
        if method == "OPTIONS":
            more = "Public: DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
        elif not self._may(method, headers.get("authorization", "")):
            status = "401 Unauthorized"
            more = f'WWW-Authenticate: Digest realm="camera", nonce="{_NONCE}"\r\n'
        elif self.path not in url:
            status = "404 Not Found"
        elif method == "DESCRIBE":
            more, body = "Content-Type: application/sdp\r\n", _SDP
        elif method == "SETUP":
            more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 7\r\n"
        elif method == "PLAY":
            more = "Session: 7\r\n"
        answer = f"RTSP/1.0 {status}\r\nCSeq: {headers['cseq']}\r\n{more}"
        answer += f"Content-Length: {len(body)}\r\n\r\n{body}"
        connection.sendall(answer.encode())
        return method == "PLAY" and status.startswith("200")

    def _may(self, method: str, given: str) -> bool:
        if self.who is None:
            return True
        values = dict(re.findall(r'(\w+)="([^"]*)"', given))
        name, password = self.who

        def h(text: str) -> str:
            return md5(text.encode()).hexdigest()

        first, last = h(f"{name}:camera:{password}"), h(f"{method}:{values.get('uri', '')}")
        return values.get("response") == h(f"{first}:{_NONCE}:{last}")

    def _play(self, connection: socket.socket) -> None:
        self.plays += 1
        try:
            script = self.scripts.get_nowait()
        except queue.Empty:
            return
        number = 0
        for step in script:
            if isinstance(step, threading.Event):
                step.wait(WAIT_S)
                continue
            for packet in packets(*step, number):
                connection.sendall(packet)
                number += 1


def _request(lines: object) -> tuple[str, dict[str, str]] | None:
    read = getattr(lines, "readline")  # noqa: B009
    line = read().decode("latin-1").strip()
    if not line:
        return None
    headers = {}
    while text := read().decode("latin-1").strip():
        key, _, value = text.partition(":")
        headers[key.lower()] = value.strip()
    return line, headers


def packets(t_s: float, level: int, number: int) -> list[bytes]:
    """A picture of that grey level in RTP, each packet behind the header of the connection."""
    jpeg = live.jpeg(level, (48, 64, 3))
    tables = b"".join(jpeg[m + 5 : m + 69] for m in _segments(jpeg, 0xDB))
    (scan,) = _segments(jpeg, 0xDA)
    data = jpeg[scan + 2 + int.from_bytes(jpeg[scan + 2 : scan + 4], "big") : -2]
    out, at = [], 0
    while at < len(data):
        part = data[at : at + 1000]
        head = struct.pack(">I", at) + bytes((1, 255, 64 // 8, 48 // 8))
        if at == 0:
            head += struct.pack(">BBH", 0, 0, len(tables)) + tables
        last = at + len(part) >= len(data)
        rtp = struct.pack(
            ">BBHII", 0x80, 26 | (0x80 if last else 0), number & 0xFFFF, int(t_s * 90_000), 1
        )
        body = rtp + head + part
        out.append(struct.pack(">BBH", ord("$"), 0, len(body)) + body)
        at, number = at + len(part), number + 1
    return out


def _segments(jpeg: bytes, kind: int) -> list[int]:
    found, at = [], 2
    while at < len(jpeg):
        if jpeg[at + 1] == kind:
            found.append(at)
        if jpeg[at + 1] == 0xDA:
            break
        at += 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
    return found
