"""The camera and the target in it: rows from a rehearsal on its pictures. Pure.

Where the target is the positioning system, two more rows say from how far it is seen, and whether
it is in view.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from statistics import mean, median

import numpy as np

from perchctl.camera import VERDICT_TEXTS, mirrored_note
from perchctl.check.rehearsal import Rehearsal
from perchctl.check.row import (
    Finding,
    Row,
    ask,
    ask_all,
    by_limits,
    failed,
    passed,
    skip_all,
    skipped,
    warned,
    worst,
)
from perchctl.errors import PerchError
from perchctl.flight import GroundCriteria, out_of_view
from perchctl.geometry import Place
from perchctl.perception import MIRRORED_FRAMES
from perchctl.profile import Profile
from perchctl.target import (
    overhead_text,
    view_from,
)
from perchctl.vision import CameraModel

RATE_WARN_HZ, RATE_FAIL_HZ = 20.0, 7.0
"""An AI-deck's program as it comes gives 8, and a simulated one perches with 7."""
LOST_WARN, LOST_FAIL = 0.2, 0.5
"""Share of pictures: a third lost is flown by; half is not."""
SMEARED, SMEARED_PX = 1.5, 0.6
"""Times the sharpest side's blur, and more: on another side it is movement, or a lens askew."""
SEEN_WARN = 0.5
"""Of the pictures."""
ROOM_WARN = 0.03
"""Of the picture's larger side: by so much a lean of 2 to 3 deg moves the target."""
LEAST_RATED = 10
"""Pictures; of fewer no rate is known."""
_SEE = "see docs/check.md"
_AGAIN = "plug the receiver or camera in again"
_LIGHT = "more light, a longer exposure, or the lens cap off"
_ADVICE = {
    VERDICT_TEXTS["frozen"]: _AGAIN,
    VERDICT_TEXTS["snow"]: "set the receiver to the camera's channel, switch the camera on",
    VERDICT_TEXTS["uniform"]: "uncover the lens, switch the camera on",
    VERDICT_TEXTS["dark"]: _LIGHT,
}


def refused_rows(error: PerchError, devices: list[str], profile: Profile) -> list[Row]:
    """Return the rows of a camera that gives no picture."""
    found, semicolon, advice = str(error).rpartition("; ")
    if not semicolon:
        found, advice = str(error), _SEE
    if "/dev/video" not in found and "there are" not in found:
        there = f"there are {', '.join(devices)}" if devices else "this computer has no camera"
        advice = f"{advice}; {there}"
    names = ("size", *names_of(profile))
    return [Row("camera", *failed(found, advice)), *skip_all(names, "no picture comes")]


def opened_finding(described: str, devices: list[str]) -> Finding:
    """Return the row of a camera that opens."""
    found = f"{described} gives pictures"
    return passed(f"{found}; there are {', '.join(devices)}" if devices else found)


def size_finding(size_px: tuple[int, int] | None, wanted_px: tuple[int, int]) -> Finding:
    if size_px is None:
        return skipped("no picture comes")
    found = "{}x{} px".format(*size_px)
    if size_px == wanted_px:
        return passed(f"{found}, as calibrated")
    return failed(
        f"{found}, calibrated at {{}}x{{}} px".format(*wanted_px),
        "set the camera to that size, or calibrate it at this one",
    )


def picture_rows(rehearsal: Rehearsal, profile: Profile, camera: CameraModel) -> list[Row]:
    """Judge what the pictures of a rehearsal show."""
    if not rehearsal.pictures:
        why = rehearsal.problem or "no picture came in the rehearsal"
        first, *rest = names_of(profile)
        return [Row(first, *failed(why, _AGAIN)), *skip_all(rest, why)]
    rows = ask_all(PICTURES, rehearsal, profile)
    if profile.positioning.by == "target":
        rows.append(ask(IN_VIEW, _in_view, rehearsal, profile, camera))
    return rows


# --- The pictures -----------------------------------------------------


def _rate(rehearsal: Rehearsal, profile: Profile) -> Finding:
    period_s = rehearsal.frame_period_s
    if period_s is None:
        return skipped("too few pictures" if rehearsal.live else "a recording has none of its own")
    hz = 1.0 / period_s
    advice = "more light, a smaller picture, or a shorter cable"
    finding = by_limits(-hz, -RATE_WARN_HZ, -RATE_FAIL_HZ, f"{hz:.0f} Hz", advice)
    wanted_hz = profile.camera.rate_hz
    if finding.verdict == "pass" and wanted_hz is not None and hz < 0.8 * wanted_hz:
        advice = "a shorter exposure (v4l2-ctl), or another camera.format"
        return warned(f"{finding.found}, asked for {wanted_hz:g}", advice)
    return finding


