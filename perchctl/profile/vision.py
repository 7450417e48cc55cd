"""The profile's keys for camera, target and pipeline."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from perchctl.extensions import PATTERN
from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.plain_yaml import value_text
from perchctl.profile.base import BodyVector3, Section, Vector3, key

# --- ArUco dictionaries by name, and the number of their ids ---


@cache
def dictionary_names() -> tuple[str, ...]:
    """All predefined dictionaries of the installed OpenCV, sorted."""
    return tuple(sorted(n for n in dir(cv2.aruco) if re.fullmatch(r"DICT_[A-Z0-9_]+", n)))


@cache
def aruco_dictionary(name: str) -> Any:
    """The cv2.aruco dictionary with this name. Raises ValueError, which lists the choices, if there
    is none."""
    if name not in dictionary_names():
        raise ValueError(
            f"dictionary {name!r} is unknown; allowed are {', '.join(dictionary_names())}"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def dictionary_size(name: str) -> int:
    """Return the number of ids in the dictionary (0 .. count - 1)."""
    return int(aruco_dictionary(name).bytesList.shape[0])


def check_marker_id(dictionary: str, marker_id: int) -> None:
    """Raise ValueError if the id is not in the dictionary."""
    count = dictionary_size(dictionary)
    if marker_id >= count:
        raise ValueError(f"id {marker_id} is not in {dictionary}, which has ids 0 to {count - 1}")


# --- The keys ---


class Mounting(Section):
    """The camera's mounting: its position in body axes and its rotation from them.

    With ``rpy_deg: [0, 0, 0]`` the camera looks up, the right of the image is the vehicle's front,
    and the bottom of the image is the vehicle's left. `rpy_deg` are rotations about body x, y, z
    (``Rz Ry Rx``, right-handed): ``[0, 0, 90]`` turns the right of the image to the vehicle's left.
    """

    position_m: BodyVector3 = key(
        (0.0, 0.0, 0.01), "position of the camera in body axes: forward, left, up"
    )
    rpy_deg: Vector3 = key(
        (0.0, 0.0, 0.0),
        "rotation of the camera; at 0 0 0, the right side of the image faces forward and "
        "its bottom faces left",
    )

    @field_validator("rpy_deg")
    @classmethod
    def _in_degrees(cls, rpy_deg: Vector3) -> Vector3:
        """Reject angles that are probably in radians: in radians, all of them would be multiples of
        45 deg."""
        turned = [(angle, _eighths(abs(angle))) for angle in rpy_deg if angle]
        if turned and all(eighths for _, eighths in turned):
            angle, eighths = turned[0]
            raise ValueError(
                f"found {angle:g}, which is {45 * eighths} degrees in radians; angles are in "
                f"degrees here: write {math.copysign(45 * eighths, angle):g}"
            )
        return rpy_deg

    @property
    def T_body_cam(self) -> Array:
        roll, pitch, yaw = (float(a) for a in np.radians(self.rpy_deg))
        return make_T(rotation_from_rpy(roll, pitch, yaw), self.position_m)


def _eighths(angle: float) -> int:
    """If the angle, read as radians, is 1 to 8 eighths of a turn, rounded to two or more decimals,
    return the number of eighths; otherwise 0."""
    return next(
        (k for k in range(1, 9) for d in range(2, 17) if angle == round(k * math.pi / 4, d)), 0
    )


MOST_CAMERA_LATENCY_S = 1.0
USUAL_LATENCY_S = 0.07
"""Default latency, s: most cameras are 60 to 100 ms late."""
START_LATENCY_S = 0.1
"""Latency at the start of a flight that measures it, s. This is close to the middle of the usable
range, so until the latency has been measured, images are at most 0.1 s newer or older than
assumed."""
USED_LATENCY_S = (0.02, 0.2)
"""Range of latencies that a flight may use if it measures its latency, s. No camera is faster, and
later images are useless for control."""


class CameraConfig(Section):
    """The profile's `camera`: source, calibration, latency, mounting."""

    source: str = key(
        "sim:",
        "camera source: `camera:N`, `camera:NAME`, `rtsp://...`, `http://...`, `aideck://HOST`, "
        "`video:FILE`, `images:DIR`, `sim:` or `my_module:MyCamera`",
    )
    calibration: str = key(
        "example_640x480.yaml",
        "calibration file: a file next to the profile or in `calib/`, or a full path",
    )
    cam: ClassVar[None] = None  # which camera of a Kalibr file with several cameras
    latency_s: Annotated[float, Field(ge=0, le=MOST_CAMERA_LATENCY_S)] | Literal["measured"] = key(
        USUAL_LATENCY_S, "time from exposure to arrival; with `measured`, each flight measures it"
    )
    mount: Mounting = Mounting()
    start_timeout_s: float = key(8.0, "time limit for the first good image", gt=0, le=60)
    mirrored: bool = key(False, "flip each image before use")
    mask: str | None = key(None, "mask file, white where the vehicle covers the view")
    fields: ClassVar[str] = "auto"  # interlaced images: measure which field comes first
    readout_s: float | None = key(
        0.0, "rolling shutter: time from the first to the last row; none if unknown", ge=0, le=0.05
    )

    format: str | None = key(
        None,
        "pixel format to request from `camera:` sources, such as `MJPG`; none: the driver's choice",
        pattern="^[A-Z0-9]{3,4}$",
    )
    rate_hz: float | None = key(
        None,
        "frame rate to request from `camera:` sources; none: the driver's choice",
        gt=0,
        le=500,
    )

    @field_validator("latency_s", mode="before")
    @classmethod
    def _a_time_or_measured(cls, latency_s: Any) -> Any:
        """Reject any value other than a time or ``measured``, in one sentence."""
        number = isinstance(latency_s, (int, float)) and not isinstance(latency_s, bool)
        if latency_s == "measured" or (number and 0.0 <= latency_s <= MOST_CAMERA_LATENCY_S):
            return latency_s
        raise ValueError(
            f"found {value_text(latency_s)}; allowed are 0 to {MOST_CAMERA_LATENCY_S:g} (seconds), "
            "or the word measured, to have each flight measure the latency"
        )

    @property
    def start_latency_s(self) -> float:
        """The assumed camera latency until the flight has measured it."""
        return START_LATENCY_S if isinstance(self.latency_s, str) else self.latency_s


