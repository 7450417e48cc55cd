"""From pressed against the ceiling to hanging with the motors off, and back when it slips.

In position mode the onboard controller never goes below `thrustMin`, so a magnet that
carries half of the weight would pass for one that holds. Raw thrust goes on to where the
motors stand still while the stream lives and everything is ready to spin again
(docs/firmware.md, "Release in raw mode"): the whole weight is put on the magnet
and watched, and only then the motors are stopped.
"""

from __future__ import annotations

from perchctl.mission.context import Context
from perchctl.mission.guidance import corrected, hold_here, limited
from perchctl.mission.state import Condition, Phase, PlannerState
from perchctl.values import replace
from perchctl.vehicle import Command, Idle, PositionSetpoint, RawThrust, StopMotors

Acted = tuple[PlannerState, Command]

STILL_THRUST = 1000
"""Raw thrust at which the motors stand still and the stream lives (5000 and less)."""
UNREAD_S = 1.5
"""Longer than that the weight has to hang where the thrust is not read: orders that do not arrive
end in the firmware's cut after 2 s, and whatever was flying falls."""
THRUST_MIN = 20000
"""What position mode leaves."""
STOPS, STOP_PERIOD_S, STOP_AGAIN_S = 5, 0.1, 0.5
CATCH_STILL_ABOVE_M, CATCH_TURNING_ABOVE_M = 1.0, 0.2
"""Motors that stand still need all the thrust there is. Those that turn with most of it
would carry the vehicle back to the ceiling, beside the target's centre."""
CATCH_LEAST_S, CATCH_LIMIT_S = 0.1, 2.0
CARRIED_RATIO = 0.85
"""Of the hover thrust: what still has so much sinks, and is let sink by its own controller. More
thrust would bring it back to the ceiling, beside the target's centre."""
POSITION_GAIN_PER_S = 2.0
"""The firmware's `posCtlPid.xKp` and `yKp`."""
CAUGHT_MPS = -0.1
"""By then the thrust is above the weight, and goes on rising until the setpoint is below."""


def lower(c: Context) -> Acted:
    """Stage one: the setpoint goes down in steps, or the raw thrust where it pressed."""
    complete, perch, state = c.profile.planner.complete, c.profile.planner.perch, c.state
    step = min(complete.steps, 1 + int(c.in_phase_s / complete.release_s * complete.steps))
    part = step / complete.steps
    if perch.mode == "raw":
        if not c.imu_proves:
            return ready(c)
        # The lowest step stays below what could carry the vehicle, above the idle cut.
        lowest = 0.9 * complete.hold_ratio * state.hover_thrust
        return state, RawThrust(int(perch.thrust + part * (lowest - perch.thrust)))
    setpoint = state.setpoint or hold_here(c)
    assert state.contact_z_m is not None
    # Without a position the estimate slides, and the vehicle does not: the setpoint goes with it.
    slid_m = 0.0 if c.placed else c.obs.telemetry.position_m[2] - state.contact_z_m
    top = state.entry_m[2] + perch.press_m + slid_m
    low = state.contact_z_m - complete.release_drop_m + slid_m
    setpoint = replace(setpoint, z_m=top + part * (low - top))
    sent = limited(c, corrected(c, setpoint, lift=False))
    return replace(state, setpoint=setpoint), sent


def let_go(c: Context) -> Acted:
    """Stage two: raw thrust down to still motors, and the stop when the whole weight has hung
    long enough. Without fresh telemetry it begins anew; a landing goes on while it is only
    late, for else what hangs would end there by its own landing."""
    late_s = c.profile.safety.telemetry_hold_s if c.state.phase is Phase.LANDING else 0.0
    if not c.imu_proves and c.attitude_age_s > late_s:
        return ready(c)
    complete, state = c.profile.planner.complete, c.state
    if state.released_s is None:
        z_m = c.obs.telemetry.position_m[2]
        state = replace(state, released_s=c.obs.t_s, contact_z_m=state.contact_z_m or z_m)
    assert state.released_s is not None
    hung_s = c.held(Condition.WEIGHT_HANGS)
    unread_s = UNREAD_S if state.unread_s >= c.obs.t_s - hung_s else 0.0
    if hung_s >= complete.hang_s + unread_s:
        return stop_motors(c)
    part = min(1.0, (c.obs.t_s - state.released_s) / complete.ramp_s)
    start = c.profile.planner.perch.thrust if state.setpoint is None else THRUST_MIN
    start = min(start, THRUST_MIN)
    return state, RawThrust(int(start + part * (STILL_THRUST - start)))


