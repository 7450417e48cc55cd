"""The profile as a whole: every key, its unit, its default and its bounds.

A profile is checked here and only here; `perchctl.profile.load` reads it from its file.
`perchctl.profile.vision`, `perchctl.profile.mission` and `perchctl.profile.simulation` hold the
larger sections.
"""

from __future__ import annotations

import datetime
from typing import Any

from pydantic import Field, model_validator

from perchctl.profile.base import Section, key, split_constant_keys
from perchctl.profile.limits import IMPOSSIBLE
from perchctl.profile.mission import PlannerConfig, SafetyConfig
from perchctl.profile.positioning import PositioningConfig
from perchctl.profile.simulation import SimulationConfig
from perchctl.profile.vision import (
    CameraConfig,
    DetectorConfig,
    KalmanConfig,
    MergeConfig,
    PoseConfig,
    TargetConfig,
    VehicleConfig,
    check_marker_id,
)


class LinkConfig(Section):
    """The profile's `link`: URI, telemetry and firmware parameters."""

    uri: str = key("sim://", "`sim://`, `radio://...`, `usb://0`, `udp://HOST:PORT`")
    connect_timeout_s: float = key(15.0, "time limit for both tries to connect", gt=0, le=120)
    parameters: dict[str, int | float] = Field(
        default_factory=dict, description="firmware parameters, set and read back before the flight"
    )
    telemetry_period_s: float = key(0.01, "period of position and attitude", ge=0.01, le=0.1)
    loop_hz: float = key(50.0, "rate of the flight loop", ge=5, le=200)


class LogConfig(Section):
    directory: str = key("perchctl-logs", "folder of the log and its plot")
    plot: bool = key(True, "draw a plot after the flight")
    max_mb: float = key(
        2000.0,
        "size before compression at which a recording ends",
        gt=0,
        le=1e6,
    )


class Profile(Section):
    """One flight's resolved configuration."""

    name: str = key("unnamed", "the profile's name; by default its file's")
    description: str = key("", "one sentence for people")
    date: datetime.date | None = key(None, "date of its measurements; printed on the target")
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
    positioning: PositioningConfig = PositioningConfig()
    simulation: SimulationConfig = SimulationConfig()
    log: LogConfig = LogConfig()

    @classmethod
    def constant_key_errors(cls, values: dict[str, Any]) -> list[str]:
        """An error sentence for each value that differs from the constant its key has become."""
        return split_constant_keys(values, cls)[2]

    @model_validator(mode="after")
    def _neighbours_can_be_printed(self) -> Profile:
        ids = self.simulation.neighbour_ids
        for name, marker, number in zip(
            ("large", "small"), (self.target.large, self.target.small), ids or (), strict=False
        ):
            try:
                check_marker_id(marker.dictionary, number)
            except ValueError as error:
                raise ValueError(f"simulation.neighbour_ids, {name}: {error}") from None
        return self

    @model_validator(mode="after")
    def _limits_fit(self) -> Profile:
        for limit in IMPOSSIBLE:
            if not limit.holds(self):
                raise ValueError(limit.violation_text(self))
        return self
