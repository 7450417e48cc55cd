"""Check that vehicle, motion-capture body and camera belong to the same home, that is, to the same
starting place of a fleet. The rows are for one of several vehicles on the floor.

```
vehicle  its LEDs blink, and somebody sees them blink at this home
body     the motion capture sees its rigid body at this home
target   its camera sees its target at the position expected from this home
```

The vehicle, its rigid body and the target in its camera's view are each compared with the home, so
none of them can belong to another vehicle. If another vehicle's camera would show the same image,
or if the target is not detected, perchctl asks the user to cover the lens, and identifies the
camera whose image goes dark. No vehicle is armed, and the motors stay off.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, open_camera, without_password
from perchctl.check import camera, capture, vehicle
from perchctl.check.rehearsal import Rehearsal, rehearse
from perchctl.check.row import Finding, Row, Verdict, failed, passed, skipped, skipped_rows
from perchctl.check.session import CheckScope, MocapOrError, open_room, start_if_simulated
from perchctl.corridor import Point
from perchctl.errors import ConnectionFailed, PerchError
from perchctl.flight import FlyOptions, WallClock
from perchctl.link import ProbeLink
from perchctl.profile import Profile
from perchctl.target import overhead_text, view_from
from perchctl.vehicle import DISARM_IT, FLYING, Telemetry
from perchctl.vision import CameraModel, make_pipeline

BODY_AT_HOME_M = 0.25
"""Distance from a home within which a body counts as being there, m: half the smallest distance
between a home and another vehicle's corridor. Larger: neighbours that have swapped places may pass.
Smaller: homes measured by tape fail."""
DARK_SHARE = 0.5
"""Fraction of dark or blank images above which a camera counts as covered. Larger: a hand that does
not cover the whole lens is not recognised. Smaller: a camera with a bad signal counts as
covered."""
_DARK = ("dark", "uniform")

Ask = Callable[[str], bool]
"""Asks the user a question; returns True for yes."""


@dataclass(frozen=True, kw_only=True)
class Stand:
    """Where one of several vehicles is on the floor. All positions and the heading are in the
    axes of its own state estimate.

    Attributes:
        home_text: its home in words, in room axes.
        homes: the homes of the other vehicles.
        views: where the target of another vehicle would appear to be if that vehicle's camera were
            mistaken for this one's. Contains only targets that have a marker in common with this
            vehicle's target: the others are not detected.
        lookalikes: vehicles whose cameras would show a target at the position at which this
            vehicle's own target must appear.
    """

    name: str
    home_m: Point
    home_text: str
    heading_rad: float = 0.0
    homes: Mapping[str, Point] = field(default_factory=dict)
    views: Mapping[str, Point] = field(default_factory=dict)
    lookalikes: tuple[str, ...] = ()


def identity_rows(options: FlyOptions, stand: Stand, scope: CheckScope, ask: Ask) -> Iterator[Row]:
    """Yield the rows about a vehicle as soon as they are known: address, vehicle, body (with motion
    capture), camera and target. A row that fails leaves that part unidentified. Errors: the same as
    for `perchctl.check.check`.

    For a simulated vehicle, which has its own simulator and camera, perchctl asks nothing.
    """
    calibrated = profile_camera(options.profile.camera)
    with contextlib.ExitStack() as stack:
        uri, spec, profile = start_if_simulated(options, calibrated, scope, stack)
        mocap = open_room(profile, scope, stack)
        link = ProbeLink(options.uri, profile.link, time.monotonic, link_uri=uri)
        stack.callback(link.close)
        scope.announce(f"connecting to {options.uri}")
        answers = True
        try:
            link.connect()
        except ConnectionFailed as error:
            answers = False
            yield vehicle.unanswered_row(error, options.uri)
            yield from skipped_rows(["vehicle"], "the vehicle does not answer")
        else:
            yield Row("address", *passed(f"{options.uri} answers"))
            yield Row("vehicle", *_vehicle_finding(link, options, stand, scope, ask))
        if mocap is not None:
            yield Row("body", *_body_finding(mocap, profile, stand, scope))
        if not answers:
            yield from skipped_rows(["camera", "target"], "the vehicle does not answer")
            return
        shown = without_password(options.source)
        scope.announce(f"opening the camera {shown}")
        try:
            source = open_camera(spec, time.monotonic, profile.camera, size_px=calibrated.size_px)
        except PerchError as error:
            yield camera.failed_camera_rows(error, options.source, profile)[0]
            yield from skipped_rows(["target"], "no picture arrives")
            return
        stack.callback(source.close)
        size = camera.size_finding(source.size_px, calibrated.size_px)
        if size.verdict is not Verdict.PASS:
            yield Row("camera", *size)
            yield from skipped_rows(["target"], "pictures of another size cannot be checked")
            return
        yield Row("camera", *passed(f"{shown} delivers pictures"))
        view = View(link, source, calibrated, profile, stand, scope)
        yield Row("target", *_target_finding(view, None if options.simulated else ask))


def _vehicle_finding(
    link: ProbeLink, options: FlyOptions, stand: Stand, scope: CheckScope, ask: Ask
) -> Finding:
    if options.simulated:
        return skipped("simulated: no other vehicle has its address")
    seen = vehicle.query_vehicle(link, options.uri, scope.listen_s)
    if seen.telemetry is None:
        return failed("no telemetry arrives", "restart the vehicle, and run perchctl check")
    if seen.is_armed or seen.telemetry.supervisor & FLYING:
        return failed("the vehicle is armed or flying, and its propellers may turn", DISARM_IT)
    try:
        with link.blinking():
            is_there = ask(
                f"{stand.name}: all LEDs of one vehicle are blinking. Is it the only one, and is "
                f"it at its home, {stand.home_text}?"
            )
    except PerchError as error:
        return failed(
            f"the vehicle's LEDs could not be made to blink: {error.found}", "update its firmware"
        )
    if is_there:
        return passed(f"you confirmed that the vehicle is blinking at its home, {stand.home_text}")
    return failed(
        f"you did not confirm that the vehicle is blinking at its home, {stand.home_text}",
        "put each vehicle at its own home, or correct uri; if two vehicles are blinking, give "
        "one of them another address",
    )


# --- The rigid body in motion capture ---


def _body_finding(
    mocap: MocapOrError, profile: Profile, stand: Stand, scope: CheckScope
) -> Finding:
    config = profile.positioning
    if mocap is None or isinstance(mocap, PerchError):
        return failed("" if mocap is None else mocap.found, "run perchctl check for this vehicle")
    scope.announce(f"listening to {config.label} for {scope.capture_s:g} s")
    seen = capture.collect_samples(list, mocap, time.monotonic, time.sleep, scope.capture_s)
    poses = seen.body_poses(config)
    if not poses:
        return failed(
            f"{config.label} does not see the body {config.body!r}",
            "correct body, or move the vehicle into the view of the motion-capture system",
        )
    x_m, y_m = np.median([pose.position_m[:2] for pose in poses], axis=0)
    away_m = math.dist((x_m, y_m), stand.home_m)
    found = f"{config.body!r} is {away_m:.2f} m from its home"
    if away_m <= BODY_AT_HOME_M:
        return passed(found)
    there = _nearest((x_m, y_m), stand.homes, BODY_AT_HOME_M)
    if there is not None:
        found += f", at the home of {there}"
    return failed(found, "put each vehicle at its own home, or correct body and home_m")


# --- The camera, identified by the target that it sees ---


@dataclass(frozen=True, eq=False)
class View:
    """What the camera sees, assuming that the vehicle is at its home."""

    link: ProbeLink
    source: FrameSource
    calibrated: CameraModel
    profile: Profile
    stand: Stand
    scope: CheckScope

    def rehearse(self, profile: Profile | None = None) -> Rehearsal:
        """Process a few seconds of images. If `profile` is given, look for the target of that
        profile instead of this vehicle's own."""
        flown = profile or self.profile
        pipeline = make_pipeline(flown, self.calibrated)
        seconds = self.scope.rehearse_s
        return rehearse(self._telemetry, self.source, pipeline, flown, WallClock(), seconds)

    def _telemetry(self) -> list[Telemetry]:
        """Roll and pitch come from the vehicle. Position and yaw are not taken from the vehicle,
        because they may still be wrong before a flight."""
        place_m = (*self.stand.home_m, self.profile.safety.ground_z_m)
        return [
            replace(
                sample,
                position_m=place_m,
                velocity_mps=(0.0, 0.0, 0.0),
                yaw_rad=self.stand.heading_rad,
            )
            for sample in self.link.telemetry()
        ]


