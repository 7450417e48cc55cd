"""The profile as a whole: every key, its unit, its default and its bounds.

A profile is checked here and only here; `perchctl.profile.load` reads it from its file.
`perchctl.profile.vision` and `perchctl.profile.mission` hold the larger sections.
"""

from __future__ import annotations

import datetime
from typing import Any, Literal

from pydantic import Field, model_validator

from perchctl.profile.base import Range, Section
from perchctl.profile.mission import PlannerConfig, SafetyConfig
from perchctl.profile.old_keys import with_present_keys
from perchctl.profile.vision import (
    CameraConfig,
    DetectorConfig,
    KalmanConfig,
    MergeConfig,
    PoseConfig,
    TargetConfig,
    VehicleConfig,
)


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
    battery_rest_v: Range = (3.85, 4.2)
    camera_latency_s: Range = (0.03, 0.12)
    camera_jitter_s: float = Field(0.008, ge=0, le=0.2)
    camera_rate_hz: float = Field(30.0, gt=0, le=200)
    camera_drop_rate: float = Field(0.1, ge=0, lt=1)
    camera_burst_frames: tuple[int, int] | None = (8, 20)
    camera_noise_sigma: Range = (4.0, 8.0)
    camera_exposure_s: float = Field(0.008, ge=0, le=0.05)
    camera_defocus_px: float = Field(0.6, ge=0, le=10)
    camera_fields: Literal["progressive", "top", "bottom"] = "progressive"
    camera_blended: bool = False
    camera_readout_s: float = Field(0.0, ge=0, le=0.05)
    camera_flicker: float = Field(0.0, ge=0, le=1)
    camera_pumping: float = Field(0.0, ge=0, le=0.9)
    camera_analogue: float = Field(0.0, ge=0, le=1)
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

    @model_validator(mode="before")
    @classmethod
    def _present_keys(cls, values: Any) -> Any:
        """Logs of earlier versions hold profiles with old keys."""
        return with_present_keys(values)[0] if isinstance(values, dict) else values

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
