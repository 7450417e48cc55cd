"""One tick as the mission sees it: state, observation and profile, and what follows from them."""

from __future__ import annotations

import math
from typing import Any

from perchctl.geometry import Array
from perchctl.mission.state import Condition, Mismatch, Observation, PlannerState
from perchctl.profile import Profile
from perchctl.values import replace

FAR_BELOW_M = 0.5
PUT_RIGHT_S = 0.5  # the estimate is drawn back to new positions for so long
CORRECTED_S = 0.13
"""Positions by pictures correct the estimate while the newest is at most so much older than the
camera's latency: three pictures at 30 a second. Larger: a blow counts later."""
BLOWN_MPS = 0.2  # 0.06 m/s in flights without a fault
SWINGS_BY_LATENCY = 2.0
"""Speed in m/s that the estimate misses for each second of the latency's sigma: by 0.1 s that
pictures are later than assumed a vehicle swings. Larger: a blow by unknown latency counts less."""
ANSWER_S = 0.2  # within it the telemetry shows an ordered raw thrust
HANGING_S = 1.0  # to prove the magnet


class Context:
    """State, observation and profile of one tick: the argument of all predicates and actions.

    Attributes:
        state, obs, profile: `PlannerState`, `Observation` and `Profile`; `telemetry` is the newest
            sample, `t_s` the time on the loop's clock.
        in_phase_s: time since the phase began.
        tilt_rad: between the vehicle's vertical axis and the world's.
        by_sight: the target itself is the positioning system.
        mismatch: error of latency or mounting that makes the target seem to move; else zero.
        height_m: above the ground that the flight started from.
        attitude_age_s: age of attitude, acceleration, thrust and supervisor bits, which come
            together; `imu_proves`: they are new enough to prove anything.
        velocity_variance_m2ps2: variance of the estimated velocity; `position_variance_m2`: of the
            position, with decks of the height alone, since a Flow deck measures no other. Infinite
            if unknown, 0 if `link.unreported` says so. `is_unsure`: one of them is too large.
        thrust_is_known: the measured thrust follows the ordered thrust.
        reads_one_g: the accelerometer reads 1 g, as on anything that is supported.
        telemetry_age_s: age of the oldest part of the telemetry; a frozen reading is as old as its
            first sample; `proves`: all parts are new enough to prove anything.
        position_age_s: age of the newest external position sent to the vehicle; with decks, of the
            newest correction of its estimate; `position_is_stale`: it is too old (fault 10).
        located: the estimated position and speed are believed: positions have come for a while,
            and fit the accelerometer if they are from pictures; `placed`: located,
            and the telemetry `proves`.
        is_corrected: positions come, and correct the estimated velocity.
        is_blown: after a blow or gust that only the accelerometer has measured, until a sight
            corrects the estimate: the firmware's estimator ignores sideways forces.
        velocity_mps: of the estimate, world axes, (3,), while it is placed without the bias that a
            wind gives it; `speed_mps`: its size.
        climb_mps: vertical speed, by the estimate where that is believed and fresh, else by the
            accelerometer.
        target_m, target_yaw_rad: the target in the world of the state estimate, (3,), and its
            heading; None while none was seen.
        error_xy_m, error_z_m, error_yaw_rad: from the gear to the target; infinite while none was
            seen.
        contact_goal_z_m: height of the body at which the gear touches the target.
        target_age_s: time since the exposure of the last frame in which the target was measured.
        tracked: the target is seen, or coasts within the filter's n_max frames; `fresh`: it was
            measured as lately as the latency allows; `small_is_fresh`: so was the small marker.
        far_below_target: the camera sees the target too far above to hold the vehicle.
        is_near_standoff: the gear is at the height at which an ascent settles.
        cone_m: how far from the target's axis an ascent may be at the present height.
    """

    def __init__(self, state: PlannerState, obs: Observation, profile: Profile) -> None:
        tel, imu, ascend = obs.telemetry, obs.imu, profile.planner.ascend
        self.state = state
        self.obs = obs
        self.profile = profile
        self.t_s = obs.t_s
        self.telemetry = tel
        self.planner = profile.planner
        self.safety = profile.safety
        self.by_sight = profile.positioning.by == "target"
        self.mismatch = obs.mismatch or Mismatch()
        self.in_phase_s = obs.t_s - state.entered_s
        self.height_m = tel.position_m[2] - state.ground_z_m
        self.attitude_age_s = obs.t_s - tel.t_s
        self.imu_proves = self.attitude_age_s <= profile.safety.proof_age_s
        self.reads_one_g = abs(tel.acc_z_g - 1.0) <= profile.planner.perch.contact_acc_g
        up = math.cos(tel.roll_rad) * math.cos(tel.pitch_rad)
        self.tilt_rad = math.acos(max(-1.0, min(1.0, up)))
        by_deck = profile.positioning.by == "deck"
        place_m2 = tel.height_variance_m2 if by_deck else tel.position_variance_m2
        unknown = 0.0 if "variance" in profile.link.unreported else math.inf
        self.velocity_variance_m2ps2, self.position_variance_m2 = (
            unknown if reported is None else reported if reported >= 0.0 else math.inf
            for reported in (tel.velocity_variance_m2ps2, place_m2)
        )
        self.is_unsure = (
            self.velocity_variance_m2ps2 > profile.safety.flight_velocity_variance_m2ps2
            or self.position_variance_m2 > profile.safety.flight_variance_m2
        )
        unanswered_s = state.unanswered_s
        self.thrust_is_known = unanswered_s is None or obs.t_s - unanswered_s <= ANSWER_S
        oldest_s = max(tel.behind_s, imu.attitude_age_s, imu.place_age_s)
        self.telemetry_age_s = obs.t_s - tel.t_s + oldest_s
        self.proves = self.telemetry_age_s <= profile.safety.proof_age_s
        self.position_age_s = obs.position_age_s
        if by_deck:
            self.position_age_s = max(obs.position_age_s, imu.corrections.age_s(obs.t_s))
        self.position_is_stale = self.position_age_s > profile.positioning.hold_s
        doubted = state.astray or (self.by_sight and obs.mismatch is not None)
        just_again = state.stale_s is not None and obs.t_s - state.stale_s <= PUT_RIGHT_S
        self.located = not (doubted or self.position_is_stale or just_again)
        self.placed = self.located and self.proves
        vx_mps, vy_mps, vz_mps = tel.velocity_mps
        if self.placed:
            bias_x_mps, bias_y_mps = state.reckoning.velocity_bias_mps
            vx_mps, vy_mps = vx_mps - bias_x_mps, vy_mps - bias_y_mps
        self.velocity_mps = (vx_mps, vy_mps, vz_mps)
        self.speed_mps = math.sqrt(sum(v * v for v in self.velocity_mps))
        reckoning, climb_mps = state.reckoning, tel.velocity_mps[2]
        is_reckoned = reckoning.imu is not None
        # On its arrival a frame is as old as the camera's latency.
        latency_s = profile.camera.start_latency_s + obs.delay_s
        self.is_corrected = self.position_age_s <= latency_s + CORRECTED_S
        uncorrected = self.by_sight and is_reckoned and not self.is_corrected
        blown_mps = BLOWN_MPS + SWINGS_BY_LATENCY * obs.delay_sigma_s
        self.is_blown = uncorrected and math.hypot(*reckoning.missed_mps) > blown_mps
        by_imu = is_reckoned and (state.blind_s is not None or not self.placed)
        self.climb_mps = reckoning.velocity_mps[2] if by_imu else climb_mps
        self.contact_goal_z_m = math.inf
        self.target_m: Array | None = None
        self.target_yaw_rad: float | None = None
        self.error_xy_m = self.error_z_m = self.error_yaw_rad = self.target_age_s = math.inf
        self.tracked = self.fresh = self.small_is_fresh = False
        if (target := obs.target) is not None:
            self.target_m, self.target_yaw_rad = target.world_m, target.world_yaw_rad
            self.error_xy_m = math.hypot(target.e_m[0], target.e_m[1])
            self.error_z_m, self.error_yaw_rad = float(target.e_m[2]), target.e_yaw_rad
            self.target_age_s = obs.t_s - target.measured_s
            self.tracked = target.tracked
            if target.world_m is not None:
                gear_z_m = profile.vehicle.gear_body_m[2]
                self.contact_goal_z_m = float(target.world_m[2]) - gear_z_m
            limit_s = ascend.fresh_s + latency_s
            self.fresh = target.tracked and self.target_age_s <= limit_s
            self.small_is_fresh = obs.t_s - target.small_measured_s <= limit_s
        self.far_below_target = self.target_m is not None and self.error_z_m > FAR_BELOW_M
        self.is_near_standoff = self.error_z_m <= ascend.standoff_m + ascend.settle_z_m
        self.cone_m = ascend.cone_base_m + ascend.cone_slope * max(0.0, self.error_z_m)

    def with_state(self, state: PlannerState) -> Context:
        return Context(state, self.obs, self.profile)

    def evolve(self, **changes: Any) -> Context:
        """The same context with `changes` of its state's fields."""
        return self.with_state(replace(self.state, **changes))

    def held_s(self, condition: Condition) -> float:
        """Seconds for which the condition has been true; -1 while it is false."""
        since = self.state.since.get(condition)
        return -1.0 if since is None else self.t_s - since

    def is_sinking(self, mps: float) -> bool:
        """True if the vehicle sinks faster than `mps`.

        A speed that no position corrects counts only while the accelerometer reads less than the
        weight, too.
        """
        tel = self.telemetry
        if self.climb_mps >= -mps:
            return False
        return self.placed or tel.acc_z_g < 1.0 - self.planner.perch.contact_acc_g
