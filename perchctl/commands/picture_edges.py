"""How a camera is turned, in words: which edge of its picture is the vehicle's front.

People see the picture and the vehicle, and no axes: a hand over the vehicle's front comes into
the picture at one edge, over its left side at another. The two tell the camera's turn about
its view, and whether the picture is mirrored (docs/conventions.md, "Camera mount").
"""

from __future__ import annotations

import math

from perchctl.geometry import Array
from perchctl.profile import Mounting

PICTURE_EDGES: dict[str, tuple[int, int]] = {
    "top": (0, -1),
    "right": (1, 0),
    "bottom": (0, 1),
    "left": (-1, 0),
}
"""Where each is in the picture, x right and y down."""
UPRIGHT = math.cos(math.radians(30.0))


def edges_beside(front: str) -> tuple[str, str]:
    """Return at which edges the vehicle's left side can be: first that of a picture that is not
    mirrored."""
    x, y = PICTURE_EDGES[front]
    plain = next(edge for edge, place in PICTURE_EDGES.items() if place == (-y, x))
    mirrored = next(edge for edge, place in PICTURE_EDGES.items() if place == (y, -x))
    return plain, mirrored


def mount_from_edges(front: str, left: str) -> tuple[float, bool]:
    """Return the last of `camera.mount.rpy_deg` for a camera that looks up, and whether its picture
    is mirrored. `left` is one of `edges_beside(front)`."""
    x, y = PICTURE_EDGES[front]
    mirrored = left == edges_beside(front)[1]
    if mirrored:
        x = -x  # of the picture as it is flipped before use
    # The front is at the angle a in the picture; x right, y down, seen from below: the turn is -a.
    turn_deg = -math.degrees(math.atan2(y, x))
    return (180.0 if turn_deg == -180.0 else turn_deg + 0.0), mirrored


def picture_edges(mount: Mounting, mirrored: bool) -> tuple[str, str] | None:
    """Return the edges of the vehicle's front and left side in the picture as the camera gives it;
    None for a camera that does not look up, or is turned by about an eighth of a circle."""
    R_cam_body = mount.T_body_cam[:3, :3].T
    if R_cam_body[2, 2] < UPRIGHT:
        return None
    front, left = (_edge(R_cam_body[:2, axis], mirrored) for axis in (0, 1))
    return None if front is None or left is None else (front, left)


def _edge(direction: Array, mirrored: bool) -> str | None:
    x, y = (-direction[0] if mirrored else direction[0]), direction[1]
    return next(
        (e for e, place in PICTURE_EDGES.items() if x * place[0] + y * place[1] >= UPRIGHT), None
    )
