"""The profile's models: every key, its unit, its default and its bounds.

A profile is checked here and only here; `perchctl.profile.load` reads it from its file.
"""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.profile.dictionaries import check_marker_id

Vector3 = tuple[float, float, float]


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError(f"the lower bound {pair[0]} is above the upper bound {pair[1]}")
    return pair


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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
    latency_s: float = Field(0.07, ge=0, le=1)
    mount: Mounting = Mounting()
    start_timeout_s: float = Field(8.0, gt=0, le=60)
    mirrored: bool = False  # flip the picture before use


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
    large: MarkerConfig = MarkerConfig(dictionary="DICT_4X4_1000", id=997, side_m=0.150)
    small: MarkerConfig = MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=5, side_m=0.025)

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
    blurred_every: int = Field(4, ge=1, le=100)  # ... in every Nth frame of a stream without it
    correction_bits_large: int = Field(0, ge=0, le=3)
    correction_bits_small: int = Field(1, ge=0, le=3)


class PoseConfig(Section):
    solver: Literal["sqpnp", "iterative", "epnp", "ippe", "ippe_square"] = "sqpnp"
    refine: bool = True
    max_reprojection_px: float = Field(3.0, gt=0)


class KalmanConfig(Section):
    """The paper's filter. k1 and k2 are variances in cm^2 and deg^2, as the paper's
    error vector is in centimetres and degrees.

    `noise`: ``fixed`` takes k1 for every measurement, as the paper does; ``measured``
    the covariance of the very pose, plus what `attitude_sigma_deg` of error in the
    vehicle's roll and pitch does at the target's distance.
    """

    k1: float = Field(0.04, gt=0)
    k2: float = Field(0.004, gt=0)
    alpha: float = Field(0.85, gt=0, le=1)
    n_max: int = Field(8, ge=0, le=100)
    frame: Literal["level", "world"] = "world"
    noise: Literal["fixed", "measured"] = "fixed"
    attitude_sigma_deg: float = Field(0.5, ge=0, le=10)


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
    z1_m: float = Field(1.15, gt=0)
    z2_m: float = Field(0.25, gt=0)
    z3_m: float = Field(0.12, gt=0)
    disagreement_m: float = Field(0.03, gt=0)
    disagreement_frames: int = Field(15, ge=1)

    @model_validator(mode="after")
    def _ranges_in_order(self) -> MergeConfig:
        if not self.z3_m < self.z2_m < self.z1_m:
            raise ValueError("z3_m < z2_m < z1_m must hold (metres)")
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


class SearchConfig(Section):
    """Phase 2. Waits `wait_s`, climbs `step_m`, tries again; never above `max_height_m`."""

    attempts: int = Field(6, ge=1, le=100)
    wait_s: float = Field(1.5, gt=0, le=60)
    step_m: float = Field(0.12, ge=0, le=1)
    max_height_m: float = Field(1.3, gt=0, le=20)
    yaw_step_deg: float = Field(60.0, ge=0, le=180)  # the picture is wider than high
    confirm_frames: int = Field(3, ge=1, le=100)


class EstimateConfig(Section):
    """Phase 3. The pose must stay within `spread_m` for `dwell_s`."""

    dwell_s: float = Field(0.4, ge=0, le=10)
    spread_m: float = Field(0.05, gt=0, le=1)
    timeout_s: float = Field(4.0, gt=0, le=60)


class AlignConfig(Section):
    """Phase 4. Errors must stay within tolerance for `dwell_s`."""

    xy_m: float = Field(0.04, gt=0, le=1)
    yaw_deg: float = Field(5.0, gt=0, le=180)
    dwell_s: float = Field(0.4, ge=0, le=10)
    timeout_s: float = Field(20.0, gt=0, le=120)
    speed_mps: float = Field(0.4, gt=0, le=2)
    yaw_rate_dps: float = Field(60.0, gt=0, le=360)


