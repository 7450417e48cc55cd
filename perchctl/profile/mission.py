"""The profile's keys of the mission: its seven phases, the two ways down, and safety."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from perchctl.profile.base import Section


class SearchConfig(Section):
    """Phase 2. Waits `wait_s`, climbs `step_m`, tries again; never above `max_height_m`."""

    attempts: int = Field(6, ge=1, le=100, description="times to wait, before it lands")
    wait_s: float = Field(1.5, gt=0, le=60, description="at each height")
    step_m: float = Field(0.12, ge=0, le=1, description="higher each time")
    max_height_m: float = Field(
        1.3, gt=0, le=20, description="never above it to look for the target"
    )
    yaw_step_deg: float = Field(
        60.0, ge=0, le=180, description="turned each time: the picture is wider than high"
    )
    confirm_frames: int = Field(3, ge=1, le=100, description="in a row with the target")


class EstimateConfig(Section):
    """Phase 3. The pose must stay within `spread_m` for `dwell_s`."""

    dwell_s: float = Field(0.4, ge=0, le=10, description="for which the pose must be steady")
    spread_m: float = Field(0.05, gt=0, le=1, description="within which it must stay")
    timeout_s: float = Field(4.0, gt=0, le=60, description="then back to search")


class AlignConfig(Section):
    """Phase 4. Errors must stay within tolerance for `dwell_s`."""

    xy_m: float = Field(
        0.04, gt=0, le=1, description="aligned: the gear's distance from the target's axis"
    )
    yaw_deg: float = Field(5.0, gt=0, le=180, description="aligned: heading")
    dwell_s: float = Field(0.4, ge=0, le=10, description="for which both must hold")
    timeout_s: float = Field(20.0, gt=0, le=120, description="then the attempt counts as failed")
    speed_mps: float = Field(0.4, gt=0, le=2, description="of the setpoint, sideways")
    yaw_rate_dps: float = Field(60.0, gt=0, le=360, description="of the setpoint")


class AscendConfig(Section):
    """Phase 5. Climbs to `standoff_m` under the target and settles there.

    Falls back to ALIGN outside the cone `cone_base_m + cone_slope * distance`.
    `standoff_m` is between gear and target; the small marker must be in view there.
    Settled is a gear within `settle_xy_m` of the axis, not more than `settle_z_m` below
    the stand-off.
    """

    speed_mps: float = Field(0.25, gt=0, le=1, description="climb, far below")
    near_speed_mps: float = Field(0.12, gt=0, le=1, description="climb, nearer than `near_m`")
    near_m: float = Field(0.35, gt=0, le=2, description="from here on it climbs slowly")
    cone_base_m: float = Field(0.05, gt=0, le=1, description="the cone's radius at the target")
    cone_slope: float = Field(
        0.2, ge=0, le=2, description="the cone's radius grows by it a metre below"
    )
    standoff_m: float = Field(
        0.08, gt=0.01, le=0.5, description="between gear and target where it settles"
    )
    settle_xy_m: float = Field(0.004, gt=0, le=0.1, description="settled: distance from the axis")
    settle_z_m: float = Field(
        0.02, gt=0, le=0.1, description="settled: at most so far below the stand-off"
    )
    settle_yaw_deg: float = Field(3.0, gt=0, le=90, description="settled: heading")
    settle_speed_mps: float = Field(0.04, gt=0, le=1, description="settled: speed")
    settle_dwell_s: float = Field(0.3, ge=0, le=10, description="for which all must hold")
    settle_timeout_s: float = Field(10.0, gt=0, le=60, description="at the stand-off")
    fresh_s: float = Field(
        0.25, gt=0, le=2, description="a target older than this, beyond the latency, is not fresh"
    )
    timeout_s: float = Field(40.0, gt=0, le=300, description="for the whole ascent")


class PerchConfig(Section):
    """Phase 6. `position` presses with a setpoint `press_m` above the contact;
    `raw` raises the thrust with stabilised position control off, as the paper does."""

    mode: Literal["position", "raw"] = Field(
        "position", description="press by a setpoint above the contact, or by raw thrust"
    )
    thrust: int = Field(60000, ge=1000, le=65535, description="of the raw mode")
    press_m: float = Field(0.25, gt=0, le=1, description="the setpoint above the contact")
    climb_mps: float = Field(0.2, gt=0, le=1, description="of the setpoint")
    contact_dwell_s: float = Field(0.25, gt=0, le=5, description="for which contact must hold")
    contact_z_m: float = Field(
        0.05, gt=0, le=0.3, description="contact: the gear's distance from the target"
    )
    contact_xy_m: float = Field(
        0.025, gt=0, le=0.5, description="contact: its distance from the axis, the magnet's radius"
    )
    contact_speed_mps: float = Field(0.06, gt=0, le=1, description="contact: vertical speed")
    contact_acc_g: float = Field(
        0.12, gt=0, le=1, description="contact: acceleration differs from 1 g by at most this"
    )
    contact_thrust_ratio: float = Field(
        1.03, gt=1, le=2, description="contact: thrust over hover thrust, where there is more"
    )
    timeout_s: float = Field(3.0, gt=0, le=20, description="without contact")


class CompleteConfig(Section):
    """Phase 7. The thrust is released in two stages, before the motors stop.

    By position setpoints in `steps` over `release_s`, as far as the onboard controller
    goes: the magnet must hold for `hold_dwell_s` with the thrust below `hold_ratio` of the
    hover thrust. Then by raw thrust over `ramp_s` down to where the motors stand still with
    the stream alive: the whole weight must hang for `hang_s`. `watch_s` after the stop.
    """

    steps: int = Field(5, ge=1, le=50, description="of the release")
    release_s: float = Field(0.8, gt=0, le=10, description="over which the thrust is released")
    release_drop_m: float = Field(
        0.25, gt=0, le=1, description="the setpoint's last step lies below the contact"
    )
    hold_ratio: float = Field(
        0.6, gt=0, lt=1, description="thrust over the hover thrust that proves the magnet"
    )
    hold_dwell_s: float = Field(0.3, ge=0, le=5, description="for which it must prove it")
    ramp_s: float = Field(
        0.5,
        gt=0,
        le=10,
        description="of raw thrust, from the least of position mode to still motors",
    )
    hang_s: float = Field(
        1.0, ge=0.3, le=10, description="that the whole weight must hang before the motors stop"
    )
    release_timeout_s: float = Field(
        8.0, gt=0, le=30, description="then the attempt counts as failed"
    )
    slip_m: float = Field(
        0.03, gt=0, le=0.3, description="hanging: at most so far below the contact"
    )
    slip_mps: float = Field(0.12, gt=0, le=1, description="a slip: sinking faster")
    slip_dwell_s: float = Field(
        0.03, ge=0, le=0.5, description="a slip: for so long; a free fall is answered at once"
    )
    slip_acc_g: float = Field(
        0.5, gt=0, lt=1, description="a free fall, or a slip wherever the estimate is: less"
    )
    watch_s: float = Field(
        1.5, gt=0, le=60, description="after the motor stop, before it counts as perched"
    )


class RecoverConfig(Section):
    """After a miss or a slip: descend, steady, back to phase 3."""

    descend_m: float = Field(0.10, gt=0, le=1, description="below where the attempt ended")
    dwell_s: float = Field(0.5, ge=0, le=10, description="for which it must be steady")
    steady_mps: float = Field(0.1, gt=0, le=1, description="steady: speed")
    timeout_s: float = Field(6.0, gt=0, le=60, description="then it lands")


class LandingConfig(Section):
    """Down by position setpoints at `speed_mps` to `handover_m`, the rest by the vehicle's
    own landing, which goes to `undershoot_m` below the ground of the estimate, and by
    `drift_mps` of the flight's time lower, so that a drifted height still ends on the floor."""

    speed_mps: float = Field(0.3, gt=0, le=1, description="of the landing")
    handover_m: float = Field(
        0.3, ge=0.1, le=2, description="above the ground: from here the vehicle lands by itself"
    )
    undershoot_m: float = Field(
        0.05, ge=0, le=1, description="the landing aims so far below the ground"
    )
    drift_mps: float = Field(
        0.012, ge=0, le=0.1, description="of the estimate's height: the aim sinks so fast"
    )
    timeout_s: float = Field(30.0, gt=0, le=120, description="for which a landing is waited for")


