"""Down without a heading: level, by raw thrust, on the vertical speed alone.

With a heading that is far beside the true one, position control leads away from its
setpoint, the vehicle's own landing too: it speeds up until it tilts over. Roll, pitch, height
and vertical speed do not hang on the heading, and raw thrust flies level on them.
"""

from __future__ import annotations

from dataclasses import replace

from perchctl.mission.context import Context
from perchctl.mission.release import Acted
from perchctl.vehicle import RawThrust

SINK_MPS = 0.3
DAMPING_S_PER_M = 0.15
"""Part of the hover thrust for each m/s: full thrust is 7 % over the weight at 42 g."""
INTEGRAL_PER_M = 0.1
RAMP_PER_S = 0.25
STILL_MPS = 0.05
ASTRAY_PART, ASTRAY_S = 0.88, 1.5


def can_level(c: Context) -> bool:
    """Whether height is measured, and the thrust known that carries the vehicle. A change to the
    vehicle's own landing and back costs more than a speed that is a moment old."""
    recent = c.telemetry_age_s <= c.profile.safety.telemetry_hold_s
    return c.state.hover_thrust > 0 and recent


def level_down(c: Context) -> Acted:
    """One tick. What does not sink gets less and less thrust: a hovering vehicle begins to
    sink, the ceiling lets go or proves that it holds, and the floor is proven by what carries
    the vehicle."""
    state, tel = c.state, c.obs.telemetry
    dt_s, vz = c.obs.t_s - state.t_s, tel.velocity_mps[2]
    # Learned in a climb, or not at all, the hover thrust is a few per cent beside the true one.
    hover = state.hover_thrust * (1.0 - INTEGRAL_PER_M * (vz + SINK_MPS) * dt_s)
    thrust = hover * (1.0 - DAMPING_S_PER_M * (vz + SINK_MPS))
    if vz > -STILL_MPS:
        before = state.level_thrust or hover
        thrust = min(thrust, before - RAMP_PER_S * hover * dt_s)
    # The speed of a vehicle that is astray is not its own: it sinks by a little less than hovering
    # takes, from the little height that it has, before it is let down.
    blind = state.astray and c.in_phase_s < ASTRAY_S
    thrust = max((ASTRAY_PART if blind else 0.4) * hover, min(60000.0, thrust))
    state = replace(
        state, hover_thrust=hover, level_thrust=thrust, setpoint=None, orders=0, caught=True
    )
    return state, RawThrust(int(thrust))