class AscendConfig(Section):
    """Phase 5. Climbs to `standoff_m` under the target and settles there.

    Falls back to ALIGN outside the cone `cone_base_m + cone_slope * distance`.
    `standoff_m` is between gear and target; the small marker must be in view there.
    Settled is a gear within `settle_xy_m` of the axis, not more than `settle_z_m` below
    the stand-off.
    """

    speed_mps: float = Field(0.25, gt=0, le=1)
    near_speed_mps: float = Field(0.12, gt=0, le=1)
    near_m: float = Field(0.35, gt=0, le=2)
    cone_base_m: float = Field(0.05, gt=0, le=1)
    cone_slope: float = Field(0.2, ge=0, le=2)
    standoff_m: float = Field(0.08, gt=0.01, le=0.5)
    settle_xy_m: float = Field(0.004, gt=0, le=0.1)
    settle_z_m: float = Field(0.02, gt=0, le=0.1)
    settle_yaw_deg: float = Field(3.0, gt=0, le=90)
    settle_speed_mps: float = Field(0.04, gt=0, le=1)
    settle_dwell_s: float = Field(0.3, ge=0, le=10)
    settle_timeout_s: float = Field(10.0, gt=0, le=60)
    fresh_s: float = Field(0.25, gt=0, le=2)
    timeout_s: float = Field(40.0, gt=0, le=300)


class PerchConfig(Section):
    """Phase 6. `position` presses with a setpoint `press_m` above the contact;
    `raw` raises the thrust with stabilised position control off, as the paper does."""

    mode: Literal["position", "raw"] = "position"
    thrust: int = Field(60000, ge=1000, le=65535)
    press_m: float = Field(0.25, gt=0, le=1)
    climb_mps: float = Field(0.2, gt=0, le=1)
    contact_dwell_s: float = Field(0.25, gt=0, le=5)
    contact_z_m: float = Field(0.05, gt=0, le=0.3)
    contact_speed_mps: float = Field(0.06, gt=0, le=1)
    contact_acc_g: float = Field(0.12, gt=0, le=1)
    contact_thrust_ratio: float = Field(1.03, gt=1, le=2)
    timeout_s: float = Field(3.0, gt=0, le=20)


class CompleteConfig(Section):
    """Phase 7. Thrust is released in `steps` over `release_s`; the magnet must hold
    with the thrust below `hold_ratio` of the hover thrust before the motors stop."""

    steps: int = Field(5, ge=1, le=50)
    release_s: float = Field(0.8, gt=0, le=10)
    release_drop_m: float = Field(0.25, gt=0, le=1)
    hold_ratio: float = Field(0.6, gt=0, lt=1)
    hold_dwell_s: float = Field(0.3, ge=0, le=5)
    release_timeout_s: float = Field(4.0, gt=0, le=30)
    slip_m: float = Field(0.03, gt=0, le=0.3)
    slip_acc_g: float = Field(0.5, gt=0, lt=1)
    watch_s: float = Field(2.5, gt=0, le=60)


class RecoverConfig(Section):
    """After a miss or a slip: descend, steady, back to phase 3."""

    descend_m: float = Field(0.10, gt=0, le=1)
    speed_mps: float = Field(0.4, gt=0, le=1)
    dwell_s: float = Field(0.5, ge=0, le=10)
    steady_mps: float = Field(0.1, gt=0, le=1)
    timeout_s: float = Field(6.0, gt=0, le=60)


class LandingConfig(Section):
    """`undershoot_m` below the ground of the estimate, so that a drifted height still
    ends on the floor."""

    speed_mps: float = Field(0.35, gt=0, le=1)
    undershoot_m: float = Field(0.05, ge=0, le=1)
    timeout_s: float = Field(20.0, gt=0, le=120)


class PlannerConfig(Section):
    takeoff_height_m: float = Field(0.5, ge=0.2, le=5)
    takeoff_duration_s: float = Field(2.5, gt=0.5, le=20)
    approach_xy_m: tuple[float, float] | None = None  # fly here after take-off
    approach_timeout_s: float = Field(15.0, gt=0, le=120)
    search: SearchConfig = SearchConfig()
    estimate: EstimateConfig = EstimateConfig()
    align: AlignConfig = AlignConfig()
    ascend: AscendConfig = AscendConfig()
    perch: PerchConfig = PerchConfig()
    complete: CompleteConfig = CompleteConfig()
    recover: RecoverConfig = RecoverConfig()
    landing: LandingConfig = LandingConfig()
    attempts: int = Field(5, ge=1, le=50)
    perching_time_s: float = Field(120.0, gt=0, le=1200)
    integral_per_s: float = Field(0.4, ge=0, le=5)  # integral of the position error
    integral_limit_m: float = Field(0.08, ge=0, le=0.5)


