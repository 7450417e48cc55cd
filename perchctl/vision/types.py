"""Frozen dataclasses for the values that the steps of the vision pipeline exchange."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rot_z, rotation_from_rpy
from perchctl.values import cached_property

MarkerName = Literal["large", "small"]
PictureKind = Literal["whole", "woven", "top", "bottom"]
MARKERS: tuple[MarkerName, MarkerName] = ("large", "small")
"""The target's markers, the large one first."""
GearToTargetVectorInLevelFrame = Array
"""A vector (3,) from the gear to the target in level axes, m: the paper's (e_x, e_y, e_z)."""


class VisibleMarkers(Enum):
    """Which of the target's two markers are in view: none, only the large one, both, or only the
    small one. The paper (section II-A.2) calls these the stages of an approach."""

    NONE = "none"
    LARGE = "large"  # Stage 1 of the paper, equation 5.
    BOTH = "both"  # Stage 2 of the paper, equation 8.
    SMALL = "small"  # Stage 3 of the paper, equation 12.


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A calibrated camera.

    Attributes:
        size_px: width, height.
        K: camera matrix (3, 3), px: (fx, 0, cx), (0, fy, cy), (0, 0, 1).
        dist: distortion coefficients in OpenCV's order, shape (n,).
        model: distortion model, ``plumb_bob`` (5 coefficients), ``rational_polynomial`` (8) or
            ``fisheye`` (4).

    Raises InvalidValue for any other form of `K`, except for a skew (row 0, column 1) of at most
    `MAX_CAMERA_MATRIX_SKEW_PX`, because OpenCV only uses fx, fy, cx and cy and silently ignores the
    other entries.
    """

    size_px: tuple[int, int]
    K: Array
    dist: Array
    model: str = "plumb_bob"

    def __post_init__(self) -> None:
        check_camera_matrix(np.asarray(self.K, np.float64))

    @property
    def calibration_key(self) -> tuple[tuple[int, int], str, bytes, bytes]:
        """A hashable value that is the same for all cameras with the same calibration: image size,
        distortion model, camera matrix and distortion coefficients."""
        K, dist = (np.asarray(each, np.float64).tobytes() for each in (self.K, self.dist))
        return self.size_px, self.model, K, dist


MAX_CAMERA_MATRIX_SKEW_PX = 0.3
"""Largest skew allowed in a camera matrix, px. A skew of s px moves an image point laterally by s
y/z. With this skew, a point at the lower edge of the example camera's image moves by 0.2 px, or 0.5
mm at 1 m. Larger: an error that no other check detects is accepted."""


def check_camera_matrix(K: Array) -> None:
    """Raise InvalidValue if the camera matrix is not of the shape (3, 3) and the form (fx, s, cx),
    (0, fy, cy), (0, 0, 1), for example because it is transposed, or if its skew s is larger than
    `MAX_CAMERA_MATRIX_SKEW_PX` (0.3 px)."""
    if K.shape != (3, 3):
        raise InvalidValue(f"the camera matrix must have the shape (3, 3), found {K.shape}")
    if (K[1:, 0] == 0.0).all() and K[2, 1] == 0.0 and K[2, 2] == 1.0:
        if abs(K[0, 1]) > MAX_CAMERA_MATRIX_SKEW_PX:
            raise InvalidValue(
                f"the camera matrix has a skew of {K[0, 1]:g} px (row 1, column 2), but at most "
                f"{MAX_CAMERA_MATRIX_SKEW_PX:g} px is allowed: calibrate without skew "
                f"(CALIB_FIX_SKEW in OpenCV, --fisheye-fix-skew in ROS)"
            )
        return
    if (K[:2, 2] == 0.0).all() and K[0, 1] == 0.0 and K[2, 2] == 1.0:
        raise InvalidValue("the camera matrix is transposed: write it row by row, fx 0 cx first")
    raise InvalidValue(
        f"the camera matrix must be fx 0 cx, 0 fy cy, 0 0 1; found "
        f"{', '.join(' '.join(f'{value:g}' for value in row) for row in K)}"
    )


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera image. `t_s` is its exposure time on the loop's clock: the arrival time,
    `t_arrival_s`, minus `camera.latency_s` of the profile. The additional latency measured in
    flight and half the duration of a field are subtracted only in `perchctl.perception`.

    `image` is grey, uint8, shape (height, width); `step` also accepts BGR, (height, width, 3).

    `picture_kind` describes interlacing: ``whole`` for an image from one exposure, ``woven`` for
    two interlaced fields, ``top`` or ``bottom`` for one field interpolated to full height, None if
    not classified yet (`perchctl.vision.fields`). `is_repeated` is True if the source returned the
    previous image again; such an image is not a new measurement. `source_jpeg` is the JPEG from the
    source, which `cv2.imdecode` decodes exactly to `image` with IMREAD_GRAYSCALE and
    IMREAD_IGNORE_ORIENTATION; None if the source sends no JPEG or if the image was modified.
    """

    index: int
    t_s: float
    image: NDArray[np.uint8]
    t_arrival_s: float = 0.0
    picture_kind: PictureKind | None = None
    is_repeated: bool = False
    source_jpeg: bytes | None = None


