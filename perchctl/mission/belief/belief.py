"""What the planner believes about the vehicle: one frozen value for each tick.

`update_belief` computes it once from the belief before, the observation, what was sent, and the
profile. It makes no decisions and knows no phases. What follows from it is a property, computed
when it is first asked for. Each claim has a variance or an age, and what is unknown is infinite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from perchctl.geometry import Array
from perchctl.mission.belief.battery import EnergyState
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver, Sent
from perchctl.mission.belief.motion import ZERO, ImuMotion, Vector
from perchctl.mission.belief.mounting import MountingMonitor
from perchctl.mission.belief.reckoning import DeadReckoning
from perchctl.mission.belief.target import TargetBelief, TargetMotion
from perchctl.mission.belief.thrust import HoverThrust
from perchctl.mission.observation import Mismatch, Observation
from perchctl.profile import Profile
from perchctl.values import cached_property, replace
from perchctl.vehicle import Telemetry

POSITION_RETURNS_S = 0.5
"""Time for which new positions draw the estimate back after a gap. Smaller: it is believed too
soon."""
CORRECTED_S = 0.13
"""Positions by pictures correct the estimate while the newest is at most so much older than the
camera's latency: three pictures at 30 a second. Larger: a blow counts later."""
DISPLACED_MPS = 0.2
"""Speed, gained unseen, of a blow or gust; flights without a fault show 0.06 m/s. Larger: a blow
goes unnoticed. Smaller: an error of the attitude counts as one."""
SWINGS_BY_LATENCY = 2.0
"""Speed in m/s that the estimate misses for each second of the latency's sigma: by 0.1 s that
pictures are later than assumed a vehicle swings. Larger: a blow by unknown latency counts less."""
THRUST_REPORT_S = 0.2
"""Time within which the telemetry shows an ordered raw thrust. Smaller: late telemetry counts as an
unread thrust."""


@dataclass(frozen=True)
class ContactOffset:
    """Gear's distance from the target's axis at a touch; its sigma, infinite if unknown."""

    aside_m: float
    sigma_m: float

    def is_within(self, radius_m: float) -> bool:
        """True if the gear was surely within `radius_m` of the axis."""
        return self.aside_m + self.sigma_m <= radius_m

    @property
    def text(self) -> str:
        """The error in words, as in ``1.8 +- 0.6 mm off centre``."""
        if not math.isfinite(self.sigma_m):
            return "at an unknown distance from the centre"
        return f"{1e3 * self.aside_m:.1f} +- {1e3 * self.sigma_m:.1f} mm off centre"