class VehicleConfig(Section):
    gear_body_m: BodyVector3 = key(
        (0.0, 0.0, 0.03), "position of the magnet gear's tip in body axes: forward, left, up"
    )
    battery_mah: float = key(250.0, "capacity printed on the battery", ge=50, le=5000)


class MarkerConfig(Section):
    """One marker of the profile's `target`: dictionary, id and side."""

    dictionary: str = key(..., "OpenCV dictionary of the marker")
    id: int = key(..., "id of the marker in its dictionary", ge=0)
    side_m: float = key(
        ...,
        "side of the printed black square; the small marker's side must be less than half "
        "of the large marker's",
        ge=0.004,
        le=2.0,
    )

    @model_validator(mode="after")
    def _id_in_dictionary(self) -> MarkerConfig:
        check_marker_id(self.dictionary, self.id)
        return self

    @property
    def bits(self) -> NDArray[np.uint8]:
        """The cells inside the black border (n, n), 1 = white, row 0 at the top of the print."""
        source = aruco_dictionary(self.dictionary)
        rows = np.ascontiguousarray(source.bytesList[self.id : self.id + 1])
        return np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(rows, source.markerSize))

    def has_same_pattern(self, other: MarkerConfig) -> bool:
        """True if both markers have the same cells in some rotation. The first ids of
        ``DICT_4X4_1000``, for example, are those of ``DICT_4X4_50``."""
        return any(np.array_equal(np.rot90(self.bits, turn), other.bits) for turn in range(4))


_MIN_RING_TO_LARGE_SIDE_RATIO = 1 / 150
"""Smallest width of the white ring around the small marker, relative to the large marker's side: 1
mm on a 150 mm marker. Without a ring, the small marker is never found (measured for ids whose
centre is black)."""
_UNSAMPLED_CELL_MARGIN = 0.13
"""Margin along each side of a cell that cv2.aruco does not sample, as a fraction of the cell."""
_MAX_WHITE_IN_BLACK_CELL = 0.3
"""Largest share of white that the small marker and its ring may add to the sampled part of a black
cell of the large one."""


FARTHEST_IN_A_ROOM_M = 50.0
"""Largest distance of a target from the origin of a room's positioning, in x or in y, m."""
_InARoom = Annotated[float, Field(ge=-FARTHEST_IN_A_ROOM_M, le=FARTHEST_IN_A_ROOM_M)]


