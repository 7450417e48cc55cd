"""What the tests of the simulated vehicle's process share."""

from __future__ import annotations

import contextlib
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

import perchctl

ROOT = str(Path(perchctl.__file__).resolve().parents[1])


WAIT_S = 20.0


@contextlib.contextmanager
def wired(uri: str) -> Iterator[socket.socket]:
    """A socket to a vehicle's link: one datagram, one packet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mine:
        mine.connect(("127.0.0.1", int(uri.rsplit(":", 1)[1])))
        mine.setblocking(False)
        yield mine


def _parts(url: str, count: int) -> list[np.ndarray]:
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
