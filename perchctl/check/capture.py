"""The motion capture that a vehicle would be told its position by: answers, body, rate, noise.

`listen` hears vehicle and capture for a while; `rows` judges, pure. Nothing is sent.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perchctl.check.row import Row, by_limits, failed, passed, skipped, worse
from perchctl.flight import (
    external_height_problem,
    millimetres_problem,
    motion_problem,
    tilt_problem,
    world_problem,
)
from perchctl.geometry import Array
from perchctl.positioning import CaptureFrame, CaptureSource, Placed
from perchctl.profile import PositioningConfig, Profile
from perchctl.vehicle import Telemetry

LISTEN_S = 2.0
POLL_S = 0.005
RATE_WARN_HZ, RATE_FAIL_HZ = 50.0, 20.0
"""Between two at 20 Hz a vehicle falls by 12 mm before it is told."""
AGE_WARN_S, AGE_FAIL_S = 0.03, 0.1
NOISE_FAIL = 4.0
"""Times `positioning.position_sigma_m`: so much more than the vehicle takes it for."""
WILD_M = 0.1
"""No capture is so noisy."""

NAMES = ("capture", "body", "body rate", "body age", "body noise", "body place")
"""The rows of a capture, in their order."""

Wait = Callable[[float], None]


@dataclass(frozen=True)
class Listened:
    """What came while it was listened to: for how long, the vehicle's telemetry, the capture's
    frames with the age that each had when it was read, and what the capture complained of."""

    lasted_s: float
    telemetry: tuple[Telemetry, ...] = ()
    frames: tuple[tuple[CaptureFrame, float], ...] = ()
    problem: str | None = None

    def places(self, config: PositioningConfig) -> list[Placed]:
        """Of the vehicle's body, at the moments of exposure, oldest first."""
        return [
            Placed.of(frame.bodies[config.body], config, frame.t_s - config.latency_s)
            for frame, _ in self.frames
            if config.body in frame.bodies
        ]


def listen(
    heard: Callable[[], list[Telemetry]],
    source: CaptureSource,
    clock: Callable[[], float],
    wait: Wait,
    for_s: float = LISTEN_S,
    enough: Callable[[Listened], bool] = lambda so_far: False,
) -> Listened:
    """For so long, or until it is enough; that is asked every half second."""
    began_s, asked_s = clock(), clock()
    telemetry: list[Telemetry] = []
    frames: list[tuple[CaptureFrame, float]] = []
    source.poll(began_s)  # what came before is old
    heard()
    while (now_s := clock()) - began_s < for_s:
        telemetry.extend(heard())
        frame = source.poll(now_s)
        if frame is not None:
            frames.append((frame, now_s - frame.t_s))
        if now_s - asked_s > 0.5:
            asked_s = now_s
            if enough(Listened(now_s - began_s, tuple(telemetry), tuple(frames))):
                break
        wait(POLL_S)
    now_s = clock()
    return Listened(now_s - began_s, tuple(telemetry), tuple(frames), source.problem(now_s))


def refused(why: str, config: PositioningConfig) -> list[Row]:
    """It could not be opened."""
    advice = "does it stream, is positioning.host right, does a firewall stop it?"
    return [
        failed("capture", why, advice),
        *(skipped(name, f"no {config.label}") for name in NAMES[1:]),
    ]


def rows(heard: Listened, profile: Profile) -> list[Row]:
    config = profile.positioning
    if not heard.frames:
        return refused(heard.problem or f"{config.label} sends no frame", config)
    first = passed("capture", f"{config.label} sends")
    places = heard.places(config)
    if not places:
        others = sorted({name for frame, _ in heard.frames for name in frame.bodies})
        found = f"no rigid body {config.body!r}; it sees {', '.join(others) or 'none'}"
        return [
            first, failed("body", found, "correct positioning.body, or show it to the cameras"),
            *(skipped(name, "the rigid body is not seen") for name in NAMES[2:]),
        ]  # fmt: skip
    return [
        first,
        _seen(heard, places, config),
        _rate(places, config),
        _age(heard),
        _noise(places, config),
        _place(heard, places, profile),
    ]


