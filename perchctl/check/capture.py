"""Check rows about the motion-capture system that measures a vehicle's position: connection, rigid
body, rate, noise and axes. Pure.

Let R_own be the vehicle's attitude as estimated by the vehicle, and R_seen as measured by the
motion-capture system. Let A be the rotation from the vehicle's world frame to the system's, and B
the rotation from the rigid body's axes to the vehicle's; both should be the identity:

    R_seen = A R_own B

Take the vehicle's rotation between two times as a rotation vector. If the vehicle measures this
vector as ``w`` in its own world frame, the system measures ``A w`` in the system's world frame. If
the vehicle measures the vector as ``v`` in its body axes, it is ``B^T v`` in the rigid body's axes.
A and B are therefore found as the rotations that align two sets of vectors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.check.row import (
    Finding,
    Row,
    Verdict,
    failed,
    limits_finding,
    passed,
    skipped,
    skipped_rows,
    warned,
    worst_finding,
)
from perchctl.errors import PerchError
from perchctl.flight import GroundCriteria
from perchctl.geometry import Array, nearest_axis, rotation_from_rpy, rpy_from_rotation
from perchctl.link import vehicle_uri
from perchctl.perception import History, attitude_at
from perchctl.positioning import (
    CaptureFrame,
    CaptureSource,
    VehiclePose,
    load_comparison,
    save_comparison,
)
from perchctl.profile import PositioningConfig, Profile
from perchctl.vehicle import Telemetry

CAPTURE_S = 3.0
"""Time for which the motion-capture system is observed, s. Shorter: a body that drifts at 0.05 m/s
is not detected."""
CAPTURE_POLL_S = 0.005
NOISE_FAIL = 4.0
"""Noise above which the row fails, in units of the `positioning.position_sigma_m` that the vehicle
assumes."""
WILD_M = 0.1
"""Spread of a resting body's positions, m, above which the positions must be in millimetres,
because no motion-capture system is that noisy."""


@dataclass(frozen=True)
class CaptureSamples:
    """Samples from one listening period: the vehicle's telemetry, the frames from the
    motion-capture system, and that system's problem as an error, or None."""

    telemetry: tuple[Telemetry, ...] = ()
    frames: tuple[CaptureFrame, ...] = ()
    error: PerchError | None = None

    def body_poses(self, config: PositioningConfig) -> list[VehiclePose]:
        """The vehicle's poses as measured by the motion-capture system, corrected for latency,
        oldest first."""
        return [
            VehiclePose.of(frame.bodies[config.body], config, frame.t_s - config.latency_s)
            for frame in self.frames
            if config.body in frame.bodies
        ]


def collect_samples(
    take_telemetry: Callable[[], list[Telemetry]],
    source: CaptureSource,
    clock: Callable[[], float],
    wait: Callable[[float], None],
    duration_s: float = CAPTURE_S,
) -> CaptureSamples:
    """Collect the vehicle's telemetry and the motion-capture system's frames for `duration_s`
    seconds."""
    began_s = clock()
    telemetry: list[Telemetry] = []
    frames: list[CaptureFrame] = []
    source.poll(began_s)  # discards older samples
    take_telemetry()
    while (now_s := clock()) - began_s < duration_s:
        telemetry.extend(take_telemetry())
        frame = source.poll(now_s)
        if frame is not None:
            frames.append(frame)
        wait(CAPTURE_POLL_S)
    return CaptureSamples(tuple(telemetry), tuple(frames), _find_error(source, clock()))


def _find_error(source: CaptureSource, now_s: float) -> PerchError | None:
    if hasattr(source, "error"):
        error: PerchError | None = source.error(now_s)
        return error
    problem = source.problem(now_s)
    return None if problem is None else PerchError(problem)


# --- At rest ---


BODY_ROWS = ("body", "body place")


def failed_capture_rows(error: PerchError, config: PositioningConfig) -> list[Row]:
    """The rows for a motion-capture system that cannot be opened or sends nothing."""
    advice = error.advice or (
        "check that it streams, that positioning.host is right, and that no firewall blocks it"
    )
    first = Row("capture", *failed(error.found, advice))
    return [first, *skipped_rows(BODY_ROWS, f"no {config.label}")]


