"""What must be true on the ground before anything spins."""

from __future__ import annotations

import math

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.profile import Profile
from perchctl.vehicle import (
    CAN_FLY,
    CRASHED,
    DECK_FAULT,
    FLYING,
    LOCKED,
    NO_BATTERY_READING_V,
    TUMBLED,
    Telemetry,
)
from perchctl.vision.types import TargetEstimate

KNOWN_SUPERVISOR_BITS = 0x0FFF
REST_ACC_G = 0.15
"""At rest the accelerometer reads 1 g, give or take so much."""
WITHIN_REACH_M = 0.35
"""Of the gear. From the ground no target is so near: a take-off needs more height."""

_FORBIDDEN = (
    (LOCKED, "is locked: inspect it and restart it"),
    (CRASHED, "reports a crash: put it upright and restart it"),
    (TUMBLED, "lies upside down: put it upright"),
    (DECK_FAULT, "reports a deck fault: check the deck and restart it"),
    (FLYING, "is flying already: land it first"),
)


def refuse(telemetry: Telemetry | None, profile: Profile) -> None:
    """Raises SafetyAbort for what waiting will not mend."""
    if telemetry is None:
        return
    for bit, what in _FORBIDDEN:
        if telemetry.has(bit):
            raise SafetyAbort(f"the vehicle {what} (supervisor 0x{telemetry.supervisor:04X})")
    unknown = telemetry.supervisor & ~KNOWN_SUPERVISOR_BITS
    if unknown:
        raise SafetyAbort(
            f"the supervisor reports unknown bits (0x{telemetry.supervisor:04X}): this firmware "
            f"is newer than perchctl knows"
        )
    needed_v = profile.safety.min_rest_v
    if NO_BATTERY_READING_V <= telemetry.battery_v < needed_v:
        raise SafetyAbort(
            f"the battery rests at {telemetry.battery_v:.2f} V, at least {needed_v:.2f} V are "
            f"needed (safety.min_rest_v): charge it"
        )


def _refuse_off_the_ground(telemetry: Telemetry, profile: Profile) -> None:
    """Raises SafetyAbort for a vehicle that hangs, or is held, by the settled estimate."""
    safety = profile.safety
    z_m = telemetry.position_m[2]
    if abs(z_m - safety.ground_z_m) > safety.ground_tolerance_m:
        raise SafetyAbort(
            f"the state estimate places the vehicle at {z_m:.2f} m, and the ground is at "
            f"{safety.ground_z_m:.2f} m: if it hangs, take it down and restart it; if the "
            f"positioning system's zero is elsewhere, set safety.ground_z_m"
        )


def _refuse_within_reach(target: TargetEstimate | None) -> None:
    """Raises SafetyAbort for a target that is too near to be seen from the ground."""
    if target is None or not target.tracked:
        return
    away_m = math.hypot(*(float(e) for e in target.e_m))
    if away_m < WITHIN_REACH_M:
        raise SafetyAbort(
            f"the target is only {away_m:.2f} m away, at least {WITHIN_REACH_M:g} m are needed: "
            f"the vehicle hangs, or stands too close under it; take it down first"
        )


def still_waiting_for(
    telemetry: Telemetry | None,
    has_frame: bool,
    camera_problem: str | None,
    waited_s: float,
    profile: Profile,
    target: TargetEstimate | None = None,
    age_s: float = 0.0,
) -> str:
    """What is missing yet, or empty when ready. Errors: TimedOut past the bound, and
    SafetyAbort off the ground."""
    safety = profile.safety
    if telemetry is None:
        return _bounded("telemetry", waited_s, safety.estimator_wait_s)
    if age_s > safety.telemetry_hold_s:
        return _bounded(f"telemetry (the newest is {age_s:.1f} s old)", waited_s,
                        safety.estimator_wait_s)  # fmt: skip
    variance = telemetry.position_variance_m2
    if variance is not None and not variance <= safety.estimator_variance_m2:
        return _bounded(
            f"the state estimate to settle (variance {variance:.3g} m^2, at most "
            f"{safety.estimator_variance_m2:g} allowed; is there a positioning system?)",
            waited_s,
            safety.estimator_wait_s,
        )
    _refuse_off_the_ground(telemetry, profile)
    tilt_deg = math.degrees(max(abs(telemetry.roll_rad), abs(telemetry.pitch_rad)))
    if tilt_deg > safety.start_tilt_deg:
        return _bounded(
            f"the vehicle to stand level (it is tilted by {tilt_deg:.0f} deg, at most "
            f"{safety.start_tilt_deg:g} allowed)",
            waited_s,
            safety.estimator_wait_s,
        )
    if abs(telemetry.acc_z_g - 1.0) > REST_ACC_G:
        return _bounded(
            f"the vehicle to stand still (its accelerometer reads {telemetry.acc_z_g:.2f} g)",
            waited_s,
            safety.estimator_wait_s,
        )
    if not telemetry.has(CAN_FLY):
        return _bounded(
            f"the supervisor to allow flight (0x{telemetry.supervisor:04X})",
            waited_s,
            safety.estimator_wait_s,
        )
    if not has_frame:
        what = f"a good picture ({camera_problem or 'none has come'})"
        return _bounded(what, waited_s, profile.camera.start_timeout_s)
    _refuse_within_reach(target)
    return ""


def _bounded(what: str, waited_s: float, limit_s: float) -> str:
    if waited_s > limit_s:
        raise TimedOut(f"waited {limit_s:.0f} s for {what}: not flying")
    return what
