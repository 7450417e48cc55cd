"""The profile's keys for the mission: the seven phases, recovery, landing, hover, and safety."""

from __future__ import annotations

from typing import ClassVar, Literal

from perchctl.corridor import Corridor
from perchctl.extensions import PATTERN
from perchctl.profile.base import Section, key


class SearchConfig(Section):
    """Phase 2: the vehicle waits for `wait_s`, climbs by `step_m` and tries again, up to
    `max_height_m`."""

    attempts: int = key(
        6, "number of times the vehicle waits for the target before it lands", ge=1, le=100
    )
    wait_s: float = key(1.5, "waiting time at each height", gt=0, le=60)
    step_m: ClassVar[float] = 0.12
    """Height by which the vehicle climbs between two waits, m."""
    max_height_m: float = key(1.3, "maximum height of the search", gt=0, le=20)
    yaw_step_deg: float = key(
        60.0,
        "rotation between two waits; it extends the view, as the image is wider than it is high",
        ge=0,
        le=180,
    )
    confirm_frames: ClassVar[int] = 3
    """Number of successive frames that must show the target."""


class EstimateConfig(Section):
    """Phase 3. The pose must stay within `spread_m` for `dwell_s`."""

    dwell_s: ClassVar[float] = 0.4  # time for which the pose must be steady
    spread_m: ClassVar[float] = 0.05
    """Range within which the pose must stay to count as steady, m."""
    timeout_s: ClassVar[float] = 4.0
    """Time after which the vehicle goes back to search if the pose is not steady, s."""


class AlignConfig(Section):
    """Phase 4. Position and heading errors must stay within tolerance for `dwell_s`."""

    xy_m: float = key(
        0.04, "maximum distance of the gear from the target's axis to count as aligned", gt=0, le=1
    )
    yaw_deg: ClassVar[float] = 5.0  # largest heading error that counts as aligned
    dwell_s: ClassVar[float] = 0.4  # time for which position and heading must both be aligned
    timeout_s: ClassVar[float] = 20.0
    """Time after which an attempt that is not aligned counts as failed, s."""
    speed_mps: ClassVar[float] = 0.4  # lateral speed of the setpoint
    yaw_rate_dps: ClassVar[float] = 60.0
    """Rotation rate of the setpoint, deg/s."""


class AscendConfig(Section):
    """Phase 5: the vehicle climbs to `standoff_m` under the target and settles there.

    The vehicle returns to ALIGN if it leaves the cone `cone_base_m + cone_slope * distance`.
    `standoff_m` is the distance between gear and target; the small marker must be in view there.
    The gear counts as settled within `settle_xy_m` of the axis and not more than `settle_z_m` below
    the stand-off.
    """

    speed_mps: float = key(0.25, "climb speed while far below the target", gt=0, le=1)
    near_speed_mps: ClassVar[float] = 0.12
    """Climb speed closer to the target than `near_m`, m/s."""
    near_m: ClassVar[float] = 0.35
    """Distance to the target below which the vehicle climbs slowly, m."""
    cone_base_m: ClassVar[float] = 0.05
    """The cone's radius at the target, m."""
    cone_slope: ClassVar[float] = 0.2
    """Increase of the cone's radius for each metre below the target."""
    standoff_m: float = key(
        0.08,
        "distance below the target at which the vehicle settles before contact",
        gt=0.01,
        le=0.5,
    )
    settle_xy_m: float = key(
        0.004,
        "maximum distance of the gear from the target's axis to count as settled",
        gt=0,
        le=0.1,
    )
    settle_z_m: ClassVar[float] = 0.02  # largest distance below stand-off that counts as settled
    settle_yaw_deg: ClassVar[float] = 3.0
    """Largest heading error that counts as settled, deg."""
    settle_speed_mps: ClassVar[float] = 0.04
    """Largest speed that counts as settled, m/s."""
    settle_dwell_s: float = key(
        0.3,
        "time for which position, heading and speed must stay within limits to count as settled",
        ge=0,
        lt=10,
    )
    settle_timeout_s: ClassVar[float] = 10.0  # time limit for settling at the stand-off
    fresh_s: float = key(
        0.25,
        "maximum age at which a target estimate counts as fresh, in addition to the camera latency",
        gt=0,
        le=2,
    )
    timeout_s: ClassVar[float] = 40.0
    """Time after which an ascent counts as failed, s."""