def to_grey(image: Any) -> NDArray[np.uint8]:
    """Convert a grey, BGR or BGRA image, uint8 or uint16, to a contiguous uint8 grey image (height,
    width). Of 16 bits, the upper 8 are kept. A grey image may have the shape (height, width) or
    (height, width, 1). Raises InvalidValue for anything else."""
    if image is None:
        raise InvalidValue(
            "the picture is None: cv2.imread returns None if it cannot read a file as an image"
        )
    shape: tuple[int, ...] = getattr(image, "shape", ())
    kind = getattr(image, "dtype", None)
    is_picture = len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3, 4))
    is_array = isinstance(image, np.ndarray) and kind in (np.uint8, np.uint16)
    if not (is_array and is_picture) or 0 in shape:
        found = type(image).__name__ if kind is None else f"{kind} of shape {shape}"
        raise InvalidValue(
            f"a picture must be a uint8 array, (height, width) in grey or (height, width, "
            f"3) in BGR; found {found}"
        )
    if kind == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if len(shape) == 3:
        codes = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
        image = cv2.cvtColor(image, codes[shape[2]]) if shape[2] in codes else image[:, :, 0]
    return np.ascontiguousarray(image, np.uint8)


@dataclass(frozen=True, eq=False)
class Detection:
    """One marker's corners in the distorted image, (4, 2) px, in the order of cv2.aruco: top left,
    top right, bottom right, bottom left. (0, 0) is the centre of the top-left pixel.

    Attributes:
        sigma_px: standard deviation of the corners, from the residuals of the line fit, or a
            default value if no lines were fitted.
        are_corners_fitted: True if the corners come from a line fit or a photometric fit; False if
            they come from OpenCV or were inferred from the other marker, which is less accurate.
        remaining_edge_shift_sigma_px: standard deviation of the distance by which all edges of the
            marker may still be shifted outwards or inwards (blooming, gamma), after a correction
            or without one.
        corner_shift_per_readout_time_sigma_px: change (4, 2) of the corners, px, for one standard
            deviation of the error of the rolling-shutter readout time, which is common to both
            markers; None if this error is not considered.
        cov_px2: covariance (8, 8) of corners that were inferred from a visible part of the marker
            and may be outside the image. It is in pixels of a pinhole camera, in the order x0, y0,
            x1, y1, ...; None for corners from other methods.
        row_jitter_sigma_px: standard deviation of the corners along x, because analogue video
            shifts each image row horizontally by a random distance (row jitter).
        horizontal_side_deinterlacing_sigma_px: additional standard deviation of the position of
            horizontal sides, perpendicular to the side, if every second row of the image is
            interpolated.
    """

    marker: MarkerName
    corners_px: Array
    sigma_px: float
    are_corners_fitted: bool
    remaining_edge_shift_sigma_px: float = 0.0
    corner_shift_per_readout_time_sigma_px: Array | None = None
    cov_px2: Array | None = None
    row_jitter_sigma_px: float = 0.0
    horizontal_side_deinterlacing_sigma_px: float = 0.0


