"""Set up the estimator of a vehicle that uses external positions: set its parameters, start it, and
check that estimate and measurement agree.

This is done only on the ground. The filter is reset to the measured pose while positions are
already arriving; otherwise it would drift. Positions do not determine the heading, and a wrong
heading makes the vehicle fly away (docs/positioning.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from perchctl.errors import ConnectionFailed, TimedOut
from perchctl.geometry import wrap_rad, yaw_of
from perchctl.link.firmware import set_parameters
from perchctl.positioning import FeedStatus, PositionFeed, VehiclePose
from perchctl.profile import PositioningConfig
from perchctl.vehicle import (
    ExternalPosition,
    SendPosition,
    Telemetry,
    has_fresh_position,
    may_be_flying,
)

ESTIMATOR = "stabilizer.estimator"
KALMAN = 2
RESET_PARAMETER = "kalman.resetEstimation"
RESETS = 3
"""Number of attempts to reset the estimator."""
RESET_PULSE_S = 0.1
"""Time for which the reset parameter is set, s."""
AGREE_WITHIN_S, AGREE_FOR_S = 3.0, 0.5
"""Timeout for agreement after one reset, and how long the agreement must last, s. There are at most
`RESETS` resets."""
RESET_AGREE_M = 0.05
"""Largest distance between estimated and measured position after a reset, m: ten times the assumed
error of motion capture."""
RESET_AGREE_RAD = math.radians(5.0)
"""Largest difference between estimated and measured heading after a reset, rad: tolerable for half
a metre of climb."""
RESET_STILL_M = 0.05
"""Largest distance that the vehicle may move between the reset and the agreement, m; a vehicle that
moves farther is being carried."""
ESTIMATE_POLL_S = 0.02
"""Time between two comparisons of the estimate with the measured position, s."""


def estimator_parameters(config: PositioningConfig) -> dict[str, float]:
    """Return the firmware parameters for external positions, which are set after the user's own
    parameters; none if decks measure the position."""
    if config.source.is_deck:
        return {}
    return {
        ESTIMATOR: KALMAN,
        "locSrv.extPosStdDev": config.position_sigma_m,
        "locSrv.extQuatStdDev": config.attitude_sigma_rad,
    }


def estimator_start_parameters(start: VehiclePose) -> dict[str, float]:
    """Return the `kalman.initial*` parameters that make a reset start the estimator at `start`."""
    x, y, z = (float(part) for part in start.position_m)
    values = {"X": x, "Y": y, "Z": z, "Yaw": yaw_of(start.R)}
    return {f"kalman.initial{name}": value for name, value in values.items()}


def settle_estimator(
    cf: Any,
    uri: str,
    config: PositioningConfig,
    feed: PositionFeed | StandingFeed,
    newest: Callable[[], Telemetry | None],
    clock: Callable[[], float],
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Reset the estimator of a vehicle on the ground until it agrees with the feed, with a timeout.

    `newest` returns the vehicle's newest telemetry, and `wait` waits for a number of seconds.
    Raises ConnectionFailed for a vehicle that may be flying, NotFound, InvalidValue and TimedOut.
    """
    end_s = clock() + config.connect_timeout_s
    while (status := feed.status(clock())).problem is not None or not status.sent:
        if clock() >= end_s:
            raise TimedOut(
                f"no external position within {config.connect_timeout_s:g} s: "
                f"{status.problem or 'none was sent'}"
            )
        wait(ESTIMATE_POLL_S)
    for _ in range(RESETS):
        if may_be_flying(newest(), clock()):
            raise ConnectionFailed(
                f"the vehicle at {uri} may be flying: its estimate is reset only on the ground"
            )
        start = feed.sent_pose()
        assert start is not None  # the loop above has waited for a sent pose
        x, y, z = start.position_m
        set_parameters(cf, uri, estimator_start_parameters(start))
        # Only the estimate shows whether the reset was received, because the firmware may clear the
        # parameter itself.
        for value in (1, 0):
            set_parameters(cf, uri, {RESET_PARAMETER: value}, read_back=False)
            wait(RESET_PULSE_S * value)
        if _agree(feed, start, newest, clock, wait):
            return
    where = "the origin, the position of the vehicle"
    if not config.source.is_target:
        where = f"x {x:.2f}, y {y:.2f}, z {z:.2f} m, where {config.label} sees the vehicle"
    raise TimedOut(
        f"the estimate of {uri} does not converge to {where}: check that the vehicle is "
        "at rest and that it receives its own positions, in metres"
    )


def _agree(
    feed: PositionFeed | StandingFeed,
    start: VehiclePose,
    newest: Callable[[], Telemetry | None],
    clock: Callable[[], float],
    wait: Callable[[float], None],
) -> bool:
    """Return True once fresh samples of feed and estimate have agreed for `AGREE_FOR_S` while the
    vehicle stayed at `start`."""
    end_s = clock() + AGREE_WITHIN_S
    since_s: float | None = None
    while (now_s := clock()) < end_s:
        status, placed, sample = feed.status(now_s), feed.sent_pose(), newest()
        agree = (
            status.problem is None
            and placed is not None
            and sample is not None
            and has_fresh_position(sample, now_s)
            and math.dist(placed.position_m, start.position_m) <= RESET_STILL_M
            and math.dist(placed.position_m, sample.position_m) <= RESET_AGREE_M
            and abs(wrap_rad(sample.yaw_rad - yaw_of(placed.R))) <= RESET_AGREE_RAD
        )
        since_s = (now_s if since_s is None else since_s) if agree else None
        if since_s is not None and now_s - since_s >= AGREE_FOR_S:
            return True
        wait(ESTIMATE_POLL_S)
    return False


class StandingFeed:
    """Feed for a vehicle whose position on the ground defines the world: the vehicle is level at
    x = y = 0 and faces along x. `wait` sends that position `rate_hz` times a second."""

    def __init__(
        self, send: SendPosition, ground_z_m: float, rate_hz: float, clock: Callable[[], float]
    ) -> None:
        self._send, self._place = send, ExternalPosition((0.0, 0.0, ground_z_m))
        self._period_s, self._due_s = 1.0 / rate_hz, -math.inf
        self._clock, self._count = clock, 0

    def wait(self, duration_s: float) -> None:
        """Send the position until `duration_s` has passed."""
        end_s = self._clock() + duration_s
        while (now_s := self._clock()) < end_s:
            if now_s >= self._due_s:
                self._count += self._send(self._place) is not False
                self._due_s = now_s + self._period_s
            time.sleep(min(self._due_s, end_s) - now_s)

    def status(self, now_s: float) -> FeedStatus:
        return FeedStatus(0.0, None, self._count, self._place)

    def sent_pose(self) -> VehiclePose:
        return VehiclePose(self._clock(), np.array(self._place.position_m), np.eye(3))
