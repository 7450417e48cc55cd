"""Positions from outside in lockstep: the simulated motion capture, the same feed as in real
time, and the simulated vehicle prepared as a real one is."""

from __future__ import annotations

from typing import Literal

from perchctl.errors import ConnectionFailed
from perchctl.geometry import yaw_of
from perchctl.link import RESET_PARAMETER, MockLink, estimator_parameters
from perchctl.positioning import FeedThread, PositionFeed
from perchctl.profile import PositioningConfig, Profile
from perchctl.sim import SIMULATED_SYSTEM, LockstepCapture

FIRST_FRAME_S = 1.0


def with_positioning(by: Literal["deck", "mocap"], profile: Profile) -> Profile:
    """The same with its position by decks, or from outside."""
    config = profile.positioning.model_copy(update={"by": by})
    return profile.model_copy(update={"positioning": config})


def feed_lockstep(link: MockLink, profile: Profile) -> PositionFeed | None:
    """A feed that turns with the link's time, for the flight loop; None with decks, and where
    the target is the positioning system: the loop feeds then.

    Lets the time pass until the vehicle's body is seen, and starts the estimate there. Errors:
    ConnectionFailed when it is not.
    """
    capture, config = link.vehicle.capture, profile.positioning
    if config.by == "target":
        _start_at(link, config, 0.0, 0.0, profile.safety.ground_z_m, 0.0)
        return None
    if capture is None or config.by != "mocap":
        return None
    config = config.model_copy(update={"system": SIMULATED_SYSTEM, "host": "sim"})
    feed = PositionFeed(LockstepCapture(capture), link.external, config)
    link.each(FeedThread.PERIOD_S, feed.turn)
    end_s = link.now_s + FIRST_FRAME_S
    while (place := feed.place()) is None:
        if link.now_s >= end_s:
            why = feed.status(link.now_s).problem or f"nothing comes from {config.label}"
            raise ConnectionFailed(f"no position within {FIRST_FRAME_S:g} s: {why}")
        link.advance_to(link.now_s + FeedThread.PERIOD_S)
    x, y, z = (float(part) for part in place.position_m)
    _start_at(link, config, x, y, z, yaw_of(place.R))
    return feed


def _start_at(
    link: MockLink, config: PositioningConfig, x_m: float, y_m: float, z_m: float, yaw_rad: float
) -> None:
    start = {"X": x_m, "Y": y_m, "Z": z_m, "Yaw": yaw_rad}
    initial = {f"kalman.initial{name}": value for name, value in start.items()}
    for name, value in (estimator_parameters(config) | initial | {RESET_PARAMETER: 1}).items():
        link.vehicle.firmware.set_parameter(name, value)
    link.vehicle.firmware.set_parameter(RESET_PARAMETER, 0)
