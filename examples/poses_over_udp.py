"""Poses as JSON over UDP, for example for ROS 2: python poses_over_udp.py SOURCE [CALIBRATION]

Each picture is one datagram, an object in UTF-8:

    t_s           exposure, s; of a live source by this computer's monotonic clock
    index         number of the picture, from 0
    position_m    [x, y, z] of the target in the camera frame (right, down, along the view);
                  null without an accepted pose
    quaternion    [w, x, y, z] that turns target axes to camera axes, or null
    covariance    36 numbers, row by row: x, y, z (m), turns about x, y, z (rad); or null.
                  That is the order of ROS's PoseWithCovariance
"""

import json
import socket
import sys
from typing import Any

from perchctl import Sighting, track
from perchctl.geometry import quaternion_from_rotation

ADDRESS = ("127.0.0.1", 9870)


def message(seen: Sighting) -> dict[str, Any]:
    """Return the object that is sent for a picture."""
    T, covariance = seen.T_cam_target, seen.covariance
    return {
        "t_s": seen.t_s,
        "index": seen.index,
        "position_m": None if T is None else T[:3, 3].tolist(),
        "quaternion": None if T is None else quaternion_from_rotation(T[:3, :3]),
        "covariance": None if covariance is None else covariance.ravel().tolist(),
    }


def send_poses(source: str, calibration: str | None, address: tuple[str, int] = ADDRESS) -> None:
    """Send until the source ends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for seen in track(source, "sim", calibration):
            sender.sendto(json.dumps(message(seen)).encode(), address)


if __name__ == "__main__":
    send_poses(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None)