class SafetyConfig(Section):
    """Limits and reaction times; `*_hold_s` stays where it is, `*_land_s` lands."""

    min_rest_v: float = Field(3.6, ge=0, le=5)
    min_load_v: float = Field(3.0, ge=0, le=5)
    battery_debounce_s: float = Field(1.5, ge=0, le=30)
    battery_stale_s: float = Field(90.0, gt=0, le=600)  # grace for a reading that stands still
    telemetry_hold_s: float = Field(0.3, gt=0, le=5)
    telemetry_land_s: float = Field(1.0, gt=0, le=10)
    camera_hold_s: float = Field(0.5, gt=0, le=10)
    camera_land_s: float = Field(3.0, gt=0, le=60)
    max_frame_age_s: float = Field(0.4, gt=0, le=5)
    jump_m: float = Field(0.25, gt=0, le=5)
    jump_hold_s: float = Field(0.5, ge=0, le=0.5)
    max_height_m: float = Field(3.0, gt=0, le=20)
    fence_radius_m: float = Field(2.0, gt=0, le=50)
    max_tilt_deg: float = Field(55.0, gt=0, le=180)
    tilt_debounce_s: float = Field(0.2, ge=0, le=2)
    loop_late_hold_s: float = Field(0.25, gt=0, le=5)
    loop_late_land_s: float = Field(1.0, gt=0, le=10)
    estimator_wait_s: float = Field(10.0, gt=0, le=60)
    estimator_variance_m2: float = Field(0.01, gt=0, le=10)
    land_on_log_error: bool = False


class LinkConfig(Section):
    uri: str = "sim://"
    connect_timeout_s: float = Field(15.0, gt=0, le=120)
    parameters: dict[str, int | float] = Field(default_factory=dict)
    telemetry_period_s: float = Field(0.01, ge=0.01, le=0.1)
    loop_hz: float = Field(50.0, ge=5, le=200)


class SimulationConfig(Section):
    """Ranges from which a seed draws one flight's conditions (`perchctl.sim.draw`)."""

    start_offset_m: float = Field(0.5, ge=0, le=5)
    target_yaw_deg: Range = (-180.0, 180.0)
    ceiling_z_m: Range = (1.8, 2.6)
    mass_kg: Range = (0.038, 0.042)
    battery_rest_v: Range = (3.7, 4.2)
    camera_latency_s: Range = (0.03, 0.12)
    camera_jitter_s: float = Field(0.008, ge=0, le=0.2)
    camera_rate_hz: float = Field(30.0, gt=0, le=200)
    camera_drop_rate: float = Field(0.1, ge=0, lt=1)
    camera_burst_frames: tuple[int, int] | None = (8, 20)
    camera_noise_sigma: Range = (4.0, 8.0)
    camera_exposure_s: float = Field(0.008, ge=0, le=0.05)
    camera_defocus_px: float = Field(0.6, ge=0, le=10)
    mount_error_deg: float = Field(1.0, ge=0, le=20)
    mount_error_m: float = Field(0.001, ge=0, le=0.05)
    estimate_noise_m: float = Field(0.002, ge=0, le=0.2)
    estimate_tilt_bias_deg: float = Field(0.3, ge=0, le=10)
    drift_mps: float = Field(0.01, ge=0, le=0.2)
    draught_mps: Range = (0.0, 0.3)
    magnet_force_n: float = Field(1.2, ge=0, le=20)
    first_contact_fails: float = Field(0.1, ge=0, le=1)
    no_target: bool = False


class LogConfig(Section):
    directory: str = "perchctl-logs"
    plot: bool = True


class Profile(Section):
    """One flight's resolved configuration."""

    name: str = "unnamed"
    description: str = ""
    date: datetime.date | None = None  # of the measurements in it; printed on the target
    camera: CameraConfig = CameraConfig()
    vehicle: VehicleConfig = VehicleConfig()
    target: TargetConfig = TargetConfig()
    detector: DetectorConfig = DetectorConfig()
    pose: PoseConfig = PoseConfig()
    kalman: KalmanConfig = KalmanConfig()
    merge: MergeConfig = MergeConfig()
    planner: PlannerConfig = PlannerConfig()
    safety: SafetyConfig = SafetyConfig()
    link: LinkConfig = LinkConfig()
    simulation: SimulationConfig = SimulationConfig()
    log: LogConfig = LogConfig()

    @model_validator(mode="after")
    def _heights_fit(self) -> Profile:
        if self.planner.search.max_height_m > self.safety.max_height_m:
            raise ValueError(
                f"planner.search.max_height_m ({self.planner.search.max_height_m}) must not "
                f"exceed safety.max_height_m ({self.safety.max_height_m})"
            )
        if self.planner.takeoff_height_m > self.planner.search.max_height_m:
            raise ValueError(
                f"planner.takeoff_height_m ({self.planner.takeoff_height_m}) must not exceed "
                f"planner.search.max_height_m ({self.planner.search.max_height_m})"
            )
        return self
