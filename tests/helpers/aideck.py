"""An AI-deck on loopback: its bytes, made of any pictures, and a server that sends a script."""

from __future__ import annotations

import queue
import select
import socket
import struct
import threading
from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
APP, CONSOLE, WIFI_CTRL = 5, 2, 4
CHUNK_BYTES = 1020  # of a packet of 1022, the deck's most
GAP8_TO_HOST = 0x40 | (4 << 3) | 3
ESP32_TO_HOST = 0x40 | (2 << 3) | 3
LEAST_S = 10.0  # bound of every wait; reached only when a test fails


@dataclass(frozen=True)
class Pause:
    """Between two pictures, as a camera takes them."""

    length_s: float


Script = list[bytes | threading.Event | Pause]


def packet(data: bytes, function: int = APP, routing: int = GAP8_TO_HOST) -> bytes:
    return struct.pack("<HBB", len(data) + 2, routing, function) + data


def header(width: int, height: int, size: int, kind: int, depth: int = 1) -> bytes:
    return packet(struct.pack("<BHHBBI", 0xBC, width, height, depth, kind, size))


def chunks(data: bytes) -> list[bytes]:
    """As the streamer sends a buffer: the last one shorter, and empty where all are full."""
    return [packet(data[i : i + CHUNK_BYTES]) for i in range(0, len(data) + 1, CHUNK_BYTES)]


def raw_packets(image: Picture) -> list[bytes]:
    height, width = image.shape
    return [header(width, height, image.size, 0), *chunks(image.tobytes())]


def jpeg_packets(image: Picture, quality: int = 75) -> list[bytes]:
    """The JPEG's head, its scan and its last two bytes apart, as the deck's encoder has them."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    head = data.index(b"\xff\xda")
    height, width = image.shape
    return [
        header(width, height, len(data), 1),
        packet(data[:head]),
        *chunks(data[head:-2]),
        packet(data[-2:]),
    ]


def raw(image: Picture) -> bytes:
    return b"".join(raw_packets(image))


def jpeg(image: Picture) -> bytes:
    return b"".join(jpeg_packets(image))


def console(text: str = "capture=58ms, transfer=64 ms\n") -> bytes:
    return packet(text.encode() + b"\0", CONSOLE, ESP32_TO_HOST)


def picture(level: int, size_px: tuple[int, int] = (324, 244)) -> Picture:
    """Noise around a grey level, by which it is known again."""
    rng = np.random.default_rng(level)
    width, height = size_px
    return np.clip(rng.normal(level, 4.0, (height, width)), 0, 255).astype(np.uint8)


def bayer(image: Picture, gains: tuple[float, float, float] = (0.55, 1.0, 0.7)) -> Picture:
    """What a colour sensor of blue, green, red that sees this grey scene delivers."""
    blue, green, red = gains
    mosaic = image.astype(np.float64)
    mosaic[0::2, 0::2] *= blue
    mosaic[0::2, 1::2] *= green
    mosaic[1::2, 0::2] *= green
    mosaic[1::2, 1::2] *= red
    return mosaic.astype(np.uint8)


class AiDeck:
    """Serves one script a connection: bytes to send, events to wait for, then the end."""

    def __init__(self) -> None:
        self.scripts: queue.Queue[Script] = queue.Queue()
        self.forever: list[bytes] = []  # sent over and over to whom no script is left for
        self.connections = 0
        self.closed = threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"aideck://127.0.0.1:{self._listening.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.closed.set()
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(LEAST_S)

    def _serve(self) -> None:
        while not self.closed.is_set():
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            self.connections += 1
            with client, suppress(OSError):
                client.settimeout(LEAST_S)
                self._send(client)

    def _send(self, client: socket.socket) -> None:
        try:
            script = self.scripts.get_nowait()
        except queue.Empty:
            script = []
            while self.forever and not self.closed.is_set():
                for data in self.forever:
                    client.sendall(data)
                    self.closed.wait(0.01)
        for step in script:
            if isinstance(step, threading.Event):
                while not (step.wait(0.01) or self.closed.is_set()):
                    if select.select([client], [], [], 0.0)[0]:
                        return  # the computer has hung up
            elif isinstance(step, Pause):
                self.closed.wait(step.length_s)
            else:
                client.sendall(step)
