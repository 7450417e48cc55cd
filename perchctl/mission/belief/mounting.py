"""Verify that the camera is mounted as the profile says: the target must be stationary in the
world.

If `camera.mount` is wrong by a rotation about the vehicle's upward axis, the target seems to move
by (1 - M) times the motion of the point where that axis meets the target's plane; M is the rotation
as a complex number. A least-squares fit over a decimetre of motion determines M (docs/mission.md,
"The mounting").
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

from perchctl.geometry import Array, rotation_from_rpy
from perchctl.values import replace
from perchctl.vehicle import Telemetry

CAMERA_MOUNTING_CHECK_WINDOW_S = 3.0  # older sightings are dropped because the estimate drifts
MIN_SIGHTINGS_TO_JUDGE_CAMERA_MOUNTING = 10
"""Number of sightings required to judge the mounting."""
MIN_VEHICLE_UP_AXIS_MOTION_TO_JUDGE_MOUNTING_M, MIN_VEHICLE_UP_AXIS_MOTION_TO_CONFIRM_MOUNTING_M = (
    0.12,
    0.3,
)
"""Motion of the vehicle's upward axis, m, above which the mounting is judged, and above which it is
proven."""
(
    MAX_APPARENT_TARGET_TO_VEHICLE_MOTION_RATIO_IF_MOUNTING_RIGHT,
    MIN_APPARENT_TARGET_TO_VEHICLE_MOTION_RATIO_IF_MOUNTING_WRONG,
) = (
    0.35,
    0.6,
)
"""Ratio of the target's apparent motion to the vehicle's motion: below the first value, the target
is stationary; above the second, it moves with the vehicle. Undisturbed flights show 0.25 at most; a
camera rotated by a quarter turn shows 1.4."""
MIN_TARGET_POSITION_RMS_TO_JUDGE_MOUNTING_WRONG_M = 0.05
"""Smallest RMS distance of the target's estimated world positions from their mean that shows that
the target moves, m."""
MAX_ROTATION_FIT_RESIDUAL_TO_TARGET_SPREAD_RATIO = 0.45  # fraction of the target's spread
MIN_FITTED_ROTATION_MODULUS_TO_JUDGE_MOUNTING_WRONG = (
    0.5  # modulus of M; near 0, the world frame drifts
)
# with a smaller rotation, the vehicle still reaches the target on a curve
MIN_CAMERA_YAW_ERROR_TO_JUDGE_MOUNTING_WRONG_RAD = math.radians(65.0)
MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG = 4
"""Number of successive contradicting sightings that prove a wrong mounting. Smaller: single wrong
poses end the flight."""
TARGET_JUMP_MIN_DISTANCE_M_MAX_DURATION_S_PAIRS, MOUNTING_CHECK_PAUSE_AFTER_JUMP_S = (
    ((0.1, 0.1), (0.15, 0.2)),
    0.4,
)
"""`TARGET_JUMP_MIN_DISTANCE_M_MAX_DURATION_S_PAIRS` are pairs of a distance, m, and a time, s: a
target that moves by more than the distance plus twice the vehicle's motion within that time has
been moved. `MOUNTING_CHECK_PAUSE_AFTER_JUMP_S` is the pause of the check after a jump, s."""
MIN_POSITION_CHANGE_TO_DETECT_ESTIMATE_JUMP_M = 0.05
"""Motion of the vehicle's estimated position between two sightings above which the state estimate
has jumped, m; `ESTIMATE_JUMP_THRESHOLD_GROWTH_MPS` times the time between them is added. Larger:
sightings from before and after a jump are compared."""
ESTIMATE_JUMP_THRESHOLD_GROWTH_MPS = 1.5
"""Increase of `MIN_POSITION_CHANGE_TO_DETECT_ESTIMATE_JUMP_M` for each second between the
sightings, m/s. Smaller: the sightings of a fast vehicle are dropped."""
_MAX_TARGET_JUMP_DURATION_S = max(
    within_s for _, within_s in TARGET_JUMP_MIN_DISTANCE_M_MAX_DURATION_S_PAIRS
)


@dataclass(frozen=True)
class CameraMountingSample:
    """Horizontal positions of vehicle and target at `t_s` in the world frame of the state estimate,
    as x + iy in m.

    `vehicle_to_up_axis_at_target_height_world_xy_m` is the vector from the vehicle to the point
    where its upward axis meets the target's plane.
    """

    t_s: float
    vehicle_world_xy_m: complex
    target_world_xy_m: complex
    vehicle_to_up_axis_at_target_height_world_xy_m: complex = 0j

    @property
    def up_axis_at_target_height_world_xy_m(self) -> complex:
        """Point, world x + iy in m, where the vehicle's upward axis meets the horizontal plane at
        the target's height."""
        return self.vehicle_world_xy_m + self.vehicle_to_up_axis_at_target_height_world_xy_m