def _lost(rehearsal: Rehearsal, profile: Profile) -> Finding:
    """Judge the lost frames by the gaps between pictures that arrived one after another."""
    if not rehearsal.live:
        return skipped("a recording")
    if rehearsal.silent_s > profile.safety.camera_hold_s:
        return failed(f"none for the last {rehearsal.silent_s:.1f} s", _AGAIN)
    pairs = pairwise(rehearsal.arrivals)
    gaps = [t - t0 for (i0, t0), (i, t) in pairs if i == i0 + 1]
    if len(gaps) < LEAST_RATED:
        return skipped("too few pictures")
    period_s, slack = median(sorted(gaps)[: 1 + len(gaps) * 3 // 4]), 1.5
    if rehearsal.repeats:  # new ones come at the receiver's own times, near theirs
        period_s, slack = mean(gap for gap in gaps if gap < 2.2 * period_s), 1.8
    lost = sum(max(0, math.ceil(gap / period_s - slack)) for gap in gaps)
    share = lost / (lost + len(gaps) + 1)
    found = f"{100.0 * share:.0f} %, longest gap {1e3 * max(gaps):.0f} ms"
    advice = "bring the receiver nearer, turn its antenna, choose another channel"
    if max(gaps) > profile.safety.camera_hold_s:
        return failed(found, advice)
    return by_limits(share, LOST_WARN, LOST_FAIL, found, advice)


def _age(rehearsal: Rehearsal, profile: Profile) -> Finding:
    """Judge how old pictures are when they have been searched; only the profile knows the way from
    the sensor."""
    if not rehearsal.live or not rehearsal.ages_s:
        return skipped("none was looked at" if rehearsal.live else "a recording")
    age_s, limit_s = percentile(rehearsal.ages_s, 0.95), profile.safety.max_frame_age_s
    latency_ms = 1e3 * profile.camera.start_latency_s
    found = f"95 % within {1e3 * age_s:.0f} ms, {latency_ms:.0f} of them by camera.latency_s"
    advice = "measure camera.latency_s; use a faster receiver or computer"
    return by_limits(age_s, 0.6 * limit_s, limit_s, found, advice)


def percentile(values: list[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def _pictures(rehearsal: Rehearsal, profile: Profile) -> Finding:
    """Judge the pictures that a flight takes for no measurement: frozen, snow, uniform, dark,
    late."""
    late = sum(t < t0 for (_, t0), (_, t) in pairwise(rehearsal.arrivals))
    if late:
        found = f"{late} of {rehearsal.pictures} came after newer ones"
        return failed(found, "use another stream or receiver: these hold pictures back")
    if not rehearsal.problems:
        again = rehearsal.repeats
        repeated = f"; {again} repetitions by the receiver are not counted" if again else ""
        return passed(f"{rehearsal.pictures} good ones{repeated}")
    text, count = rehearsal.problems.most_common(1)[0]
    share = sum(rehearsal.problems.values()) / rehearsal.pictures
    found = f"{count} of {rehearsal.pictures}: {text}"
    advice = "see mirrored" if text == mirrored_note(profile.camera) else _ADVICE.get(text, _SEE)
    return by_limits(share, 0.05, 0.5, found, advice)


def _focus(rehearsal: Rehearsal, profile: Profile) -> Finding:
    blur = rehearsal.blur
    if blur is None:
        why = "measured by the target's edges, and no target was seen"
        return skipped(why, "put the camera under the target")
    found = f"blur sigma {blur.least_px:.1f} px"
    if blur.most_px > SMEARED * blur.least_px + SMEARED_PX:
        found += f", {blur.most_px:.1f} px on another side"
        return warned(found, "hold the camera still, look at the lens's seat")
    advice = "turn the lens until perchctl track --view shows the target sharp"
    return by_limits(blur.least_px, 1.6, 2.5, found, advice)


def _mirrored(rehearsal: Rehearsal, profile: Profile) -> Finding:
    if rehearsal.mirrored >= MIRRORED_FRAMES:
        found, _, advice = mirrored_note(profile.camera).partition(": ")
        return failed(found, advice)
    if not rehearsal.found:
        return skipped("no target was seen to tell by")
    return passed("no")


def _target_in_view(rehearsal: Rehearsal, profile: Profile) -> Finding:
    if not rehearsal.found:
        return skipped("not in view", "put the vehicle under it to check the rest")
    found = _share_found(rehearsal)
    target = rehearsal.target
    if target is not None:
        away_m = math.hypot(*(float(e) for e in target.e_m))
        spread_mm = 1e3 * float(max(target.sigma_m))
        found += f", {away_m:.2f} m from the gear (+- {spread_mm:.0f} mm)"
        if problem := GroundCriteria.too_near(target):
            return failed(problem.found, problem.advice)
    if rehearsal.found < SEEN_WARN * rehearsal.pictures:
        return warned(found, "nearer, sharper, or more light: see focus")
    return passed(found)


def _share_found(rehearsal: Rehearsal) -> str:
    return f"in {100 * rehearsal.found // rehearsal.pictures} % of the pictures"


def _print(rehearsal: Rehearsal, profile: Profile) -> Finding:
    verdict = rehearsal.print_verdict
    if verdict is None:
        return skipped("both markers must be in view", "hold it nearer to the target")
    wrong, text = verdict
    found, _, advice = text.partition("; ")
    return failed(found, advice) if wrong else passed(found)


PICTURES: dict[str, Callable[[Rehearsal, Profile], Finding]] = {
    "frame rate": _rate,
    "lost frames": _lost,
    "picture age": _age,
    "pictures": _pictures,
    "focus": _focus,
    "mirrored": _mirrored,
    "target": _target_in_view,
    "print": _print,
}


# --- Where the target is the positioning system -----------------------


def _in_view(rehearsal: Rehearsal, profile: Profile, camera: CameraModel) -> Finding:
    """Judge the view from where the vehicle stands, and on its way up: what `fly` refuses fails."""
    if not rehearsal.found:
        where = overhead_text(profile.target, camera, profile.camera.mount)
        return failed("no, and fly refuses", f"put the vehicle under the target: {where}")
    found = _share_found(rehearsal)
    if rehearsal.found < SEEN_WARN * rehearsal.pictures:
        return warned(found, "nearer, sharper, or more light: see focus")
    if rehearsal.target is None:
        return warned(f"{found}, and not at the end", "see lost frames; once more")
    feet = (0.0, 0.0, profile.safety.ground_z_m)
    # The world of a level vehicle that stands at the origin, its front along x.
    gear_m = np.asarray(profile.vehicle.gear_body_m)
    place = Place(np.array(feet) + rehearsal.target.e_m + gear_m, rehearsal.target.e_yaw_rad)
    problem = out_of_view(place, feet, 0.0, profile, camera)
    if problem is not None:
        return failed(problem.found, problem.advice)
    sight = view_from(
        np.array(feet),
        0.0,
        place.position_m,
        place.yaw_rad,
        profile.target,
        camera,
        profile.camera.mount,
    )
    found += (
        f", {math.hypot(*sight.aside_m):.2f} m aside of the camera's axis "
        f"{sight.height_m:.2f} m above it"
    )
    found_large = (each.output.detections.large for each in rehearsal.looked)
    shown = [marker for marker in found_large if marker is not None]
    room = 1.0
    if shown:
        far_edge = np.array(camera.size_px) - 0.5
        least_px = np.minimum(shown[-1].corners_px + 0.5, far_edge - shown[-1].corners_px).min()
        room = float(least_px) / max(camera.size_px)
    if room < ROOM_WARN:
        found += f", only {100.0 * max(0.0, room):.0f} % of the picture's width from its edge"
        return warned(found, f"put the vehicle {sight.aside_text} from here")
    return passed(found)


IN_VIEW = "in view"


def names_of(profile: Profile) -> tuple[str, ...]:
    """Return the names of the pictures' rows, in their order."""
    return (*PICTURES, *([IN_VIEW] if profile.positioning.by == "target" else ()))


# --- The computer that looks at the pictures --------------------------


def loop_finding(rehearsal: Rehearsal | None, profile: Profile) -> Finding:
    """Judge the loop by a rehearsal: the time for a picture against that between two, and the turns
    that begin later than half a period."""
    if rehearsal is None or len(rehearsal.work_s) < LEAST_RATED:
        return skipped("no pictures to rehearse with")
    if not rehearsal.live:
        return skipped("a recording comes as fast as it is read")
    work_s = percentile(rehearsal.work_s, 0.95)
    turn_s = 1.0 / profile.link.loop_hz
    period_s = rehearsal.frame_period_s or turn_s
    late = sum(late_s > turn_s / 2.0 for late_s in rehearsal.late_s) / len(rehearsal.late_s)
    latest_s = max(rehearsal.late_s)
    found = (
        f"{1e3 * work_s:.0f} ms a picture of {1e3 * period_s:.0f}, "
        f"{100.0 * late:.0f} % of the turns late, at most {1e3 * latest_s:.0f} ms"
    )
    advice = "close other programs, use a smaller picture, or a faster computer"
    if latest_s > profile.safety.loop_late_hold_s:
        return failed(found, advice)
    return worst(
        by_limits(work_s / period_s, 0.7, 1.0, found, advice),
        by_limits(late, 0.05, 0.3, found, advice),
    )
