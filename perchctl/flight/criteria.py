"""What is asked of a vehicle on the ground: by `fly` before it takes off, and by `check`.

Each criterion gives what is wrong, or None. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.errors import distinct_figures
from perchctl.profile import Profile
from perchctl.vehicle import (
    CAN_FLY,
    CRASHED,
    DECK_FAULT,
    FLYING,
    LOCKED,
    NO_BATTERY_READING_V,
    POSITION_DECKS,
    TUMBLED,
    MeasuredBy,
    Telemetry,
)
from perchctl.vision import TargetEstimate

KNOWN_SUPERVISOR_BITS = 0x0FFF
REST_ACC_G = 0.15
"""At rest the accelerometer reads 1 g, give or take so much."""
WITHIN_REACH_M = 0.35
"""Of the gear. From the ground no target is so near: a take-off needs more height."""

_FORBIDDEN = (
    (LOCKED, "is locked", "inspect it and restart it"),
    (CRASHED, "reports a crash", "put it upright and restart it"),
    (TUMBLED, "lies upside down", "put it upright"),
    (DECK_FAULT, "reports a deck fault", "check the deck and restart it"),
    (FLYING, "is flying already", "land it first"),
)


@dataclass(frozen=True)
class Problem:
    """What was found, with what is allowed, and what to do."""

    found: str
    advice: str

    @property
    def sentence(self) -> str:
        return f"{self.found}: {self.advice}"


def forbidden_problem(telemetry: Telemetry) -> Problem | None:
    """What the supervisor reports that waiting will not mend."""
    raw = f"0x{telemetry.supervisor:04X}"
    for bit, what, advice in _FORBIDDEN:
        if telemetry.has(bit):
            return Problem(f"the vehicle {what} (supervisor {raw})", advice)
    if telemetry.supervisor & ~KNOWN_SUPERVISOR_BITS:
        return Problem(
            f"the supervisor reports unknown bits ({raw})",
            "this firmware is newer than perchctl knows",
        )
    return None


def battery_problem(telemetry: Telemetry, profile: Profile) -> Problem | None:
    """A reading below `NO_BATTERY_READING_V` is none, and no problem here."""
    needed_v = profile.safety.min_rest_v
    if not NO_BATTERY_READING_V <= telemetry.battery_v < needed_v:
        return None
    rests, needed = distinct_figures(telemetry.battery_v, needed_v, 2)
    return Problem(
        f"the battery rests at {rests} V, at least {needed} V are needed (safety.min_rest_v)",
        "charge it",
    )


def unsettled_problem(telemetry: Telemetry, profile: Profile) -> Problem | None:
    """The estimate's variance; one that is no number is not settled either."""
    variance, most = telemetry.position_variance_m2, profile.safety.estimator_variance_m2
    if variance is None or variance <= most:
        return None
    advice = "is there a positioning system?"
    if profile.positioning.by == "target":
        advice = "do the positions arrive, and does the target stay in view?"
    found, allowed = distinct_figures(variance, most, 2)
    return Problem(f"variance {found} m^2, at most {allowed} allowed", advice)


def unmeasured_problem(by: MeasuredBy, profile: Profile) -> Problem | None:
    """Nothing tells the vehicle where it is: it would fly by a sum of accelerations."""
    config = profile.positioning
    if config.by != "deck" or by.placed_by(config.decks) or by.external:
        return None
    if by.external is None:
        found = "no positioning deck; whether positions come from outside is not told"
    else:
        found = "no positioning deck, and no position comes from outside"
    advice = (
        "mount a positioning deck (flow, lighthouse, loco), or set positioning: mocap or "
        "positioning: target"
    )
    others = [deck for deck in by.decks if deck not in POSITION_DECKS]
    if others:
        advice += f"; if {' or '.join(others)} measures it, name that one in positioning.decks"
    return Problem(found, advice)


def height_problem(telemetry: Telemetry, profile: Profile) -> Problem | None:
    """A vehicle that hangs, or is held, by the settled estimate."""
    safety, z_m = profile.safety, telemetry.position_m[2]
    if abs(z_m - safety.ground_z_m) <= safety.ground_tolerance_m:
        return None
    return Problem(
        f"the state estimate places the vehicle at {z_m:.2f} m, and the ground is at "
        f"{safety.ground_z_m:.2f} m",
        "if it hangs, take it down and restart it; if the positioning system's zero is "
        "elsewhere, set safety.ground_z_m",
    )


def tilt_deg(telemetry: Telemetry) -> float:
    """NaN where one of the angles is."""
    roll_rad, pitch_rad = abs(telemetry.roll_rad), abs(telemetry.pitch_rad)
    return math.degrees(max(roll_rad, pitch_rad) + 0.0 * (roll_rad + pitch_rad))


def tilt_problem(telemetry: Telemetry, profile: Profile) -> Problem | None:
    """The vehicle does not stand level enough to take off."""
    found_deg, most_deg = tilt_deg(telemetry), profile.safety.start_tilt_deg
    if found_deg <= most_deg:
        return None
    found, allowed = distinct_figures(found_deg, most_deg, 0)
    return Problem(f"tilted by {found} deg, at most {allowed} allowed", "put it on level ground")


def motion_problem(telemetry: Telemetry) -> Problem | None:
    """The vehicle is moved or vibrates: its accelerometer does not read one g."""
    if abs(telemetry.acc_z_g - 1.0) <= REST_ACC_G:
        return None
    return Problem(f"its accelerometer reads {telemetry.acc_z_g:.2f} g", "let it stand still")


def not_allowed_problem(telemetry: Telemetry) -> Problem | None:
    """The supervisor does not let it fly (yet)."""
    if telemetry.has(CAN_FLY):
        return None
    return Problem(f"0x{telemetry.supervisor:04X}", "wait, or restart it")


def too_near_problem(target: TargetEstimate | None) -> Problem | None:
    """A target that is too near to be seen from the ground."""
    if target is None or not target.tracked:
        return None
    away_m = math.hypot(*(float(e) for e in target.e_m))
    if away_m >= WITHIN_REACH_M:
        return None
    away, needed = distinct_figures(away_m, WITHIN_REACH_M, 2)
    return Problem(
        f"the target is only {away} m away, at least {needed} m are needed",
        "the vehicle hangs, or stands too close under it; take it down first",
    )