def _target_finding(view: View, ask: Ask | None) -> Finding:
    """Check the position of the target. `ask` is None if the camera cannot belong to another
    vehicle."""
    view.scope.announce(f"looking for the target for {view.scope.rehearse_s:g} s")
    target, stand = view.profile.target, view.stand
    expected_m = target.expected_xy_m
    assert expected_m is not None, "each vehicle of a fleet has a target position"
    own = view.rehearse()
    place_m = _target_place(own)
    # A target beyond the limit fails: another look may show it within the limit by chance.
    if place_m is None:
        anywhere = target.model_copy(update={"expected_xy_m": None})
        own_or_other = view.profile.model_copy(update={"target": anywhere})
        place_m = _target_place(view.rehearse(own_or_other))
    if place_m is None:
        if ask is not None:
            return _covered_finding(view, own, ask, "its target is not detected")
        return _undetected_finding(view, expected_m)
    away_m = math.dist(place_m, expected_m)
    if away_m <= target.expected_within_m:
        found = f"the camera sees the vehicle's target {away_m:.2f} m from its expected position"
        if ask is None or not stand.lookalikes:
            return passed(found)
        return _covered_finding(
            view,
            own,
            ask,
            f"{stand.lookalikes[0]}'s camera would see its own target at the same position",
        )
    found = f"the camera sees a target {away_m:.2f} m from the vehicle's own target"
    there = _nearest(place_m, stand.views, target.expected_within_m)
    if there is not None:
        found += (
            f", at the position where {there}'s camera would see its own target; the two "
            "cameras may be swapped"
        )
    return failed(found, "correct source, target_m, home_m or heading_deg")


