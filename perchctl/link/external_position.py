"""A vehicle that is told its position from outside: parameters, the filter's start, agreement.

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
"""Of one reset; the whole is bounded by `RESETS` of them."""
AGREE_M, AGREE_RAD = 0.05, math.radians(5.0)
"""Ten times what a capture is trusted for, and what half a metre of climb can bear."""
STILL_M = 0.05
"""From the reset until they agree: who carries the vehicle about has not put it down."""
_POLL_S = 0.02
NEEDED_BY = "positioning from outside"


Feed = PositionFeed | StandingFeed
"""What sends the positions, and says which."""


def estimator_parameters(config: PositioningConfig) -> dict[str, float]:
    """What the firmware has to be set to for positions from outside; none with decks."""
    if config.by == "deck":
        return {}
    return {
        ESTIMATOR: KALMAN,
        "locSrv.extPosStdDev": config.position_sigma_m,
        "locSrv.extQuatStdDev": config.attitude_sigma_rad,
    }


def start_parameters(start: Placed) -> dict[str, float]:
    """Where a reset of the firmware's estimator starts it."""
    x, y, z = (float(part) for part in start.position_m)
    values = {"X": x, "Y": y, "Z": z, "Yaw": yaw_of(start.R)}
    return {f"kalman.initial{name}": value for name, value in values.items()}


def check_estimator_parameters(own: Mapping[str, float], config: PositioningConfig) -> None:
    """One thing is said in one place. Errors: InvalidValue where `link.parameters` says another
    than `positioning`."""
    for name, wanted in estimator_parameters(config).items():
        if name in own and not math.isclose(own[name], wanted, rel_tol=1e-6):
            raise InvalidValue(
                f"link.parameters sets {name} to {own[name]:g}, but with positioning: {config.by} "
                f"it is {wanted:g}: take it out of link.parameters"
            )


class Settling:
    """Everything that is waited for; all of it bounded.

    `newest` gives the vehicle's newest telemetry. Errors of the methods: ConnectionFailed,
    NotFound, InvalidValue, TimedOut.
    """

    def __init__(
        self,
        cf: Any,
        uri: str,
        config: PositioningConfig,
        newest: Callable[[], Telemetry | None],
        clock: Callable[[], float],
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._cf, self._uri, self._config = cf, uri, config
        self._newest, self._clock, self._wait = newest, clock, wait

    def settle(self, feed: Feed) -> None:
        """Until the vehicle's estimate is where the capture sees it."""
        self._await_positions(feed)
        found = ""
        for _ in range(RESETS):
            start = self._place_on_ground(feed)
            self._reset(start)
            found = self._agreement(feed, start)
            if not found:
                return
        if self._config.by == "target":
            raise TimedOut(
                f"the estimate of {self._uri} does not come to the origin, where the vehicle is "
                f"told that it stands: {found}; do positions arrive?"
            )
        raise TimedOut(
            f"the estimate of {self._uri} does not come to where {self._config.label} sees the "
            f"vehicle: {found}; do positions arrive, and is this its rigid body?"
        )

    def _await_positions(self, feed: Feed) -> None:
        end_s = self._clock() + self._config.connect_timeout_s
        while (status := feed.status(self._clock())).problem is not None or not status.sent:
            if self._clock() >= end_s:
                why = status.problem or "none was sent"
                raise TimedOut(
                    f"no position from outside within {self._config.connect_timeout_s:g} s: {why}"
                )
            self._wait(_POLL_S)

    def _place_on_ground(self, feed: Feed) -> Placed:
        """Where the capture sees the vehicle now; refused if it may be flying."""
        if may_fly(self._newest(), self._clock()):
            raise ConnectionFailed(
                f"the vehicle at {self._uri} may be flying: its estimate is set on the ground only"
            )
        placed = feed.place()
        assert placed is not None  # `_await_positions` has seen one
        return placed

    def _reset(self, start: Placed) -> None:
        set_parameters(self._cf, self._uri, start_parameters(start), needed_by=NEEDED_BY)
        # Whether it was heard shows in the estimate: the firmware may clear it by itself.
        order_parameter(self._cf, self._uri, RESET_PARAMETER, 1, needed_by=NEEDED_BY)
        self._wait(RESET_PULSE_S)
        order_parameter(self._cf, self._uri, RESET_PARAMETER, 0, needed_by=NEEDED_BY)

    def _agreement(self, feed: Feed, start: Placed) -> str:
        """Empty once capture and estimate agree over fresh samples of both for a while;
        otherwise what has been in the way."""
        found = "no fresh telemetry has come"
        end_s = self._clock() + AGREE_WITHIN_S
        since_s: float | None = None
        while (now_s := self._clock()) < end_s:
            status, placed, newest = feed.status(now_s), feed.place(), self._newest()
            if status.problem is not None or placed is None:
                found, since_s = str(status.problem), None
            elif newest is None or not knows_its_position(newest, now_s):
                since_s = None
            else:
                found = _difference(placed, newest)
                if _way_m(placed.position_m, start.position_m) > STILL_M:
                    found = "it is being moved"
                since_s = None if found else (now_s if since_s is None else since_s)
            if since_s is not None and now_s - since_s >= AGREE_FOR_S:
                return ""
            self._wait(_POLL_S)
        return found or "it has not stayed there"


def _difference(placed: Placed, newest: Telemetry) -> str:
    """Empty if they are one."""
    way_m = _way_m(placed.position_m, newest.position_m)
    turn_rad = wrap_rad(newest.yaw_rad - yaw_of(placed.R))
    if way_m <= AGREE_M and abs(turn_rad) <= AGREE_RAD:
        return ""
    return f"they are {way_m:.2f} m and {abs(math.degrees(turn_rad)):.0f} deg of heading apart"


def _way_m(a: Any, b: Any) -> float:
    return math.dist([float(part) for part in a], [float(part) for part in b])
