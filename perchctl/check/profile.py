"""What a profile tells about a flight before anything is opened: the check's rows of it.

What no flight could end well with is refused when the profile is read; here is what is read, and
was hardly meant. `fly` asks the same, with the computer's disk, before it connects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from perchctl.calibration import profile_camera
from perchctl.camera import without_password
from perchctl.check import computer, sight
from perchctl.check.row import Row, Verdict
from perchctl.errors import PerchError, SafetyAbort
from perchctl.flight import FlyOptions
from perchctl.geometry import Array
from perchctl.profile import (
    OVERDUE_SHARE,
    REACHED_SHARE,
    Limit,
    Profile,
    data_folder,
    find_calibration,
)
from perchctl.target import check_target, mm_text, sees_small_marker

FAR_M = 0.15
"""No gear and no camera is farther from the centre of a vehicle of 42 g."""
APART_M = 0.003
"""A camera is not where the gear is."""
NEAR_AN_ANGLE_RAD = 0.02
NOTABLE_RAD = tuple(sorted({k * math.pi / n for n in (4, 6) for k in range(1, 2 * n + 1)}))
"""Eighths and twelfths of a circle."""
LOOKS_UP = math.cos(math.radians(45.0))
"""Of the view's upward part: with less the camera does not look at the ceiling."""


def profile_rows(
    profile: Profile, *, uri: str | None = None, source: str | None = None
) -> tuple[Row, ...]:
    """A row for each question, in the order in which they matter.

    `uri` and `source` take the place of the profile's. Opens no link and no camera; reads the
    calibration's file. Raises nothing.
    """
    uri = profile.link.uri if uri is None else uri
    source = profile.camera.source if source is None else source
    return (
        _calibration(profile, source),
        _gear_place(profile),
        _camera_place(profile),
        _camera_turn(profile),
        _markers(profile),
        _standoff(profile),
        *(_limits(name, limits, profile) for name, limits in DOUBTFUL.items()),
        _way(profile, simulated=uri.startswith("sim://")),
        *_sight(profile, simulated=uri.startswith("sim://")),
    )


def _calibration(profile: Profile, source: str) -> Row:
    name = "calibration file"
    try:
        path = find_calibration(profile.camera.calibration)
    except PerchError as error:
        return Row(name, Verdict.FAIL, str(error), "make one with perchctl calibrate")
    if not source.startswith("sim:") and _is_shipped_example(path):
        return Row(
            name,
            Verdict.WARN,
            f"{path.name} is the shipped example, and {without_password(source)} a camera of your "
            f"own",
            "calibrate it (perchctl calibrate), and name the file in camera.calibration",
        )
    return Row(name, Verdict.PASS, path.name)


def _is_shipped_example(path: Path) -> bool:
    """By what is in it: a copy under another name fits no other lens."""
    try:
        text = path.read_bytes()
        return any(text == file.read_bytes() for file in data_folder("calib").glob("example_*"))
    except OSError:
        return False


def _gear_place(profile: Profile) -> Row:
    return _place("gear place", "vehicle.gear_body_m", profile.vehicle.gear_body_m)


def _camera_place(profile: Profile) -> Row:
    mount, gear_m = profile.camera.mount, profile.vehicle.gear_body_m
    row = _place("camera place", "camera.mount.position_m", mount.position_m)
    if row.verdict is Verdict.PASS and math.dist(mount.position_m, gear_m) < APART_M:
        return Row(
            row.name,
            Verdict.WARN,
            f"{row.found}, where the gear's tip is",
            "measure both: camera.mount.position_m, vehicle.gear_body_m",
        )
    return row


def _place(name: str, key: str, place_m: Sequence[float]) -> Row:
    """The place of a part in body axes."""
    away_m = math.hypot(*place_m)
    found = f"{_mm(place_m)} (forward, left, up)"
    if away_m <= FAR_M:
        return Row(name, Verdict.PASS, found)
    return Row(
        name,
        Verdict.WARN,
        f"{found}: {away_m * 1e2:.0f} cm from the vehicle's centre",
        f"measure {key} anew: no part is farther than {FAR_M * 1e2:.0f} cm",
    )