@dataclass(frozen=True)
class EdgeShiftEstimate:
    """Common shift of all black-white edges of an image, due to blooming or gamma.

    `white_growth_per_edge_px` is the distance by which each edge is displaced from the white side
    to the black side; if positive, a marker's black square looks smaller than it is, by twice this
    distance in width. `sigma_px` is the standard deviation of this distance, and `age_frames` the
    number of frames since it was measured.
    """

    white_growth_per_edge_px: float
    sigma_px: float
    age_frames: int = 0


@dataclass(frozen=True, eq=False)
class Detections:
    """The target's markers as detected in one frame.

    Attributes:
        frame_index, t_s: index and exposure time of the frame.
        large, small: the two markers; None if not detected.
        is_mirrored_marker_seen: True if no marker was detected, but one was decoded as its mirror
            image.
        target_count: number of complete targets, with both markers, that a search of the image
            found; 0 if there was no search.
        corner_flow_pxps: image velocity of each marker's corners since the previous detections,
            px/s: one velocity per corner, (4, 2), or one for all four corners, (2,). Empty if
            unknown.
        edge_shift: common shift of all black-white edges of the image; None if unknown.
    """

    frame_index: int
    t_s: float
    large: Detection | None = None
    small: Detection | None = None
    is_mirrored_marker_seen: bool = False
    target_count: int = 0
    corner_flow_pxps: dict[MarkerName, Array] = field(default_factory=dict)
    edge_shift: EdgeShiftEstimate | None = None

    def get(self, marker: MarkerName) -> Detection | None:
        """Return the marker's detection; None if it was not detected."""
        return self.large if marker == "large" else self.small

    @property
    def markers(self) -> list[Detection]:
        """The markers that were detected, the large one first."""
        return [each for each in (self.large, self.small) if each is not None]


@dataclass(frozen=True, eq=False)
class VehicleState:
    """The vehicle's attitude, position and velocity at a frame's time, in world axes.

    Signs are as in `perchctl.geometry`: right-handed, pitch positive nose down. `velocity_mps` is
    None if unknown.
    """

    t_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity_mps: tuple[float, float, float] | None = None

    @cached_property
    def R_level_body(self) -> Array:
        """Rotation (3, 3) from body to level axes, given by roll and pitch."""
        return rotation_from_rpy(self.roll_rad, self.pitch_rad, 0.0)

    @cached_property
    def R_world_level(self) -> Array:
        """Rotation (3, 3) from level to world axes, given by the heading."""
        return rot_z(self.yaw_rad)

    @cached_property
    def R_world_body(self) -> Array:
        """Rotation (3, 3) from body to world axes."""
        return self.R_world_level @ self.R_level_body


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """The target's pose from one frame: from the ``large`` marker, the ``small`` marker or both
    (``joint``), as named by `source`.

    Attributes:
        rvec_rad, tvec_m: pose in the OpenCV camera frame, with cv2.aruco's marker axes, (3,).
        e_m: position of the target relative to the gear in the level frame, (3,): x forward, y
            left and z up, with the heading of the vehicle but without its roll and pitch.
        e_yaw_rad: heading of the target's x axis in the level frame, positive counter-clockwise
            seen from above.
        sigma_m, sigma_yaw_rad: standard deviations of `e_m`, (3,), and of `e_yaw_rad`.
        rms_reprojection_px: RMS distance between the projected and the measured corners.
        chi2_per_dof: sum of the squared errors of the corners divided by their variances, per
            degree of freedom.
        level_frame_xyz_yaw_cov: covariance (4, 4) of (e_x, e_y, e_z, e_yaw), m and rad; None if
            unknown.
        position_shift_per_print_error_sigma_m: shift (3, 2) of `e_m` for one standard deviation of
            the print's size error (column 0) and of the sheet's curl (column 1). These errors are
            included in `sigma_m` and `level_frame_xyz_yaw_cov`, but are the same in every frame.
        rvec_tvec_cov: covariance (6, 6) of (rvec_rad, tvec_m), without these print errors; None if
            unknown.
    """

    source: Literal["large", "small", "joint"]
    t_s: float
    rvec_rad: Array
    tvec_m: Array
    e_m: GearToTargetVectorInLevelFrame
    e_yaw_rad: float
    sigma_m: Array
    sigma_yaw_rad: float
    rms_reprojection_px: float
    chi2_per_dof: float = 0.0
    level_frame_xyz_yaw_cov: Array | None = None
    position_shift_per_print_error_sigma_m: Array = field(default_factory=lambda: np.zeros((3, 2)))
    rvec_tvec_cov: Array | None = None