class TargetConfig(Section):
    """The printed target, and standard deviations of the print.

    `size_sigma`: common relative error of all printed sizes; printers err by about 0.3 %, so it is
    0.5 % until the printed sizes are measured. `curl_per_m`: a point at distance r from the sheet's
    centre is out of the sheet's plane by `curl_per_m` times r^2; for the corners of a 150 mm
    marker, this is 0.3 mm.
    """

    large: MarkerConfig = MarkerConfig(dictionary="DICT_4X4_1000", id=997, side_m=0.150)
    small: MarkerConfig = MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=5, side_m=0.025)
    size_sigma: float = key(
        0.005,
        "relative error common to all printed sizes, one sigma; smaller once you measure them",
        ge=0,
        le=0.1,
    )
    curl_per_m: float = key(
        0.03,
        "curl of the sheet: maximum deviation from its plane at distance r from its "
        "centre, divided by r^2",
        ge=0,
        le=10,
    )

    expected_xy_m: tuple[_InARoom, _InARoom] | None = key(
        None,
        "expected position of the target, in the world frame of the state estimate; if there are "
        "several targets, the nearest one is used",
    )
    expected_within_m: float = key(
        0.3,
        "maximum distance of the target from `expected_xy_m`; a target farther away is "
        "treated as another vehicle's",
        gt=0,
        le=20,
    )

    @model_validator(mode="after")
    def _within_of_a_place(self) -> TargetConfig:
        given = self.model_fields_set
        if "expected_within_m" in given and "expected_xy_m" not in given:
            raise ValueError(
                "expected_within_m is set, but expected_xy_m is not: set expected_xy_m too, or "
                "remove expected_within_m"
            )
        return self

    @model_validator(mode="after")
    def _markers_differ(self) -> TargetConfig:
        large, small = self.large, self.small
        if large.has_same_pattern(small):
            both = dict.fromkeys(f"{m.dictionary}/{m.id}" for m in (large, small))
            raise ValueError(
                f"large and small are the same marker, {' and '.join(both)}, and cannot be "
                "distinguished: give one of them another id"
            )
        return self

    @model_validator(mode="after")
    def _small_inside_large(self) -> TargetConfig:
        if self.small.side_m >= self.large.side_m / 2:
            raise ValueError(
                f"the small marker ({self.small.side_m} m) must be less than half of the "
                f"large one ({self.large.side_m} m); sizes are in metres, as printed"
            )
        return self

    @property
    def ring_m(self) -> float:
        """Width of the white ring that is printed around the small marker and cut into the large
        one: one cell of the small marker, or as wide as the large marker's black cells under it
        allow."""
        large, small = (np.pad(marker.bits, 1) == 0 for marker in (self.large, self.small))
        n, half_m = len(large), self.large.side_m / 2.0
        # The sampled part of each row of cells of the large marker.
        middle_m = half_m * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
        reach_m = half_m * (1.0 - 2.0 * _UNSAMPLED_CELL_MARGIN) / n

        def coverage(edges_m: Array) -> Array:
            ends = np.clip(edges_m, (middle_m - reach_m)[:, None], (middle_m + reach_m)[:, None])
            return np.diff(ends, axis=1) / (2.0 * reach_m)

        cells = coverage(self.small.side_m * (np.arange(len(small) + 1) / len(small) - 0.5))
        black = cells @ small @ cells.T
        least_m = _MIN_RING_TO_LARGE_SIDE_RATIO * self.large.side_m
        widest_m = max(self.small.side_m / len(small), least_m)
        for ring_m in np.linspace(widest_m, least_m, 16):
            hole = coverage((self.small.side_m / 2.0 + ring_m) * np.array([-1.0, 1.0]))
            if float((hole @ hole.T - black)[large].max()) <= _MAX_WHITE_IN_BLACK_CELL:
                break
        return float(ring_m)


class DetectorConfig(Section):
    """The profile's `detector`: how markers are found and measured."""

    refinement: Literal["subpix", "line"] = key(
        "line",
        "find corners from edge lines (even blurred or cut ones), or with OpenCV's subpixel method",
    )
    own: str | None = key(None, "your own detector, as `my_module:corners`", pattern=PATTERN)
    blurred: ClassVar[bool] = True  # with `lines` only: also search where blur may hide the target
    # number of images without the target in a stream before that search
    blurred_every: ClassVar[int] = 4
    # with `lines` only: also measure if the image's edge cuts both markers
    cut: ClassVar[bool] = True
    correction_bits_large: ClassVar[int] = 0  # number of wrong cells that are corrected
    correction_bits_small: ClassVar[int] = 1


