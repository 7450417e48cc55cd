"""Check rows about the profile and the computer's disk, which need no connection."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from perchctl.calibration import profile_camera
from perchctl.check.row import (
    Finding,
    Row,
    Unanswerable,
    Verdict,
    evaluate_row,
    evaluate_rows,
    failed,
    limits_finding,
    passed,
    skipped,
    warned,
)
from perchctl.errors import PerchError, SafetyAbort
from perchctl.files import check_writable
from perchctl.flight import FlyOptions
from perchctl.link import check_uri, vehicle_uri
from perchctl.places import is_shipped_example
from perchctl.profile import DOUBTFUL, Profile, find_calibration
from perchctl.target import mm_text, sees_small_marker
from perchctl.vision import CameraModel

LOOKS_UP = math.cos(math.radians(45.0))
"""Vertical component of the viewing direction below which the camera does not look at the
ceiling."""


def profile_rows(
    profile: Profile, *, source: str | None = None, uri: str | None = None
) -> list[Row]:
    """Return a row for each check of the profile, the most important first.

    `source` and `uri` replace the profile's camera source and the vehicle's URI. Opens no link and
    no camera; reads the calibration file. Raises nothing.
    """
    plan = _Plan(profile, profile.camera.source if source is None else source)
    rows = evaluate_rows(JUDGES, plan)
    rows += [evaluate_row(name, _limits, name, profile) for name in DOUBTFUL]
    rows += _short_address_rows(profile.link.uri if uri is None else uri)
    if profile.positioning.source.is_target:
        rows.append(evaluate_row("latency", _latency, plan))
    return rows


def offline_rows(options: FlyOptions) -> list[Row]:
    """The rows about the computer's disk and the profile, without opening a link or camera."""
    return [
        evaluate_row("log folder", log_finding, options.log_dir),
        *profile_rows(options.profile, source=options.source, uri=options.uri),
    ]


def warnings_before_flight(options: FlyOptions) -> list[str]:
    """Return a sentence for each offline row that warns.

    Errors: SafetyAbort for the first row that fails; InvalidValue, NotFound (calibration file);
    InvalidValue (log folder).
    """
    profile_camera(options.profile.camera)
    check_writable(options.log_dir / "flight.jsonl", force=True)
    rows = offline_rows(options)
    for row in rows:
        if row.verdict is Verdict.FAIL:
            raise SafetyAbort(_sentence(row))
    return [_sentence(row) for row in rows if row.verdict is Verdict.WARN]


def _sentence(row: Row) -> str:
    return f"{row.name}: {row.found}: {row.advice}"


@dataclass(frozen=True)
class _Plan:
    profile: Profile
    source: str

    @property
    def camera(self) -> CameraModel:
        """Raises Unanswerable without a calibration."""
        try:
            return profile_camera(self.profile.camera)
        except PerchError as error:
            raise Unanswerable(f"no calibration: {error}") from None


def _short_address_rows(uri: str) -> list[Row]:
    """Return a row for a radio URI whose address is too short: cflib puts zeros before it."""
    try:
        scheme = check_uri(uri)
    except PerchError:
        return []  # an invalid URI is refused elsewhere, and identifies no vehicle
    parts = uri.partition("?")[0].split("/")
    if scheme != "radio" or len(parts) < 6:
        return []
    whole = vehicle_uri(uri).rpartition("/")[2]
    if not 0 < len(parts[5]) < len(whole):
        return []
    advice = "write all ten digits of the address"
    return [Row("short address", *warned(f"{uri} means the address {whole}", advice))]


def _calibration(plan: _Plan) -> Finding:
    try:
        path = find_calibration(plan.profile.camera.calibration)
    except PerchError as error:
        return failed(str(error), "make a calibration with perchctl calibrate")
    if not plan.source.startswith("sim:") and is_shipped_example(path):
        return warned(
            f"{path.name} is the shipped example",
            "calibrate your camera (perchctl calibrate), and name the file in camera.calibration",
        )
    return passed(path.name)


def _camera_turn(plan: _Plan) -> Finding:
    mount = plan.profile.camera.mount
    found = f"rpy {' '.join(f'{angle:g}' for angle in mount.rpy_deg)} deg"
    up = float(mount.T_body_cam[2, 2])  # of the view
    if up < LOOKS_UP:
        tilted_deg = math.degrees(math.acos(max(-1.0, up)))
        return failed(
            f"{found}: the camera points {tilted_deg:.0f} deg away from straight up",
            "correct camera.mount.rpy_deg: 0 0 0 points up, and the last angle turns the picture",
        )
    return passed(found)


def _standoff(plan: _Plan) -> Finding:
    """Check that the small marker is in view at the stand-off, because an ascent only settles while
    the camera sees that marker."""
    standoff_m = plan.profile.planner.ascend.standoff_m
    shown = f"at {mm_text(standoff_m)} mm below the target the small marker is"
    if sees_small_marker(plan.camera, plan.profile, standoff_m):
        return passed(f"{shown} in view")
    return failed(
        f"{shown} not wholly in view, so the vehicle could not settle there",
        "measure camera.mount and vehicle.gear_body_m, or raise planner.ascend.standoff_m",
    )


JUDGES: dict[str, Callable[[_Plan], Finding]] = {
    "calibration file": _calibration,
    "camera turn": _camera_turn,
    "stand-off": _standoff,
}


def _limits(name: str, profile: Profile) -> Finding:
    limits = DOUBTFUL[name]
    if profile.planner.perch.mode == "position":
        limits = tuple(limit for limit in limits if "planner.perch.thrust" not in limit.keys)
    broken = [limit for limit in limits if not limit.holds(profile)]
    if not broken:
        return passed(f"consistent ({len(limits)} checked)")
    keys = dict.fromkeys(key for limit in broken for key in limit.keys)
    sentences = "; ".join(limit.violation_text(profile) for limit in broken)
    return warned(sentences, f"change {' or '.join(keys)}")


# --- If the target is the positioning system ---


def _latency(plan: _Plan) -> Finding:
    latency_s = plan.profile.camera.latency_s
    if isinstance(latency_s, str):
        return passed("measured by each flight")
    return warned(
        f"camera.latency_s is {1e3 * latency_s:g} ms; an error of 30 ms makes the "
        "vehicle oscillate",
        "set camera.latency_s: measured",
    )


# --- The computer's disk ---


def log_finding(folder: Path) -> Finding:
    """Check the free space on the folder's disk, and whether the folder is writable, without
    creating it."""
    whole = folder.absolute()
    try:
        check_writable(folder / "flight.jsonl", force=True)
        usage = shutil.disk_usage(next(p for p in (whole, *whole.parents) if p.exists()))
    except PerchError as error:
        return failed(str(error), "name another folder with --log-dir, or set log.directory")
    except OSError as error:
        return skipped(f"free space unknown ({error.strerror or error})")
    if not usage.total:
        return skipped(f"free space unknown: {folder} is not on a disk")
    found = f"{folder}, {usage.free / 1e6:,.0f} MB free"
    return limits_finding(
        -usage.free, -500e6, -50e6, found, "free some space: a flight log takes about 5 MB a minute"
    )
