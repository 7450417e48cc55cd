"""Criteria for a vehicle on the ground, used by `fly` before take-off and by `check`. Pure.

Each criterion returns a problem, or None. Even without motion capture, two things are known about a
vehicle at rest: the height of the ground, and which way is up. A turn is one iteration of the
flight loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.errors import Problem, distinct_texts
from perchctl.geometry import (
    nearest_axis,
    rotation_from_quaternion,
    rotation_from_rpy,
    wrap_rad,
    yaw_of,
)
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import (
    ABSOLUTE_DECKS,
    CAN_FLY,
    CRASHED,
    DECK_FAULT,
    FLYING,
    LOCKED,
    MOST_CELL_V,
    NO_BATTERY_READING_V,
    POSITION_DECKS,
    TUMBLED,
    ExternalPosition,
    Telemetry,
    is_armed_by_request,
    is_battery_reading,
    is_disarmed,
)
from perchctl.vision import TargetEstimate

KNOWN_SUPERVISOR_BITS = 0x0FFF
READING_AGE_S = 1.0  # battery and variances arrive ten times a second
REST_ACC_G = 0.15  # tolerance on the 1 g that the accelerometer reads at rest
WITHIN_REACH_M = (
    0.35  # distance from the gear; a take-off needs more height, so no target can be that close
)
ROOM_M = 50.0  # no capture volume is larger: a more distant position must be in another unit
# tolerance between the vehicle's vertical and the motion-capture system's; the rigid body's axes
# were aligned by eye
UP_AXIS_AGREE_DEG = 20.0
WANDERED_M = 0.1  # far above the noise of motion capture
REST_S = 1.9
"""Time for which the state estimate must have stood still before a take-off. The loop keeps no
older samples. Shorter: a slow drift is harder to detect."""
DRIFT_M = 0.07
"""Largest distance by which the estimate may move within `REST_S` (0.037 m/s). A healthy estimate
moves by up to 0.006 m with a Flow or Lighthouse deck, 0.03 m with positions from images, and 0.035
m with ranging anchors."""
STANDING_MPS = 0.1
"""Largest mean velocity of the estimate over `REST_S`. With the target as the only source of
positions, it reaches 0.076 m/s on a slope of 9 deg, because the tilted accelerometer misleads the
estimate."""
ESTIMATE_AGREE_M = 0.1
"""Largest distance between the estimated and the measured position once positions are fused.
Larger: positions meant for another vehicle are mistaken for this vehicle's."""
ESTIMATE_AGREE_DEG = 15.0
"""Largest difference between the estimated and the measured heading. Larger: another rigid body is
mistaken for the vehicle's."""

_FORBIDDEN = (
    (LOCKED, "is locked", "inspect it and restart it"),
    (CRASHED, "reports a crash", "put it upright and restart it"),
    (TUMBLED, "lies upside down", "put it upright"),
    (DECK_FAULT, "reports a deck fault", "check the deck and restart it"),
    (FLYING, "is already flying", "land it first"),
)


@dataclass(frozen=True)
class Variance:
    """A variance reported by the vehicle's estimator, and its limit for take-off.

    Attributes:
        what: the estimated quantity, as named in messages.
        value: the variance, in `unit`; None if the vehicle does not report it.
        most: the largest variance, in `unit`, with which the vehicle may take off.
        unit: unit of `value` and `most`.
    """

    what: str
    value: float | None
    most: float
    unit: str

    @property
    def text(self) -> str:
        return (
            f"of {self.what} {'unknown' if self.value is None else f'{self.value:.2g}'} {self.unit}"
        )