def mocap_rows_at_rest(samples: CaptureSamples, profile: Profile) -> list[Row]:
    """Check samples from a motion-capture system that were taken while the vehicle was at rest."""
    config = profile.positioning
    if not samples.frames:
        error = samples.error or PerchError(f"{config.label} sends no frames")
        return failed_capture_rows(error, config)
    first = Row("capture", *passed(f"{config.label} sends frames"))
    places = samples.body_poses(config)
    if not places:
        others = sorted({name for frame in samples.frames for name in frame.bodies})
        found = (
            f"{config.label} sees no body {config.body!r}; it sees {', '.join(others) or 'none'}"
        )
        body = failed(found, "correct positioning.body, or move the body into the cameras' view")
        return [
            first,
            Row("body", *body),
            Row("body place", *skipped("the motion-capture system does not see the body")),
        ]
    body = _body(samples, places, profile)
    return [first, Row("body", *body), Row("body place", *_place(samples, places, profile))]


def _body(samples: CaptureSamples, places: list[VehiclePose], profile: Profile) -> Finding:
    config = profile.positioning
    at = np.array([place.position_m for place in places])
    if len(at) > 2 and not np.ptp(at, axis=0).any():
        advice = "real poses are noisy: check if motion capture is paused or the body is hidden"
        return failed("frozen: all its poses are identical", advice)
    sigma_m = float(np.max(1.4826 * np.median(np.abs(at - np.median(at, axis=0)), axis=0)))
    times = [place.t_s for place in places]
    span_s = times[-1] - times[0]
    rate_hz = (len(times) - 1) / span_s if span_s > 0.0 else 0.0
    gap_s = max((b - a for a, b in itertools.pairwise(times)), default=math.inf)
    # `MotionCapture.poll` prefers frames with the body, so the other frames are those without the
    # body.
    share = 1.0 - len(places) / len(samples.frames)
    found = (
        f"{config.body!r} seen in {100.0 * (1.0 - share):.0f} % of the frames, "
        f"{rate_hz:.0f} Hz, longest gap {1e3 * gap_s:.0f} ms, noise {1e3 * sigma_m:.1f} "
        "mm"
    )
    hidden = (
        "the body may be hidden at times or have too few markers: look at it in the capture "
        "software"
    )
    slow = (
        "raise the motion-capture rate, connect by cable, or close other programs on this computer"
    )
    noisy = (
        "keep the vehicle still; calibrate the motion-capture system, or raise "
        "positioning.position_sigma_m"
        if sigma_m < WILD_M
        else "the positions appear to be in millimetres: set the unit of the stream to metres"
    )
    limit_m = config.position_sigma_m
    return worst_finding(
        limits_finding(share, 0.02, 0.2, found, hidden),
        limits_finding(-rate_hz, -50.0, -20.0, found, slow),
        limits_finding(gap_s, config.hold_s / 2.0, config.hold_s, found, slow),
        limits_finding(sigma_m, limit_m, NOISE_FAIL * limit_m, found, noisy),
    )


def _place(samples: CaptureSamples, places: list[VehiclePose], profile: Profile) -> Finding:
    """Check the position by the same criteria as `fly`."""
    newest = samples.telemetry[-1] if samples.telemetry else None
    place = places[-1].to_external(attitude=True)
    if newest is None:
        return skipped("no telemetry to compare it with")
    criteria = GroundCriteria(newest, profile)
    if not criteria.stands:
        return skipped("the vehicle is not level and at rest")
    problem = criteria.position_frame_problem(place)
    if problem is None and all(GroundCriteria(each, profile).stands for each in samples.telemetry):
        moved_m = float(np.linalg.norm(places[-1].position_m - places[0].position_m))
        problem = criteria.moved_body(moved_m, profile)
    if problem is not None:
        return failed(problem.found, problem.advice)
    x, y, z = place.position_m
    return passed(f"x {x:.2f}, y {y:.2f}, z {z:.2f} m")


# --- Moved by hand ---