def ready(c: Context) -> Acted:
    """Held by position while nothing is known: what hangs stays on about the thrust that carries
    it, what falls unseen is caught. Still motors would be a stop without a proof."""
    state, tel = c.state, c.obs.telemetry
    x, y, z_m = tel.position_m
    if state.contact_z_m is not None and c.placed:  # else the estimate has slid away from it
        z_m = state.contact_z_m
    setpoint = PositionSetpoint(x, y, z_m + CATCH_TURNING_ABOVE_M, tel.yaw_rad)
    return replace(state, setpoint=setpoint, released_s=None), limited(c, setpoint)


def is_still(c: Context) -> bool:
    """Whether the motors stand still by raw thrust: what stops them then only ends the stream
    in a way that does not lock."""
    released_s = c.state.released_s
    return released_s is not None and c.obs.t_s - released_s > c.profile.planner.complete.ramp_s


def stop_motors(c: Context) -> Acted:
    """Stop and notify, several times whatever the telemetry shows: one lost notify locks a
    vehicle that hangs well, and the pair is harmless twice. Again while there is thrust."""
    state, now_s = c.state, c.obs.t_s
    if state.stopped_s is None:
        return replace(state, stopped_s=now_s, ordered_s=now_s, orders=1), StopMotors()
    waited_s = now_s - (state.ordered_s if state.ordered_s is not None else state.stopped_s)
    still_to_send = state.orders < STOPS and waited_s >= STOP_PERIOD_S
    if still_to_send or (c.obs.telemetry.thrust >= 1 and waited_s >= STOP_AGAIN_S):
        return replace(state, ordered_s=now_s, orders=state.orders + 1), StopMotors()
    return state, Idle()


def catch_above_m(hover_thrust: float, thrust: float) -> float:
    """How far above the falling vehicle the setpoint is that stops it."""
    turning = thrust > 0.5 * hover_thrust
    return CATCH_TURNING_ABOVE_M if turning else CATCH_STILL_ABOVE_M


def is_carried(hover_thrust: float, thrust: float) -> bool:
    """Whether what slips hardly falls: most of the weight was on the motors."""
    return thrust >= CARRIED_RATIO * hover_thrust


def catch(c: Context) -> Acted | None:
    """After a slip: far above until it hardly sinks, then held where it is; None when it
    is caught, or nothing new is known of it. (A setpoint below would cost the change of mode
    its height.)"""
    state, tel = c.state, c.obs.telemetry
    if state.caught or not c.imu_proves:
        return None
    begun = c.in_phase_s < CATCH_LEAST_S
    if begun or (c.climb_mps < CAUGHT_MPS and c.in_phase_s < CATCH_LIMIT_S):
        x, y = _braked_place_m(c) if c.is_blown else state.entry_m[:2]
        setpoint = PositionSetpoint(
            x, y, tel.position_m[2] + state.catch_above_m, state.entry_yaw_rad
        )
        return replace(state, setpoint=setpoint), limited(c, setpoint)
    return None


def _braked_place_m(c: Context) -> tuple[float, float]:
    """Where a setpoint takes out the sideways speed that the vehicle has and its estimate has not:
    the position mode asks for `POSITION_GAIN_PER_S` times the way to it."""
    tel, reckoned_mps = c.obs.telemetry, c.state.reckoning.velocity_mps
    x_m, y_m = (
        tel.position_m[i] - (reckoned_mps[i] - tel.velocity_mps[i]) / POSITION_GAIN_PER_S
        for i in range(2)
    )
    return x_m, y_m


def left_contact(c: Context, below_m: float) -> Context:
    """Seen so far below the contact, it is free of the magnet."""
    contact_z_m = c.state.contact_z_m
    if contact_z_m is None or c.obs.telemetry.position_m[2] >= contact_z_m - below_m:
        return c
    return Context(replace(c.state, contact_z_m=None, contact_aside_m=None), c.obs, c.profile)