class PerchConfig(Section):
    """Phase 6. `position` presses with a setpoint `press_m` above the contact;
    `raw` raises the thrust with stabilised position control off, as the paper does."""

    mode: Literal["position", "raw"] = key(
        "position",
        "whether to press with a position setpoint above the contact point, or with raw thrust",
    )
    thrust: int = key(60000, "thrust with `mode: raw`", ge=1000, le=65535)
    press_m: ClassVar[float] = 0.25  # distance of the setpoint above the contact
    climb_mps: ClassVar[float] = 0.2
    """Speed at which the setpoint rises during the press, m/s."""
    contact_dwell_s: float = key(0.25, "time for which the contact must persist", gt=0, lt=3)
    contact_z_m: float = key(
        0.05, "maximum vertical distance to the target to count as contact", gt=0, le=0.3
    )
    contact_xy_m: float = key(
        0.025,
        "maximum horizontal distance to the target to count as contact: the magnet's radius",
        gt=0,
        le=0.5,
    )
    # largest deviation of the accelerometer from 1 g that counts as contact
    contact_acc_g: ClassVar[float] = 0.12
    timeout_s: ClassVar[float] = 3.0
    """Time after which an attempt without contact counts as failed, s."""


class CompleteConfig(Section):
    """Phase 7. The thrust is released in two stages, before the motors stop.

    In the first stage, the position setpoint is lowered in `steps` steps within `release_s`; the
    magnet must hold for `hold_dwell_s` with the thrust below `hold_ratio` of the hover thrust. In
    the second stage, setpoints of raw thrust decrease to zero within `ramp_s`, until the motors
    stop turning; the whole weight must then hang on the magnet for `hang_s`. The vehicle is
    monitored for `watch_s` after the motors have been stopped.
    """

    steps: ClassVar[int] = 5
    """Number of setpoint steps in the release."""
    release_s: ClassVar[float] = 0.8
    """Time over which the thrust is released, s."""
    release_drop_m: ClassVar[float] = 0.25
    """Distance of the last setpoint below the contact, m."""
    hold_ratio: ClassVar[float] = 0.6
    """Thrust, as a fraction of the hover thrust, below which the magnet must hold the vehicle to
    prove its hold."""
    hold_dwell_s: ClassVar[float] = 0.3  # time for which the magnet must hold
    ramp_s: ClassVar[float] = 0.5
    """Time in which the raw thrust decreases from the minimum of position mode to zero, s."""
    hang_s: ClassVar[float] = 1.0
    """Time for which the whole weight must hang on the magnet before the motors are stopped, s."""
    release_timeout_s: ClassVar[float] = 8.0  # time after which the attempt counts as failed
    slip_m: ClassVar[float] = 0.03  # largest distance below the contact that counts as hanging
    slip_mps: ClassVar[float] = 0.12  # sink rate that counts as a slip
    # duration of a slip before perchctl reacts; it reacts to a free fall at once
    slip_dwell_s: ClassVar[float] = 0.03
    # specific force below which the vehicle falls freely, or slips even if the estimate contradicts
    # it
    slip_acc_g: ClassVar[float] = 0.5
    watch_s: float = key(
        1.5,
        "time for which perchctl monitors the stopped vehicle before it reports PERCHED",
        gt=0,
        le=60,
    )


class RecoverConfig(Section):
    """After a miss or a slip, the vehicle descends, settles and returns to phase 3."""

    descend_m: ClassVar[float] = 0.10  # distance below the place where the attempt ended
    dwell_s: ClassVar[float] = 0.5
    """Time for which the vehicle must be steady, s."""
    steady_mps: ClassVar[float] = 0.1
    """Largest speed that counts as steady, m/s."""
    timeout_s: ClassVar[float] = 6.0
    """Time after which the vehicle lands if it is not steady, s."""


class HoverConfig(Section):
    """A mission that hovers below the target and lands, instead of a perch (`perchctl hover`)."""

    below_m: float = key(
        0.5, "distance of the gear below the target during the hover", ge=0.2, le=2
    )
    duration_s: float = key(20.0, "duration of the hover", ge=1, le=300)


OVERDUE_SHARE = 0.5
"""Fraction of a landing's time limit for which the landing may proceed by setpoints before the
vehicle's own landing takes over."""