@dataclass(frozen=True)
class GroundCriteria:
    """Criteria for a vehicle at rest. Each method returns the problem that it finds, or None.
    `decks` are the vehicle's decks, by the firmware's names."""

    telemetry: Telemetry
    profile: Profile
    decks: Sequence[str] = ()

    @property
    def supervisor_fault(self) -> Problem | None:
        """Problem: the supervisor reports a fault that waiting does not clear, such as a crash."""
        raw = f"0x{self.telemetry.supervisor:04X}"
        for bit, what, advice in _FORBIDDEN:
            if self.telemetry.has_bit(bit):
                return Problem(f"the vehicle {what} (supervisor {raw})", advice)
        if self.telemetry.supervisor & ~KNOWN_SUPERVISOR_BITS:
            return Problem(
                f"the supervisor reports unknown bits ({raw})",
                "the firmware may be newer than this perchctl: update perchctl",
            )
        return None

    @property
    def waits_for_arming(self) -> bool:
        """True if the vehicle does not arm itself and only arming is missing. `fly` arms it last,
        just before take-off. Also true while its motors are starting."""
        telemetry = self.telemetry
        if telemetry.has_bit(CAN_FLY):
            return False
        return is_disarmed(telemetry) or is_armed_by_request(telemetry.supervisor)

    @property
    def supervisor_not_ready(self) -> Problem | None:
        """Problem: the supervisor does not allow flight (yet), and arming would not change that."""
        if self.telemetry.has_bit(CAN_FLY) or self.waits_for_arming:
            return None
        return Problem(f"0x{self.telemetry.supervisor:04X}", "wait, or restart the vehicle")

    @property
    def battery_too_low(self) -> Problem | None:
        """Problem: the battery is too low for take-off. See also `battery_unknown`."""
        rests_v, needed_v = self.telemetry.battery_v, self.profile.safety.min_rest_v
        if not NO_BATTERY_READING_V <= rests_v < needed_v:
            return None
        rests, needed = distinct_texts(rests_v, needed_v, 2)
        return Problem(
            f"the resting battery voltage is {rests} V, but at least {needed} V is needed "
            "(safety.min_rest_v)",
            "charge it",
        )

    @property
    def battery_too_high(self) -> Problem | None:
        """Problem: the battery's voltage is higher than that of a single cell, so the limits do not
        apply."""
        rests_v = self.telemetry.battery_v
        if not rests_v > MOST_CELL_V:
            return None
        rests, most = distinct_texts(rests_v, MOST_CELL_V, 2)
        return Problem(
            f"the resting battery voltage is {rests} V, but a single cell has at most {most} V",
            "use a vehicle with a one-cell battery",
        )

    @property
    def battery_unknown(self) -> Problem | None:
        """Problem: the battery voltage is unknown, or its last reading is too old."""
        telemetry = self.telemetry
        if "battery" in self.profile.link.unreported:
            return None
        if not is_battery_reading(telemetry.battery_v):
            return Problem(
                "the vehicle reports no battery voltage",
                "restart it; if it never reports the voltage, set link.unreported: [battery]",
            )
        if telemetry.battery_behind_s <= READING_AGE_S:
            return None
        return Problem(
            f"the battery voltage is {telemetry.battery_behind_s:.1f} s old, but at most "
            f"{READING_AGE_S:g} s is allowed",
            "restart the vehicle if this persists",
        )

    @property
    def variances(self) -> tuple[Variance, ...]:
        """The variances that decide whether the state estimate is good enough for take-off
        (docs/firmware.md, "Variances").

        The velocity's variance shows whether anything corrects the estimate. The position's
        variance shows whether the estimate has received a position since the estimator last
        started. A Flow deck measures the height, but not the horizontal position.
        """
        telemetry, safety = self.telemetry, self.profile.safety
        is_placed = not self.profile.positioning.source.is_deck or {*self.decks} & {*ABSOLUTE_DECKS}
        return (
            Variance(
                what="velocity",
                value=telemetry.velocity_variance_m2ps2,
                most=safety.estimator_velocity_variance_m2ps2,
                unit="(m/s)^2",
            ),
            Variance(
                what="position" if is_placed else "height",
                value=telemetry.position_variance_m2 if is_placed else telemetry.height_variance_m2,
                most=safety.estimator_variance_m2,
                unit="m^2",
            ),
        )

    @property
    def estimate_unsettled(self) -> Problem | None:
        """Problem: a variance of the state estimate is too large, unknown or too old."""
        telemetry, advice = self.telemetry, "check the positioning system"
        if self.profile.positioning.source.is_target:
            advice = "check that the positions arrive and that the target stays in view"
        unreported = "variance" in self.profile.link.unreported
        for each in self.variances:
            if each.value is None:
                if unreported:
                    continue
                return Problem(
                    f"the vehicle reports no variance for its {each.what}",
                    "run its Kalman filter (stabilizer.estimator: 2 under link.parameters); if "
                    "the vehicle has none, set link.unreported: [variance]",
                )
            if not each.value <= each.most:
                found, allowed = distinct_texts(each.value, each.most, 2)
                return Problem(
                    f"the {each.what}'s variance is {found} {each.unit}, but at most {allowed} is "
                    "allowed",
                    advice,
                )
        if not (unreported or telemetry.variance_behind_s <= READING_AGE_S):
            return Problem(
                f"the variances are {telemetry.variance_behind_s:.1f} s old, but at most "
                f"{READING_AGE_S:g} s is allowed",
                "restart the vehicle if this persists",
            )
        return None

    @property
    def off_ground(self) -> Problem | None:
        """Problem: according to the settled state estimate, the vehicle is not on the ground; it is
        hanging or being held."""
        return self._off_the_ground(
            self.telemetry.position_m[2],
            "the state estimate places the vehicle at",
            "if the vehicle is hanging, take it down and restart it; if the positioning system "
            "has its origin at another height, set safety.ground_z_m",
        )

    def _off_the_ground(self, z_m: float, found: str, advice: str) -> Problem | None:
        safety = self.profile.safety
        if abs(z_m - safety.ground_z_m) <= safety.ground_tolerance_m:
            return None
        return Problem(
            f"{found} {z_m:.2f} m, but the ground is at {safety.ground_z_m:.2f} m", advice
        )

    @property
    def tilt_deg(self) -> float:
        """The larger of abs(roll) and abs(pitch); NaN if either is NaN."""
        angles_rad = np.abs((self.telemetry.roll_rad, self.telemetry.pitch_rad))
        return math.degrees(float(angles_rad.max()))

    @property
    def not_level(self) -> Problem | None:
        """Problem: the vehicle is not level enough to take off."""
        most_deg = self.profile.safety.start_tilt_deg
        if self.tilt_deg <= most_deg:
            return None
        found, allowed = distinct_texts(self.tilt_deg, most_deg, 0)
        return Problem(
            f"tilted by {found} deg, but at most {allowed} deg is allowed",
            "put the vehicle on level ground",
        )

    @property
    def not_still(self) -> Problem | None:
        """Problem: the accelerometer does not read 1 g, so the vehicle is moving or vibrating."""
        acc_z_g = self.telemetry.acc_z_g
        if abs(acc_z_g - 1.0) <= REST_ACC_G:
            return None
        return Problem(f"the accelerometer reads {acc_z_g:.2f} g", "keep it still")

    @property
    def stands(self) -> bool:
        """True if the accelerometer shows that the vehicle is level and still."""
        return self.not_level is None and self.not_still is None

    @staticmethod
    def no_position_source(decks: Sequence[str], profile: Profile) -> Problem | None:
        """Problem: the profile expects a deck that measures positions, but none of the detected
        `decks` does."""
        config = profile.positioning
        if not config.source.is_deck or {*decks} & {*POSITION_DECKS, *config.decks}:
            return None
        advice = (
            "mount a positioning deck (flow, lighthouse, loco), or set positioning: mocap or "
            "positioning: target"
        )
        if decks:
            advice += (
                f"; if {' or '.join(decks)} measures the position, name it in positioning.decks"
            )
        return Problem("no positioning deck", advice)

    @staticmethod
    def target_too_near(target: TargetEstimate | None) -> Problem | None:
        """Problem: the target is too close for a vehicle that is on the ground."""
        if target is None or not target.tracked:
            return None
        away_m = math.hypot(*(float(e) for e in target.e_m))
        if away_m >= WITHIN_REACH_M:
            return None
        away, needed = distinct_texts(away_m, WITHIN_REACH_M, 2)
        return Problem(
            f"the target is only {away} m away, but at least {needed} m is needed",
            "if the vehicle is hanging, take it down first; if not, move it farther from the "
            "target",
        )

    @staticmethod
    def moving_estimate(samples: Sequence[Telemetry], profile: Profile) -> Problem | None:
        """Problem: within the `rest_window` of `samples` (oldest first), the state estimate has
        moved, or its mean velocity was too high.

        The vehicle is not moving, so something is misleading its estimate: optical flow over a dark
        floor, a base station that was moved, or the positions of another body. It is also possible
        that somebody is carrying the vehicle too smoothly for its accelerometer to detect the
        motion. If the samples span less time, only those are checked.
        """
        if not samples:
            return None
        newest, advice = (
            samples[-1],
            "keep the vehicle still; if it was still, check its positioning",
        )
        if profile.positioning.source.is_deck:
            advice += " (light, floor, base stations)"
        window = rest_window(samples)
        lasts_s = newest.t_s - window[0].t_s
        moved_m = math.dist(window[0].position_m, newest.position_m)
        if not moved_m <= DRIFT_M:
            moved, most = distinct_texts(moved_m, DRIFT_M, 2)
            found = (
                f"the estimated position moved {moved} m in {lasts_s:.1f} s, but at most {most} m "
                "is allowed"
            )
            return Problem(found, advice)
        mean_mps = math.hypot(*np.mean([s.velocity_mps for s in window], axis=0))
        if not mean_mps <= STANDING_MPS:
            mean, most = distinct_texts(mean_mps, STANDING_MPS, 2)
            found = (
                f"the estimated speed was {mean} m/s for {lasts_s:.1f} s, "
                f"but at most {most} m/s is allowed"
            )
            return Problem(found, advice)
        return None

    @staticmethod
    def moved_body(moved_m: float, profile: Profile) -> Problem | None:
        """Problem: the external positions have moved by `moved_m` while the vehicle stood still.
        The positions belong to another rigid body, or the target is swinging."""
        if moved_m <= WANDERED_M:
            return None
        return Problem(
            f"{feed_name(profile)} shows a motion of {moved_m:.2f} m, but the vehicle is at rest",
            "keep the target still, put down the body being carried, or correct positioning.body",
        )

    def position_frame_problem(self, place: ExternalPosition) -> Problem | None:
        """Problem: the position `place` is in another unit, has a different axis pointing up, or is
        too far from the expected target. If the target itself is the positioning system, only the
        distance is checked."""
        x, y, z = place.position_m
        if self.profile.positioning.source.is_target:
            return self._unreachable(place)
        if not max(abs(x), abs(y), abs(z)) < ROOM_M:
            return Problem(
                f"the motion-capture system places the vehicle at x {x:.0f}, y {y:.0f}, z {z:.0f} "
                "m, which appears to be in millimetres",
                "set the unit of the motion-capture stream to metres",
            )
        standing = self._off_the_ground(
            z,
            "the motion-capture system places the vehicle at",
            "its axes may be swapped, its unit may be millimetres, or its origin or rigid body "
            "may be wrong: run perchctl check --lift; if this height is right, set "
            "safety.ground_z_m to it",
        )
        return up_axis_problem(place, self.telemetry) or standing or self._unreachable(place)

    def _unreachable(self, place: ExternalPosition) -> Problem | None:
        """Problem: no flight from this position can reach the expected target. The position may
        belong to another vehicle."""
        target, (x, y, _) = self.profile.target, place.position_m
        if target.expected_xy_m is None:
            return None
        away_m = math.dist((x, y), target.expected_xy_m)
        fence_m = self.profile.safety.fence_radius_m
        if away_m <= fence_m + target.expected_within_m:
            return None
        return Problem(
            f"the target is expected {away_m:.1f} m from the vehicle (x "
            f"{x:.2f}, y {y:.2f} m), but the fence is {fence_m:g} m",
            "correct target.expected_xy_m, or positioning.body if it names another vehicle's body",
        )


