"""Check rows about the camera and the target in its images, from a rehearsal (the flight loop's
perception, run for a few seconds on the ground). Pure.

If the target is the positioning system, one more row says whether it is in view.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from perchctl.camera import mirrored_problem
from perchctl.check.rehearsal import Rehearsal
from perchctl.check.row import (
    Finding,
    Row,
    evaluate_row,
    evaluate_rows,
    failed,
    limits_finding,
    passed,
    skipped,
    skipped_rows,
    warned,
    worst_finding,
)
from perchctl.errors import PerchError
from perchctl.flight import GroundCriteria, view_problem
from perchctl.geometry import Place
from perchctl.profile import Profile
from perchctl.target import overhead_text
from perchctl.vision import CameraModel

RATE_WARN_HZ, RATE_FAIL_HZ = 20.0, 7.0
"""Image rates below which the check warns and fails, Hz. An AI-deck with its standard program sends
8 images per second, and a simulated vehicle can perch with 7."""
GAP_WARN = 0.4
"""Longest gap between images before the check warns, as a fraction of `safety.camera_hold_s`."""
SEEN_WARN = 0.5
"""Fraction of images that show the target, below which the check warns."""
LEAST_RATED = 10
"""Number of images below which no rate can be computed."""
_AGAIN = {
    "camera": "plug the receiver or camera in again",
    "aideck": "switch the Crazyflie off and on again",
    "sim": "start it again",
}
_NEARER = {
    "camera": "for a receiver: move it closer, turn its antenna or choose another channel; "
    "otherwise use another cable",
    "aideck": "move this computer closer to the deck, or choose another Wi-Fi channel",
    "sim": "close other programs: the simulated camera runs on this computer",
}
_RESTART, _NETWORK = (
    "switch the camera off and on again",
    "check the network between this computer and the camera",
)
"""Advice for all other kinds of camera sources."""
_LIGHT = "add light, lengthen the exposure, or take off the lens cap"
_ADVICE = {
    "frozen": _RESTART,
    "snow": "set the receiver to the camera's channel, and switch the camera on",
    "uniform": "uncover the lens, and switch the camera on",
    "dark": _LIGHT,
}


def failed_camera_rows(error: PerchError, source: str, profile: Profile) -> list[Row]:
    """Return the rows for a camera `source` that failed: the first row fails, the others are
    skipped."""
    advice = error.advice or "see docs/check.md"
    if not error.advice and source.startswith("camera:"):
        advice += "; perchctl check --cameras lists the cameras"
    names = ("size", *picture_row_names(profile))
    return [Row("camera", *failed(error.found, advice)), *skipped_rows(names, "no picture arrives")]


def size_finding(size_px: tuple[int, int] | None, calibrated_px: tuple[int, int]) -> Finding:
    """Compare the image size (None: unknown) with the size in the calibration."""
    found, wanted = ("x".join(map(str, size or ("unknown",))) for size in (size_px, calibrated_px))
    if size_px == calibrated_px:
        return passed(f"{found} px, as calibrated")
    advice = "set the camera to the calibrated size, or calibrate it at the current size"
    return failed(f"{found} px, but calibrated at {wanted} px", advice)


def picture_rows(rehearsal: Rehearsal, profile: Profile, camera: CameraModel) -> list[Row]:
    """The rows named by `picture_row_names` for a rehearsal. The first row fails if no image
    arrived."""
    if not rehearsal.pictures:
        why = rehearsal.problem or "no picture arrived during the rehearsal"
        first, *rest = picture_row_names(profile)
        advice = _AGAIN.get(rehearsal.scheme, _RESTART)
        return [Row(first, *failed(why, advice)), *skipped_rows(rest, why)]
    rows = evaluate_rows(PICTURES, rehearsal, profile)
    if profile.positioning.source.is_target:
        rows.append(evaluate_row(IN_VIEW, _in_view, rehearsal, profile, camera))
    return rows


# --- The images ---


def _rate(rehearsal: Rehearsal, profile: Profile) -> Finding:
    period_s = rehearsal.frame_period_s
    if period_s is None:
        return skipped(
            "too few pictures" if rehearsal.live else "a recording has no frame rate of its own"
        )
    hz = 1.0 / period_s
    advice = "add light, request smaller pictures, or use a shorter cable"
    return limits_finding(-hz, -RATE_WARN_HZ, -RATE_FAIL_HZ, f"{hz:.0f} Hz", advice)


def _gaps(rehearsal: Rehearsal, profile: Profile) -> Finding:
    """Check the longest gap between successive images."""
    if not rehearsal.live:
        return skipped("a recording")
    if rehearsal.silent_s > profile.safety.camera_hold_s:
        advice = _AGAIN.get(rehearsal.scheme, _RESTART)
        return failed(f"no picture for the last {rehearsal.silent_s:.1f} s", advice)
    pairs = pairwise(rehearsal.arrivals)
    gaps_s = [t - t0 for (i0, t0), (i, t) in pairs if i == i0 + 1]
    if len(gaps_s) < LEAST_RATED:
        return skipped("too few pictures")
    longest_s, limit_s = max(gaps_s), profile.safety.camera_hold_s
    found = f"longest gap {1e3 * longest_s:.0f} ms"
    advice = _NEARER.get(rehearsal.scheme, _NETWORK)
    return limits_finding(longest_s, GAP_WARN * limit_s, limit_s, found, advice)


def _age(rehearsal: Rehearsal, profile: Profile) -> Finding:
    if not rehearsal.live or not rehearsal.ages_s:
        return skipped("no picture was processed" if rehearsal.live else "a recording")
    age_s, limit_s = float(np.quantile(rehearsal.ages_s, 0.95)), profile.safety.max_frame_age_s
    latency_ms = 1e3 * profile.camera.start_latency_s
    found = (
        f"95 % within {1e3 * age_s:.0f} ms, which includes camera.latency_s of {latency_ms:.0f} ms"
    )
    advice = "measure camera.latency_s; use a faster receiver or computer"
    return limits_finding(age_s, 0.6 * limit_s, limit_s, found, advice)


def _pictures(rehearsal: Rehearsal, profile: Profile) -> Finding:
    late = sum(t < t0 for (_, t0), (_, t) in pairwise(rehearsal.arrivals))
    if late:
        found = f"{late} of {rehearsal.pictures} pictures arrived after newer ones"
        return failed(found, "use another stream or receiver: this one delays pictures")
    if not rehearsal.problems:
        again = rehearsal.repeats
        repeated = f"; {again} pictures that the receiver repeated are not counted" if again else ""
        return passed(f"{rehearsal.pictures} good pictures{repeated}")
    if any(problem.kind == "mirrored" for problem in rehearsal.problems):
        mirrored = mirrored_problem(profile.camera)
        return failed(mirrored.found, mirrored.advice)
    problem, count = rehearsal.problems.most_common(1)[0]
    share = sum(rehearsal.problems.values()) / rehearsal.pictures
    found = f"{count} of {rehearsal.pictures}: {problem.text}"
    advice = _ADVICE.get(problem.kind or "", "see docs/check.md")
    return limits_finding(share, 0.05, 0.5, found, advice)


def _focus(rehearsal: Rehearsal, profile: Profile) -> Finding:
    blur_px = rehearsal.blur_px
    if blur_px is None:
        why = "focus is measured on the target's edges, but no target was seen"
        return skipped(why, "put the camera under the target")
    advice = "turn the lens until perchctl track --view shows a sharp target"
    return limits_finding(blur_px, 1.6, 2.5, f"blur sigma {blur_px:.1f} px", advice)


def _target_in_view(rehearsal: Rehearsal, profile: Profile) -> Finding:
    if not rehearsal.target_pictures:
        return skipped("not detected", "put the vehicle under the target to check the other rows")
    found = f"seen in {100 * rehearsal.target_pictures // rehearsal.pictures} % of the pictures"
    target = rehearsal.target
    if target is not None:
        away_m = math.hypot(*(float(e) for e in target.e_m))
        spread_mm = 1e3 * float(max(target.sigma_m))
        found += f", {away_m:.2f} m from the gear (+- {spread_mm:.0f} mm)"
        if problem := GroundCriteria.target_too_near(target):
            return failed(problem.found, problem.advice)
    if rehearsal.target_pictures < SEEN_WARN * rehearsal.pictures:
        return warned(found, "move closer, focus the lens (see focus), or add light")
    return passed(found)


def _print(rehearsal: Rehearsal, profile: Profile) -> Finding:
    if rehearsal.prints is None:
        return skipped("both markers must be in view", "hold the vehicle closer to the target")
    verdict = rehearsal.prints.verdict()
    return failed(verdict.found, verdict.advice) if verdict.is_wrong else passed(verdict.found)


PICTURES: dict[str, Callable[[Rehearsal, Profile], Finding]] = {
    "frame rate": _rate,
    "lost frames": _gaps,
    "picture age": _age,
    "pictures": _pictures,
    "focus": _focus,
    "target": _target_in_view,
    "print": _print,
}


# --- If the target is the positioning system ---


def _in_view(rehearsal: Rehearsal, profile: Profile, camera: CameraModel) -> Finding:
    """Check that the target is in view from the vehicle's position on the ground and during the
    climb. The row fails if `fly` would refuse the flight."""
    if not rehearsal.target_pictures:
        where = overhead_text(profile.target, camera, profile.camera.mount)
        return failed(
            "the target is not detected, so perchctl fly would refuse to take off",
            f"put the vehicle under the target: {where}",
        )
    if rehearsal.target is None:
        return warned(
            "the target was no longer in view at the end of the rehearsal",
            "see the rows lost frames and target, then check again",
        )
    if problem := GroundCriteria.moved_body(rehearsal.target_moved_m, profile):
        return failed(problem.found, problem.advice)
    feet = (0.0, 0.0, profile.safety.ground_z_m)
    # World frame: the vehicle is level, at the origin, and faces along x.
    gear_m = np.asarray(profile.vehicle.gear_body_m)
    place = Place(np.array(feet) + rehearsal.target.e_m + gear_m, rehearsal.target.e_yaw_rad)
    problem = view_problem(place, feet, 0.0, profile, camera)
    if problem is not None:
        return failed(problem.found, problem.advice)
    return passed("in view now, and also from take-off height")


IN_VIEW = "in view"


def picture_row_names(profile: Profile) -> tuple[str, ...]:
    """The names of the rows about images, in order."""
    return (*PICTURES, *([IN_VIEW] if profile.positioning.source.is_target else ()))


# --- The computer that processes the images ---


def loop_finding(rehearsal: Rehearsal | None, profile: Profile) -> Finding:
    """Check the loop's processing time per image and the lateness of its ticks; skipped if there
    was no rehearsal."""
    if rehearsal is None or len(rehearsal.processing_s) < LEAST_RATED:
        return skipped("no pictures to rehearse with")
    if not rehearsal.live:
        return skipped("a recording plays as fast as it is read")
    work_s = float(np.quantile(rehearsal.processing_s, 0.95))
    turn_s = 1.0 / profile.link.loop_hz
    period_s = rehearsal.frame_period_s or turn_s
    late = sum(late_s > turn_s / 2.0 for late_s in rehearsal.tick_delays_s) / len(
        rehearsal.tick_delays_s
    )
    latest_s = max(rehearsal.tick_delays_s)
    found = (
        f"processing takes {1e3 * work_s:.0f} of the {1e3 * period_s:.0f} ms per picture; "
        f"{100.0 * late:.0f} % of the ticks are late, by at most {1e3 * latest_s:.0f} ms"
    )
    advice = "close other programs, request smaller pictures, or use a faster computer"
    if latest_s > profile.safety.loop_late_hold_s:
        return failed(found, advice)
    return worst_finding(
        limits_finding(work_s / period_s, 0.7, 1.0, found, advice),
        limits_finding(late, 0.05, 0.3, found, advice),
    )
