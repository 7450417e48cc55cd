"""What `perchctl fly --dry-run` shows: the flight as it is resolved, before anything is opened."""

from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

from perchctl.calibration import profile_camera
from perchctl.camera import profile_record, without_password
from perchctl.check import Row, Verdict, comparison_rows, profile_rows
from perchctl.flight import FlyOptions, wall_date
from perchctl.profile import (
    Profile,
    find_calibration,
    find_mask,
    find_weights,
    picture_edges,
    read_weights,
)
from perchctl.target import mm_text, overhead_view

_COLUMN, _WIDTH = 13, 80


def plan(options: FlyOptions) -> dict[str, Any]:
    """What would be flown, fully resolved; nothing is connected."""
    calibration = find_calibration(options.profile.camera.calibration)
    mask = options.profile.camera.mask
    return {
        "uri": options.uri,
        "source": without_password(options.source),
        "seed": options.seed if options.simulated else None,
        "profile_file": str(options.profile_path),
        "calibration_file": str(calibration),
        "mask_file": None if mask is None else str(find_mask(mask)),
        "log_directory": str(options.log_dir),
        "record": options.record,
        "profile": profile_record(options.profile),
        "check": [
            dataclasses.asdict(row)
            for row in (
                *profile_rows(options.profile, uri=options.uri, source=options.source),
                *_compared(options),
            )
        ],
    }


def plan_text(options: FlyOptions) -> str:
    """The plan for people: what, where, and the phases with their numbers."""
    resolved, planner = plan(options), options.profile.planner
    search, ascend, perch = planner.search, planner.ascend, planner.perch
    target = options.profile.target
    merge = options.profile.merge
    how = weights_text(options) if merge.method == "weights" else "joint solve"
    press = (
        f"raw thrust {perch.thrust}" if perch.mode == "raw" else f"press {perch.press_m} m above"
    )
    lines = [
        f"vehicle      {resolved['uri']}" + (f", seed {options.seed}" if options.simulated else ""),
        f"camera       {resolved['source']}, calibration {resolved['calibration_file']}"
        + (f" {options.profile.camera.cam}" if options.profile.camera.cam else "")
        + (f", mask {resolved['mask_file']}" if resolved["mask_file"] else ""),
        _positioning_line(options),
        *_compared_lines(options),
        f"profile      {resolved['profile_file']}: {options.profile.description}".rstrip(": "),
        f"target       {target.large.side_m * 1e3:g} mm {target.large.dictionary}/"
        f"{target.large.id} around {target.small.side_m * 1e3:g} mm "
        f"{target.small.dictionary}/{target.small.id}",
        *_place_lines(options.profile),
        *_vehicle_lines(options.profile),
        f"merge        {how}",
        f"1 APPROACH   take off to {planner.takeoff_height_m:g} m",
        f"2 SEARCH     {search.attempts} attempts of {search.wait_s:g} s, {search.step_m:g} m "
        f"higher each, at most {search.max_height_m:g} m",
        f"3 ESTIMATE   {planner.estimate.dwell_s:g} s of steady pose",
        f"4 ALIGN      within {planner.align.xy_m * 1e3:g} mm and {planner.align.yaw_deg:g} deg "
        f"for {planner.align.dwell_s:g} s",
        f"5 ASCEND     at {ascend.speed_mps:g} m/s to {ascend.standoff_m * 1e3:g} mm under the "
        f"target, settle within {ascend.settle_xy_m * 1e3:g} mm",
        f"6 PERCH      {press}, at most {perch.timeout_s:g} s",
        f"7 COMPLETE   release in {planner.complete.steps} steps, watch for "
        f"{planner.complete.watch_s:g} s",
        f"attempts     {planner.attempts}, perching time {planner.perching_time_s:g} s",
        *_limit_lines(options.profile),
        f"log          {resolved['log_directory']}"
        + (f", with pictures up to {options.profile.log.max_mb:g} MB" if options.record else ""),
        *_doubts(resolved["check"]),
    ]
    return "\n".join(lines)


