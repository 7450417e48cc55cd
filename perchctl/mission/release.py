"""What happens at the ceiling: a press, its end, the release onto the magnet, a stop and a catch.

In position mode the onboard controller never goes below `LEAST_POSITION_THRUST`. Raw thrust goes on
to where the motors stand still (docs/firmware.md, "Release in raw mode"): the whole weight is put
on the magnet and monitored, and only then the motors are stopped.
"""

from __future__ import annotations

from perchctl.mission.belief.contact import WEIGHT_HANGS, exceeds_hover_thrust
from perchctl.mission.belief.thrust import LEAST_POSITION_THRUST
from perchctl.mission.belief.update import STILL_THRUST
from perchctl.mission.context import Context
from perchctl.mission.setpoints import (
    Action,
    correct_setpoint,
    hold_here,
    limit_setpoint,
)
from perchctl.mission.state import PlannerState
from perchctl.values import replace
from perchctl.vehicle import Idle, PositionSetpoint, RawThrust, StopMotors

# --- the end of a press ---
CONTACT_LEFT_M = 0.08
"""So far below what it pressed against, the vehicle has left it."""
PULLED_MPS = -0.3
"""Vertical speed at which it falls off: then the setpoint is where it is."""
UNWIND_M = 1.0
"""Distance of the setpoint below a vehicle that still presses, to unwind the onboard integrators.
Smaller: they take seconds."""
UNWIND_AWAY_M = 0.25
"""The same once it has left. Larger: it falls."""
UNPRESS_LIMIT_S = 4.0
"""After this time `leave_press` ends, whether or not the vehicle has come away."""

# --- the release ---
LOWEST_PART = 0.9
"""Share of the holding thrust down to which a press by raw thrust is lowered."""
UNREAD_S = 1.5
"""Longer hang if the thrust is not read as ordered."""

# --- the stop ---
STOPS = 5
"""Orders to stop: a lost notify locks a hanging vehicle."""
STOP_PERIOD_S = 0.1
"""Time between them."""
STOP_AGAIN_S = 0.5
"""Time after which one more is sent while the telemetry shows thrust."""

# --- the catch ---
CATCH_STILL_ABOVE_M = 1.0
"""Distance of the setpoint above a falling vehicle whose motors stand still."""
CATCH_TURNING_ABOVE_M = 0.2
"""The same of motors that turn: by all the thrust there is they would carry it to the ceiling."""
TURNING_PART = 0.5
"""Share of hover thrust above which the motors turn."""
CATCH_LEAST_S = 0.1
"""Bounds of a catch's time."""
CATCH_LIMIT_S = 2.0
CATCH_END_MPS = -0.1
"""The catch ends once the vehicle sinks more slowly than this: the thrust is above the weight
then."""
MOST_BRAKED_MPS = 1.0
"""No blow that the vehicle survives leaves more speed."""
POSITION_GAIN_PER_S = 2.0
"""The firmware's `posCtlPid.xKp` and `yKp`."""


def leave_press(c: Context) -> tuple[PlannerState, PositionSetpoint | None]:
    """The state, and a setpoint below the vehicle until it is away from what it pressed against and
    the onboard integrators have come down; None after that, or if nothing was pressed."""
    state, tel = c.state, c.telemetry
    x, y, z = state.entry.position_m
    if not state.pressed:
        return state, None
    away_m = z - tel.position_m[2]
    calm = (
        away_m > CONTACT_LEFT_M
        and not exceeds_hover_thrust(c.belief)
        and tel.velocity_mps[2] > PULLED_MPS
    )
    if calm or c.in_phase_s > UNPRESS_LIMIT_S:
        return replace(state, pressed=False), None
    below_m = UNWIND_M if away_m < CONTACT_LEFT_M else UNWIND_AWAY_M
    if tel.velocity_mps[2] < PULLED_MPS:
        below_m = 0.0
    dx, dy = state.integral_m
    setpoint = PositionSetpoint(x + dx, y + dy, tel.position_m[2] - below_m, state.entry.yaw_rad)
    return state, limit_setpoint(c, setpoint)


def lower_thrust(c: Context) -> Action:
    """The release's first stage: lower the setpoint, or a press's raw thrust, in steps."""
    complete, perch, state, b = c.planner.complete, c.planner.perch, c.state, c.belief
    step = min(complete.steps, 1 + int(c.in_phase_s / complete.release_s * complete.steps))
    part = step / complete.steps
    if perch.mode == "raw":
        if not b.imu_proves:
            return hold_by_position(c)
        lowest = LOWEST_PART * complete.hold_ratio * b.hover_thrust
        return state, RawThrust(int(perch.thrust + part * (lowest - perch.thrust)))
    setpoint = state.setpoint or hold_here(c)
    assert b.contact_z_m is not None
    slid_m = 0.0 if b.position_valid else c.telemetry.position_m[2] - b.contact_z_m
    top = state.entry.position_m[2] + perch.press_m + slid_m
    low = b.contact_z_m - complete.release_drop_m + slid_m
    setpoint = replace(setpoint, z_m=top + part * (low - top))
    sent = limit_setpoint(c, correct_setpoint(c, setpoint, lift=False))
    return replace(state, setpoint=setpoint), sent


