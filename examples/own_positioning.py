"""Your own positioning source: poses of the vehicle's body as JSON over UDP.

In the profile: `positioning: {by: mocap, system: "own_positioning:UdpPoses", body: crazyflie}`.
A datagram: {"body": "crazyflie", "position_m": [x, y, z], "quaternion": [w, x, y, z]}, in a world
with z up; the quaternion turns body axes to world axes. Only the newest is passed on; perchctl
refuses jumps, frozen and stale poses. Before the first flight: `perchctl check --lift`.
"""

import json
import socket
from collections.abc import Callable

from perchctl import BodyPose, CaptureFrame

ADDRESS = ("127.0.0.1", 9872)
SILENT_AFTER_S = 0.3


class UdpPoses:
    """A `perchctl.CaptureSource`; made with the loop's clock and the section `positioning`."""

    def __init__(self, clock: Callable[[], float], config: object) -> None:
        self._heard_s = clock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(ADDRESS)
        self._socket.setblocking(False)  # nothing in a flight may wait

    def poll(self, now_s: float) -> CaptureFrame | None:
        data = b""
        try:
            while True:
                data = self._socket.recv(4096)
        except BlockingIOError:
            pass  # `data` is the newest one
        if not data:
            return None
        self._heard_s = now_s
        pose = json.loads(data)
        (x, y, z), (qw, qx, qy, qz) = pose["position_m"], pose["quaternion"]
        return CaptureFrame(now_s, {pose["body"]: BodyPose((x, y, z), (qw, qx, qy, qz))})

    def problem(self, now_s: float) -> str | None:
        silent_s = now_s - self._heard_s
        return f"no pose for {silent_s:.1f} s" if silent_s > SILENT_AFTER_S else None

    def close(self) -> None:
        self._socket.close()