@dataclass(frozen=True, eq=False)
class MarkerFilterState:
    """State of a marker's Kalman filter (paper, section II-A.1).

    The state `x` (8,) contains yaw, yaw rate, then position and velocity of x, y, z, in SI units,
    in the track's frame: relative to the gear in level axes, or in the world;
    `perchctl.vision.filter` defines names for its indices. `P` (8, 8) is its covariance due to the
    noise of measurements and motion. Column k of `state_shift_per_bias_sigma` (8, 4) is the change
    of the state for one standard deviation of bias k: the vehicle's roll and pitch, the print's
    size and curl. `unseen_frames` counts the frames since the last measurement.
    """

    t_s: float
    x: Array
    P: Array
    unseen_frames: int = 0
    state_shift_per_bias_sigma: Array = field(default_factory=lambda: np.zeros((8, 4)))

    @property
    def state_cov_with_biases(self) -> Array:
        """Covariance (8, 8) of the state `x` (yaw, yaw rate, then position and velocity of x, y, z;
        SI), including the four biases: the vehicle's roll and pitch, the print's size and curl."""
        return self.P + self.state_shift_per_bias_sigma @ self.state_shift_per_bias_sigma.T


@dataclass(frozen=True, eq=False)
class TargetEstimate:
    """The target's position and heading at `t_s`, the paper's (e_x, e_y, e_z, e_psi), with standard
    deviations.

    Attributes:
        t_s: time of the estimate, which is the time of the frame, or a later time for a prediction.
        last_measured_at_s, small_marker_last_measured_at_s: exposure times (on the clock of `t_s`)
            of the last frame in which the target was measured, and of the last frame in which its
            small marker was measured; -inf if there is no such frame.
        stage: markers measured in the newest frame; ``NONE`` while the filter coasts.
        is_measured_in_newest_frame: True if the newest frame contains a detection of the target.
        tracked: True if the target was measured at most `kalman.n_max` frames ago. If False, the
            estimate is the target's last position.
        unseen_frames: number of frames since the last detection.
        e_m: vector from the gear to the target in the level frame, (3,).
        sigma_m, sigma_yaw_rad: standard deviations of `e_m`, (3,), and of `e_yaw_rad`. While only a
            similar pattern at a contradictory position is seen, which may be the target, they also
            cover its position and heading.
        e_yaw_rad: heading of the target in the level frame, in (-pi, pi].
        velocity_mps: velocity (3,) from the filter, in level axes: the rate of change of `e_m`
            (`kalman.frame: level`), or the velocity of the target in the world (`kalman.frame:
            world`).
        measured_gear_to_target_world_m: vector (3,) from the gear to the target at
            `last_measured_at_s`, in the axes of the state estimate's world frame; None if the
            attitude was unknown. Unlike `e_m`, it does not depend on how far the vehicle has moved
            since then.
        measured_gear_to_target_sigma_m: the larger of the standard deviations of this vector along
            the horizontal axes of the level frame; infinite if the vector is None.
        world_m, world_yaw_rad: position (3,) and heading of the target in the world frame of the
            vehicle's state estimate; None without an attitude.
        world_velocity_mps: velocity (3,) of the target in the world frame of the state estimate,
            which is the drift of this frame; None if the filter works in the level frame.
    """

    t_s: float
    last_measured_at_s: float
    small_marker_last_measured_at_s: float
    stage: VisibleMarkers
    is_measured_in_newest_frame: bool
    tracked: bool
    unseen_frames: int
    e_m: GearToTargetVectorInLevelFrame
    e_yaw_rad: float
    velocity_mps: Array
    sigma_m: Array
    sigma_yaw_rad: float
    world_m: Array | None = None
    world_yaw_rad: float | None = None
    world_velocity_mps: Array | None = None
    measured_gear_to_target_world_m: Array | None = None
    measured_gear_to_target_sigma_m: float = math.inf