class PlannerConfig(Section):
    takeoff_height_m: float = Field(
        0.5, ge=0.2, le=5, description="of the take-off, above the ground"
    )
    takeoff_speed_mps: float = Field(
        0.3, gt=0, le=1, description="of the setpoint, from the ground up"
    )
    approach_xy_m: tuple[float, float] | None = Field(
        None, description="fly here after take-off, in the estimate's world"
    )
    approach_timeout_s: float = Field(15.0, gt=0, le=120, description="for take-off and way")
    search: SearchConfig = SearchConfig()
    estimate: EstimateConfig = EstimateConfig()
    align: AlignConfig = AlignConfig()
    ascend: AscendConfig = AscendConfig()
    perch: PerchConfig = PerchConfig()
    complete: CompleteConfig = CompleteConfig()
    recover: RecoverConfig = RecoverConfig()
    landing: LandingConfig = LandingConfig()
    attempts: int = Field(5, ge=1, le=50, description="perching attempts in all")
    perching_time_s: float = Field(120.0, gt=0, le=1200, description="then it lands")
    integral_per_s: float = Field(
        0.4, ge=0, le=5, description="gain of the integral of the horizontal error"
    )
    integral_limit_m: float = Field(0.08, ge=0, le=0.5, description="of that integral")


class SafetyConfig(Section):
    """Limits and reaction times; `*_hold_s` stays where it is, `*_land_s` lands."""

    min_rest_v: float = Field(3.8, ge=0, le=5, description="no flight begins below it")
    min_load_v: float = Field(3.0, ge=0, le=5, description="in flight, under load: lands below it")
    battery_debounce_s: float = Field(
        1.5, ge=0, le=30, description="below `min_load_v` before it lands"
    )
    energy_gate: bool = Field(
        True, description="no attempt begins that the battery has not enough for: it lands"
    )
    energy_reserve_s: float = Field(
        4.0, ge=0, le=120, description="of hovering, left after an attempt and a landing"
    )
    battery_stale_s: float = Field(
        90.0, gt=0, le=600, description="grace for a reading that stands still"
    )
    telemetry_hold_s: float = Field(0.3, gt=0, le=5, description="age of telemetry: held")
    telemetry_land_s: float = Field(1.0, gt=0, le=10, description="age of telemetry: landed")
    proof_age_s: float = Field(
        0.1,
        gt=0,
        le=0.5,
        description="older telemetry proves nothing: no contact, no landing, no stop",
    )
    camera_hold_s: float = Field(0.5, gt=0, le=10, description="since the last good picture: held")
    camera_land_s: float = Field(
        3.0, gt=0, le=60, description="since the last good picture: landed"
    )
    max_frame_age_s: float = Field(
        0.4, gt=0, le=5, description="an older picture is no measurement"
    )
    jump_m: float = Field(
        0.25, gt=0, le=5, description="a step of the estimate beyond its speed: a jump"
    )
    jump_z_m: float = Field(0.15, gt=0, le=5, description="a step of its height")
    jump_deg: float = Field(15.0, gt=0, le=180, description="a step of its heading")
    heading_lost_deg: float = Field(
        40.0, gt=0, le=180, description="step of the heading: down at once, level, by raw thrust"
    )
    jump_mps: float = Field(1.0, gt=0, le=10, description="a step of its velocity")
    flight_variance_m2: float = Field(
        0.05, gt=0, le=10, description="of the position in flight: above it, held"
    )
    variance_land_s: float = Field(1.0, ge=0, le=30, description="above it for so long: landed")
    jump_hold_s: float = Field(0.5, ge=0, le=0.5, description="held, then landed")
    max_height_m: float = Field(3.0, gt=0, le=20, description="above the ground: lands when higher")
    fence_radius_m: float = Field(
        2.0, gt=0, le=50, description="of the fence around the place of take-off: lands outside"
    )
    max_tilt_deg: float = Field(55.0, gt=0, le=180, description="beyond it the motors are cut")
    tilt_debounce_s: float = Field(0.2, ge=0, le=2, description="for which it must be tilted")
    loop_late_hold_s: float = Field(0.25, gt=0, le=5, description="a turn so late: held")
    loop_late_land_s: float = Field(1.0, gt=0, le=10, description="a turn so late: landed")
    estimator_wait_s: float = Field(10.0, gt=0, le=60, description="on the ground")
    estimator_variance_m2: float = Field(
        0.01, gt=0, le=10, description="of the position, at most, before take-off"
    )
    ground_z_m: float = Field(
        0.0,
        ge=-10,
        le=10,
        description="height at which the estimate places the ground, where it takes off",
    )
    ground_tolerance_m: float = Field(
        0.15, gt=0, le=10, description="farther from it the vehicle hangs, or is held: no take-off"
    )
    start_tilt_deg: float = Field(
        10.0, gt=0, le=45, description="roll and pitch, at most, before take-off"
    )
    blocked_s: float = Field(
        0.7, gt=0, le=5, description="pressed against something and not moving: back off down"
    )
    blocked_thrust_ratio: float = Field(
        1.1, gt=1, le=2, description="of the hover thrust: from here on it is pressed"
    )
    land_on_log_error: bool = Field(False, description="land when the log cannot be written")
