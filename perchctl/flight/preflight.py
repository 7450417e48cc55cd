"""Checks that must pass on the ground before any motor turns.

A turn is one iteration of the flight loop, which also runs while the vehicle waits for take-off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from perchctl.errors import Problem, SafetyAbort, TimedOut
from perchctl.flight.criteria import (
    REST_S,
    GroundCriteria,
    RestCheck,
    estimate_problem,
    feed_name,
    rest_window,
    unsent_problem,
)
from perchctl.geometry import Place, rot_z
from perchctl.link import Link
from perchctl.mission import OperatorRequest
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.target import TargetView, view_from
from perchctl.values import replace
from perchctl.vehicle import ARMED, Arm, Telemetry, is_armed_by_request, may_be_flying
from perchctl.vision import CameraModel, TargetEstimate


def abort_on(problem: Problem | None) -> None:
    """Raise SafetyAbort with the text of the problem; do nothing if there is no problem."""
    if problem is not None:
        raise SafetyAbort(problem.sentence)


def refuse_unfit_vehicle(telemetry: Telemetry | None, profile: Profile) -> None:
    """Raise SafetyAbort if waiting cannot help: the supervisor reports a fault, or the battery is
    unfit."""
    if telemetry is not None:
        criteria = GroundCriteria(telemetry, profile)
        battery = criteria.battery_too_low or criteria.battery_too_high
        abort_on(criteria.supervisor_fault or battery)


def refuse_armed(telemetry: Telemetry | None) -> None:
    """Raise SafetyAbort if a vehicle that does not arm itself was already armed, because another
    program may be commanding it."""
    if telemetry is not None and is_armed_by_request(telemetry.supervisor):
        raise SafetyAbort(
            "the vehicle is armed, but not by perchctl: keep away from its propellers, and "
            "end the program that armed it; not flying"
        )


def refuse_without_positions(link: Link, profile: Profile, *, has_feed: bool) -> None:
    """Raise SafetyAbort if the vehicle has no position source. `has_feed` is True if positions from
    motion capture are being sent."""
    if profile.positioning.source.is_deck:
        abort_on(GroundCriteria.no_position_source(link.decks(), profile))
    elif profile.positioning.source.is_mocap and not has_feed:
        raise SafetyAbort(
            "the profile sets positioning: mocap, but nothing sends positions: not flying"
        )


def refuse_wrong_positions(
    status: FeedStatus | None,
    telemetry: Telemetry | None,
    profile: Profile,
    now_s: float,
    rest_check: RestCheck | None = None,
) -> None:
    """Raise SafetyAbort if positions are in another unit, or belong to another world frame or
    another body.

    Nothing is checked if the data is old or if the vehicle is tilted or moving. `rest_check` stores
    the position from earlier turns.
    """
    if status is None or telemetry is None:
        return
    if now_s - telemetry.t_s + telemetry.behind_s > profile.safety.proof_age_s:
        return  # the position is neither checked nor reset
    criteria = GroundCriteria(telemetry, profile)
    stands = criteria.stands
    # The last position before a problem may have been measured while the vehicle was elsewhere.
    sent = status.problem is None and status.age_s <= profile.positioning.hold_s
    if stands and not sent:
        return
    place = status.measured if stands else None
    if place is not None:
        abort_on(criteria.position_frame_problem(place))
    if rest_check is not None:
        abort_on(rest_check.moved_body_problem(place, profile))


@dataclass(frozen=True)
class GroundTurn:
    """The data of one loop turn before take-off.

    `waited_s` is the total waiting time, and `took_s` the duration of this turn so far. `samples`
    is the recent telemetry, oldest first; the newest sample is `telemetry_age_s` old.
    `picture_problem` says why there is no good and fresh image; `unseen_s` is the time since the
    last good one. `link_problem` says what is wrong with the link.
    """

    profile: Profile
    waited_s: float
    samples: Sequence[Telemetry] = ()
    telemetry_age_s: float = 0.0
    decks: Sequence[str] = ()
    feed: FeedStatus | None = None
    picture_problem: str | None = None
    unseen_s: float = 0.0
    target: TargetEstimate | None = None
    link_problem: str | None = None
    took_s: float = 0.0


def still_waiting_for(turn: GroundTurn) -> str:
    """Return the conditions that must still be met before take-off, in words; empty if the vehicle
    is ready. Only the current turn counts: if a check passed earlier but fails now, take-off waits
    for it again. Errors: TimedOut if the wait takes too long, SafetyAbort if the vehicle is not on
    the ground or is too close to the target."""
    profile, waited_s, feed = turn.profile, turn.waited_s, turn.feed
    limit_s, by_target = profile.safety.estimator_wait_s, profile.positioning.source.is_target
    if not turn.samples:
        return _bounded("telemetry", waited_s, limit_s)
    if not turn.telemetry_age_s <= profile.safety.telemetry_hold_s:
        old = f"telemetry (the newest is {turn.telemetry_age_s:.1f} s old)"
        return _bounded(old, waited_s, limit_s)
    telemetry = turn.samples[-1]
    criteria = GroundCriteria(telemetry, profile, turn.decks)
    unsent = None if feed is None else unsent_problem(feed, profile)
    seen = None if feed is None else feed.measured
    waiting = _first(
        {
            "positions from the motion-capture system": None if by_target else unsent,
            "the state estimate to settle": criteria.estimate_unsettled,
            f"the state estimate to agree with {feed_name(profile)}": None
            if seen is None
            else estimate_problem(seen, telemetry),
        }
    )
    if not waiting:
        waiting = _first({"the state estimate to stop moving": _unrest(turn.samples, profile)})
        limit_s += REST_S if waiting else 0.0
    if not waiting:
        abort_on(criteria.off_ground)
        waiting = _first(
            {
                "a battery reading": criteria.battery_unknown,
                "the vehicle to be level": criteria.not_level,
                "the vehicle to be at rest": criteria.not_still,
                "the supervisor to allow flight": criteria.supervisor_not_ready,
            }
        )
    if not waiting and turn.link_problem:
        waiting = f"the link ({turn.link_problem})"
    if not waiting and turn.picture_problem:
        waiting = f"a good picture ({turn.picture_problem})"
        others_s, limit_s = limit_s + REST_S, profile.camera.start_timeout_s
        if waited_s <= others_s + limit_s:  # the camera may have failed during the other checks
            waited_s = min(waited_s, turn.unseen_s)
    waiting = waiting or _first(
        {"a view of the target, from which the position is measured": unsent}
    )
    if not waiting and not turn.took_s <= profile.safety.loop_late_hold_s:
        waiting = f"the flight loop to keep up (a tick took {turn.took_s:.1f} s)"
    if not waiting:
        abort_on(criteria.target_too_near(turn.target))
        return ""
    return _bounded(waiting, waited_s, limit_s)


def _unrest(samples: Sequence[Telemetry], profile: Profile) -> Problem | None:
    """Problem: the estimate is moving, or has not been still for long enough. A gap in the
    telemetry does not count as being still."""
    window = rest_window(samples)
    seen_s = window[-1].t_s - window[0].t_s
    if seen_s < REST_S:
        return Problem(f"observed for {seen_s:.1f} of {REST_S:g} s", "keep it still")
    positions_s = [sample.t_s - sample.behind_s for sample in window]
    pause_s = max(after_s - before_s for before_s, after_s in pairwise(positions_s))
    if not pause_s <= profile.safety.telemetry_hold_s:
        return Problem(f"the telemetry paused for {pause_s:.1f} s", "keep it still")
    return GroundCriteria.moving_estimate(samples, profile)


def _first(problems: Mapping[str, Problem | None]) -> str:
    found = (f"{what} ({problem.sentence})" for what, problem in problems.items() if problem)
    return next(found, "")


def _bounded(what: str, waited_s: float, limit_s: float) -> str:
    if waited_s > limit_s:
        raise TimedOut(f"waited {limit_s:.0f} s for {what}: not flying")
    return what


# --- Arming, the last step before take-off ---


ARMS_WITHIN_S = 5.0
"""Longest time from the first arming request until the supervisor allows flight, s. The firmware
gives up after 2 s if the motors do not start. Longer: the propellers of a vehicle that cannot fly
keep turning for longer."""
REQUEST_PERIOD_S = 0.25
ARMING_PAUSE_S = 0.5
"""Longest time for which another check may fail once arming has begun, s, for example because of a
late packet. Longer: the propellers keep turning while somebody picks the vehicle up, or while its
state is unknown. Shorter: a brief disturbance ends the flight."""


class Arming:
    """Once all other checks have passed, arms a vehicle that does not arm itself.

    Arming is the last step, after the operator's confirmation, because the propellers turn from
    then on. After the first request, other checks may fail for no longer than `ARMING_PAUSE_S`. A
    vehicle that disarms itself is not armed again, since somebody may have reached for it.
    """

    def __init__(self) -> None:
        self._ready_s = self._requested_s = -math.inf
        self._began_s: float | None = None
        self._was_armed = False

    @property
    def has_begun(self) -> bool:
        """True after the first request to arm."""
        return self._requested_s > -math.inf

    def note_waiting(self, waiting: str, began_s: float, now_s: float) -> None:
        """Record which checks failed (`waiting`, may be empty) in a turn that began at `began_s`
        and has just ended.

        Raises SafetyAbort if any check has failed for longer than `ARMING_PAUSE_S` since the first
        request to arm. The time of a turn that hangs counts as well, because nothing was observed
        during the turn.
        """
        if not waiting:
            self._ready_s = began_s
        elif self.has_begun and now_s - self._ready_s > ARMING_PAUSE_S:
            raise SafetyAbort(
                f"after arming, waited {now_s - self._ready_s:.1f} s for {waiting}: disarming, not "
                f"flying"
            )

    def next_request(self, telemetry: Telemetry, now_s: float) -> Arm | None:
        """Return the request to send now, if any. Must be called in each turn in which the vehicle
        `waits_for_arming`, with fresh telemetry.

        Raises TimedOut if the vehicle is not armed within `ARMS_WITHIN_S`, and SafetyAbort if it
        disarms itself while its motors are starting.
        """
        if self._began_s is None:
            self._began_s = now_s
        bits = f"supervisor 0x{telemetry.supervisor:04X}"
        if telemetry.has_bit(ARMED):
            self._was_armed = True
        elif self._was_armed:
            raise SafetyAbort(
                "the vehicle was armed but disarmed itself before its motors were ready "
                f"({bits}): a propeller may be blocked; inspect it, then restart the vehicle"
            )
        if now_s - self._began_s > ARMS_WITHIN_S:
            raise TimedOut(
                f"the vehicle could not be armed within {ARMS_WITHIN_S:.0f} s ({bits}): restart it"
            )
        if telemetry.has_bit(ARMED) or now_s - self._requested_s < REQUEST_PERIOD_S:
            return None
        self._requested_s = now_s
        return Arm(True)


def disarm_on_word(operator: Callable[[], OperatorRequest]) -> Callable[..., Arm | None]:
    """Return the link's guard for the wait before take-off: it disarms the vehicle on the
    operator's command, even while the loop hangs."""

    def poll(
        now_s: float, newest: Telemetry | None, waiting: Sequence[Telemetry] = ()
    ) -> Arm | None:
        if operator() is OperatorRequest.NONE or may_be_flying(newest, now_s):
            return None
        is_armed = newest is not None and is_armed_by_request(newest.supervisor)
        return Arm(False) if is_armed else None

    return poll


