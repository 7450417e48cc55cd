"""What must be true on the ground before anything spins."""

from __future__ import annotations

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

KNOWN_SUPERVISOR_BITS = 0x0FFF

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


def still_waiting_for(
    telemetry: Telemetry | None,
    has_frame: bool,
    camera_problem: str | None,
    waited_s: float,
    profile: Profile,
) -> str:
    """What is missing yet, or empty when ready. Raises TimedOut past the bound."""
    safety = profile.safety
    if telemetry is None:
        return _bounded("telemetry", waited_s, safety.estimator_wait_s)
    variance = telemetry.position_variance_m2
    if variance is not None and variance > safety.estimator_variance_m2:
        return _bounded(
            f"the state estimate to settle (variance {variance:.3g} m^2, at most "
            f"{safety.estimator_variance_m2:g} allowed; is there a positioning system?)",
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
    return ""


def _bounded(what: str, waited_s: float, limit_s: float) -> str:
    if waited_s > limit_s:
        raise TimedOut(f"waited {limit_s:.0f} s for {what}: not flying")
    return what