def rest_window(samples: Sequence[Telemetry]) -> list[Telemetry]:
    """Return the samples, oldest first, from which to decide if a vehicle has stood still for
    `REST_S`: those within `REST_S`, and the one before them, which shows if there was a gap at the
    beginning. Samples from before the vehicle's last restart are left out. If the samples span less
    time, all are returned."""
    same = [s for s in samples if s.start == samples[-1].start]
    first = max((i for i, s in enumerate(same) if same[-1].t_s - s.t_s >= REST_S), default=0)
    return same[first:]


def up_axis_problem(place: ExternalPosition, telemetry: Telemetry) -> Problem | None:
    """Problem: the motion-capture system and the vehicle's own attitude disagree about the
    vertical."""
    if place.quaternion is None:
        return None
    # The vertical in the motion-capture system's axes, assuming that the rigid body's axes are the
    # vehicle's.
    R_own = rotation_from_rpy(telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad)
    up = rotation_from_quaternion(place.quaternion) @ R_own.T[:, 2]
    off_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(up[2])))))
    if off_deg <= UP_AXIS_AGREE_DEG:
        return None
    axis = nearest_axis(up)
    found = (
        "the vertical in the motion-capture system differs from the vehicle's own by "
        f"{off_deg:.0f} deg"
    )
    if axis is not None:
        found = f"swapped axes: up is {axis} in the motion-capture system"
    return Problem(
        found,
        "set the motion-capture world frame to z up, define the rigid body with level axes, or set "
        "positioning.body_rpy_deg to the angles that perchctl check --lift reports",
    )