class TargetBearingPredictionErrors(NamedTuple):
    """Running mean squared errors, rad^2, of the vehicle's estimated motion between two poses of
    the target: one for the motion computed from the difference of two estimated positions, and one
    for the motion computed from velocity times time. An error is the angle, seen from the camera,
    between the predicted and the measured direction of the target."""

    mean_squared_error_using_positions_rad2: float = 0.0
    mean_squared_error_using_velocities_rad2: float = 0.0


@dataclass(frozen=True, eq=False)
class LastAcceptedPose:
    """The last accepted pose of the target, the vehicle's attitude, position and velocity at that
    time (`vehicle_state`, None if unknown), and the mean squared errors of the vehicle's motion
    between poses. There is one error for the motion computed from positions and one for the motion
    computed from velocities; the smaller error has more weight in the prediction of the next
    pose."""

    pose: MarkerPose
    vehicle_state: VehicleState | None
    bearing_prediction_errors: TargetBearingPredictionErrors = field(
        default_factory=TargetBearingPredictionErrors
    )


@dataclass(frozen=True, eq=False)
class TargetLockState:
    """The target that the pipeline is locked onto: its last track and pose, the number of frames
    with an accepted pose (`accepted_frame_count`), and whether any of these poses used both markers
    (`has_shown_both_markers`). The track is in the world frame of the state estimate if
    `is_in_world_frame` is True, otherwise relative to the gear in the level frame.
    `track_before_last_pose` is the track as it was before its last pose updated it; None after the
    first pose."""

    track: MarkerFilterState
    last_pose: MarkerPose
    is_in_world_frame: bool
    accepted_frame_count: int
    has_shown_both_markers: bool
    track_before_last_pose: MarkerFilterState | None = None


@dataclass(frozen=True, eq=False)
class RivalTargetState:
    """A track of a target-like pattern at a position that contradicts the track of the locked
    target. It may be another target, or the target itself if its track is wrong.

    Attributes:
        track: state of the rival's filter.
        is_in_world_frame: True if the track is in the world frame, False if in the level frame.
        first_seen_at_s: time of the first frame that showed the rival.
        seen_frame_count, frames_with_both_markers: number of frames that showed the rival, and
            number of frames that showed both of its markers.
        has_different_range_from_target: True if the rival's z, which is its range from a
            camera that looks straight up, differs significantly from the target's.
        position_relative_to_target_text: the rival's position relative to the target, in words.
    """

    track: MarkerFilterState
    is_in_world_frame: bool
    first_seen_at_s: float
    seen_frame_count: int
    frames_with_both_markers: int
    has_different_range_from_target: bool
    position_relative_to_target_text: str


@dataclass(frozen=True, eq=False)
class FrameMarkerPoses:
    """The poses estimated from one frame.

    Attributes:
        poses_by_source: all poses, with the keys ``joint``, ``large`` and ``small`` in this order.
        poses_by_updated_track: the poses that update a track, by the track's name: ``joint``, or
            ``large`` and ``small``.
        do_markers_contradict: True if both markers were detected, but the positions computed from
            each of them differ by more than their errors explain.
    """

    poses_by_source: dict[str, MarkerPose] = field(default_factory=dict)
    poses_by_updated_track: dict[str, MarkerPose] = field(default_factory=dict)
    do_markers_contradict: bool = False

    @property
    def most_certain_pose(self) -> MarkerPose | None:
        """The pose whose position has the smallest standard deviation (norm of `sigma_m`), from
        `poses_by_updated_track` if it is not empty, otherwise from `poses_by_source`; None if there
        are no poses."""
        poses = self.poses_by_updated_track or self.poses_by_source
        return min(poses.values(), key=lambda p: float(p.sigma_m @ p.sigma_m), default=None)