HOW_TO_TURN = (
    "lift the vehicle straight up by 30 cm, turn it by 90 deg, tilt it forward and sideways, and "
    "put it back"
)
POSE_PAIR_PERIOD_S = 0.1
LEAST_STEP_RAD, MOST_STEP_RAD = math.radians(12.0), math.radians(120.0)
"""Smallest and largest rotation between two times that is used: a smaller rotation may be noise,
and the axis of a larger one is uncertain."""
MOVED_RAD, MOVED_M, MOVED_G = math.radians(12.0), 0.06, 0.05
BODY_STILL_RAD = math.radians(4.0)
"""Rotation up to which the rigid body counts as still, rad. Larger: a moving body counts as
still."""
BODY_STILL_M = 0.03
"""Displacement up to which the rigid body counts as still, m."""
MANY_SHARE = 0.9
"""If at least this share of the rotations deviate from one axis by at most `LEAST_STEP_RAD`, all of
them count as rotations about this axis."""
WORLD_TILT_DEG = 25.0
"""If the angle between the motion-capture system's z axis and the vertical is larger than this, the
system's world frame is wrong, deg. Larger: a tilted world passes."""
BODY_WARN_DEG = 5.0
"""Angle between the axes of rigid body and vehicle above which the row warns, deg."""
BODY_FAIL_DEG = 15.0
"""Angle between the axes of rigid body and vehicle above which the row fails, deg. Larger: a body
with rotated axes passes with a warning."""
LEAST_RISE_M = 0.12
"""Smallest displacement at which a lift shows the vertical direction, m. Larger: a short lift is
not sufficient."""
HAND_REACH_M = 5.0
"""Largest possible lift by hand, m. If a body seems to move farther, its positions must be in
another unit."""
STRANGER = 0.4
"""If A and B leave, on average, more than this share of a rotation unexplained, the motion-capture
system tracks another body."""


@dataclass(frozen=True, eq=False)
class PairedMotion:
    """The motion as seen by vehicle and motion-capture system at n common times.

    Attributes:
        R_vehicle, R_capture: n attitudes each, from the vehicle and from the motion-capture system.
        positions_m: positions (n, 3) from the motion-capture system.
        max_deviation_g: the accelerometer's largest deviation from 1 g.
    """

    R_vehicle: Rotation
    R_capture: Rotation
    positions_m: Array
    max_deviation_g: float

    @property
    def displacements_m(self) -> Array:
        """Displacement of each position from the first, (n, 3)."""
        return np.asarray(self.positions_m - self.positions_m[0])


@dataclass(frozen=True, eq=False)
class FrameAlignment:
    """Rotations A and B with R_capture = A R_vehicle B.

    Attributes:
        R_world: A, from the vehicle's world frame to the motion-capture system's.
        R_body: B, from the rigid body's axes to the vehicle's.
        residual_share: mean share of a rotation that A and B leave unexplained.
    """

    R_world: Rotation
    R_body: Rotation
    residual_share: float

    @property
    def vertical(self) -> Array:
        """Upward unit vector in the motion-capture system's world, (3,)."""
        return np.asarray(self.R_world.as_matrix()[:, 2])


def pair_motion(
    telemetry: Sequence[Telemetry], capture_poses: Sequence[VehiclePose]
) -> PairedMotion | None:
    """Pair motion-capture poses, `POSE_PAIR_PERIOD_S` apart, with the vehicle's attitudes at the
    same times; None for fewer than three pairs."""
    if len(telemetry) < 2:
        return None
    history = History(tuple(telemetry))
    own, seen, place_m, last_s = [], [], [], -math.inf
    for placed in capture_poses:
        inside = telemetry[0].t_s <= placed.t_s <= telemetry[-1].t_s
        if not inside or placed.t_s < last_s + POSE_PAIR_PERIOD_S:
            continue
        attitude = attitude_at(history, placed.t_s)
        if attitude is None:
            continue
        own.append(rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad))
        seen.append(placed.R)
        place_m.append(placed.position_m)
        last_s = placed.t_s
    if len(own) < 3:
        return None
    moved_g = max(abs(t.acc_z_g - 1.0) for t in telemetry)
    return PairedMotion(
        Rotation.from_matrix(np.array(own)),
        Rotation.from_matrix(np.array(seen)),
        np.array(place_m),
        moved_g,
    )