def feed_name(profile: Profile) -> str:
    """The name of the source of external positions, as used in messages."""
    by_target = profile.positioning.source.is_target
    return "the view of the target" if by_target else "the motion-capture system"


class RestCheck:
    """Detects that the motion-capture system tracks another body, which moves while the vehicle
    stands still."""

    def __init__(self) -> None:
        self._from: ExternalPosition | None = None

    def moved_body_problem(
        self, place: ExternalPosition | None, profile: Profile
    ) -> Problem | None:
        """Problem: the rigid body has moved since the vehicle came to rest.

        Must be called in each turn with fresh telemetry and a fresh position. `place` is None while
        the vehicle is not standing still, which restarts the check."""
        self._from = None if place is None else self._from or place
        if place is None or self._from is None:
            return None
        way_m = math.dist(self._from.position_m, place.position_m)
        return GroundCriteria.moved_body(way_m, profile)


def unsent_problem(status: FeedStatus, profile: Profile) -> Problem | None:
    """Problem: external positions are not being sent, or are too old."""
    if status.problem is not None:
        return Problem(status.problem, "see perchctl check")
    if status.age_s <= profile.positioning.hold_s:
        return None
    age = (
        f"{status.age_s:.2f} s old"
        if math.isfinite(status.age_s)
        else "no position has been sent yet"
    )
    return Problem(age, "see perchctl check")


def estimate_problem(place: ExternalPosition, telemetry: Telemetry) -> Problem | None:
    """Problem: the position or heading of the state estimate differs from `place`."""
    away_m = math.dist(place.position_m, telemetry.position_m)
    turned_deg = 0.0
    if place.quaternion is not None:
        yaw_rad = yaw_of(rotation_from_quaternion(place.quaternion))
        turned_deg = abs(math.degrees(wrap_rad(telemetry.yaw_rad - yaw_rad)))
    if away_m <= ESTIMATE_AGREE_M and turned_deg <= ESTIMATE_AGREE_DEG:
        return None
    return Problem(
        f"the positions differ by {away_m:.2f} m, and the headings by {turned_deg:.0f} deg",
        "check that this vehicle receives the positions and that positioning.body names its body",
    )
