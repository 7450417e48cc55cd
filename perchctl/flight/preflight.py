"""What must be true on the ground before anything spins."""

from __future__ import annotations

import math

import numpy as np

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight.criteria import (
    AtRest,
    GroundCriteria,
    Problem,
    apart,
    measurer,
    missing,
)
from perchctl.geometry import Place, rot_z
from perchctl.link import Link
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.target import (
    TargetView,
    overhead_text,
    view_from,
)
from perchctl.values import replace
from perchctl.vehicle import Telemetry
from perchctl.vision import CameraModel, TargetEstimate


def refuse(telemetry: Telemetry | None, profile: Profile) -> None:
    """Raises SafetyAbort for what waiting will not mend."""
    if telemetry is not None:
        criteria = GroundCriteria(telemetry, profile)
        _refuse(criteria.forbidden)
        _refuse(criteria.battery)


def refuse_unmeasured(link: Link, profile: Profile, *, positions: bool) -> None:
    """Raises SafetyAbort without any position source. `positions`: those of the profile's motion
    capture are being sent."""
    if profile.positioning.by == "deck":
        _refuse(GroundCriteria.unmeasured(link.decks(), profile))
    elif profile.positioning.by == "mocap" and not positions:
        raise SafetyAbort("the profile says positioning: mocap, and nothing sends positions")


def refuse_strange(
    status: FeedStatus | None,
    telemetry: Telemetry | None,
    profile: Profile,
    now_s: float,
    at_rest: AtRest | None = None,
) -> None:
    """Raises SafetyAbort for positions in another unit, or of another world or body. A tilted or
    moved vehicle is not judged, nor anything old. `at_rest`: the turns before."""
    if status is None or telemetry is None:
        return
    if now_s - telemetry.t_s + telemetry.behind_s > profile.safety.proof_age_s:
        return  # unknown: not judged, and nothing is forgotten
    criteria = GroundCriteria(telemetry, profile)
    stands = criteria.tilt is None and criteria.motion is None
    # The last position before a problem may have been elsewhere.
    sent = status.problem is None and status.age_s <= profile.positioning.hold_s
    if stands and not sent:
        return
    place = status.measured if stands else None
    if place is not None:
        _refuse(criteria.world_problem(place))
    if at_rest is not None:
        _refuse(at_rest.strange(place, profile))


def refuse_out_of_view(
    target: Place | None, telemetry: Telemetry, profile: Profile, camera: CameraModel
) -> None:
    """Raises SafetyAbort if the way up leads out of sight of a target that is the positioning
    system. `target`: its place in the estimate's world; None if something else measures."""
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
    """Return what is missing yet; empty when ready. Errors: TimedOut past the bound, SafetyAbort
    off the ground."""
    limit_s, by_sight = profile.safety.estimator_wait_s, profile.positioning.by == "target"
    if telemetry is None:
        return _bounded("telemetry", waited_s, limit_s)
    if age_s > profile.safety.telemetry_hold_s:
        return _bounded(f"telemetry (the newest is {age_s:.1f} s old)", waited_s, limit_s)
    if outside is not None and not by_sight and (problem := missing(outside, profile)):
        return _bounded(f"positions of the motion capture ({problem.sentence})", waited_s, limit_s)
    criteria = GroundCriteria(telemetry, profile)
    if problem := criteria.unsettled:
        what = f"the state estimate to settle ({problem.found}; {problem.advice})"
        return _bounded(what, waited_s, limit_s)
    seen = None if outside is None else outside.measured
    if seen is not None and (problem := apart(seen, telemetry)):
        what = f"the state estimate to agree with {measurer(profile)} ({problem.sentence})"
        return _bounded(what, waited_s, limit_s)
    _refuse(criteria.height)
    if problem := criteria.tilt:
        return _bounded(f"the vehicle to stand level (it is {problem.found})", waited_s, limit_s)
    if problem := criteria.motion:
        return _bounded(f"the vehicle to stand still ({problem.found})", waited_s, limit_s)
    if problem := criteria.not_allowed:
        return _bounded(f"the supervisor to allow flight ({problem.found})", waited_s, limit_s)
    if not has_frame:
        what = f"a good picture ({camera_problem or 'none has come'})"
        return _bounded(what, waited_s, profile.camera.start_timeout_s)
    if outside is not None and by_sight and (problem := missing(outside, profile)):
        if waited_s > limit_s and outside.is_unseen:
            problem = not_in_view(target, camera_problem, telemetry, profile, camera)
        what = f"a sight of the target, which measures the position ({problem.sentence})"
        return _bounded(what, waited_s, limit_s)
    _refuse(criteria.too_near(target))
    return ""