def solve_alignment(motion: PairedMotion) -> FrameAlignment | None:
    """Solve for the alignment from all pairs of times between which the vehicle rotated; None if
    the vehicle rotated about fewer than two axes."""
    i, j = np.triu_indices(len(motion.R_vehicle), 1)
    size = (motion.R_vehicle[j] * motion.R_vehicle[i].inv()).magnitude()
    kept = (size >= LEAST_STEP_RAD) & (size <= MOST_STEP_RAD)
    if kept.sum() < 3:
        return None
    i, j, size = i[kept], j[kept], size[kept]
    world_own, world_seen = (
        (R[j] * R[i].inv()).as_rotvec() for R in (motion.R_vehicle, motion.R_capture)
    )
    body_own, body_seen = (
        (R[i].inv() * R[j]).as_rotvec() for R in (motion.R_vehicle, motion.R_capture)
    )
    if not _has_many_axes(world_own) or not _has_many_axes(body_own):
        return None
    world, _ = Rotation.align_vectors(world_seen, world_own)
    body, _ = Rotation.align_vectors(body_own, body_seen)
    left = np.linalg.norm(world_seen - world.apply(world_own), axis=1)
    return FrameAlignment(world, body, float(np.mean(left / size)))


def _has_many_axes(turns: Array) -> bool:
    """True if the rotation vectors (n, 3) are about more than one axis."""
    axis = np.linalg.eigh(turns.T @ turns)[1][:, 2]  # the largest eigenvalue comes last
    aside_rad = np.linalg.norm(turns - np.outer(turns @ axis, axis), axis=1)
    return bool(np.quantile(aside_rad, MANY_SHARE) > LEAST_STEP_RAD)


def _turned_rad(attitudes: Rotation) -> Array:
    """The angle of each attitude's rotation from the first one, (n,)."""
    return np.asarray((attitudes[0].inv() * attitudes).magnitude())


def comparison_finding(motion: PairedMotion | None, config: PositioningConfig) -> Finding:
    """Check that vehicle and motion-capture system agree on the motion; skipped if `motion` is
    None."""
    if motion is None:
        return skipped(
            "the reports of the vehicle and the motion-capture system do not overlap in time",
            HOW_TO_TURN,
        )
    own_rad, seen_rad = (float(_turned_rad(R).max()) for R in (motion.R_vehicle, motion.R_capture))
    way_m = float(np.linalg.norm(motion.displacements_m, axis=1).max())
    body = f"rigid body {config.body!r}"
    others = "the name may belong to another body: correct positioning.body"
    if own_rad <= MOVED_RAD and motion.max_deviation_g <= MOVED_G:
        if way_m > MOVED_M or seen_rad > MOVED_RAD:
            return failed(f"the {body} moves while the vehicle does not", others)
        return skipped("the vehicle was not moved", HOW_TO_TURN)
    if seen_rad <= BODY_STILL_RAD and way_m <= BODY_STILL_M:
        return failed(f"the vehicle moves while the {body} does not", others)
    if way_m > HAND_REACH_M:
        found = f"the {body} moved by {way_m:.0f} m: the positions appear to be in millimetres"
        return failed(found, "set the unit of the motion-capture stream to metres")
    turns = solve_alignment(motion)
    if turns is None:
        turned_deg = math.degrees(own_rad)
        return warned(
            f"turned by {turned_deg:.0f} deg, but about too few axes to compare", HOW_TO_TURN
        )
    if turns.residual_share > STRANGER:
        advice = (
            "the name may belong to another body, or the markers may be too few or too symmetric"
        )
        return failed(f"the rotation of the {body} does not match the vehicle's", advice)
    return _world_finding(turns, motion) or _body_finding(turns, motion, config)


def _risen_m(turns: FrameAlignment, motion: PairedMotion) -> Array:
    """Return the displacement (3,) from the first position to the one that is farthest from it
    along the motion-capture system's vertical or, if that is too close for a lift, to the farthest
    one in any direction."""
    displacements_m = motion.displacements_m
    risen_m = displacements_m[int(np.argmax(np.abs(displacements_m @ turns.vertical)))]
    if float(np.linalg.norm(risen_m)) < LEAST_RISE_M:
        risen_m = displacements_m[int(np.argmax(np.linalg.norm(displacements_m, axis=1)))]
    return np.asarray(risen_m)


