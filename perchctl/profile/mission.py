"""The profile's keys of the mission: its seven phases, the two ways down, and safety."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from perchctl.profile.base import Section


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
    """Phase 7. The thrust is released in two stages, before the motors stop.

    By position setpoints in `steps` over `release_s`, as far as the onboard controller
    goes: the magnet must hold for `hold_dwell_s` with the thrust below `hold_ratio` of the
    hover thrust. Then by raw thrust over `ramp_s` down to where the motors stand still with
    the stream alive: the whole weight must hang for `hang_s`. `watch_s` after the stop.
    """

    steps: int = Field(5, ge=1, le=50)
    release_s: float = Field(0.8, gt=0, le=10)
    release_drop_m: float = Field(0.25, gt=0, le=1)
    hold_ratio: float = Field(0.6, gt=0, lt=1)
    hold_dwell_s: float = Field(0.3, ge=0, le=5)
    ramp_s: float = Field(0.5, gt=0, le=10)
    hang_s: float = Field(1.0, ge=0.3, le=10)
    release_timeout_s: float = Field(8.0, gt=0, le=30)
    slip_m: float = Field(0.03, gt=0, le=0.3)
    slip_mps: float = Field(0.12, gt=0, le=1)
    slip_dwell_s: float = Field(0.03, ge=0, le=0.5)
    slip_acc_g: float = Field(0.5, gt=0, lt=1)
    watch_s: float = Field(1.5, gt=0, le=60)


class RecoverConfig(Section):
    """After a miss or a slip: descend, steady, back to phase 3."""

    descend_m: float = Field(0.10, gt=0, le=1)
    dwell_s: float = Field(0.5, ge=0, le=10)
    steady_mps: float = Field(0.1, gt=0, le=1)
    timeout_s: float = Field(6.0, gt=0, le=60)


class LandingConfig(Section):
    """Down by position setpoints at `speed_mps` to `handover_m`, the rest by the vehicle's
    own landing, which goes to `undershoot_m` below the ground of the estimate, and by
    `drift_mps` of the flight's time lower, so that a drifted height still ends on the floor."""

    speed_mps: float = Field(0.3, gt=0, le=1)
    handover_m: float = Field(0.3, ge=0.1, le=2)
    undershoot_m: float = Field(0.05, ge=0, le=1)
    drift_mps: float = Field(0.012, ge=0, le=0.1)  # of the estimate's height: lower by that
    timeout_s: float = Field(30.0, gt=0, le=120)


class PlannerConfig(Section):
    takeoff_height_m: float = Field(0.5, ge=0.2, le=5)
    takeoff_speed_mps: float = Field(0.3, gt=0, le=1)  # of the setpoint
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

    min_rest_v: float = Field(3.8, ge=0, le=5)
    min_load_v: float = Field(3.0, ge=0, le=5)
    battery_debounce_s: float = Field(1.5, ge=0, le=30)
    battery_stale_s: float = Field(90.0, gt=0, le=600)  # grace for a reading that stands still
    telemetry_hold_s: float = Field(0.3, gt=0, le=5)
    telemetry_land_s: float = Field(1.0, gt=0, le=10)
    proof_age_s: float = Field(0.1, gt=0, le=0.5)  # older telemetry proves nothing
    camera_hold_s: float = Field(0.5, gt=0, le=10)
    camera_land_s: float = Field(3.0, gt=0, le=60)
    max_frame_age_s: float = Field(0.4, gt=0, le=5)
    jump_m: float = Field(0.25, gt=0, le=5)
    jump_z_m: float = Field(0.15, gt=0, le=5)
    jump_deg: float = Field(15.0, gt=0, le=180)  # of the heading
    heading_lost_deg: float = Field(40.0, gt=0, le=180)  # a step of the heading: down level
    jump_mps: float = Field(1.0, gt=0, le=10)
    flight_variance_m2: float = Field(0.05, gt=0, le=10)  # of the position, in flight
    variance_land_s: float = Field(1.0, ge=0, le=30)
    jump_hold_s: float = Field(0.5, ge=0, le=0.5)
    max_height_m: float = Field(3.0, gt=0, le=20)
    fence_radius_m: float = Field(2.0, gt=0, le=50)
    max_tilt_deg: float = Field(55.0, gt=0, le=180)
    tilt_debounce_s: float = Field(0.2, ge=0, le=2)
    loop_late_hold_s: float = Field(0.25, gt=0, le=5)
    loop_late_land_s: float = Field(1.0, gt=0, le=10)
    estimator_wait_s: float = Field(10.0, gt=0, le=60)
    estimator_variance_m2: float = Field(0.01, gt=0, le=10)
    ground_z_m: float = Field(0.0, ge=-10, le=10)  # of the estimate, where it takes off
    ground_tolerance_m: float = Field(0.15, gt=0, le=10)
    start_tilt_deg: float = Field(10.0, gt=0, le=45)
    blocked_s: float = Field(0.7, gt=0, le=5)  # pressed and not moving for so long
    blocked_thrust_ratio: float = Field(1.1, gt=1, le=2)  # of the hover thrust
    land_on_log_error: bool = False