class LandingConfig(Section):
    """A landing by position setpoints at `speed_mps` down to `handover_m`, and then by the
    firmware. The firmware aims below the estimated ground, by `undershoot_m` plus `drift_mps` times
    the flight's duration, so that the vehicle reaches the floor in spite of drift."""

    speed_mps: float = key(0.3, "descent speed during landing", gt=0, le=1)
    handover_m: float = key(
        0.3, "height above the ground at which the firmware takes over the landing", ge=0.1, le=2
    )
    undershoot_m: float = key(
        0.05, "how far below the ground the landing's target height is", ge=0, le=1
    )
    drift_mps: ClassVar[float] = 0.012  # assumed drift of the estimated height
    timeout_s: float = key(30.0, "time limit for a landing", gt=0, le=120)

    @property
    def setpoint_time_s(self) -> float:
        """Longest time for which the landing proceeds by setpoints before the firmware's landing
        begins, s."""
        return OVERDUE_SHARE * self.timeout_s


class PlannerConfig(Section):
    """How the mission flies, phase by phase."""

    takeoff_height_m: float = key(0.5, "take-off height above the ground", ge=0.2, le=5)
    takeoff_speed_mps: float = key(0.3, "climb speed during take-off", gt=0, le=1)
    approach_xy_m: tuple[float, float] | None = key(
        None, "point to fly to after take-off, in the world frame of the state estimate"
    )
    approach_timeout_s: ClassVar[float] = 15.0  # for take-off and the flight to the target together
    search: SearchConfig = SearchConfig()
    estimate: EstimateConfig = EstimateConfig()
    align: AlignConfig = AlignConfig()
    ascend: AscendConfig = AscendConfig()
    perch: PerchConfig = PerchConfig()
    complete: CompleteConfig = CompleteConfig()
    recover: RecoverConfig = RecoverConfig()
    landing: LandingConfig = LandingConfig()
    hover: HoverConfig | None = key(
        None, "hover below the target instead of perching; set by `perchctl hover`"
    )
    rows: str | None = key(
        None, "your own mission transitions, as `my_module:ROWS`", pattern=PATTERN
    )
    attempts: int = key(5, "maximum number of perching attempts", ge=1, le=50)
    perching_time_s: float = key(
        120.0, "total time for all attempts, after which the vehicle lands", gt=0, le=1200
    )
    integral_per_s: float = key(0.4, "integral gain of the horizontal control", ge=0, le=5)
    integral_limit_m: ClassVar[float] = 0.08
    """Limit of the horizontal control's integral while the vehicle moves, m."""


class CorridorConfig(Section):
    """The space that a vehicle of a fleet may use, in the axes of its state estimate: all places
    within `radius_m` of the line from `home_m` to `target_m` (`perchctl.corridor`)."""

    home_m: tuple[float, float] = key(..., "take-off position: x, y")
    target_m: tuple[float, float] = key(..., "position under the target: x, y")
    radius_m: float = key(
        ..., "maximum distance from the line between home and target", gt=0, le=50
    )
    way_top_m: float = key(..., "maximum height above the ground along the corridor", gt=0, le=20)
    target_top_m: float = key(..., "maximum height above the ground under the target", gt=0, le=20)

    def contains(self, x_m: float, y_m: float, height_m: float) -> bool:
        """True for a position inside the corridor; False for an unknown position (NaN)."""
        return Corridor(**dict(self)).contains(x_m, y_m, height_m)