def make_camera_mounting_sample(
    t_s: float, telemetry: Telemetry, target_world_m: Array
) -> CameraMountingSample:
    """Return the sample at the loop time `t_s` for a target at `target_world_m` (3,), in the world
    frame of the state estimate, and the vehicle's estimated pose in `telemetry`."""
    x, y, z = telemetry.position_m
    up = rotation_from_rpy(telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad)[:, 2]
    vehicle_to_up_axis_at_target_height_world_xy_m = (float(target_world_m[2]) - z) * up
    place = complex(float(target_world_m[0]), float(target_world_m[1]))
    return CameraMountingSample(
        t_s,
        complex(x, y),
        place,
        complex(
            float(vehicle_to_up_axis_at_target_height_world_xy_m[0]),
            float(vehicle_to_up_axis_at_target_height_world_xy_m[1]),
        ),
    )


@dataclass(frozen=True)
class CameraMountingMonitor:
    """The sightings of the last `CAMERA_MOUNTING_CHECK_WINDOW_S`, and whether they contradict or
    confirm the camera's mounting in the profile: with the right mounting, the target is stationary
    in the world.

    Attributes:
        sightings: one sample for each frame that measured the target, oldest first.
        check_paused_until_s: loop time until which new sightings are ignored after a jump.
        is_camera_mounting_confirmed: the target stayed in place while the vehicle's upward axis
            moved by at least `MIN_VEHICLE_UP_AXIS_MOTION_TO_CONFIRM_MOUNTING_M`; the check is
            complete.
        is_target_stationary: the present sightings show a stationary target.
        contradicting_sighting_count: number of successive sightings, up to the newest one, that
            contradict the mounting.
        camera_yaw_error_rad: rotation of the camera, relative to its mounting in the profile, with
            which the target would be stationary, about the vehicle's upward axis, positive
            counter-clockwise from above; 0 until a sighting contradicts the mounting.
    """

    sightings: tuple[CameraMountingSample, ...] = ()
    check_paused_until_s: float = -math.inf
    # the target was stationary while the vehicle moved
    # `MIN_VEHICLE_UP_AXIS_MOTION_TO_CONFIRM_MOUNTING_M`: the check is complete
    is_camera_mounting_confirmed: bool = False
    is_target_stationary: bool = False  # the target has been stationary so far
    contradicting_sighting_count: int = 0  # successive sightings that contradict the mounting
    # rotation of the mounting with which the target would be stationary
    camera_yaw_error_rad: float = 0.0

    @property
    def is_camera_mounting_wrong(self) -> bool:
        """True once `MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG` successive sightings
        contradict the mounting."""
        return (
            self.contradicting_sighting_count >= MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG
        )

    @property
    def is_target_motion_undetermined(self) -> bool:
        """True until the sightings have shown that the target is stationary in the world, as it is
        if the mounting is right. Before that, the vehicle may have moved too little, or the
        mounting may be wrong (`is_camera_mounting_wrong`)."""
        return not (self.is_camera_mounting_confirmed or self.is_target_stationary)


def update_camera_mounting_monitor(
    old: CameraMountingMonitor, sample: CameraMountingSample
) -> CameraMountingMonitor:
    """Return the monitor after one more frame that measured the target.

    A camera mounted with a wrong rotation about the vehicle's upward axis makes the target seem to
    move in the world in proportion to the vehicle's motion, or rather to that of the point where
    the upward axis meets the target's plane. Once this point has moved far enough, a complex
    least-squares fit determines the factor. If the target hardly moves, it is stationary, and more
    motion of the point confirms the mounting. The sighting contradicts the mounting if the fit
    shows a large rotation of the camera.

    Once the mounting is confirmed or found wrong, nothing changes any more. After a jump of the
    target or of the state estimate, the check starts again and pauses for
    `MOUNTING_CHECK_PAUSE_AFTER_JUMP_S`. Sightings older than `CAMERA_MOUNTING_CHECK_WINDOW_S` are
    dropped.
    """
    if old.is_camera_mounting_confirmed or old.is_camera_mounting_wrong:
        return old
    kept = tuple(s for s in old.sightings if sample.t_s - s.t_s <= CAMERA_MOUNTING_CHECK_WINDOW_S)
    if kept and _has_target_or_estimate_jumped(kept, sample):
        return CameraMountingMonitor(
            check_paused_until_s=sample.t_s + MOUNTING_CHECK_PAUSE_AFTER_JUMP_S
        )
    if sample.t_s < old.check_paused_until_s:
        return old
    new = replace(
        old, sightings=(*kept, sample), is_target_stationary=False, contradicting_sighting_count=0
    )
    return (
        new
        if len(new.sightings) < MIN_SIGHTINGS_TO_JUDGE_CAMERA_MOUNTING
        else _judge_camera_mounting(new, old.contradicting_sighting_count)
    )