def _seen(heard: Listened, places: list[Placed], config: PositioningConfig) -> Row:
    """`Capture.poll` prefers frames with the body, so a frame without is one more unseen."""
    share = 1.0 - len(places) / len(heard.frames)
    found = f"{config.body!r} seen in {100.0 * (1.0 - share):.0f} % of the frames"
    advice = "it is hidden at times, or has too few markers: look at it in the capture"
    return by_limits("body", share, 0.02, 0.2, found, advice)


def _rate(places: list[Placed], config: PositioningConfig) -> Row:
    times = [place.t_s for place in places]
    span_s = times[-1] - times[0]
    rate_hz = (len(times) - 1) / span_s if span_s > 0.0 else 0.0
    gap_s = max((b - a for a, b in itertools.pairwise(times)), default=math.inf)
    found = f"{rate_hz:.0f} Hz, the longest gap {1e3 * gap_s:.0f} ms"
    advice = "raise the capture's rate, use a cable, close what loads this computer"
    by_rate = by_limits("body rate", -rate_hz, -RATE_WARN_HZ, -RATE_FAIL_HZ, found, advice)
    by_gap = by_limits("body rate", gap_s, config.hold_s / 2.0, config.hold_s, found, advice)
    return worse(by_rate, by_gap)


def _age(heard: Listened) -> Row:
    """From its arrival to its reading; what passes before, from the exposure on, no clock of
    this computer's tells."""
    ages = sorted(age_s for _, age_s in heard.frames)
    age_s = ages[int(0.95 * (len(ages) - 1))]
    found = f"95 % read within {1e3 * max(0.0, age_s):.0f} ms of their arrival"
    return by_limits(
        "body age", age_s, AGE_WARN_S, AGE_FAIL_S, found, "close what loads this computer"
    )


def _noise(places: list[Placed], config: PositioningConfig) -> Row:
    """Of a vehicle at rest."""
    at = np.array([place.position_m for place in places])
    if len(at) > 2 and not np.ptp(at, axis=0).any():
        return failed(
            "body noise", "frozen: all of its numbers repeat",
            "a measured pose has noise: is the capture paused, or the body hidden?",
        )  # fmt: skip
    sigma_m = _sigma_m(at)
    found = f"{1e3 * sigma_m:.1f} mm (one sigma)"
    advice = (
        "let it stand still; calibrate the capture, or raise positioning.position_sigma_m"
        if sigma_m < WILD_M
        else "these look like millimetres: set the unit of its stream to metres"
    )
    limit_m = config.position_sigma_m
    return by_limits("body noise", sigma_m, limit_m, NOISE_FAIL * limit_m, found, advice)


def _sigma_m(at: Array) -> float:
    """Of the worst axis, about the middle; a few wild ones do not make it."""
    middle = np.median(at, axis=0)
    return float(np.max(1.4826 * np.median(np.abs(at - middle), axis=0)))


def _place(heard: Listened, places: list[Placed], profile: Profile) -> Row:
    """By what `fly` asks of it."""
    newest = heard.telemetry[-1] if heard.telemetry else None
    place = places[-1].external(pose=True)
    if newest is None:
        problem = millimetres_problem(place, profile) or external_height_problem(place, profile)
    elif tilt_problem(newest, profile) or motion_problem(newest):
        return skipped("body place", "the vehicle does not stand level and still")
    else:
        problem = world_problem(place, newest, profile)
    if problem is not None:
        return failed("body place", problem.found, problem.advice)
    x, y, z = place.position_m
    found = f"x {x:.2f}, y {y:.2f}, z {z:.2f} m"
    if newest is None:
        return skipped("body place", f"{found}; its attitude is not compared: no telemetry")
    return passed("body place", found)
