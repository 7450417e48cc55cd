"""What must be true on the ground before anything spins."""

from __future__ import annotations

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight.criteria import (
    Problem,
    battery_problem,
    forbidden_problem,
    height_problem,
    motion_problem,
    not_allowed_problem,
    tilt_problem,
    too_near_problem,
    unmeasured_problem,
    unsettled_problem,
)
from perchctl.flight.outside import AtRest, apart, measurer, missing, world_problem
from perchctl.flight.view import not_in_view, out_of_view
from perchctl.geometry import Place
from perchctl.link import Link
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import Telemetry
from perchctl.vision import CameraModel, TargetEstimate


def refuse(telemetry: Telemetry | None, profile: Profile) -> None:
    """Raises SafetyAbort for what waiting will not mend."""
    if telemetry is None:
        return
    _refuse(forbidden_problem(telemetry))
    _refuse(battery_problem(telemetry, profile))


def refuse_unmeasured(link: Link, profile: Profile, *, positions: bool) -> None:
    """Raises SafetyAbort where nothing would tell the vehicle its position. `positions`: those
    of the profile's motion capture are being sent."""
    if profile.positioning.by == "deck":
        _refuse(unmeasured_problem(link.measured_by(), profile))
    elif profile.positioning.by == "mocap" and not positions:
        raise SafetyAbort("the profile says positioning: mocap, and nothing sends positions")


def refuse_strange(
    status: FeedStatus | None,
    telemetry: Telemetry | None,
    profile: Profile,
    now_s: float,
    at_rest: AtRest | None = None,
) -> None:
    """Raises SafetyAbort for positions in another unit, or of another world or body. Held askew or
    moved it is not judged, nor by anything old: capture and attitude are not of one moment.
    `at_rest`: what has been seen in the turns before."""
    if status is None or telemetry is None:
        return
    if now_s - telemetry.t_s + telemetry.behind_s > profile.safety.proof_age_s:
        return  # unknown: neither judged, nor is what was seen so far forgotten
    stands = tilt_problem(telemetry, profile) is None and motion_problem(telemetry) is None
    # What was sent last before a problem may have been elsewhere.
    told = status.problem is None and status.age_s <= profile.positioning.hold_s
    if stands and not told:
        return
    place = status.measured if stands else None
    if place is not None:
        _refuse(world_problem(place, telemetry, profile))
    if at_rest is not None:
        _refuse(at_rest.strange(place, profile))


def refuse_out_of_view(
    target: Place | None, telemetry: Telemetry, profile: Profile, camera: CameraModel
) -> None:
    """Raises SafetyAbort where the way up leads out of sight of a target that is the positioning
    system. `target`: its place in the estimate's world, None where something else measures."""
    if target is not None:
        start_m = telemetry.position_m
        _refuse(out_of_view(target, start_m, telemetry.yaw_rad, profile, camera))


def still_waiting_for(
    telemetry: Telemetry | None,
    has_frame: bool,
    camera_problem: str | None,
    waited_s: float,
    profile: Profile,
    target: TargetEstimate | None = None,
    age_s: float = 0.0,
    outside: FeedStatus | None = None,
    camera: CameraModel | None = None,
) -> str:
    """What is missing yet, or empty when ready. Errors: TimedOut past the bound, and
    SafetyAbort off the ground."""
    limit_s, by_sight = profile.safety.estimator_wait_s, profile.positioning.by == "target"
    if telemetry is None:
        return _bounded("telemetry", waited_s, limit_s)
    if age_s > profile.safety.telemetry_hold_s:
        return _bounded(f"telemetry (the newest is {age_s:.1f} s old)", waited_s, limit_s)
    if outside is not None and not by_sight and (problem := missing(outside, profile)):
        return _bounded(f"positions of the motion capture ({problem.sentence})", waited_s, limit_s)
    if problem := unsettled_problem(telemetry, profile):
        what = f"the state estimate to settle ({problem.found}; {problem.advice})"
        return _bounded(what, waited_s, limit_s)
    seen = None if outside is None else outside.measured
    if seen is not None and (problem := apart(seen, telemetry)):
        what = f"the state estimate to agree with {measurer(profile)} ({problem.sentence})"
        return _bounded(what, waited_s, limit_s)
    _refuse(height_problem(telemetry, profile))
    if problem := tilt_problem(telemetry, profile):
        return _bounded(f"the vehicle to stand level (it is {problem.found})", waited_s, limit_s)
    if problem := motion_problem(telemetry):
        return _bounded(f"the vehicle to stand still ({problem.found})", waited_s, limit_s)
    if problem := not_allowed_problem(telemetry):
        return _bounded(f"the supervisor to allow flight ({problem.found})", waited_s, limit_s)
    if not has_frame:
        what = f"a good picture ({camera_problem or 'none has come'})"
        return _bounded(what, waited_s, profile.camera.start_timeout_s)
    if outside is not None and by_sight and (problem := missing(outside, profile)):
        if waited_s > limit_s and outside.is_unseen:
            problem = not_in_view(target, camera_problem, telemetry, profile, camera)
        what = f"a sight of the target, which measures the position ({problem.sentence})"
        return _bounded(what, waited_s, limit_s)
    _refuse(too_near_problem(target))
    return ""


def _refuse(problem: Problem | None) -> None:
    if problem is not None:
        raise SafetyAbort(problem.sentence)


def _bounded(what: str, waited_s: float, limit_s: float) -> str:
    if waited_s > limit_s:
        raise TimedOut(f"waited {limit_s:.0f} s for {what}: not flying")
    return what