def _mm(place_m: Sequence[float]) -> str:
    return f"{' '.join(mm_text(part) for part in place_m)} mm"


def _camera_turn(profile: Profile) -> Row:
    name, mount = "camera turn", profile.camera.mount
    found = f"rpy {' '.join(f'{angle:g}' for angle in mount.rpy_deg)} deg"
    turned = [abs(angle) for angle in mount.rpy_deg if angle]
    if turned and all(any(abs(a - n) <= NEAR_AN_ANGLE_RAD for n in NOTABLE_RAD) for a in turned):
        meant = " ".join(f"{math.degrees(angle):.0f}" for angle in mount.rpy_deg)
        return Row(
            name,
            Verdict.WARN,
            f"{found}: this looks like radians, of {meant} deg",
            f"if so write camera.mount.rpy_deg: [{', '.join(meant.split())}]",
        )
    up = float(_view(profile)[2])
    if up < LOOKS_UP:
        tilted_deg = math.degrees(math.acos(max(-1.0, up)))
        return Row(
            name,
            Verdict.FAIL,
            f"{found}: the camera looks {tilted_deg:.0f} deg away from straight up",
            "camera.mount.rpy_deg: 0 0 0 looks up, the last angle turns the picture",
        )
    return Row(name, Verdict.PASS, found)


def _view(profile: Profile) -> Array:
    """Where the camera looks, body axes, (3,)."""
    return profile.camera.mount.T_body_cam[:3, 2]


def _markers(profile: Profile) -> Row:
    large, small = profile.target.large, profile.target.small
    found = (
        f"{mm_text(large.side_m)} mm {large.dictionary}/{large.id} around "
        f"{mm_text(small.side_m)} mm {small.dictionary}/{small.id}"
    )
    try:
        # The magnet is no part of a profile: one that just covers the small marker.
        check_target(profile.target, 1.01 * math.sqrt(2.0) * small.side_m)
    except PerchError as error:
        return Row("markers", Verdict.WARN, f"{found}: {error}", "print a target that can be read")
    return Row("markers", Verdict.PASS, found)


def _standoff(profile: Profile) -> Row:
    """Settled counts only what shows the small marker."""
    name, ascend = "stand-off", profile.planner.ascend
    shown = f"at {mm_text(ascend.standoff_m)} mm under the target the small marker is"
    try:
        camera = profile_camera(profile.camera)
    except PerchError as error:
        return Row(name, Verdict.SKIPPED, f"no calibration to tell by: {error}")
    if sees_small_marker(camera, profile, ascend.standoff_m):
        return Row(name, Verdict.PASS, f"{shown} in the picture")
    return Row(
        name,
        Verdict.FAIL,
        f"{shown} not whole in the picture, and no ascent could settle",
        "measure camera.mount and vehicle.gear_body_m, or raise planner.ascend.standoff_m",
    )


def _limits(name: str, limits: Sequence[Limit], profile: Profile) -> Row:
    """One row for limits of a kind."""
    if name == "thresholds" and profile.planner.perch.mode == "position":
        limits = [limit for limit in limits if "planner.perch.thrust" not in limit.keys]
    broken = [limit for limit in limits if not limit.holds(profile)]
    if not broken:
        return Row(name, Verdict.PASS, f"{len(limits)} fit each other")
    keys = dict.fromkeys(key for limit in broken for key in limit.keys)
    return Row(
        name,
        Verdict.WARN,
        "; ".join(limit.sentence(profile) for limit in broken),
        f"change {' or '.join(keys)}",
    )


def _sight(profile: Profile, simulated: bool) -> list[Row]:
    """Where the target is the positioning system."""
    try:
        camera = profile_camera(profile.camera)
    except PerchError:
        camera = None
    return sight.of_profile(profile, camera, simulated)


