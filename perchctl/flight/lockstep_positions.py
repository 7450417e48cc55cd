"""Positions from outside in lockstep: the simulated motion capture, the same feed as in real
time, and the simulated vehicle prepared as a real one is."""

from __future__ import annotations

from perchctl.errors import ConnectionFailed
from perchctl.geometry import yaw_of
from perchctl.link.mock import MockLink
from perchctl.positioning.feed import PositionFeed
from perchctl.positioning.judge import Placed, label, place_of
from perchctl.positioning.thread import PERIOD_S
from perchctl.profile import Profile
from perchctl.sim.capture.system import LockstepCapture

FIRST_FRAME_S = 1.0


def feed_lockstep(link: MockLink, profile: Profile) -> PositionFeed | None:
    """A feed that turns with the link's time; None without a motion capture.

    Lets the time pass until the vehicle's body is seen, and begins the estimate there. Errors:
    ConnectionFailed when it is not seen.
    """
    capture, config = link.vehicle.capture, profile.positioning
    if capture is None or config.by != "mocap":
        return None
    source = LockstepCapture(capture)
    place = _seen(link, source, profile)
    firmware = link.vehicle.firmware
    x, y, z = (float(part) for part in place.position_m)
    for name, value in {
        "stabilizer.estimator": 2,
        "locSrv.extPosStdDev": config.position_sigma_m,
        "locSrv.extQuatStdDev": config.attitude_sigma_rad,
        "kalman.initialX": x,
        "kalman.initialY": y,
        "kalman.initialZ": z,
        "kalman.initialYaw": yaw_of(place.R),
        "kalman.resetEstimation": 1,
    }.items():
        firmware.set_parameter(name, value)
    firmware.set_parameter("kalman.resetEstimation", 0)
    feed = PositionFeed(source, link.external, config)
    link.each(PERIOD_S, feed.turn)
    return feed


def _seen(link: MockLink, source: LockstepCapture, profile: Profile) -> Placed:
    end_s = link.now_s + FIRST_FRAME_S
    while link.now_s < end_s:
        link.advance_to(link.now_s + PERIOD_S)
        frame = source.poll(link.now_s)
        if frame is not None and profile.positioning.body in frame.bodies:
            return place_of(frame.bodies[profile.positioning.body], profile.positioning)
    raise ConnectionFailed(
        f"{label(profile.positioning)} does not see the rigid body {profile.positioning.body!r} "
        f"within {FIRST_FRAME_S:g} s"
    )