def _positioning_line(options: FlyOptions) -> str:
    config = options.profile.positioning
    if config.by == "target":
        return "\n".join(
            textwrap.wrap(
                f"positioning  the target itself, by the camera, from the ground on: "
                f"{_overhead(options.profile)}",
                _WIDTH,
                subsequent_indent=" " * _COLUMN,
            )
        )
    if config.by != "mocap":
        return "positioning  the vehicle's own deck"
    where = "the simulated room's" if options.simulated else f"{config.system}:{config.host}"
    return (
        f"positioning  motion capture {where}, body {config.body!r}, {config.send} at most "
        f"{config.rate_hz:g} Hz"
    )


def _overhead(profile: Profile) -> str:
    """Where it has to be."""
    return overhead_view(profile.target, profile_camera(profile.camera), profile.camera.mount).words


def _compared_lines(options: FlyOptions) -> list[str]:
    return [
        f"{'':{_COLUMN}}{row.found}" for row in _compared(options) if row.verdict == Verdict.PASS
    ]


def _compared(options: FlyOptions) -> list[Row]:
    return comparison_rows(
        options.profile.positioning, options.uri, wall_date(), simulated=options.simulated
    )


def _place_lines(profile: Profile) -> list[str]:
    """Where the target has to be, if that is said."""
    target = profile.target
    if target.expected_xy_m is None:
        return []
    x_m, y_m = target.expected_xy_m
    within_m = target.expected_within_m
    return [f"{'':{_COLUMN}}within {within_m:g} m of x {x_m:g} m, y {y_m:g} m, or it is another's"]


def _vehicle_lines(profile: Profile) -> list[str]:
    """Where gear and camera are, and how late the picture is."""
    camera = profile.camera
    edges = picture_edges(camera.mount, camera.mirrored)
    seen = [] if edges is None else [f"picture's {edges[0]} is the front, {edges[1]} the left side"]
    latency = camera.latency_s
    late = f"{latency * 1e3:g} ms" if isinstance(latency, (int, float)) else str(latency)
    return [
        f"gear         tip at {_mm(profile.vehicle.gear_body_m)} (forward, left, up)",
        f"mounting     camera at {_mm(camera.mount.position_m)}, rpy "
        f"{' '.join(f'{angle:g}' for angle in camera.mount.rpy_deg)} deg"
        + (", mirrored" if camera.mirrored else ""),
        *(f"{'':{_COLUMN}}{line}" for line in seen),
        f"latency      {late} from exposure to arrival",
    ]


def _mm(place_m: tuple[float, float, float]) -> str:
    return f"{' '.join(mm_text(part) for part in place_m)} mm"


def _limit_lines(profile: Profile) -> list[str]:
    safety = profile.safety
    return [
        f"fence        {safety.fence_radius_m:g} m around the place of take-off",
        f"height       at most {safety.max_height_m:g} m above the ground",
        f"battery      at least {safety.min_rest_v:g} V at rest, {safety.min_load_v:g} V in flight",
        f"{'':{_COLUMN}}{_gate_text(profile)}",
    ]


def _gate_text(profile: Profile) -> str:
    if not profile.safety.energy_gate:
        return "attempts begin whatever it has left"
    return (
        f"{profile.vehicle.battery_mah:g} mAh; no attempt without enough for its landing and "
        f"{profile.safety.energy_reserve_s:g} s"
    )


def _doubts(rows_found: list[dict[str, str]]) -> list[str]:
    """What of the profile was hardly meant, at 80 columns."""
    lines: list[str] = []
    for row in rows_found:
        if row["verdict"] in (Verdict.WARN, Verdict.FAIL):
            text = f"{row['name']}: {row['found']}; {row['advice']}"
            lines += textwrap.wrap(
                text, _WIDTH, initial_indent=f"{row['verdict']:{_COLUMN}}",
                subsequent_indent=" " * _COLUMN, break_long_words=False, break_on_hyphens=False,
            )  # fmt: skip
    return lines


def weights_text(options: FlyOptions) -> str:
    """Which merge weights fly, and where they are from: date, method, data."""
    merge = options.profile.merge
    numbers = ", ".join(f"{axis} {w:g}" for axis, w in merge.weights.model_dump().items())
    if merge.weights_file is None:
        return f"weights {numbers} (of the profile)"
    path = find_weights(merge.weights_file)
    fitted = read_weights(path)
    origin = [fitted.date and f"of {fitted.date}", fitted.method]
    if fitted.data.sha256:
        origin.append(f"data {fitted.data.sha256[:12]}")
    details = ", ".join(part for part in origin if part)
    return f"weights {numbers} (from {path}{': ' + details if details else ''})"