def release_by_thrust(c: Context, *, late_s: float = 0.0) -> Action:
    """The release's second stage: raw thrust down to still motors, and the stop when the whole
    weight has hung long enough. Telemetry that is no proof, and older than `late_s`, restarts the
    stage."""
    complete, state, b = c.planner.complete, c.state, c.belief
    if not b.imu_proves and b.attitude_age_s > late_s:
        return hold_by_position(c)
    released_s = state.released_s
    if released_s is None:
        released_s, z_m = c.t_s, c.telemetry.position_m[2]
        b = replace(b, contact_z_m=z_m if b.contact_z_m is None else b.contact_z_m)
        state = replace(state, released_s=released_s, belief=b)
    hung_s = c.held_s(WEIGHT_HANGS)
    unread_s = UNREAD_S if b.unread_s >= c.t_s - hung_s else 0.0
    if hung_s >= complete.hang_s + unread_s:
        return stop_motors(c)
    part = min(1.0, (c.t_s - released_s) / complete.ramp_s)
    start = c.planner.perch.thrust if state.setpoint is None else LEAST_POSITION_THRUST
    start = min(start, LEAST_POSITION_THRUST)
    return state, RawThrust(int(start + part * (STILL_THRUST - start)))


def hold_by_position(c: Context) -> Action:
    """Hold by position while telemetry is old, to stay in contact or to catch an unseen fall."""
    state, tel, b = c.state, c.telemetry, c.belief
    x, y, z_m = tel.position_m
    if b.contact_z_m is not None and b.position_valid:
        z_m = b.contact_z_m
    setpoint = PositionSetpoint(x, y, z_m + CATCH_TURNING_ABOVE_M, tel.yaw_rad)
    return replace(state, setpoint=setpoint, released_s=None), limit_setpoint(c, setpoint)


def motors_are_still(c: Context) -> bool:
    """True if raw thrust has brought the motors to a stop."""
    released_s = c.state.released_s
    return released_s is not None and c.t_s - released_s > c.planner.complete.ramp_s


def stop_motors(c: Context) -> Action:
    """Send stop and notify `STOPS` times, since a lost notify locks a hanging vehicle; send more
    while telemetry shows thrust."""
    state, now_s = c.state, c.t_s
    if state.stopped_s is None:
        return replace(state, stopped_s=now_s, ordered_s=now_s, orders=1), StopMotors()
    waited_s = now_s - (state.ordered_s if state.ordered_s is not None else state.stopped_s)
    still_to_send = state.orders < STOPS and waited_s >= STOP_PERIOD_S
    if still_to_send or (c.telemetry.thrust >= 1 and waited_s >= STOP_AGAIN_S):
        return replace(state, ordered_s=now_s, orders=state.orders + 1), StopMotors()
    return state, Idle()


def catch_goal_above_m(hover_thrust: float, thrust: float) -> float:
    """How far above a falling vehicle its setpoint must be, by its present `thrust`."""
    turning = thrust > TURNING_PART * hover_thrust
    return CATCH_TURNING_ABOVE_M if turning else CATCH_STILL_ABOVE_M


def catch_slip(c: Context) -> Action | None:
    """The setpoint far above that stops a slip; None after the fall, or with old telemetry."""
    state, tel, b = c.state, c.telemetry, c.belief
    if state.catch_above_m is None or not b.imu_proves:
        return None
    begun = c.in_phase_s < CATCH_LEAST_S
    if begun or (b.climb_mps < CATCH_END_MPS and c.in_phase_s < CATCH_LIMIT_S):
        x, y = _braked_place_m(c) if b.is_displaced else state.entry.position_m[:2]
        setpoint = PositionSetpoint(
            x, y, tel.position_m[2] + state.catch_above_m, state.entry.yaw_rad
        )
        return replace(state, setpoint=setpoint), limit_setpoint(c, setpoint)
    return None


def _braked_place_m(c: Context) -> tuple[float, float]:
    """The setpoint that takes out a sideways speed which the estimate misses."""
    tel, reckoned_mps = c.telemetry, c.belief.reckoning.velocity_mps
    missed_mps = (reckoned_mps[i] - tel.velocity_mps[i] for i in range(2))
    x_mps, y_mps = (max(-MOST_BRAKED_MPS, min(MOST_BRAKED_MPS, mps)) for mps in missed_mps)
    x_m, y_m, _ = tel.position_m
    return x_m - x_mps / POSITION_GAIN_PER_S, y_m - y_mps / POSITION_GAIN_PER_S


def clear_contact_below(state: PlannerState, below_m: float) -> PlannerState:
    """The state; without its contact if the vehicle is more than `below_m` below the contact."""
    b = state.belief
    if b.contact_z_m is None or b.telemetry.position_m[2] >= b.contact_z_m - below_m:
        return state
    return replace(state, belief=replace(b, contact_z_m=None, contact=None))