# --- Check that a target used as the positioning system stays in view during the climb. Pure ---


LEAN_DEG = 5.0  # allowance for the tilt during the climb, also against a draught
Start = tuple[float, float, float]  # the vehicle's position, in the same axes as the target's


def view_problem(
    target: Place, start_m: Start, yaw_rad: float, profile: Profile, camera: CameraModel
) -> Problem | None:
    """Problem: the camera would lose the target during the climb. With the vehicle slightly tilted
    at take-off height, above the start or above `planner.approach_xy_m`, no marker would be
    completely in the image. `yaw_rad` is the vehicle's heading."""
    planner, (x, y, z) = profile.planner, start_m
    advice = f"lower planner.takeoff_height_m (now {planner.takeoff_height_m:g} m)"
    for over in ((x, y), planner.approach_xy_m):
        if over is None:
            continue
        body_m = (*over, z + planner.takeoff_height_m)
        sight = _seen_leaning(body_m, yaw_rad, target, profile, camera)
        if over == (x, y):
            advice = f"move the vehicle {sight.aside_text}, or {advice}"
        else:
            advice = "remove planner.approach_xy_m, or set it near the target"
        if not sight.has_marker:
            return Problem(
                f"the target is the positioning system, but from x {over[0]:.2f}, y "
                f"{over[1]:.2f} m at take-off height the vehicle would not see it, because the "
                f"target would be {math.hypot(*sight.aside_m):.2f} m from the camera's axis and "
                f"{sight.height_m:.2f} m above the camera",
                advice,
            )
    return None


def target_view_from(
    body_m: Start, yaw_rad: float, target: Place, profile: Profile, camera: CameraModel
) -> TargetView:
    """The target as seen from a level vehicle at `body_m`, a position in the same axes as
    `target`."""
    return view_from(
        np.array(body_m),
        yaw_rad,
        target.position_m,
        target.yaw_rad,
        profile.target,
        camera,
        profile.camera.mount,
    )


def _seen_leaning(
    body_m: Start, yaw_rad: float, target: Place, profile: Profile, camera: CameraModel
) -> TargetView:
    """The view from a vehicle that tilts so that the target moves towards the image border."""
    level = target_view_from(body_m, yaw_rad, target, profile, camera)
    aside_m = math.hypot(*level.aside_m)
    if not (level.has_marker and aside_m > 1e-9):
        return level
    away = -rot_z(yaw_rad)[:2, :2] @ np.array(level.aside_m) / aside_m
    leant_m = level.height_m * math.tan(math.radians(LEAN_DEG))
    x, y = np.array(body_m[:2]) + leant_m * away
    leaning = target_view_from((float(x), float(y), body_m[2]), yaw_rad, target, profile, camera)
    return replace(level, has_marker=leaning.has_marker)
