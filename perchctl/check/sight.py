"""Where the target is the positioning system: from how far it is seen, whether it is in view, and
what the profile says of that. Pure."""

from __future__ import annotations

import math

from perchctl.check.rehearsal import Rehearsal
from perchctl.check.row import Row, failed, passed, skipped, warned
from perchctl.flight import out_of_view, place_seen, target_from
from perchctl.profile import Profile
from perchctl.target import TargetDesign, edge_margin, mm_text, offset_text, overhead_view
from perchctl.vision import CameraModel

NAMES = ("sight range", "in view")
SEEN_WARN = 0.5
"""Of the pictures, as in the row `target`."""
ROOM_WARN = 0.03
"""Of the picture's larger side: by so much a lean of 2 to 3 deg moves the target."""
LARGER = "print a larger target: perchctl make-target suggest --ceiling M proposes one"


def is_asked(profile: Profile) -> bool:
    return profile.positioning.by == "target"


def unseen(why: str, profile: Profile) -> list[Row]:
    """For a camera whose pictures cannot be looked at."""
    return [skipped(name, why) for name in NAMES] if is_asked(profile) else []


def rows(
    rehearsal: Rehearsal,
    design: TargetDesign,
    measured: bool,
    profile: Profile,
    camera: CameraModel,
) -> list[Row]:
    """None where something else measures the position. `measured`: the blur that `design` is for
    is that of these pictures."""
    if not is_asked(profile):
        return []
    if not rehearsal.pictures:
        return unseen(rehearsal.problem or "no picture came in the rehearsal", profile)
    return [
        _range(rehearsal, design, measured, profile, camera),
        _in_view(rehearsal, profile, camera),
    ]


def of_profile(profile: Profile, camera: CameraModel | None, simulated: bool) -> list[Row]:
    """What is known before anything is opened."""
    if not is_asked(profile):
        return []
    return [_latency(profile), _size(profile, camera, simulated)]


def _range(
    rehearsal: Rehearsal,
    design: TargetDesign,
    measured: bool,
    profile: Profile,
    camera: CameraModel,
) -> Row:
    """With this camera, and its blur where that is known."""
    name = NAMES[0]
    plain_px = design.ranges.large_px
    if plain_px is None:
        return failed(
            name, "no marker is read through this blur and noise", "a sharper picture is needed"
        )
    where = overhead_view(
        profile.target, camera, profile.camera.mount, plain_px if measured else None
    )
    if not where.reaches:
        return failed(name, f"the target has to be {where.words}", "see camera turn")
    found = f"the target has to be {where.words}"
    if not measured:
        return skipped(name, f"with a sharp picture {found}", "see focus")
    if rehearsal.target is not None:
        place = place_seen(rehearsal.target, profile)
        seen = target_from((0.0, 0.0, profile.safety.ground_z_m), 0.0, place, profile, camera)
        if seen.height_m > where.highest_m:
            return warned(name, f"it is {seen.height_m:.1f} m above it; {found}", LARGER)
    return passed(name, found)


def _in_view(rehearsal: Rehearsal, profile: Profile, camera: CameraModel) -> Row:
    """From where the vehicle stands, and on its way up: what `fly` refuses fails."""
    name = NAMES[1]
    if not rehearsal.found:
        where = overhead_view(profile.target, camera, profile.camera.mount).words
        return failed(name, "no, and fly refuses", f"put the vehicle under the target: {where}")
    found = f"in {100 * rehearsal.found // rehearsal.pictures} % of the pictures"
    if rehearsal.found < SEEN_WARN * rehearsal.pictures:
        return warned(name, found, "nearer, sharper, or more light: see sight range and focus")
    if rehearsal.target is None:
        return warned(name, f"{found}, and not at the end", "see lost frames; once more")
    place = place_seen(rehearsal.target, profile)
    feet = (0.0, 0.0, profile.safety.ground_z_m)
    problem = out_of_view(place, feet, 0.0, profile, camera)
    if problem is not None:
        return failed(name, problem.found, problem.advice)
    sight = target_from(feet, 0.0, place, profile, camera)
    found += (
        f", {math.hypot(*sight.aside_m):.2f} m aside of the camera's axis "
        f"{sight.height_m:.2f} m above it"
    )
    room = _room(rehearsal, camera)
    if room is not None and room < ROOM_WARN:
        found += f", only {100.0 * max(0.0, room):.0f} % of the picture's width from its edge"
        return warned(name, found, f"put the vehicle {offset_text(sight.aside_m)} from here")
    return passed(name, found)


def _room(rehearsal: Rehearsal, camera: CameraModel) -> float | None:
    """Of the large marker in the newest picture that shows it."""
    for looked in reversed(rehearsal.looked):
        large = looked.detections.large
        if large is not None:
            return edge_margin(large.corners_px, camera.size_px)
    return None


def _latency(profile: Profile) -> Row:
    """A time that was written down is true for one camera, receiver and computer."""
    latency_s = profile.camera.latency_s
    if isinstance(latency_s, str):
        return passed("latency", "measured by each flight")
    return warned(
        "latency",
        f"camera.latency_s is {1e3 * latency_s:g} ms, and the position is by the pictures: one "
        f"that is 30 ms wrong makes the vehicle swing under the target",
        "set camera.latency_s: measured",
    )


def _size(profile: Profile, camera: CameraModel | None, simulated: bool) -> Row:
    name = "marker size"
    if camera is None:
        return skipped(name, "no calibration to tell by")
    mount = profile.camera.mount
    highest_m = overhead_view(profile.target, camera, mount).highest_m
    side = mm_text(profile.target.large.side_m)
    found = f"{side} mm, seen from the ground up to {highest_m:.1f} m above the camera"
    ceiling_m = profile.simulation.ceiling_z_m[1]
    if simulated and ceiling_m - mount.position_m[2] > highest_m:
        return warned(name, f"{found}; simulated ceilings are up to {ceiling_m:g} m high", LARGER)
    return passed(name, found)