def _world_finding(turns: FrameAlignment, motion: PairedMotion) -> Finding | None:
    """Find what is wrong with the motion-capture system's world frame: it may be tilted or
    mirrored, or its axes may be swapped. The system may use different axes for positions and
    attitudes."""
    off_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(turns.vertical[2])))))
    if off_deg > WORLD_TILT_DEG:
        found, axis = (
            f"the motion-capture world frame is tilted by {off_deg:.0f} deg",
            nearest_axis(turns.vertical),
        )
        if axis is not None:
            found = f"swapped axes: up is {axis} in the motion-capture system"
        advice = (
            "set the motion-capture world frame to z up, and define the rigid body again with "
            "the vehicle level"
        )
        return failed(found, advice)
    risen_m = _risen_m(turns, motion)
    way_m = float(np.linalg.norm(risen_m))
    if way_m < LEAST_RISE_M or nearest_axis(risen_m / way_m) == "z":
        return None
    x, y, z = risen_m
    return failed(
        f"swapped or mirrored axes: when lifted, the body moves by x {x:.2f}, y "
        f"{y:.2f}, z {z:.2f} m",
        "set the motion-capture world frame to z up, right-handed; if you moved the "
        "vehicle sideways, lift it again, straight up",
    )


def _body_finding(
    turns: FrameAlignment, motion: PairedMotion, config: PositioningConfig
) -> Finding:
    off_deg = math.degrees(float(turns.R_body.magnitude()))
    if off_deg > BODY_WARN_DEG:
        profiled = rotation_from_rpy(*(math.radians(a) for a in config.body_rpy_deg))
        rpy = rpy_from_rotation(turns.R_body.as_matrix() @ profiled)
        wanted = ", ".join(f"{math.degrees(angle):.0f}" for angle in rpy)
        verdict = failed if off_deg > BODY_FAIL_DEG else warned
        return verdict(
            f"the rigid body's axes are rotated by {off_deg:.0f} deg from the vehicle's",
            f"set positioning.body_rpy_deg: [{wanted}], or define the body again",
        )
    found = f"rotation agrees with the vehicle's within {off_deg:.0f} deg"
    risen_m = float(_risen_m(turns, motion) @ turns.vertical)
    if risen_m < LEAST_RISE_M:
        return warned(
            f"{found}; the vehicle was not lifted along the motion-capture z axis", HOW_TO_TURN
        )
    return passed(f"{found}; rose by {risen_m:.2f} m")


# --- The result of the lift comparison, saved for `fly` ---

COMPARED = "compared"


def comparison_rows(
    config: PositioningConfig, uri: str, now: datetime, *, simulated: bool
) -> list[Row]:
    """Return one row that says whether there is a saved lift comparison with this motion-capture
    system, which `fly` requires. Without motion capture, or for the simulated vehicle, return no
    row."""
    if not config.source.is_mocap or simulated:
        return []
    return [_record_row(config, uri, now)]


def save_comparison_row(
    finding: Finding, config: PositioningConfig, uri: str, now: datetime
) -> Row:
    """Save the finding of a lift comparison for `fly`, unless it was skipped, and return the row
    about the saved comparison."""
    passes, vehicle = finding.verdict is Verdict.PASS, vehicle_uri(uri)
    if finding.verdict is Verdict.SKIPPED:
        return _record_row(config, uri, now)
    why = save_comparison(config, vehicle, now, passes, finding.found)
    if why is None:
        return _record_row(config, uri, now)
    if not passes and load_comparison(config, vehicle).objection_and_advice(now) is None:
        found = (
            "this result could not be saved, so perchctl fly would rely on an older check that "
            f"passed: {why}"
        )
        advice = "free some space or restore write permission, and do not fly until this is done"
        return Row(COMPARED, *failed(found, advice))
    return Row(
        COMPARED,
        *warned(
            f"the result could not be saved, so perchctl fly cannot use it: {why}",
            "then check again",
        ),
    )


def _record_row(config: PositioningConfig, uri: str, now: datetime) -> Row:
    record = load_comparison(config, vehicle_uri(uri))
    objection = record.objection_and_advice(now)
    if objection is None:
        return Row(COMPARED, *passed(record.text(now)))
    found, advice = objection
    return Row(COMPARED, *warned(f"{found}, so perchctl fly refuses to start", advice))