class SafetyConfig(Section):
    """Limits and reaction times: the vehicle hovers after `*_hold_s` and lands after `*_land_s`."""

    min_rest_v: float = key(3.8, "minimum resting battery voltage for take-off", ge=0, le=5)
    min_load_v: float = key(
        3.0, "battery voltage in flight below which the vehicle lands", ge=0, le=5
    )
    # time below `min_load_v` after which the vehicle lands
    battery_debounce_s: ClassVar[float] = 1.5
    energy_gate: bool = key(
        True, "land instead of starting an attempt that the battery cannot finish"
    )
    energy_reserve_s: float = key(
        4.0,
        "hover time that must remain in the battery after an attempt and a landing",
        ge=0,
        le=120,
    )
    battery_stale_s: ClassVar[float] = 90.0
    """Time without a change after which a battery reading is stale, s."""
    telemetry_hold_s: float = key(
        0.3, "age of the telemetry at which the vehicle holds its position", gt=0, le=5
    )
    telemetry_land_s: float = key(
        1.0, "age of the telemetry at which the vehicle lands", gt=0, le=10
    )
    proof_age_s: ClassVar[float] = 0.1
    """Age above which telemetry is too old to prove a contact, a landing or a motor stop, s."""
    camera_hold_s: float = key(
        0.5, "time without a good image after which the vehicle holds its position", gt=0, le=10
    )
    camera_land_s: float = key(
        3.0, "time without a good image after which the vehicle lands", gt=0, le=60
    )
    max_frame_age_s: float = key(
        0.4, "maximum age of an image; older images are not used", gt=0, le=5
    )
    jump_m: float = key(
        0.25,
        "change in the position estimate, unexplained by the velocity, that counts as a jump",
        gt=0,
        le=5,
    )
    jump_z_m: ClassVar[float] = 0.15
    """Height jump: a step of the estimate that its velocity does not explain, m."""
    jump_deg: ClassVar[float] = 15.0
    """Heading jump: a step of the estimate that no rotation explains, deg."""
    heading_lost_deg: ClassVar[float] = 40.0
    """Heading jump after which the vehicle descends at once, level, by raw thrust, deg."""
    jump_mps: ClassVar[float] = 1.0
    """Velocity jump: a step of the estimate beyond what a flight can gain, m/s."""
    flight_velocity_variance_m2ps2: ClassVar[float] = 0.05
    """Variance of the velocity in flight above which the vehicle holds its position: it is reached
    4.5 s after the last position. Larger: the vehicle drifts for longer."""
    flight_variance_m2: ClassVar[float] = 0.05
    """Variance of the position in flight above which the vehicle holds its position, too: the
    estimator has restarted, or has received no position for 3 s. If decks measure the position, the
    limit applies to the variance of the height."""
    # time above one of these limits after which the vehicle lands
    variance_land_s: ClassVar[float] = 1.0
    # time for which the vehicle holds after a jump before it lands
    jump_hold_s: ClassVar[float] = 0.5
    max_height_m: float = key(
        3.0, "maximum height above the ground; the vehicle lands if it is higher", gt=0, le=20
    )
    fence_radius_m: float = key(
        2.0, "distance from the take-off point beyond which the vehicle lands", gt=0, le=50
    )
    corridor: CorridorConfig | None = key(
        None,
        "corridor of a vehicle in a fleet, set by the fleet; a vehicle that leaves it lands",
    )
    max_tilt_deg: float = key(55.0, "tilt above which perchctl cuts the motors", gt=0, le=180)
    tilt_debounce_s: ClassVar[float] = 0.2  # time for which the vehicle must be tilted
    loop_late_hold_s: ClassVar[float] = 0.25
    """Lateness of the loop at which the vehicle holds its position, s."""
    loop_late_land_s: ClassVar[float] = 1.0
    """Lateness of the loop at which the vehicle lands, s."""
    estimator_wait_s: ClassVar[float] = 10.0  # longest wait on the ground
    estimator_velocity_variance_m2ps2: ClassVar[float] = 0.01
    """Variance of the velocity above which take-off is refused. With ranging anchors, the variance
    is up to 0.007; without positions, it exceeds the limit within 1 s."""
    estimator_variance_m2: ClassVar[float] = 0.01
    """Variance of the position above which take-off is refused. With ranging anchors, the variance
    is 0.0013. After a reset, it is 1 m^2 in height and 100 m^2 horizontally until the first
    position."""
    ground_z_m: float = key(
        0.0, "height of the ground in the state estimate at take-off", ge=-10, le=10
    )
    ground_tolerance_m: float = key(
        0.15,
        "maximum distance from `ground_z_m` at take-off; a vehicle farther away counts as "
        "hanging or held",
        gt=0,
        le=10,
    )
    start_tilt_deg: ClassVar[float] = 10.0
    """Roll or pitch above which take-off is refused, deg."""
    # time for which the vehicle may press against an obstacle before it backs off downwards
    blocked_s: ClassVar[float] = 0.7
    land_on_log_error: bool = key(False, "land if the log cannot be written")
