"""The estimator of a vehicle whose position is measured from outside: its parameters, its start,
and the agreement of estimate and measurement.

On the ground only. The filter is set to where the capture sees the vehicle while positions are
arriving already, since without them it would drift from there at once; its heading is what no
position can give it, and a wrong one sends the vehicle away in its first movement
(docs/positioning.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from perchctl.errors import ConnectionFailed, InvalidValue, TimedOut
from perchctl.geometry import wrap_rad, yaw_of
from perchctl.link.firmware import order_parameter, set_parameters
from perchctl.positioning import Placed, PositionFeed, StandingFeed
from perchctl.profile import PositioningConfig
from perchctl.vehicle import Telemetry, knows_its_position, may_fly

ESTIMATOR = "stabilizer.estimator"
KALMAN = 2
RESET_PARAMETER = "kalman.resetEstimation"
RESETS = 3
RESET_PULSE_S = 0.1
AGREE_WITHIN_S, AGREE_FOR_S = 3.0, 0.5
"""After one reset; the whole is bounded by `RESETS` of them."""
AGREE_M, AGREE_RAD = 0.05, math.radians(5.0)
"""Ten times what a capture is trusted for, and what half a metre of climb can bear."""
STILL_M = 0.05
"""From the reset until they agree: a vehicle that moves farther is being carried."""
_POLL_S = 0.02
NEEDED_BY = "positioning from outside"

Feed = PositionFeed | StandingFeed
"""What sends the positions, and says which."""


def estimator_parameters(config: PositioningConfig) -> dict[str, float]:
    """Return what the firmware has to be set to for positions from outside; none with decks."""
    if config.by == "deck":
        return {}
    return {
        ESTIMATOR: KALMAN,
        "locSrv.extPosStdDev": config.position_sigma_m,
        "locSrv.extQuatStdDev": config.attitude_sigma_rad,
    }


def start_parameters(start: Placed) -> dict[str, float]:
    """Return the parameters by which a reset starts the firmware's estimator at a place."""
    x, y, z = (float(part) for part in start.position_m)
    values = {"X": x, "Y": y, "Z": z, "Yaw": yaw_of(start.R)}
    return {f"kalman.initial{name}": value for name, value in values.items()}


def check_estimator_parameters(own: Mapping[str, float], config: PositioningConfig) -> None:
    """Raises InvalidValue if the user's own `link.parameters` contradict `positioning`."""
    for name, wanted in estimator_parameters(config).items():
        if name in own and not math.isclose(own[name], wanted, rel_tol=1e-6):
            raise InvalidValue(
                f"link.parameters sets {name} to {own[name]:g}, but with positioning: {config.by} "
                f"it is {wanted:g}: take it out of link.parameters"
            )


def settle_estimate(
    cf: Any,
    uri: str,
    config: PositioningConfig,
    feed: Feed,
    newest: Callable[[], Telemetry | None],
    clock: Callable[[], float],
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Reset the vehicle's estimator to where `feed` places it, until both agree. Bounded.

    `newest` gives the vehicle's newest telemetry. Raises ConnectionFailed for a vehicle that may
    fly, NotFound, InvalidValue, TimedOut.
    """
    _await_positions(config, feed, clock, wait)
    found = ""
    for _ in range(RESETS):
        if may_fly(newest(), clock()):
            raise ConnectionFailed(
                f"the vehicle at {uri} may be flying: its estimate is set on the ground only"
            )
        start = feed.place()
        assert start is not None  # `_await_positions` has seen one
        set_parameters(cf, uri, start_parameters(start), needed_by=NEEDED_BY)
        # Whether it was heard shows in the estimate: the firmware may clear it by itself.
        order_parameter(cf, uri, RESET_PARAMETER, 1, needed_by=NEEDED_BY)
        wait(RESET_PULSE_S)
        order_parameter(cf, uri, RESET_PARAMETER, 0, needed_by=NEEDED_BY)
        found = _disagreement(feed, start, newest, clock, wait)
        if not found:
            return
    if config.by == "target":
        raise TimedOut(
            f"the estimate of {uri} does not come to the origin, where the vehicle is "
            f"told that it stands: {found}; do positions arrive?"
        )
    raise TimedOut(
        f"the estimate of {uri} does not come to where {config.label} sees the "
        f"vehicle: {found}; do positions arrive, and is this its rigid body?"
    )


def _await_positions(
    config: PositioningConfig,
    feed: Feed,
    clock: Callable[[], float],
    wait: Callable[[float], None],
) -> None:
    end_s = clock() + config.connect_timeout_s
    while (status := feed.status(clock())).problem is not None or not status.sent:
        if clock() >= end_s:
            raise TimedOut(
                f"no position from outside within {config.connect_timeout_s:g} s: "
                f"{status.problem or 'none was sent'}"
            )
        wait(_POLL_S)


def _disagreement(
    feed: Feed,
    start: Placed,
    newest: Callable[[], Telemetry | None],
    clock: Callable[[], float],
    wait: Callable[[float], None],
) -> str:
    """Return an empty string once capture and estimate have agreed over fresh samples of both for
    `AGREE_FOR_S`; otherwise what has been in the way."""
    found = "no fresh telemetry has come"
    end_s = clock() + AGREE_WITHIN_S
    since_s: float | None = None
    while (now_s := clock()) < end_s:
        status, placed, sample = feed.status(now_s), feed.place(), newest()
        if status.problem is not None or placed is None:
            found, since_s = str(status.problem), None
        elif sample is None or not knows_its_position(sample, now_s):
            since_s = None
        else:
            found = _difference(placed, sample)
            if math.dist(placed.position_m, start.position_m) > STILL_M:
                found = "it is being moved"
            since_s = None if found else (now_s if since_s is None else since_s)
        if since_s is not None and now_s - since_s >= AGREE_FOR_S:
            return ""
        wait(_POLL_S)
    return found or "it has not stayed there"


def _difference(placed: Placed, newest: Telemetry) -> str:
    """Return in words how far apart they are; empty if they agree."""
    way_m = math.dist(placed.position_m, newest.position_m)
    turn_rad = wrap_rad(newest.yaw_rad - yaw_of(placed.R))
    if way_m <= AGREE_M and abs(turn_rad) <= AGREE_RAD:
        return ""
    return f"they are {way_m:.2f} m and {abs(math.degrees(turn_rad)):.0f} deg of heading apart"
