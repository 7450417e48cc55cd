"""One tick as the mission sees it: state, observation and profile, and what follows from them."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

from perchctl.geometry import Array
from perchctl.mission.state import Condition, Mismatch, Observation, PlannerState
from perchctl.profile import Profile
from perchctl.values import replace

FAR_BELOW_M = 0.5
PUT_RIGHT_S = 0.5  # when external positions come again, the estimate is drawn back for so long
CORRECTED_S, BLOWN_MPS = 0.2, 0.2  # of a newest sight, and 0.06 m/s in flights without a fault
ANSWER_S = 0.2  # within it the telemetry shows an ordered raw thrust
HANGING_S = 1.0  # a thrust below the weight must be enough for so long to prove the magnet


class Context:
    """The argument of the table's predicates and the phases' actions: one tick, whole.

    Attributes:
        t_s: time of the tick on the loop's clock.
        telemetry: the newest sample.
        planner, safety: the profile's sections of those names.
        by_sight: the target itself is the positioning system.
        mismatch: what would bring the target to rest; zero while it rests.
        in_phase_s: seconds since the phase was entered.
        height_m: above the ground that the flight started from, in the estimate's world.
        attitude_age_s: age of attitude, acceleration, thrust and supervisor bits, which come
            together; `imu_proves`: new enough to prove anything, whatever the position's age.
        telemetry_age_s: age of the telemetry's oldest part: position and velocity come in a packet
            of their own, and a frozen reading is as old as its first one; `proves`: new enough.
    """

    def __init__(self, state: PlannerState, obs: Observation, profile: Profile) -> None:
        tel, imu = obs.telemetry, obs.imu
        self.state, self.obs, self.profile = state, obs, profile
        self.t_s, self.telemetry = obs.t_s, tel
        self.planner, self.safety = profile.planner, profile.safety
        self.by_sight = profile.positioning.by == "target"
        self.mismatch = obs.mismatch or Mismatch()
        self.in_phase_s = obs.t_s - state.entered_s
        self.height_m = tel.position_m[2] - state.ground_z_m
        self.attitude_age_s = obs.t_s - tel.t_s
        self.imu_proves = self.attitude_age_s <= profile.safety.proof_age_s
        oldest_s = max(tel.behind_s, imu.attitude_age_s, imu.place_age_s)
        self.telemetry_age_s = obs.t_s - tel.t_s + oldest_s
        self.proves = self.telemetry_age_s <= profile.safety.proof_age_s

    def with_state(self, state: PlannerState) -> Context:
        """The same tick with another state."""
        return Context(state, self.obs, self.profile)

    def evolve(self, **changes: Any) -> Context:
        """The same tick with changes of its state."""
        return self.with_state(replace(self.state, **changes))

    def held(self, condition: Condition) -> float:
        """Seconds for which the condition has been true; -1 when it is not."""
        since = self.state.since.get(condition)
        return -1.0 if since is None else self.t_s - since

    # --- the vehicle -----------------------------------------------------

    @cached_property
    def speed_mps(self) -> float:
        """Length of the estimated velocity."""
        return math.sqrt(sum(v * v for v in self.telemetry.velocity_mps))

    @property
    def position_age_s(self) -> float:
        """Age of the newest external position that was sent to the vehicle; with decks, of the
        newest correction of its estimate."""
        age_s = self.obs.position_age_s
        if self.profile.positioning.by == "deck":
            age_s = max(age_s, self.obs.imu.corrections.age_s(self.t_s))
        return age_s

    @property
    def position_is_stale(self) -> bool:
        """True while no external position is fresh (fault 10)."""
        return self.position_age_s > self.profile.positioning.hold_s

    @property
    def thrust_is_known(self) -> bool:
        """True if the thrust that is read follows what is ordered."""
        unanswered_s = self.state.unanswered_s
        return unanswered_s is None or self.t_s - unanswered_s <= ANSWER_S

    @property
    def located(self) -> bool:
        """True if the estimated position and speed are believed: positions come, not only just
        again, and pictures that give them fit the accelerometer."""
        if self.by_sight and self.obs.mismatch is not None:
            return False
        if self.state.astray or self.position_is_stale:
            return False
        stale_s = self.state.stale_s
        return stale_s is None or self.t_s - stale_s > PUT_RIGHT_S

    @property
    def placed(self) -> bool:
        """True if the estimated position and speed can prove anything: believed, and fresh."""
        return self.located and self.proves

    @property
    def is_blown(self) -> bool:
        """True after a blow or gust that only the accelerometer has measured, until a sight
        corrects the estimate: the firmware's estimator ignores sideways forces."""
        reckoning = self.state.reckoning
        if not self.by_sight or reckoning.imu is None or self.position_age_s <= CORRECTED_S:
            return False
        (x, y, _), (ex, ey, _) = reckoning.velocity_mps, self.telemetry.velocity_mps
        return math.hypot(x - ex, y - ey) > BLOWN_MPS

    @property
    def climb_mps(self) -> float:
        """Vertical speed, by the estimate where that is believed and fresh, else by the
        accelerometer."""
        blind = self.state.blind_s is not None or not self.placed
        reckoning = self.state.reckoning
        if blind and reckoning.imu is not None:
            return reckoning.velocity_mps[2]
        return self.telemetry.velocity_mps[2]

    def sinks(self, mps: float) -> bool:
        """True if the vehicle sinks faster than `mps`. A speed that no position corrects counts
        only while the accelerometer reads less than the weight, too."""
        tel = self.telemetry
        if self.climb_mps >= -mps:
            return False
        return self.placed or tel.acc_z_g < 1.0 - self.planner.perch.contact_acc_g

    @property
    def variance_m2(self) -> float:
        """Variance of the position; 0 if the firmware reports none, infinite if it is no number."""
        variance = self.telemetry.position_variance_m2 or 0.0
        return math.inf if math.isnan(variance) else variance

    @property
    def reads_one_g(self) -> bool:
        """True if the accelerometer reads one g, as of what something carries."""
        acc_g = self.planner.perch.contact_acc_g
        return abs(self.telemetry.acc_z_g - 1.0) <= acc_g

    @property
    def tilt_rad(self) -> float:
        """Angle between the vehicle's upward axis and the vertical."""
        tel = self.telemetry
        return math.acos(max(-1.0, min(1.0, math.cos(tel.roll_rad) * math.cos(tel.pitch_rad))))

    # --- the target ------------------------------------------------------

    @property
    def target_m(self) -> Array | None:
        """The target in the world of the state estimate, (3,); None while none was seen."""
        return None if self.obs.target is None else self.obs.target.world_m

    @property
    def target_yaw_rad(self) -> float | None:
        """The target's heading in the world of the state estimate; None while none was seen."""
        return None if self.obs.target is None else self.obs.target.world_yaw_rad

    @property
    def error_xy_m(self) -> float:
        """Horizontal distance of the gear from the target's axis; infinite without a target."""
        target = self.obs.target
        return math.inf if target is None else math.hypot(target.e_m[0], target.e_m[1])

    @property
    def error_z_m(self) -> float:
        """Height of the target above the gear; infinite without a target."""
        target = self.obs.target
        return math.inf if target is None else float(target.e_m[2])

    @property
    def error_yaw_rad(self) -> float:
        """Heading of the target relative to the vehicle's; infinite without a target."""
        target = self.obs.target
        return math.inf if target is None else target.e_yaw_rad

    @property
    def target_age_s(self) -> float:
        """Seconds since the exposure of the last frame in which the target was measured."""
        target = self.obs.target
        return math.inf if target is None else self.t_s - target.measured_s

    @property
    def tracked(self) -> bool:
        """True if the target is seen, or coasts within the filter's n_max frames."""
        return self.obs.target is not None and self.obs.target.tracked

    @property
    def fresh(self) -> bool:
        """True if the target is tracked, and was measured as lately as the latency allows."""
        return self.tracked and self.target_age_s <= self._fresh_limit_s

    @property
    def small_is_fresh(self) -> bool:
        """True if the small marker was measured as lately as the latency allows."""
        target = self.obs.target
        if target is None:
            return False
        return self.t_s - target.small_measured_s <= self._fresh_limit_s

    @property
    def _fresh_limit_s(self) -> float:
        # On its arrival a frame is as old as the camera's latency.
        latency_s = self.profile.camera.start_latency_s + self.obs.delay_s
        return self.planner.ascend.fresh_s + latency_s

    @property
    def contact_goal_z_m(self) -> float:
        """Height of the body at which the gear touches the target."""
        if self.target_m is None:
            return math.inf
        return float(self.target_m[2]) - self.profile.vehicle.gear_body_m[2]

    @property
    def far_below_target(self) -> bool:
        """True if the camera sees that nothing holds the vehicle where it is, whatever height a
        frozen positioning system reports."""
        return self.target_m is not None and self.error_z_m > FAR_BELOW_M

    @property
    def is_near_standoff(self) -> bool:
        """True once the gear is at the height at which an ascent settles."""
        ascend = self.planner.ascend
        return self.error_z_m <= ascend.standoff_m + ascend.settle_z_m

    @property
    def cone_m(self) -> float:
        """How far aside of the target an ascent may be at the present height."""
        ascend = self.planner.ascend
        return ascend.cone_base_m + ascend.cone_slope * max(0.0, self.error_z_m)
