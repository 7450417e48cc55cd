"""Your own camera: JPEGs that come by UDP, one a datagram, as small camera boards send them.

In the profile: `camera: {source: "own_camera:UdpCamera"}`; on the command line:
`perchctl track own_camera:UdpCamera --view`, called in the folder of this file.
"""

import socket
from collections.abc import Callable

import cv2
import numpy as np

from perchctl import Frame

ADDRESS = ("127.0.0.1", 9871)


class UdpCamera:
    """A `perchctl.FrameSource`; made with the loop's clock and the profile's section `camera`."""

    live = True  # it runs in real time, and only the newest picture counts
    finished = False  # a recording says True at its end
    size_px = None  # perchctl reads it from the pictures

    def __init__(self, clock: Callable[[], float], config: object) -> None:
        self._latency_s = float(getattr(config, "start_latency_s", 0.0))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(ADDRESS)
        self._socket.setblocking(False)  # nothing in a flight may wait

    def poll(self, now_s: float) -> Frame | None:
        data = b""
        try:
            while True:
                data = self._socket.recv(65535)
        except BlockingIOError:
            pass  # `data` is the newest one
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if image is None:
            return None
        return Frame(
            0, now_s - self._latency_s, np.asarray(image, np.uint8)
        )  # BGR; perchctl counts

    def problem(self, now_s: float) -> str | None:
        return None  # a sentence if it is broken; perchctl itself notices that no pictures come

    def describe(self) -> str:
        return "JPEGs at {}:{}".format(*ADDRESS)

    def close(self) -> None:
        self._socket.close()