def _refuse(problem: Problem | None) -> None:
    if problem is not None:
        raise SafetyAbort(problem.sentence)


def _bounded(what: str, waited_s: float, limit_s: float) -> str:
    if waited_s > limit_s:
        raise TimedOut(f"waited {limit_s:.0f} s for {what}: not flying")
    return what


# --- Whether a target that is the positioning system stays in view on the way up. Pure ---
# The way up is known: straight, then to `planner.approach_xy_m`. The higher the vehicle, the less
# of the ceiling is in its picture; without the target it has no position.


LEAN_DEG = 5.0  # on its way up, and against a draught
Start = tuple[float, float, float]  # where it stands, in the world of the target's place


def out_of_view(
    target: Place, start_m: Start, yaw_rad: float, profile: Profile, camera: CameraModel
) -> Problem | None:
    """Return the problem of a way up that loses the target: no marker would be wholly in the
    picture of a vehicle that leans a little, at take-off height over the start or over
    `planner.approach_xy_m`. `yaw_rad`: its heading at the start."""
    planner, (x, y, z) = profile.planner, start_m
    advice = f"lower planner.takeoff_height_m, now {planner.takeoff_height_m:g} m"
    for over in ((x, y), planner.approach_xy_m):
        if over is None:
            continue
        body_m = (*over, z + planner.takeoff_height_m)
        sight = _seen_leaning(body_m, yaw_rad, target, profile, camera)
        if over == (x, y):
            advice = f"put the vehicle {sight.aside_text} from where it stands, or {advice}"
        else:
            advice = "leave planner.approach_xy_m out, or set it near the target"
        if not sight.whole:
            return Problem(
                f"the target is the positioning system, and from x {over[0]:.2f}, y {over[1]:.2f} "
                f"m at take-off height the vehicle would not see it: {_too_far(sight)}",
                advice,
            )
    return None


def target_from(
    body_m: Start, yaw_rad: float, target: Place, profile: Profile, camera: CameraModel
) -> TargetView:
    """Return the target as seen from a level vehicle at a place in its world."""
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
    """Return the target as `target_from` gives it for a vehicle that leans so that the target moves
    to the picture's edge, as if it stood farther away."""
    level = target_from(body_m, yaw_rad, target, profile, camera)
    aside_m = math.hypot(*level.aside_m)
    if not (level.whole and aside_m > 1e-9):
        return level
    away = -rot_z(yaw_rad)[:2, :2] @ np.array(level.aside_m) / aside_m
    x, y = np.array(body_m[:2]) + _leant_m(level) * away
    leaning = target_from((float(x), float(y), body_m[2]), yaw_rad, target, profile, camera)
    return replace(level, whole=leaning.whole)


def _leant_m(sight: TargetView) -> float:
    return sight.height_m * math.tan(math.radians(LEAN_DEG))


def _too_far(sight: TargetView) -> str:
    if not sight.height_m > 0.0:
        return "it would be no higher than the camera"
    return (
        f"{math.hypot(*sight.aside_m):.2f} m aside of the camera's axis, {sight.height_m:.2f} m "
        f"over the camera"
    )


def not_in_view(
    seen: TargetEstimate | None,
    note: str | None,
    telemetry: Telemetry,
    profile: Profile,
    camera: CameraModel | None,
) -> Problem:
    """Return the problem of a target that was not measured from the ground. `note`: a remark on
    the pictures."""
    if seen is not None and seen.tracked:
        return Problem(
            f"it is seen, and was not measured at rest yet (the accelerometer reads "
            f"{telemetry.acc_z_g:.2f} g)",
            "let the vehicle stand still, and the target hang still",
        )
    found = "it is not in view" if note is None else f"it is not in view; {note}"
    if camera is None:
        return Problem(found, "put the vehicle under it")
    where = overhead_text(profile.target, camera, profile.camera.mount)
    return Problem(found, f"put the vehicle under it: {where}")
