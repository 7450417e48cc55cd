"""Down without a heading: level, by raw thrust, on the vertical speed alone.

With a heading that is far beside the true one, position control leads away from its
setpoint, the vehicle's own landing too: it speeds up until it tilts over. Roll, pitch, height
and vertical speed do not hang on the heading, and raw thrust flies level on them.

Where positions from outside have led astray, nothing of the estimate counts, its vertical speed
least: it may be another axis'. Then the accelerometer alone tells how fast it sinks
(`felt_climb_mps`), for the second or two that such a way down takes.
"""

from __future__ import annotations

import math

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.context import Context
from perchctl.mission.release import Acted
from perchctl.values import replace
from perchctl.vehicle import RawThrust

SINK_MPS = 0.3
BLIND_SINK_MPS, BLIND_SPARE_S = 0.5, 1.0
"""Aside it goes with the third power of the time, by the gyroscope's bias: 2 m in 4 s."""
DAMPING_S_PER_M = 0.15
"""Part of the hover thrust for each m/s: full thrust is 7 % over the weight at 42 g."""
INTEGRAL_PER_M = 0.1
RAMP_PER_S = 0.25
STILL_MPS = 0.05
BRAKE_RAD_PER_MPS, MOST_BRAKE_RAD = 0.12, 0.14
"""Sideways speed goes down by 1/e in 0.85 s, several times the age of what is known of it; so much
tilt takes 1 % of the thrust."""
FELT_S = 1.0
"""In so long the estimate draws the felt speed to its own, which takes out the accelerometer's
offset: without it 0.2 m/s^2 would be 0.4 m/s in two seconds."""
UNFELT_S = 0.1
ASTRAY_S = 2.5
"""For so long the felt speed is believed, and longer from higher up; then the thrust only falls."""
ASTRAY_ABOVE_M, ASTRAY_MEAN_MPS, ASTRAY_LONGEST_S = 0.5, 0.5, 10.0
VERTICAL_ABOVE_M, VERTICAL_MPS = 0.3, 0.2
"""Risen so far by the estimate, with a speed so near to the felt one, its vertical is the true one:
the axes are swapped in the plane alone."""
ASTRAY_SINK_MPS2, ASTRAY_MOST_MPS = 0.15, 0.6
"""It is to sink the faster the longer it takes, so that a felt speed that has drifted does not
keep it up, and never as fast as what counts as a fall (1 m/s)."""
ASTRAY_GAIN_S_PER_M = 0.5
ASTRAY_LEAST, ASTRAY_MOST = 0.5, 1.05


def can_level(c: Context) -> bool:
    """Whether height is measured, and the thrust known that carries the vehicle. A change to the
    vehicle's own landing and back costs more than a speed that is a moment old."""
    recent = c.telemetry_age_s <= c.profile.safety.telemetry_hold_s
    return c.state.hover_thrust > 0 and recent


def felt_climb_mps(c: Context) -> float:
    """By the accelerometer since the tick before, m/s upwards: drawn to the estimate's speed
    while that is believed, from its last value on alone once it is astray. Where samples are
    missing it begins anew with the estimate's, or stays."""
    state, tel, last = c.state, c.obs.telemetry, c.state.last
    estimated_mps = tel.velocity_mps[2]
    if last is None:
        return estimated_mps
    dt_s = tel.t_s - last.t_s
    if not 0.0 < dt_s <= UNFELT_S:
        return state.felt_mps if state.astray or dt_s <= 0.0 else estimated_mps
    up_g = 0.5 * (tel.acc_z_g + last.acc_z_g) * math.cos(c.tilt_rad) - 1.0
    felt_mps = state.felt_mps + GRAVITY_MPS2 * up_g * dt_s
    if state.astray and state.felt_alone:
        return felt_mps
    return felt_mps + (estimated_mps - felt_mps) * dt_s / FELT_S


def is_felt_alone(c: Context) -> bool:
    """Whether nothing but the accelerometer tells how fast it sinks, as it is found astray."""
    apart_mps = abs(c.state.felt_mps - c.obs.telemetry.velocity_mps[2])
    return not (c.height_m > VERTICAL_ABOVE_M and apart_mps < VERTICAL_MPS)


