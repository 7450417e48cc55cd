"""Why a vehicle is held in place: what is not known in this tick, and may be in the next."""

from __future__ import annotations

import math

from perchctl.mission.context import Context
from perchctl.mission.state import Phase
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint

NO_PICTURE_TEXT = "no picture for"
UNCORRECTED = "the estimate's variance only grows; is the positioning system gone?"
BLIND_VARIANCE_M2 = 0.02
"""Passed about 3 s after the last sight (docs/firmware.md, "Target as position")."""
SINK_MPS, LOWEST_M = 0.2, 0.3


def hold_reason(c: Context) -> str:
    """Why the vehicle must stay where it is in this tick, or the empty string."""
    safety = c.profile.safety
    # A take-off goes on, on what is known; without a position nothing is.
    if c.state.phase in _HOLDABLE | {Phase.APPROACH} and is_unplaced(c):
        return unplaced_text(c)
    if c.state.phase not in _HOLDABLE:
        return ""
    if c.telemetry_age_s > safety.telemetry_hold_s:
        return f"telemetry is {c.telemetry_age_s:.1f} s old"
    if c.state.jump_s is not None:
        return "the state estimate jumped"
    if c.variance_m2 > safety.flight_variance_m2:
        return f"the state estimate is unsure (variance {c.variance_m2:.2g} m^2)"
    if c.obs.loop_late_s > safety.loop_late_hold_s:
        return f"the control loop is {c.obs.loop_late_s:.1f} s late"
    if c.state.phase in _CAMERA_PHASES and c.obs.camera_age_s > safety.camera_hold_s:
        return c.obs.camera_problem or f"{NO_PICTURE_TEXT} {c.obs.camera_age_s:.1f} s"
    return ""


def is_unplaced(c: Context) -> bool:
    """No position from outside is fresh (fault 10)."""
    return c.position_age_s > c.profile.positioning.hold_s


def is_lost(c: Context) -> bool:
    """No position has come for so long that none is waited for any more: by the age of the last
    one, and of the target's, whose loss leaves nothing but the gyroscope, by the estimate's own
    variance too."""
    if c.position_age_s > c.profile.positioning.land_s or c.is_blown:
        return True
    return c.by_sight and is_unplaced(c) and c.variance_m2 > BLIND_VARIANCE_M2


def sinking(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The held setpoint, a tick later: without a sight of the target it sinks, since the camera's
    cone opens upwards, and from lower down the target is soonest seen again."""
    if not (c.by_sight and is_unplaced(c)) or c.state.ground_m is None:
        return setpoint
    lowest_m = min(setpoint.z_m, c.state.ground_m[2] + LOWEST_M)
    z_m = setpoint.z_m - SINK_MPS * max(0.0, c.obs.t_s - c.state.t_s)
    return replace(setpoint, z_m=max(lowest_m, z_m))


def unplaced_text(c: Context) -> str:
    """For how long none was sent, and why."""
    if c.is_blown:
        return "pushed aside while the target was not seen"
    age_s, why = c.position_age_s, c.obs.position_problem
    if c.profile.positioning.by == "deck":
        why = why or UNCORRECTED
    text = f"no position for {age_s:.1f} s" if math.isfinite(age_s) else "no position has come"
    return f"{text}: {why}" if why else text


_CAMERA_PHASES = frozenset({Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND})
_HOLDABLE = _CAMERA_PHASES | {Phase.RECOVER}
