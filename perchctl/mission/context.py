"""What one tick means to the mission: state, observation and profile, and what follows from
them: the vehicle's height and tilt, the target's error, the ages of what is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from perchctl.geometry import Array
from perchctl.mission.state import Condition, Observation, PlannerState
from perchctl.profile import Profile
from perchctl.vehicle import FLYING, HL_ACTIVE, LOW_POWER, NO_BATTERY_READING_V

FAR_BELOW_M = 0.5
PUT_RIGHT_S = 0.5
"""Once positions from outside come again, the estimate is drawn back to them for so long: its
steps and its speed are not the vehicle's."""
CORRECTED_S, BLOWN_MPS = 0.2, 0.2
"""An estimate that the newest sights agree with is no farther from the felt speed: 0.06 m/s in
flights without a fault."""
ANSWER_S = 0.2
"""A raw thrust that is ordered shows in the telemetry within that."""
HANGING_S = 1.0
"""For how long a thrust below the weight must be enough before it proves the magnet."""


@dataclass(frozen=True, eq=False)
class Context:
    state: PlannerState
    obs: Observation
    profile: Profile

    @property
    def in_phase_s(self) -> float:
        return self.obs.t_s - self.state.entered_s

    def held(self, condition: Condition) -> float:
        """Seconds for which the condition has been true; -1 when it is not."""
        since = self.state.since.get(condition)
        return -1.0 if since is None else self.obs.t_s - since

    # --- the vehicle -----------------------------------------------------

    @cached_property
    def speed_mps(self) -> float:
        return math.sqrt(sum(v * v for v in self.obs.telemetry.velocity_mps))

    @property
    def height_m(self) -> float:
        """Above the ground the flight started from, in the estimate's world."""
        ground = self.state.ground_m
        return self.obs.telemetry.position_m[2] - (ground[2] if ground else 0.0)

    @property
    def telemetry_age_s(self) -> float:
        """Age of the oldest part: position and velocity come in a packet of their own, and what
        reads the very same is as old as its first reading."""
        tel, imu = self.obs.telemetry, self.obs.imu
        return self.obs.t_s - tel.t_s + max(tel.behind_s, imu.attitude_age_s, imu.place_age_s)

    @property
    def attitude_age_s(self) -> float:
        """Of attitude, acceleration, thrust and the supervisor's word, which come together."""
        return self.obs.t_s - self.obs.telemetry.t_s

    @property
    def position_age_s(self) -> float:
        """Of the newest position from outside that was sent to the vehicle; where it has them from
        elsewhere, as by its decks, of the newest that corrected its estimate."""
        age_s = self.obs.position_age_s
        if self.profile.positioning.by == "deck":
            age_s = max(age_s, self.obs.imu.corrections.age_s(self.obs.t_s))
        return age_s

    @property
    def proves(self) -> bool:
        """Whether all of the telemetry is new enough to prove anything. What is old is unknown."""
        return self.telemetry_age_s <= self.profile.safety.proof_age_s

    @property
    def imu_proves(self) -> bool:
        """Whether attitude, acceleration, thrust and the supervisor's word are new enough to prove
        anything, whatever became of the position's packets."""
        return self.attitude_age_s <= self.profile.safety.proof_age_s

    @property
    def thrust_is_known(self) -> bool:
        """Whether the thrust that is read follows what is ordered."""
        unanswered_s = self.state.unanswered_s
        return unanswered_s is None or self.obs.t_s - unanswered_s <= ANSWER_S

    @property
    def located(self) -> bool:
        """Whether the estimated position and speed are believed. Not where no
        position comes, or they have only just come again, nor by pictures that do not fit the
        motion that is felt."""
        if self.by_sight and self.obs.mismatch is not None:
            return False
        if self.state.astray or self.position_age_s > self.profile.positioning.hold_s:
            return False
        stale_s = self.state.stale_s
        return stale_s is None or self.obs.t_s - stale_s > PUT_RIGHT_S

    @property
    def placed(self) -> bool:
        """Whether the estimated position and speed can prove anything: believed, and fresh."""
        return self.located and self.proves

    @property
    def is_blown(self) -> bool:
        """Whether the accelerometer has felt a blow or a gust that the estimate has not, and no
        sight since corrects it: sideways the firmware's estimator feels nothing."""
        reckoning = self.state.reckoning
        if not self.by_sight or reckoning.imu is None or self.position_age_s <= CORRECTED_S:
            return False
        (x, y, _), (ex, ey, _) = reckoning.velocity_mps, self.obs.telemetry.velocity_mps
        return math.hypot(x - ex, y - ey) > BLOWN_MPS

    @property
    def climb_mps(self) -> float:
        """Vertical speed: the estimate's where that is believed and fresh, else as reckoned by the
        accelerometer."""
        blind = self.state.blind_s is not None or not self.placed
        reckoning = self.state.reckoning
        if blind and reckoning.imu is not None:
            return reckoning.velocity_mps[2]
        return self.obs.telemetry.velocity_mps[2]

    @property
    def by_sight(self) -> bool:
        """Whether the target itself is the positioning system."""
        return self.profile.positioning.by == "target"

    def sinks(self, mps: float) -> bool:
        """Faster than that. A speed that drifts, since no position corrects it, counts only where
        the accelerometer shows, too, that something less than its weight carries the vehicle."""
        tel = self.obs.telemetry
        if self.climb_mps >= -mps:
            return False
        return self.placed or tel.acc_z_g < 1.0 - self.profile.planner.perch.contact_acc_g

    @property
    def variance_m2(self) -> float:
        """Of the position; 0 where the firmware tells none, endless where it is no number."""
        variance = self.obs.telemetry.position_variance_m2 or 0.0
        return math.inf if math.isnan(variance) else variance

    @property
    def flying(self) -> bool:
        return self.obs.telemetry.has(FLYING)

    @property
    def high_level_active(self) -> bool:
        return self.obs.telemetry.has(HL_ACTIVE)

    @property
    def tilt_rad(self) -> float:
        tel = self.obs.telemetry
        return math.acos(max(-1.0, min(1.0, math.cos(tel.roll_rad) * math.cos(tel.pitch_rad))))

    @property
    def battery_is_low(self) -> bool:
        tel = self.obs.telemetry
        known = tel.battery_v >= NO_BATTERY_READING_V
        return tel.battery_state == LOW_POWER or (
            known and tel.battery_v < self.profile.safety.min_load_v
        )

    # --- the target ------------------------------------------------------

    @property
    def target_m(self) -> Array | None:
        """The target in the world of the state estimate, (3,); None while none was seen."""
        return None if self.obs.target is None else self.obs.target.world_m

    @property
    def target_yaw_rad(self) -> float | None:
        return None if self.obs.target is None else self.obs.target.world_yaw_rad

    @property
    def error_xy_m(self) -> float:
        target = self.obs.target
        return math.inf if target is None else math.hypot(target.e_m[0], target.e_m[1])

    @property
    def error_z_m(self) -> float:
        target = self.obs.target
        return math.inf if target is None else float(target.e_m[2])

    @property
    def error_yaw_rad(self) -> float:
        target = self.obs.target
        return math.inf if target is None else target.e_yaw_rad

    @property
    def target_age_s(self) -> float:
        """Since the exposure of the last frame in which the target was measured."""
        target = self.obs.target
        return math.inf if target is None else self.obs.t_s - target.measured_s

    @property
    def tracked(self) -> bool:
        """Seen, or coasting within the filter's n_max frames."""
        return self.obs.target is not None and self.obs.target.tracked

    @property
    def fresh(self) -> bool:
        return self.tracked and self.target_age_s <= self._fresh_limit_s

    @property
    def small_is_fresh(self) -> bool:
        target = self.obs.target
        if target is None:
            return False
        return self.obs.t_s - target.small_measured_s <= self._fresh_limit_s

    @property
    def _fresh_limit_s(self) -> float:
        # A frame is as old as the camera's latency when it arrives.
        latency_s = self.profile.camera.start_latency_s + self.obs.delay_s
        return self.profile.planner.ascend.fresh_s + latency_s

    @property
    def contact_goal_z_m(self) -> float:
        """Height of the body at which the gear touches the target."""
        if self.target_m is None:
            return math.inf
        return float(self.target_m[2]) - self.profile.vehicle.gear_body_m[2]

    @property
    def far_below_target(self) -> bool:
        """By the camera nothing holds it where it is, though its height stands still: that may be
        a positioning system's which has frozen."""
        return self.target_m is not None and self.error_z_m > FAR_BELOW_M

    @property
    def cone_m(self) -> float:
        ascend = self.profile.planner.ascend
        return ascend.cone_base_m + ascend.cone_slope * max(0.0, self.error_z_m)