def _believed_s(c: Context) -> float:
    ground_m = c.state.ground_m[2] if c.state.ground_m else 0.0
    above_m = max(0.0, c.state.entry_m[2] - ground_m - ASTRAY_ABOVE_M)
    return min(ASTRAY_S + above_m / ASTRAY_MEAN_MPS, ASTRAY_LONGEST_S)


def _is_overdue(c: Context) -> bool:
    """Blind for so long, it has come down, or hangs, or its estimated speed has drifted away."""
    if c.state.blind_s is None or c.placed:
        return False
    ground_m = c.state.ground_m[2] if c.state.ground_m else 0.0
    lasts_s = BLIND_SPARE_S + max(0.0, c.state.entry_m[2] - ground_m) / BLIND_SINK_MPS
    # What hung on the magnet, and slipped, begins anew.
    return c.obs.t_s - max(c.state.blind_s, c.state.entered_s) > lasts_s


def astray_down(c: Context) -> Acted:
    """One tick, by what is felt. The hover thrust stays what it was when it began: nothing could
    teach a better one."""
    state, hover = c.state, c.state.hover_thrust
    sink_mps = min(SINK_MPS + ASTRAY_SINK_MPS2 * c.in_phase_s, ASTRAY_MOST_MPS)
    part = 1.0 - ASTRAY_GAIN_S_PER_M * (state.felt_mps + sink_mps)
    thrust = hover * max(ASTRAY_LEAST, min(ASTRAY_MOST, part))
    if c.in_phase_s >= _believed_s(c):
        before = min(state.level_thrust or hover, hover)
        thrust = max(0.4 * hover, before - RAMP_PER_S * hover * (c.obs.t_s - state.t_s))
    thrust = min(60000.0, thrust)
    state = replace(state, level_thrust=thrust, setpoint=None, orders=0, caught=True)
    return state, RawThrust(int(thrust))


def level_down(c: Context) -> Acted:
    """One tick. What does not sink gets less and less thrust: a hovering vehicle begins to
    sink, the ceiling lets go or proves that it holds, and the floor is proven by what carries
    the vehicle."""
    state, tel = c.state, c.obs.telemetry
    if state.astray:
        return astray_down(c)
    dt_s, vz = c.obs.t_s - state.t_s, tel.velocity_mps[2]
    sink_mps = SINK_MPS if state.blind_s is None else BLIND_SINK_MPS
    # Learned in a climb, or not at all, the hover thrust is a few per cent beside the true one.
    hover = state.hover_thrust * (1.0 - INTEGRAL_PER_M * (vz + sink_mps) * dt_s)
    thrust = hover * (1.0 - DAMPING_S_PER_M * (vz + sink_mps))
    if vz > -STILL_MPS or _is_overdue(c):
        before = state.level_thrust or hover
        thrust = min(thrust, before - RAMP_PER_S * hover * dt_s)
    thrust = max(0.4 * hover, min(60000.0, thrust))
    state = replace(
        state, hover_thrust=hover, level_thrust=thrust, setpoint=None, orders=0, caught=True
    )
    roll_rad, pitch_rad = _braking(c)
    return state, RawThrust(int(thrust), roll_rad, pitch_rad)


def _braking(c: Context) -> tuple[float, float]:
    """Roll and pitch against the sideways speed, where that is known: the target is seen again,
    and the heading is not what was lost. Else level."""
    tel = c.obs.telemetry
    if c.state.heading_lost or not (c.placed and c.proves):
        return 0.0, 0.0
    cos, sin = math.cos(tel.yaw_rad), math.sin(tel.yaw_rad)
    x_mps, y_mps, _ = tel.velocity_mps
    ahead_mps, left_mps = x_mps * cos + y_mps * sin, y_mps * cos - x_mps * sin
    return _against(-left_mps), _against(ahead_mps)


def _against(mps: float) -> float:
    return max(-MOST_BRAKE_RAD, min(MOST_BRAKE_RAD, -BRAKE_RAD_PER_MPS * mps))