class PoseConfig(Section):
    """The profile's `pose`: how a pose is computed from corners."""

    solver: ClassVar[str] = "sqpnp"  # OpenCV's method for the first guess
    refine: ClassVar[bool] = True  # refine the pose by least squares on the corners
    max_reprojection_px: float = key(
        3.0, "RMS reprojection error above which a pose is rejected", gt=0
    )
    # next to the joint pose, also compute each marker's own pose
    each_marker: ClassVar[bool] = False


class KalmanConfig(Section):
    """The paper's filter, and its noise.

    `noise`: ``fixed`` uses the variances k1 for every measurement and k2 for every step, as the
    paper does; they are in cm^2 and deg^2, because the paper's error vector is in centimetres and
    degrees. ``measured`` uses each pose's own covariance, and accelerations as process noise: in
    the level frame, `acceleration_mps2` of the camera or target and `turn_radps2` of the camera's
    attitude and heading; in the world frame, `drift_mps2` of the state estimate. A constant error
    of the vehicle's roll and pitch, `attitude_sigma_deg`, then widens the estimate's spread.

    `drift_mps`: largest drift of the state estimate. The target is stationary, so while it is not
    measured, its position in the world of the state estimate changes only by this drift.
    """

    k1: float = key(0.04, "measurement noise with `noise: fixed`; the paper's R = k1 I", gt=0)
    k2: float = key(
        0.004, "process noise per frame with `noise: fixed`; the paper's Q = k2 I", gt=0
    )
    alpha: float = key(
        0.85, "factor by which the velocities of a coasting track decay per frame", gt=0, le=1
    )
    n_max: int = key(8, "maximum number of frames for which a track coasts", ge=0, le=100)
    frame: Literal["level", "world"] = key(
        "world", "coordinate frame in which tracks are filtered; the paper uses `level`"
    )
    noise: Literal["fixed", "measured"] = key(
        "measured",
        "`fixed` uses k1 and k2; `measured` uses the covariance of each pose, and accelerations as "
        "process noise",
    )
    acceleration_mps2: ClassVar[float] = 3.0
    """Acceleration of camera or target in the level frame, with `noise: measured`."""
    turn_radps2: ClassVar[float] = 3.0
    """Rotational acceleration of the camera's attitude and heading, with `noise: measured`."""
    drift_mps2: float = key(
        0.1,
        "drift of the state estimate as process noise, with `frame: world` and `noise: measured`",
        gt=0,
        le=100,
    )
    attitude_sigma_deg: float = key(
        0.3, "constant error in roll and pitch, one sigma, with `noise: measured`", ge=0, le=10
    )
    drift_mps: ClassVar[float] = 0.05
    """Largest speed at which an unmeasured target moves in the estimate's world, m/s."""
    gate: bool = key(True, "reject poses that contradict the target's track")


class WeightsConfig(Section):
    """The paper's weights: the large marker's share in each axis and in yaw."""

    x: float = key(
        0.275, "weight of the large marker in x; the small one has the remaining weight", ge=0, le=1
    )
    y: float = key(0.306, "weight of the large marker in y", ge=0, le=1)
    z: float = key(0.728, "weight of the large marker in z", ge=0, le=1)
    yaw: float = key(0.469, "weight of the large marker in yaw", ge=0, le=1)


class MergeConfig(Section):
    """The profile's `merge`: how the two markers become one estimate."""

    method: Literal["weights", "joint"] = key(
        "joint", "merge the markers with the paper's weights, or compute one pose from both"
    )
    weights: WeightsConfig = WeightsConfig()
    weights_file: str | None = key(
        None, "weights file from `perchctl fit-weights`; replaces `weights`"
    )
    stages: Literal["seen", "range"] = key(
        "seen",
        "merge all markers in view, or choose by distance (equations 4, 6 and 11 of the paper)",
    )
    z2_m: float = key(0.25, "maximum distance at which the small marker is readable", gt=0)
    z3_m: float = key(0.12, "minimum distance at which the whole large marker is in view", gt=0)
    disagreement_m: ClassVar[float] = 0.03
    """Difference above which the two markers contradict each other."""
    # number of successive contradictions after which the vehicle lands
    disagreement_frames: ClassVar[int] = 15

    @model_validator(mode="after")
    def _ranges_in_order(self) -> MergeConfig:
        if not self.z3_m < self.z2_m:
            raise ValueError("z3_m must be less than z2_m (both in metres)")
        return self