@dataclass(frozen=True, eq=False)
class InterlacingState:
    """What is known about the interlacing of an image stream.

    Attributes:
        picture_kind: kind of the last frame that was checked for interlacing artefacts (combing),
            None before the first one. Once a frame was interlaced, it stays ``woven``.
        frames_since_combing_check: number of frames since that check.
        top_field_first_vote_sum: sum of the votes on the order of the fields: positive if the top
            field seems to be first, negative if the bottom field does.
        is_top_field_first: order of the fields; None until the votes decide.
        recent_frame_periods_s: the most recent times between successive frames.
        last_frame_t_s: time of the last frame.
        previous_image: the previous image, to which the next one is compared to find the order of
            the fields; None if it was not interlaced.
    """

    picture_kind: PictureKind | None = None
    frames_since_combing_check: int = 0
    top_field_first_vote_sum: float = 0.0
    is_top_field_first: bool | None = None
    recent_frame_periods_s: tuple[float, ...] = ()
    last_frame_t_s: float | None = None
    previous_image: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class PipelineState:
    """The complete state of the pipeline between frames. `PipelineState()` is the initial state.

    Attributes:
        tracks: Kalman filters of the target, by name: ``joint``, or ``large`` and ``small``.
        are_tracks_in_world_frame: True if the tracks are in the world frame of the state estimate,
            False if in the level frame.
        marker_poses: poses estimated from the newest frame.
        target: estimate for the last frame in which there was a track; None before the first one.
        last_detections: detections of the last frame with an accepted marker; None if it is more
            than 1 s old.
        last_accepted_pose: the last accepted pose; None if there is no track.
        successive_frames_with_contradicting_markers: number of successive accepted frames with both
            markers in which the markers contradict each other.
        successive_frames_without_markers: number of successive frames without a marker.
        lock: the target that the pipeline is locked onto; None if there is none.
        rival: a similar pattern whose position contradicts the lock; None if there is none.
        interlacing_state: what is known about the interlacing of the images.
    """

    tracks: dict[str, MarkerFilterState] = field(default_factory=dict)
    are_tracks_in_world_frame: bool = False
    marker_poses: FrameMarkerPoses = FrameMarkerPoses()
    target: TargetEstimate | None = None
    last_detections: Detections | None = None
    last_accepted_pose: LastAcceptedPose | None = None
    successive_frames_with_contradicting_markers: int = 0
    successive_frames_without_markers: int = 0
    lock: TargetLockState | None = None
    rival: RivalTargetState | None = None
    interlacing_state: InterlacingState = InterlacingState()


@dataclass(frozen=True, eq=False)
class PipelineOutput:
    """Result of processing one frame, for the planner and the log.

    Attributes:
        detections: the markers that were detected.
        poses: the target's poses by source: ``joint``, ``large`` or ``small``.
        target: the target estimate for the time of the frame; None if there is no track.
        stage: which markers were detected in this frame.
        successive_frames_with_contradicting_markers: number of successive accepted frames with both
            markers in which the markers contradict each other.
        picture_kind: whether the image is a whole frame, interlaced (``woven``) or a field.
        target_lock_message: why this frame's pose was rejected, or accepted at an unexpected
            position, or that the frame shows several targets; otherwise empty.
        is_other_vehicles_target_seen: True if the pose was rejected because, judged by its
            position, it shows another vehicle's target.
    """

    detections: Detections
    poses: dict[str, MarkerPose]
    target: TargetEstimate | None
    stage: VisibleMarkers
    successive_frames_with_contradicting_markers: int = 0
    picture_kind: PictureKind = "whole"
    target_lock_message: str = ""
    is_other_vehicles_target_seen: bool = False


@dataclass(frozen=True)
class CameraCalibrationErrors:
    """Errors of the camera latency and mounting in the profile, estimated in flight, each with its
    standard deviation.

    `latency_above_profile_s` is the camera's latency minus the latency in the profile.
    `mount_rotation_from_profile_xyz_rad` are the small rotations of the mounting, about body x, y
    and z, relative to the mounting in the profile. `mount_rotation_sigma_xyz_rad` includes the bias
    of the attitude estimate, which shifts the target in the same way as a roll or pitch error of
    the mounting.
    """

    latency_above_profile_s: float
    latency_sigma_s: float
    mount_rotation_from_profile_xyz_rad: tuple[float, float, float]
    mount_rotation_sigma_xyz_rad: tuple[float, float, float]
