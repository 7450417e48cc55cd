"""The profile's keys of camera, target and pipeline."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.profile.base import Section, Vector3
from perchctl.profile.dictionaries import check_marker_id


class Mounting(Section):
    """Where the camera sits: its position in body axes and its turn from them.

    With ``rpy_deg: [0, 0, 0]`` the camera looks up, the image's right is the
    vehicle's forward and the image's bottom its left. `rpy_deg` are rotations
    about body x, y, z (``Rz Ry Rx``, right-handed): ``[0, 0, 90]`` turns the
    image's right to the vehicle's left.
    """

    position_m: Vector3 = (0.0, 0.0, 0.01)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)

    @property
    def T_body_cam(self) -> Array:
        roll, pitch, yaw = (float(a) for a in np.radians(self.rpy_deg))
        return make_T(rotation_from_rpy(roll, pitch, yaw), self.position_m)


class CameraConfig(Section):
    source: str = "sim:"
    calibration: str = "example_640x480.yaml"
    cam: str | None = None
    latency_s: float = Field(0.07, ge=0, le=1)
    mount: Mounting = Mounting()
    start_timeout_s: float = Field(8.0, gt=0, le=60)
    mirrored: bool = False  # flip the picture before use
    mask: str | None = None  # picture of what the vehicle's own gear covers
    fields: Literal["auto", "top", "bottom", "progressive"] = "auto"  # of interlaced pictures
    readout_s: float | None = Field(0.0, ge=0, le=0.05)  # of a rolling shutter; none: unknown


class VehicleConfig(Section):
    gear_body_m: Vector3 = (0.0, 0.0, 0.03)


class MarkerConfig(Section):
    dictionary: str
    id: int = Field(ge=0)
    side_m: float = Field(ge=0.004, le=2.0)

    @model_validator(mode="after")
    def _id_in_dictionary(self) -> MarkerConfig:
        check_marker_id(self.dictionary, self.id)
        return self


class TargetConfig(Section):
    """The printed target, and how true it is, standard deviations.

    `size_sigma`: by which share the printed sizes may all be off together. Printers err by some
    0.3 %, so it is 0.5 % until they are measured. `curl_per_m`: a place r from the centre of the
    sheet is off its plane by this times r^2; the corners of a 150 mm marker by 0.3 mm.
    """

    large: MarkerConfig = MarkerConfig(dictionary="DICT_4X4_1000", id=997, side_m=0.150)
    small: MarkerConfig = MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=5, side_m=0.025)
    size_sigma: float = Field(0.005, ge=0, le=0.1)
    curl_per_m: float = Field(0.03, ge=0, le=10)

    @model_validator(mode="after")
    def _small_inside_large(self) -> TargetConfig:
        if self.small.side_m >= self.large.side_m / 2:
            raise ValueError(
                f"the small marker ({self.small.side_m} m) must be less than half of the "
                f"large one ({self.large.side_m} m); sizes are in metres, as printed"
            )
        return self


class DetectorConfig(Section):
    refinement: Literal["none", "subpix", "line"] = "line"
    window: bool = True  # search around the last pose first
    blurred: bool = True  # look once more where blur may hide the target
    blurred_every: int = Field(4, ge=1, le=100)  # ... then every Nth of a stream without it
    cut: bool = True  # where the picture cuts both markers: by what is left of them
    correction_bits_large: int = Field(0, ge=0, le=3)
    correction_bits_small: int = Field(1, ge=0, le=3)


class PoseConfig(Section):
    solver: Literal["sqpnp", "iterative", "epnp", "ippe", "ippe_square"] = "sqpnp"
    refine: bool = True
    max_reprojection_px: float = Field(3.0, gt=0)
    each_marker: bool = False  # beside the joint pose also each marker's own, for the log


class KalmanConfig(Section):
    """The paper's filter, and what its noise is.

    `noise`: ``fixed`` takes k1 for every measurement and k2 for every step, as the paper does:
    variances in cm^2 and deg^2, as its error vector is in centimetres and degrees.
    ``measured`` takes the covariance of the very pose, and for the motion accelerations: in
    the level frame `acceleration_mps2` of the camera or target and `turn_radps2` of the
    camera's attitude and heading, in the world `drift_mps2` of the state estimate. A constant
    error of the vehicle's roll and pitch, `attitude_sigma_deg`, then widens what is claimed.

    `drift_mps`: a target stands still, so while it is not measured it moves in the world
    of the state estimate by that estimate's drift only, at most so fast.
    """

    k1: float = Field(0.04, gt=0)
    k2: float = Field(0.004, gt=0)
    alpha: float = Field(0.85, gt=0, le=1)
    n_max: int = Field(8, ge=0, le=100)
    frame: Literal["level", "world"] = "world"
    noise: Literal["fixed", "measured"] = "measured"
    acceleration_mps2: float = Field(3.0, gt=0, le=100)
    turn_radps2: float = Field(3.0, gt=0, le=1000)
    drift_mps2: float = Field(0.1, gt=0, le=100)
    attitude_sigma_deg: float = Field(0.3, ge=0, le=10)
    drift_mps: float = Field(0.05, ge=0, le=1)
    gate: bool = True  # a pose that contradicts the target's track is not taken


class WeightsConfig(Section):
    x: float = Field(0.275, ge=0, le=1)
    y: float = Field(0.306, ge=0, le=1)
    z: float = Field(0.728, ge=0, le=1)
    yaw: float = Field(0.469, ge=0, le=1)


class MergeConfig(Section):
    method: Literal["weights", "joint"] = "joint"
    weights: WeightsConfig = WeightsConfig()
    weights_file: str | None = None  # of `perchctl fit-weights`; replaces `weights`
    stages: Literal["seen", "range"] = "seen"  # range: by z2 and z3, equations 4, 6, 11
    z2_m: float = Field(0.25, gt=0)
    z3_m: float = Field(0.12, gt=0)
    disagreement_m: float = Field(0.03, gt=0)
    disagreement_frames: int = Field(15, ge=1)

    @model_validator(mode="after")
    def _ranges_in_order(self) -> MergeConfig:
        if not self.z3_m < self.z2_m:
            raise ValueError("z3_m < z2_m must hold (metres)")
        return self


class FittedData(BaseModel):
    """The data that weights were fitted to."""

    file: str = ""
    sha256: str = ""
    rows: int = 0
    positions: int = 0


class FittedWeights(BaseModel):
    """A weights file, as far as a flight needs it (`perchctl.weights.files` writes more)."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    date: str = ""
    method: str = ""
    weights: WeightsConfig
    data: FittedData = FittedData()

    @model_validator(mode="before")
    @classmethod
    def _all_axes(cls, values: dict[str, Any]) -> dict[str, Any]:
        given = values.get("weights")
        if isinstance(given, dict):
            missing = [axis for axis in WeightsConfig.model_fields if axis not in given]
            if missing:
                raise ValueError(f"weights.{missing[0]} is missing; needed are x, y, z and yaw")
        return values