@dataclass(frozen=True, eq=False, kw_only=True)
class Belief:
    """What is believed about the vehicle and the target, with what it rests on.

    Times are on the loop's clock; a time of None is one that has not come yet.
    """

    obs: Observation  #: the newest, which all properties rest on
    profile: Profile
    sent: Sent = field(default_factory=lambda: Sent(maneuver=Maneuver()))
    t_s: float = 0.0  #: of the last update
    last: Telemetry | None = None  #: the newest sample that was taken in

    # --- the estimate's world, and how far it can be relied on ---
    ground_m: Vector | None = None  #: where the flight started
    jump_s: float | None = None  #: the state estimate first jumped
    shift_m: Vector = ZERO  #: by which its world has moved in this tick
    stale_s: float | None = None  #: when there was no position last
    diverged: bool = False  #: external positions lead elsewhere: they prove nothing any more
    heading_lost: bool = False  #: position control would lead away from its setpoint
    dead_reckoned_s: float | None = None  #: accelerometer and attitude are all there is, since
    reckoned_height_m: float = 0.0  #: above the ground, as reckoned since then

    # --- motion, target and contact ---
    reckoning: DeadReckoning = field(default_factory=DeadReckoning)
    last_target_m: Array | None = None  #: in the world, at the last frame that measured it
    target_spread_m: float = 0.0  #: by which successive frames' targets differ
    target_motion: TargetMotion = field(default_factory=TargetMotion)  #: by pictures alone
    mounting: MountingMonitor = field(default_factory=MountingMonitor)
    contact_z_m: float | None = None  #: height of the body where the magnet may hold it
    contact: ContactOffset | None = None  #: as it made contact
    reach_s: float | None = None  #: within the magnet's reach since
    since: dict[Condition[Any], float] = field(default_factory=dict)  #: conditions, and from when

    # --- thrust and battery ---
    hover: HoverThrust = field(default_factory=HoverThrust)
    lagged_thrust: float | None = None  #: that the rotors give, 0..65535; None before a sample
    unanswered_s: float | None = None  #: the thrust that is read is not what is ordered, since
    unread_s: float = -math.inf  #: when that last had lasted too long
    energy: EnergyState = field(default_factory=EnergyState)  #: fitted to the battery

    @classmethod
    def on_ground(cls, obs: Observation, profile: Profile) -> Belief:
        """The belief about a vehicle that stands where it will take off."""
        return cls(obs=obs, profile=profile, t_s=obs.t_s, ground_m=obs.telemetry.position_m)

    def seen(self, obs: Observation, profile: Profile) -> Belief:
        """The same belief beside a newer observation, which it has not taken in yet."""
        return replace(self, obs=obs, profile=profile)

    def held_s(self, condition: Condition[Belief]) -> float:
        """Seconds for which the condition has been true; -1 while it is false."""
        began_s = self.since.get(condition)
        return -1.0 if began_s is None else self.obs.t_s - began_s

    # --- How old the telemetry is ---

    @property
    def telemetry(self) -> Telemetry:
        """The newest sample."""
        return self.obs.telemetry

    @property
    def imu(self) -> ImuMotion:
        """The motion by accelerometer and attitude alone."""
        return self.obs.imu

    @cached_property
    def attitude_age_s(self) -> float:
        """Age of attitude, acceleration, thrust and supervisor bits, which come together."""
        return self.obs.t_s - self.obs.telemetry.t_s

    @cached_property
    def imu_proves(self) -> bool:
        """True if attitude, acceleration and thrust are new enough to prove anything."""
        return self.attitude_age_s <= self.profile.safety.proof_age_s

    @cached_property
    def telemetry_age_s(self) -> float:
        """Age of the oldest part of the telemetry; a frozen reading is as old as its first one."""
        tel, imu = self.obs.telemetry, self.obs.imu
        oldest_s = max(tel.behind_s, imu.attitude_age_s, imu.place_age_s)
        return self.obs.t_s - tel.t_s + oldest_s

    @cached_property
    def proves(self) -> bool:
        """True if all parts of the telemetry are new enough to prove anything."""
        return self.telemetry_age_s <= self.profile.safety.proof_age_s

    # --- Whether the position can be relied on ---

    @cached_property
    def by_target(self) -> bool:
        """True if the target itself is the positioning system."""
        return self.profile.positioning.source.is_target

    @cached_property
    def velocity_variance_m2ps2(self) -> float:
        """Variance of the estimated velocity; infinite if unknown, 0 if `link.unreported` says that
        the vehicle does not report it."""
        return self._reported(self.obs.telemetry.velocity_variance_m2ps2)

    @cached_property
    def position_variance_m2(self) -> float:
        """Variance of the estimated position; with decks of the height alone, since a Flow deck
        measures nothing else. Infinite if unknown, 0 if `link.unreported` names it."""
        tel = self.obs.telemetry
        by_deck = self.profile.positioning.source.is_deck
        return self._reported(tel.height_variance_m2 if by_deck else tel.position_variance_m2)

    def _reported(self, variance: float | None) -> float:
        if variance is None:
            return 0.0 if "variance" in self.profile.link.unreported else math.inf
        return variance if variance >= 0.0 else math.inf

    @cached_property
    def is_unsure(self) -> bool:
        """True if the variance of velocity or position is too large to be moved by."""
        safety = self.profile.safety
        return (
            self.velocity_variance_m2ps2 > safety.flight_velocity_variance_m2ps2
            or self.position_variance_m2 > safety.flight_variance_m2
        )

    @cached_property
    def position_age_s(self) -> float:
        """Age of the newest external position sent to the vehicle; with decks, of the newest
        correction of its estimate."""
        if self.profile.positioning.source.is_deck:
            return max(self.obs.position_age_s, self.obs.imu.corrections.age_s(self.obs.t_s))
        return self.obs.position_age_s

    @cached_property
    def position_is_stale(self) -> bool:
        """True if the position is too old to be moved by (fault 10)."""
        return self.position_age_s > self.profile.positioning.hold_s

    @cached_property
    def position_trusted(self) -> bool:
        """True if the estimated position and speed are believed: positions have come for a while,
        and fit the accelerometer if they are from pictures."""
        doubted = self.diverged or (self.by_target and self.obs.mismatch is not None)
        returns = self.stale_s is not None and self.obs.t_s - self.stale_s <= POSITION_RETURNS_S
        return not (doubted or self.position_is_stale or returns)

    @cached_property
    def position_valid(self) -> bool:
        """True if the position is trusted, and the telemetry new enough to prove anything."""
        return self.position_trusted and self.proves

    @cached_property
    def latency_s(self) -> float:
        """Age of a frame when it arrives: the camera's latency that is in use."""
        return self.profile.camera.start_latency_s + self.obs.delay_s

    @cached_property
    def is_corrected(self) -> bool:
        """True while the newest position is young enough, by latency and `CORRECTED_S`, to still
        correct the estimated velocity."""
        return self.position_age_s <= self.latency_s + CORRECTED_S

    @cached_property
    def is_displaced(self) -> bool:
        """True after a blow or gust that only the accelerometer has measured, until a sighting
        corrects the estimate: the firmware's estimator ignores sideways forces."""
        is_reckoned = self.reckoning.imu is not None
        if not (self.by_target and is_reckoned and not self.is_corrected):
            return False
        least_mps = DISPLACED_MPS + SWINGS_BY_LATENCY * self.obs.delay_sigma_s
        return math.hypot(*self.reckoning.missed_mps) > least_mps

    @cached_property
    def is_doubtful(self) -> bool:
        """True if the height, the stream of telemetry or the loop cannot be relied on."""
        safety = self.profile.safety
        return (
            self.obs.link_problem is not None
            or self.telemetry_age_s > safety.telemetry_hold_s
            or self.jump_s is not None
            or self.obs.loop_late_s > safety.loop_late_hold_s
        )

    @cached_property
    def is_sighted(self) -> bool:
        """True if the position by the target is good enough to come down by."""
        return self.position_trusted and not self.is_displaced and not self.is_doubtful

    @cached_property
    def has_lost_its_position(self) -> bool:
        """True if only accelerometer and attitude are left to come down by."""
        if self.by_target:
            return not self.is_sighted
        return not (self.position_trusted or self.diverged)

    @cached_property
    def knows_its_place(self) -> bool:
        """True if the vehicle can come down by its position."""
        lost = self.diverged or self.dead_reckoned_s is not None
        if lost or (self.by_target and not self.is_sighted):
            return False
        # Without a vertical speed raw thrust would be blind, and its own landing is left.
        heard = self.attitude_age_s <= self.profile.safety.telemetry_hold_s
        return not (self.heading_lost and (self.by_target or heard))

    # --- How it moves ---

    @property
    def ground_z_m(self) -> float:
        """Height of the ground that the flight started from; 0 if it is unknown."""
        return self.ground_m[2] if self.ground_m else 0.0

    @cached_property
    def height_m(self) -> float:
        """Height above the ground that the flight started from."""
        return self.obs.telemetry.position_m[2] - self.ground_z_m

    @cached_property
    def tilt_rad(self) -> float:
        """Angle between the vehicle's vertical axis and the world's."""
        tel = self.obs.telemetry
        up = math.cos(tel.roll_rad) * math.cos(tel.pitch_rad)
        return math.acos(max(-1.0, min(1.0, up)))

    @cached_property
    def reads_one_g(self) -> bool:
        """True if the accelerometer reads 1 g, as on anything that is supported."""
        return abs(self.obs.telemetry.acc_z_g - 1.0) <= self.profile.planner.perch.contact_acc_g

    @cached_property
    def velocity_mps(self) -> Vector:
        """Estimated velocity, world axes; while the position is valid, without the bias that a wind
        gives it."""
        vx_mps, vy_mps, vz_mps = self.obs.telemetry.velocity_mps
        if self.position_valid:
            bias_x_mps, bias_y_mps = self.reckoning.velocity_bias_mps
            vx_mps, vy_mps = vx_mps - bias_x_mps, vy_mps - bias_y_mps
        return vx_mps, vy_mps, vz_mps

    @cached_property
    def speed_mps(self) -> float:
        """Size of the estimated velocity."""
        return math.sqrt(sum(v * v for v in self.velocity_mps))

    @cached_property
    def climb_mps(self) -> float:
        """Vertical speed, by the estimate where that is believed and fresh, else by the
        accelerometer."""
        is_reckoned = self.reckoning.imu is not None
        if is_reckoned and (self.dead_reckoned_s is not None or not self.position_valid):
            return self.reckoning.velocity_mps[2]
        return self.obs.telemetry.velocity_mps[2]

    def is_sinking(self, mps: float) -> bool:
        """True if the vehicle sinks faster than `mps`.

        A speed that no position corrects counts only while the accelerometer reads less than the
        weight, too.
        """
        if self.climb_mps >= -mps:
            return False
        light_g = 1.0 - self.profile.planner.perch.contact_acc_g
        return self.position_valid or self.obs.telemetry.acc_z_g < light_g

    @property
    def hover_thrust(self) -> float:
        """The estimated hover thrust, 0..65535; 0 while unknown."""
        return self.hover.thrust

    @cached_property
    def thrust_is_known(self) -> bool:
        """True if the measured thrust follows the ordered thrust."""
        return self.unanswered_s is None or self.obs.t_s - self.unanswered_s <= THRUST_REPORT_S

    # --- The target ---

    @cached_property
    def target(self) -> TargetBelief:
        """Where the target is, by the newest estimate of the pipeline."""
        return TargetBelief.of(self.obs.target, self.obs.t_s, self.latency_s, self.profile)

    @cached_property
    def mismatch(self) -> Mismatch:
        """Error of latency or mounting that makes the target seem to move; else zero."""
        return self.obs.mismatch or Mismatch()

    @cached_property
    def sighting_age_s(self) -> float:
        """Seconds since the exposure of the last picture with the target."""
        return max(0.0, self.obs.t_s - self.reckoning.sight_s)

    @cached_property
    def camera_is_proven(self) -> bool:
        """True if pictures have moved as the vehicle did: as its accelerometer felt by the target
        alone, else as its estimate did."""
        if self.by_target:
            return self.obs.felt is not None and self.obs.mismatch is None
        return not (self.mounting.is_unconfirmed or self.mounting.is_wrong)

    @property
    def is_in_magnet_reach(self) -> bool:
        """True if the magnet may hold the vehicle: after a contact, or once reckoned near."""
        return self.contact_z_m is not None or self.reach_s is not None