def _way(profile: Profile, simulated: bool) -> Row:
    """Whether the fence and the height limit leave room for the way to the target."""
    safety, planner = profile.safety, profile.planner
    found = f"fence {safety.fence_radius_m:g} m, height limit {safety.max_height_m:g} m"
    if planner.approach_xy_m is not None:
        away_m = math.hypot(*planner.approach_xy_m)
        if away_m >= safety.fence_radius_m:
            return Row(
                "way",
                Verdict.WARN,
                f"{found}: planner.approach_xy_m is {away_m:.2f} m from the estimate's zero",
                "raise safety.fence_radius_m unless it takes off near that place",
            )
    offset_m = math.hypot(*[profile.simulation.start_offset_m] * 2)
    highest_m = profile.simulation.ceiling_z_m[1] - profile.vehicle.gear_body_m[2]
    if simulated and offset_m >= safety.fence_radius_m:
        return Row(
            "way",
            Verdict.WARN,
            f"{found}: simulated flights start up to {offset_m:.2f} m aside of the target",
            "raise safety.fence_radius_m, or lower simulation.start_offset_m",
        )
    if simulated and highest_m >= safety.max_height_m:
        return Row(
            "way",
            Verdict.WARN,
            f"{found}: simulated ceilings are touched at up to {highest_m:.2f} m",
            "raise safety.max_height_m, or lower simulation.ceiling_z_m",
        )
    return Row("way", Verdict.PASS, found)


# --- The part of the check that costs no time: what `fly` asks before it connects --------------


def quick_rows(options: FlyOptions) -> list[Row]:
    """Of the computer's disk and the profile. Opens no link and no camera."""
    return [
        computer.disk_row(options.log_dir),
        *profile_rows(options.profile, uri=options.uri, source=options.source),
    ]


def warnings_before_flight(options: FlyOptions) -> list[str]:
    """A sentence for each row that warns. Errors: SafetyAbort for the first that fails; of the
    calibration's file InvalidValue, NotFound."""
    profile_camera(options.profile.camera)
    found = quick_rows(options)
    for row in found:
        if row.verdict is Verdict.FAIL:
            raise SafetyAbort(_sentence(row))
    return [_sentence(row) for row in found if row.verdict is Verdict.WARN]


def _sentence(row: Row) -> str:
    return f"{row.name}: {row.found}: {row.advice}"


# --- A profile's limits that are allowed and doubtful: they hardly work together ---------------
# Those that no flight could end well with are refused when the profile is read
# (`perchctl.profile.schema.IMPOSSIBLE`).


OVERSHOOT_M = 0.1
"""So far a climb passes its setpoint (docs/firmware.md, "Position take-off")."""
FRESH_UNDER_LOAD_V = 3.7
"""What a full battery has left under a light vehicle (docs/firmware.md, "Thrust to PWM")."""
FULL_V = 4.35
"""The most that one cell has, of whatever kind."""
LIGHT_HOVER_THRUST = 40200
"""Of 30 g (docs/firmware.md, "Thrust to PWM"); less raw thrust does not press."""
LEAST_TILT_DEG, LEAST_FENCE_M, LEAST_STALE_S = 20.0, 0.3, 10.0
MOST_GROUND_TOLERANCE_M = 0.45
"""What hangs is higher."""
USUAL_RATE_HZ = 25.0


def _least_time_s(takeoff_m: float, takeoff_mps: float, *dwells_s: float) -> float:
    return REACHED_SHARE * takeoff_m / takeoff_mps + sum(dwells_s)


