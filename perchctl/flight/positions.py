"""Positions from outside for one flight in real time: capture, feed, and the thread between."""

from __future__ import annotations

import contextlib
from importlib.util import find_spec

from perchctl.errors import SafetyAbort, no_motion_capture
from perchctl.flight.clock import Clock, wall_date
from perchctl.flight.outside import AtRest
from perchctl.flight.preflight import refuse_strange
from perchctl.link import CflibLink, check_estimator_parameters, vehicle_uri
from perchctl.positioning import (
    CaptureSource,
    FeedThread,
    PositionFeed,
    StandingFeed,
    check_reachable,
    load_comparison,
    open_capture,
)
from perchctl.profile import PositioningConfig, Profile

STRANGE_S = 0.5
"""For so long it is looked whether positions are of another world, before they are used."""


def check_positioning(profile: Profile, *, simulated: bool) -> None:
    """What can be refused before anything is opened. Errors: InvalidValue, UsageError."""
    config = profile.positioning
    check_estimator_parameters(profile.link.parameters, config)
    if config.by != "mocap":
        return
    if not simulated:
        check_reachable(config)
    elif find_spec("motioncapture") is None:  # its room has a capture of its own
        raise no_motion_capture()


def require_comparison(config: PositioningConfig, uri: str, *, simulated: bool) -> None:
    """Raises SafetyAbort for a capture that no hand has compared of late with this vehicle:
    that its axes are swapped does not show at rest. The simulator's own room is right as it is
    built."""
    if config.by != "mocap" or simulated:
        return
    objected = load_comparison(config, vehicle_uri(uri)).objection(wall_date())
    if objected is not None:
        raise SafetyAbort(": ".join(objected))


def opened_capture(
    stack: contextlib.ExitStack, config: PositioningConfig, clock: Clock
) -> CaptureSource | None:
    """The capture, None with decks. Errors: InvalidValue, UsageError, ConnectionFailed."""
    if config.by != "mocap":
        return None
    capture = open_capture(config, clock.now)
    stack.callback(capture.close)
    return capture


def capture_for_vehicle(
    config: PositioningConfig, simulated: tuple[str, str] | None
) -> PositioningConfig:
    """With the capture that measures this vehicle: a simulated one's is at `simulated`, its kind
    and address, and in no lab."""
    if simulated is None:
        return config
    system, host = simulated
    return config.model_copy(update={"system": system, "host": host})


def started_feed(
    stack: contextlib.ExitStack,
    capture: CaptureSource | None,
    link: CflibLink,
    config: PositioningConfig,
    clock: Clock,
    profile: Profile,
) -> PositionFeed | None:
    """The vehicle's estimate settled on what the capture says, and positions on their way until
    `stack` ends: the link is closed before that, since a vehicle that lands still needs them.
    None with decks, and where the target is the positioning system.

    Errors: those of `CflibLink.settle`, and SafetyAbort for positions of another world."""
    if config.by == "target":
        _settle_standing(link, clock, profile)
        return None  # what follows is seen, and sent, by the loop
    if capture is None:
        return None
    feed = PositionFeed(capture, link.external, config)
    thread = FeedThread(feed, clock.now)
    stack.callback(thread.close)
    thread.start()
    _refuse_strange(feed, link, clock, profile)
    link.settle(feed)
    return feed


def _settle_standing(link: CflibLink, clock: Clock, profile: Profile) -> None:
    """On the ground, which is the world's origin: the estimate is settled there."""
    feed = StandingFeed(link.external, profile.safety.ground_z_m)
    thread = FeedThread(feed, clock.now, 1.0 / profile.positioning.rate_hz)
    thread.start()
    try:
        link.settle(feed)
    finally:
        thread.close()


def _refuse_strange(feed: PositionFeed, link: CflibLink, clock: Clock, profile: Profile) -> None:
    """Before an estimate is set to them, and before their scatter or their place is taken for
    something else. What is late is left to those who wait for it."""
    end_s, newest, at_rest = clock.now() + STRANGE_S, None, AtRest()
    while (now_s := clock.now()) < end_s:
        newest = next(reversed(link.telemetry()), newest)
        refuse_strange(feed.status(now_s), newest, profile, now_s, at_rest)
        clock.wait_until(now_s + 0.02)