def _undetected_finding(view: View, expected_m: Point) -> Finding:
    """Report that the target was not detected, and whether its expected position is in the image
    under the lowest possible ceiling, which is just above the highest point of the search."""
    profile, stand = view.profile, view.stand
    floor_m = profile.safety.ground_z_m
    sight = view_from(
        np.array((*stand.home_m, floor_m)),
        stand.heading_rad,
        np.array((*expected_m, floor_m + profile.planner.search.max_height_m)),
        stand.heading_rad,
        profile.target,
        view.calibrated,
        profile.camera.mount,
    )
    if sight.has_marker:
        return failed(
            "its target is not detected, although its expected position is in the image",
            "check the light and the focus, and compute the range of its ids with perchctl "
            "make-target design",
        )
    where = overhead_text(profile.target, view.calibrated, profile.camera.mount)
    return failed(
        "its target is not detected",
        f"put the vehicle nearer to its target and correct home_m: {where}",
    )


def _covered_finding(view: View, before: Rehearsal, ask: Ask, why: str) -> Finding:
    """Check whether the camera image goes dark while the user covers the lens of the vehicle at
    this home."""
    name = view.stand.name
    if _is_dark(before) or not before.pictures:
        return failed(f"{why}, and its pictures are dark", "add light, or run perchctl check")
    if not ask(
        f"{name}: {why}. Cover the lens of the vehicle at {view.stand.home_text} with your hand. "
        f"Is it covered?"
    ):
        return failed(f"{why}, and you have not covered the lens", "give each target its own ids")
    covered = view.rehearse()
    if _is_dark(covered) or (before.target_pictures and not covered.target_pictures):
        return passed("the camera image went dark when you covered the lens")
    return failed(
        "the camera image did not go dark when you covered the lens",
        "the camera may be another vehicle's: correct source; if it is not, cover the whole lens",
    )


def _target_place(rehearsal: Rehearsal) -> Point | None:
    """Return where the target was measured; None if it was not measured."""
    places = [place_m[:2] for _, place_m in rehearsal.target_places]
    if not places:
        return None
    x_m, y_m = np.median(places, axis=0)
    return float(x_m), float(y_m)


def _is_dark(rehearsal: Rehearsal) -> bool:
    dark = sum(n for problem, n in rehearsal.problems.items() if problem.kind in _DARK)
    return dark > DARK_SHARE * rehearsal.pictures


def _nearest(place_m: Point, places: Mapping[str, Point], within_m: float) -> str | None:
    """Return the name of the nearest place within `within_m`."""
    near = {name: math.dist(place_m, other_m) for name, other_m in places.items()}
    name = min(near, key=near.__getitem__, default=None)
    return name if name is not None and near[name] <= within_m else None