DOUBTFUL: Mapping[str, tuple[Limit, ...]] = {
    "heights": (
        Limit(
            (OVERSHOOT_M, "planner.search.max_height_m"), "safety.max_height_m",
            "a climb overshoots by as much, and lands for it", equal=True,
        ),
        Limit(
            ("safety.ground_tolerance_m",), MOST_GROUND_TOLERANCE_M,
            "a vehicle that hangs would be taken for one on the ground", equal=True,
        ),
    ),
    "fence": (
        Limit(
            (LEAST_FENCE_M,), "safety.fence_radius_m", "a draught carries it so far", equal=True
        ),
    ),
    "battery limits": (
        Limit(("safety.min_load_v",), "safety.min_rest_v", "it would land as soon as it lifts"),
        Limit(
            ("safety.min_load_v",), FRESH_UNDER_LOAD_V,
            "hovering takes a full battery down to it: it would land as soon as it lifts",
        ),
        Limit(("safety.min_rest_v",), FULL_V, "no battery rests so high: no flight would begin"),
        Limit(
            (LEAST_STALE_S,), "safety.battery_stale_s",
            "a reading may well stand still for so long", equal=True,
        ),
    ),
    "time limits": (
        Limit(
            (
                "planner.takeoff_height_m", "planner.takeoff_speed_mps",
                "planner.estimate.dwell_s", "planner.align.dwell_s",
                "planner.ascend.settle_dwell_s", "planner.perch.contact_dwell_s",
            ), "planner.perching_time_s", "the perching time is over before a contact",
            of=_least_time_s, words="the least time for {0} at {1}, with {2}, {3}, {4} and {5}",
        ),
        Limit(
            ("planner.search.attempts", "planner.search.wait_s"), "planner.perching_time_s",
            "the perching time is over before the search", of=lambda waits, wait_s: waits * wait_s,
            words="{0} times {1}",
        ),
        Limit(
            ("safety.max_height_m", "planner.landing.speed_mps"), "planner.landing.timeout_s",
            "from there it is not down by setpoints when half of that is over, and is left to its "
            "own landing", of=lambda height_m, speed_mps: height_m / speed_mps / OVERDUE_SHARE,
            words="twice the time that landing from {0} takes at {1}",
        ),
        Limit(
            ("safety.camera_hold_s",), "safety.camera_land_s", "it lands before it was held"
        ),
        Limit(
            ("safety.telemetry_hold_s",), "safety.telemetry_land_s", "it lands before it was held"
        ),
        Limit(
            ("safety.loop_late_hold_s",), "safety.loop_late_land_s", "it lands before it was held"
        ),
    ),
    "thresholds": (
        Limit(
            ("planner.align.xy_m",), "planner.ascend.cone_base_m",
            "near the target it goes back and forth between ALIGN and ASCEND", equal=True,
        ),
        Limit(
            ("planner.perch.contact_z_m",), "planner.ascend.standoff_m",
            "where it settles it is as near as at a contact already",
        ),
        Limit(
            ("planner.ascend.near_speed_mps",), "planner.ascend.speed_mps",
            "it climbs faster near the target than far from it", equal=True,
        ),
        Limit(
            (LIGHT_HOVER_THRUST,), "planner.perch.thrust", "so little raw thrust does not press",
            equal=True,
        ),
        Limit(
            ("safety.start_tilt_deg",), "safety.max_tilt_deg",
            "it may start at a tilt that cuts the motors",
        ),
        Limit(
            (LEAST_TILT_DEG,), "safety.max_tilt_deg", "a gust tilts it so far, and cuts the motors",
            equal=True,
        ),
        Limit(
            ("safety.jump_deg",), "safety.heading_lost_deg",
            "each jump of the heading would take it down by thrust alone",
        ),
        Limit(
            ("safety.estimator_variance_m2",), "safety.flight_variance_m2",
            "it may start with an estimate that it lands for", equal=True,
        ),
        Limit(
            ("link.telemetry_period_s", "link.telemetry_period_s"), "safety.proof_age_s",
            "one lost packet, and nothing is proven", equal=True,
        ),
    ),
}  # fmt: skip
"""By the row that they are told in."""