def _has_target_or_estimate_jumped(
    earlier_samples: tuple[CameraMountingSample, ...], sample: CameraMountingSample
) -> bool:
    """True if, since one of `earlier_samples` (oldest first), the vehicle's estimated position has
    moved too far for a flight, or the target too far for the vehicle's motion to explain it."""
    last = earlier_samples[-1]
    far = MIN_POSITION_CHANGE_TO_DETECT_ESTIMATE_JUMP_M + ESTIMATE_JUMP_THRESHOLD_GROWTH_MPS * (
        sample.t_s - last.t_s
    )
    if abs(sample.vehicle_world_xy_m - last.vehicle_world_xy_m) > far:
        return True
    for s in reversed(earlier_samples):
        age_s = sample.t_s - s.t_s
        if age_s > _MAX_TARGET_JUMP_DURATION_S:
            return False
        target_m, vehicle_m = (
            abs(sample.target_world_xy_m - s.target_world_xy_m),
            abs(sample.up_axis_at_target_height_world_xy_m - s.up_axis_at_target_height_world_xy_m),
        )
        for jump_m, within_s in TARGET_JUMP_MIN_DISTANCE_M_MAX_DURATION_S_PAIRS:
            if age_s <= within_s and target_m > jump_m + 2.0 * vehicle_m:
                return True
    return False


def _judge_camera_mounting(
    monitor: CameraMountingMonitor, previous_contradicting_sighting_count: int
) -> CameraMountingMonitor:
    """Return the monitor after a complex least-squares fit to its sightings: how the target seems
    to move if the vehicle's upward axis moves (`update_camera_mounting_monitor`).

    If the target hardly moves, the monitor says that it is stationary and, after enough motion of
    the vehicle, that the mounting is confirmed. If it moves as with a camera rotated far from the
    profile, the number of contradicting sightings becomes `previous_contradicting_sighting_count` +
    1, and the rotation is stored. The monitor is unchanged if the vehicle has moved too little or
    the fit is ambiguous.
    """
    aims, targets = (
        [s.up_axis_at_target_height_world_xy_m for s in monitor.sightings],
        [s.target_world_xy_m for s in monitor.sightings],
    )
    n, first = len(aims), aims[0]
    moved_m = max(abs(aim - first) for aim in aims)
    if moved_m < MIN_VEHICLE_UP_AXIS_MOTION_TO_JUDGE_MOUNTING_M:
        return monitor
    p0, q0 = sum(aims) / n, sum(targets) / n
    pairs = [(aim - p0, target - q0) for aim, target in zip(aims, targets, strict=True)]
    along = sum(p.conjugate() * q for p, q in pairs) / sum(abs(p) ** 2 for p, _ in pairs)
    if abs(along) < MAX_APPARENT_TARGET_TO_VEHICLE_MOTION_RATIO_IF_MOUNTING_RIGHT:
        return replace(
            monitor,
            is_camera_mounting_confirmed=moved_m
            >= MIN_VEHICLE_UP_AXIS_MOTION_TO_CONFIRM_MOUNTING_M,
            is_target_stationary=True,
        )
    spread_m = math.sqrt(sum(abs(q) ** 2 for _, q in pairs) / n)
    unexplained_m = math.sqrt(sum(abs(q - along * p) ** 2 for p, q in pairs) / n)
    turn = 1.0 - along
    if (
        abs(along) >= MIN_APPARENT_TARGET_TO_VEHICLE_MOTION_RATIO_IF_MOUNTING_WRONG
        and abs(turn) >= MIN_FITTED_ROTATION_MODULUS_TO_JUDGE_MOUNTING_WRONG
        and abs(cmath.phase(turn)) >= MIN_CAMERA_YAW_ERROR_TO_JUDGE_MOUNTING_WRONG_RAD
        and spread_m >= MIN_TARGET_POSITION_RMS_TO_JUDGE_MOUNTING_WRONG_M
        and unexplained_m <= MAX_ROTATION_FIT_RESIDUAL_TO_TARGET_SPREAD_RATIO * spread_m
    ):
        return replace(
            monitor,
            contradicting_sighting_count=previous_contradicting_sighting_count + 1,
            camera_yaw_error_rad=-cmath.phase(turn),
        )
    return monitor
