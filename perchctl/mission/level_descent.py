"""The descent by raw thrust: level, on the vertical speed alone, for a vehicle without a position.

With the hover thrust T_h, the climb v (by accelerometer where no position shows it), the climb u
that orders have given and no sample shows yet, and the wanted sink s,

    T = T_h (1 - k (v + u + s)) / cos(tilt)

is a proportional rate controller; k falls with the age of v, or the vehicle would swing. Where the
telemetry is old and the target is seen, v is the climb that pictures show.
What does not sink gets less and less thrust: it sinks, the magnet lets go, or the floor proves
itself. Sideways the vehicle leans against the wind and brakes (`_braking`).
"""

from __future__ import annotations

import math

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.belief import hover
from perchctl.mission.belief.contact import MOST_RAW
from perchctl.mission.belief.reckoning import BIAS_MEMORY_S
from perchctl.mission.belief.target import SEEN_MEMORY_S, TargetMotion
from perchctl.mission.context import Context
from perchctl.mission.release import clear_contact_below
from perchctl.mission.setpoints import Action
from perchctl.mission.state import PlannerState
from perchctl.values import replace
from perchctl.vehicle import RawThrust

LEVEL_SINK_MPS = 0.7
"""Wanted sink. By the gyroscope's offset the vehicle goes 2 m sideways in 4 s: larger lands harder
where the floor is unseen, smaller farther aside."""
LOW_SINK_MPS = 0.4
"""The same near the floor."""
SLOW_BELOW_M = 0.6
"""Height below which it sinks slower."""
MOST_GAIN_S_PER_M = 0.5
"""Part of the hover thrust for each m/s. Larger: it swings."""
LEAST_GAIN_S_PER_M = 0.2
"""The least of it, by old telemetry."""
GAIN_AGE_S2_PER_M = 0.06
"""Gain times age of the telemetry, between the two."""
UNHEARD_PART = 0.98
"""Share of the thrust that lets it come down without a vertical speed."""
SEEN_SINK_MPS = 0.4
"""Wanted sink by pictures, which do not show how far the floor is. Larger: it lands harder.
Smaller: it drifts aside for longer."""
SEEN_LEAST_SINK_MPS = 0.2
"""Sink by pictures below which it does not sink; single detections are off by half of that."""
BRAKE_BY_TARGET_RAD_PER_MPS = 0.15
"""Lean against a sideways speed that pictures show. Larger: it swings, since what it leans looks
like a way, too. Smaller: it drifts farther aside."""
ON_THE_SPOT_S = 0.6
"""Time by setpoints at one place after which no speed is left."""
RAMP_PER_S = 0.25
"""Share of the hover thrust by which what does not sink gets less, each second. Larger: the floor
is met faster. Smaller: a magnet holds it for longer."""
SEEN_RAMP_PER_S = 0.1
"""The same by pictures, which show a sink only after a quarter of a second. Larger: it falls at
first. Smaller: it stands on the floor for longer with turning motors."""
LEAST_SINK_MPS = 0.05
"""Sink below which it does not sink."""
LEAST_ORDERED_PART = 0.4
"""Share of the hover thrust below which no thrust is ordered."""
LEAST_COSINE = 0.8
"""Bound of the tilt that the thrust makes up for."""
BRAKE_RAD_PER_MPS = 0.25
"""Lean against a sideways speed."""
MOST_BRAKE_RAD = 0.22
"""The most of that; it takes 2.5 % of the thrust."""
MOST_LEAN_RAD = 0.2
"""Against a wind of 6 m/s. Larger: a blow, or a wrong bias, throws the vehicle aside."""
BRAKED_AGE_S = 0.2
"""An older speed is braked less, or it swings."""
UNSURE_MPS = 0.05
"""Sideways speed that is not known at the loss of the position."""
UNSURE_MPS2 = 0.1
"""The same for each second since: an attitude error of 0.01 rad adds 0.1 m/s each second."""
MOST_UNSURE_MPS = 0.3
"""The most of it."""
LEVEL_FELT_S = 6.0
"""Time after which the attitude error that pictures have shown is not the present one."""
CARRIED_G = 0.95
"""Specific force from which on something carries a vehicle whose thrust is small."""
CARRIED_PART = 0.88
"""Share of the hover thrust up to which its thrust is small."""
AIRBORNE_G = 0.85
"""Specific force below which it is in the air, however long it has come down."""
TOUCH_PART = 0.5
"""Share of the hover thrust right after the floor was felt."""
TOUCH_S = 0.25
"""Time for which that lasts, and within which a blow belongs to it."""
TOUCH_BELOW_M = 0.7
"""Height below which a blow from below is the floor's."""
LEVEL_SPARE_S = 2.0
"""Time beyond the way down's own after which it has come down, or hangs."""
UNHEARD_SPARE_S = 0.8
"""The same without a vertical speed."""
OWN_ESTIMATE_S = 1.5
"""Time for which a vehicle that is not heard, and whose hover thrust is known only roughly, comes
down by its own estimate."""
LEVEL_MEAN_MPS = 0.35
"""Mean speed of the way down, at least."""
PEELED_M = 0.1
"""The magnet has let go of a vehicle that is this far below its contact. Larger: one that has come
off still seems to hang. Smaller: a drifting estimate lets one go that hangs."""
SEEN_BELOW_M = 0.2
"""The same by pictures with an old attitude. Larger: it drifts aside for longer until it brakes.
Smaller: a target seen at an angle counts as one above."""
SEEN_STANDING_PART = 0.75
"""Share of the hover thrust at which a vehicle that pictures show still stands: in the air it would
sink by a metre a second. Larger: a slow start of the descent is taken for the floor. Smaller: its
motors turn on the floor for longer."""
MOST_STEP_S = 0.1
"""Longest step between two ticks that the ramp counts."""


def _seen_motion(c: Context) -> TargetMotion | None:
    """The motion that pictures show, if the telemetry is old and they are newer."""
    b, seen = c.belief, c.belief.target_motion
    old = b.attitude_age_s > c.safety.telemetry_hold_s
    return seen if old and seen.is_known and seen.t_s > b.telemetry.t_s else None


def _is_seen_again(c: Context) -> bool:
    """True if the telemetry is old, and the target is detected again but not for long enough to
    tell the motion."""
    b, seen = c.belief, c.belief.target_motion
    old = b.attitude_age_s > c.safety.telemetry_hold_s
    return old and not seen.is_known and seen.t_s > max(b.telemetry.t_s, c.state.entry.t_s)


def _measured_s(c: Context) -> float:
    """When the vertical speed was measured, by telemetry or pictures."""
    seen = _seen_motion(c)
    return c.telemetry.t_s if seen is None else seen.t_s - SEEN_MEMORY_S


def _is_unmeasured(c: Context) -> bool:
    """True if telemetry and pictures are too old to tell the vertical speed."""
    return _age_s(c) > hover.LATEST_S


def _step_s(c: Context) -> float:
    """Time since the tick before, as far as it counts."""
    return max(0.0, min(MOST_STEP_S, c.t_s - c.state.t_s))


def _age_s(c: Context) -> float:
    """Age of the vertical speed, a tick at least."""
    return max(1e-3, _step_s(c), c.t_s - _measured_s(c))


def waits_for_its_own_estimate(c: Context) -> bool:
    """True if the vertical speed is not measured, and the hover thrust is known only roughly: for a
    while setpoints are better."""
    begins_rough = c.state.descent.thrust == 0.0 and c.belief.hover.is_rough
    return _is_unmeasured(c) and begins_rough and c.in_phase_s < OWN_ESTIMATE_S


def descend_level(c: Context) -> Action:
    """Sink level by raw thrust on the vertical speed, tilted against the sideways speed."""
    state, descent, tel, b = c.state, c.state.descent, c.telemetry, c.belief
    dt_s, age_s, measured_s = _step_s(c), _age_s(c), _measured_s(c)
    measured_mps = _measured_climb_mps(c)
    climb_mps = measured_mps + descent.under_way_mps
    sinks, ramp_per_s = climb_mps <= -LEAST_SINK_MPS, RAMP_PER_S
    if _seen_motion(c) is not None:  # on the floor the orders under way give no climb
        sinks, ramp_per_s = measured_mps <= -SEEN_LEAST_SINK_MPS, SEEN_RAMP_PER_S
    hover_thrust = hover.best_estimate(b).thrust
    height_m = b.height_m if b.dead_reckoned_s is None else b.reckoned_height_m
    height_m += min(0.0, climb_mps) * age_s
    thrust = _rate_thrust(c, hover_thrust, climb_mps, height_m)
    if age_s > hover.LATEST_S:
        thrust *= UNHEARD_PART
    floor_felt_s = _floor_felt_s(c, hover_thrust, height_m, sinks=sinks)
    touched_s = math.inf if floor_felt_s is None else c.t_s - floor_felt_s
    # In the air the accelerometer reads what the thrust gives, on the floor one g.
    falls = b.imu_proves and tel.acc_z_g < 0.5 * (1.0 + tel.thrust / hover_thrust)
    if touched_s >= TOUCH_S and falls:
        floor_felt_s = None  # it falls with its thrust: that was no floor
    carried = b.imu_proves and tel.acc_z_g > CARRIED_G and tel.thrust < CARRIED_PART * hover_thrust
    overdue = _is_overdue(c) and not (b.imu_proves and tel.acc_z_g < AIRBORNE_G)
    before = descent.thrust or hover_thrust
    if touched_s < TOUCH_S:
        thrust = TOUCH_PART * hover_thrust
    elif _is_seen_again(c):
        thrust = before
    elif floor_felt_s is not None or carried or not sinks or overdue:
        thrust = min(thrust, before - ramp_per_s * hover_thrust * dt_s)
    thrust = max(LEAST_ORDERED_PART * hover_thrust, min(MOST_RAW, thrust))
    # The speed that orders have given since the newest sample.
    shown_s = 0.0 if b.last is None else max(0.0, measured_s - descent.sample_s)
    gained_mps = GRAVITY_MPS2 * (thrust / hover_thrust - 1.0) * dt_s
    under_way_mps = descent.under_way_mps * max(0.0, 1.0 - shown_s / age_s) + gained_mps
    state = _clear_contact_after_fall(c)
    state = replace(
        state,
        descent=replace(
            descent,
            thrust=thrust,
            floor_felt_s=floor_felt_s,
            under_way_mps=under_way_mps,
            sample_s=measured_s,
        ),
        setpoint=None,
        orders=0,
        catch_above_m=None,
    )
    roll_rad, pitch_rad = (0.0, 0.0) if floor_felt_s is not None else _braking(c)
    return state, RawThrust(int(thrust), roll_rad, pitch_rad)


def _measured_climb_mps(c: Context) -> float:
    """The vertical speed as it was measured last, by telemetry or pictures; 0 where setpoints held
    the vehicle at one place since the last telemetry."""
    seen = _seen_motion(c)
    if seen is not None:
        return seen.velocity_mps[2]
    held = c.telemetry.t_s < c.state.entry.t_s - ON_THE_SPOT_S
    return 0.0 if held else c.belief.climb_mps


def _floor_felt_s(c: Context, hover_thrust: float, height_m: float, *, sinks: bool) -> float | None:
    """When the floor was first felt: by a blow from below while it sank, or by pictures that show
    it stand on a thrust which does not carry it."""
    descent, b, seen = c.state.descent, c.belief, _seen_motion(c)
    if descent.floor_felt_s is not None:
        return descent.floor_felt_s
    struck = c.t_s - b.imu.blow_s < TOUCH_S and b.reckoning.struck_mps < 0.0
    weak = 0.0 < descent.thrust < SEEN_STANDING_PART * hover_thrust
    stands = seen is not None and seen.e_m[2] > SEEN_BELOW_M and weak and not sinks
    return c.t_s if stands or (struck and height_m < TOUCH_BELOW_M) else None


def _rate_thrust(c: Context, hover_thrust: float, climb_mps: float, height_m: float) -> float:
    """The rate controller's thrust, by the equation above."""
    b = c.belief
    # Late pictures may show the floor half a metre too far.
    low = height_m <= SLOW_BELOW_M or b.mismatch.later_s != 0.0
    sink_mps = LOW_SINK_MPS if low else LEVEL_SINK_MPS
    if _seen_motion(c) is not None:
        sink_mps = SEEN_SINK_MPS
    gain = GAIN_AGE_S2_PER_M / max(1e-3, c.t_s - _measured_s(c))
    gain = max(LEAST_GAIN_S_PER_M, min(MOST_GAIN_S_PER_M, gain))
    tilt = max(LEAST_COSINE, math.cos(b.tilt_rad))
    return hover_thrust * (1.0 - gain * (climb_mps + sink_mps)) / tilt


def _clear_contact_after_fall(c: Context) -> PlannerState:
    """The state; without its contact once a position or pictures show the vehicle lower, or after a
    fall."""
    state, b, seen = c.state, c.belief, _seen_motion(c)
    if b.position_valid and b.dead_reckoned_s is None:
        return clear_contact_below(state, PEELED_M)
    reach_s = b.reach_s
    fell = reach_s is not None and b.imu.fell_s > max(reach_s, state.entry.t_s)
    if fell or (seen is not None and seen.e_m[2] > SEEN_BELOW_M):
        belief = replace(
            b,
            contact_z_m=None,
            reach_s=None,
            reckoning=replace(b.reckoning, below_m=math.inf),
            dead_reckoned_s=None if b.dead_reckoned_s is None else c.t_s,
        )
        return replace(state, belief=belief)
    return state


def _is_overdue(c: Context) -> bool:
    """True if it was without a position for so long that it has come down, or hangs."""
    state, b = c.state, c.belief
    if b.dead_reckoned_s is None and not b.diverged:
        return False
    way_m = max(0.0, state.entry.position_m[2] - b.ground_z_m)
    began_s = max(b.dead_reckoned_s or 0.0, state.entry.t_s)
    measured = c.t_s - _measured_s(c) <= hover.LATEST_S
    spare_s = LEVEL_SPARE_S if measured else UNHEARD_SPARE_S
    if not measured and b.hover.is_rough:
        spare_s += OWN_ESTIMATE_S
    return c.t_s - began_s > spare_s + way_m / LEVEL_MEAN_MPS


def _braking(c: Context) -> tuple[float, float]:
    """Roll and pitch that stand against the wind and brake the sideways speed; level without a
    heading.

    The thrust acts along the body's z axis, so what the accelerometer reads across it is the air's
    force w, m/s2. Level thrust g tan(tilt) has to give -w, and the estimated attitude is off by
    b / g, where b is the excess of accelerometer and attitude: the estimated lean is (b - w) / g.
    Both are the means of the time in which a position was known, and an offset of the
    accelerometer is in both. What it reads now does not count: most of that is the drag of the
    vehicle's own motion, which brakes it. Means of a shorter time than `BIAS_MEMORY_S` count less,
    and those by wrong positions not at all: there the bias counts that pictures have shown lately.
    """
    b = c.belief
    if b.heading_lost or b.is_in_magnet_reach:
        return 0.0, 0.0
    reckoning, yaw_rad = b.reckoning, c.telemetry.yaw_rad
    x_mps, y_mps, _ = reckoning.velocity_mps
    speed_mps = max(1e-6, math.hypot(x_mps, y_mps))
    blind_s = 0.0 if b.dead_reckoned_s is None else c.t_s - b.dead_reckoned_s
    felt_s = math.inf if c.obs.felt is None else c.t_s - c.obs.felt.t_s
    unsure_mps = min(MOST_UNSURE_MPS, UNSURE_MPS + UNSURE_MPS2 * min(blind_s, felt_s))
    part = max(0.0, 1.0 - unsure_mps / speed_mps)
    part *= min(1.0, BRAKED_AGE_S / max(1e-3, b.attitude_age_s))
    ahead_mps, left_mps = _in_heading(part * x_mps, part * y_mps, yaw_rad)
    seen, gain = _seen_motion(c), BRAKE_RAD_PER_MPS
    if seen is not None and b.camera_is_proven:
        (ahead_mps, left_mps, _), gain = seen.velocity_mps, BRAKE_BY_TARGET_RAD_PER_MPS
    (bias_x_mps2, bias_y_mps2, _), (x_mps2, y_mps2) = (
        reckoning.bias_mps2,
        reckoning.mean_lateral_mps2,
    )
    known = 0.0 if b.diverged else min(1.0, reckoning.held_s / BIAS_MEMORY_S)
    counts = known + (1.0 - known) * max(0.0, 1.0 - felt_s / LEVEL_FELT_S)
    ahead_mps2, left_mps2 = _in_heading(
        counts * bias_x_mps2 - known * x_mps2, counts * bias_y_mps2 - known * y_mps2, yaw_rad
    )
    roll_rad, pitch_rad = c.obs.imu.misled_rad
    return (
        _against(-left_mps, gain) - _lean_rad(left_mps2) + roll_rad,
        _against(ahead_mps, gain) + _lean_rad(ahead_mps2) + pitch_rad,
    )


def _in_heading(x: float, y: float, yaw_rad: float) -> tuple[float, float]:
    """World x and y as ahead and left of a vehicle with this heading."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return x * cos + y * sin, y * cos - x * sin


def _lean_rad(mps2: float) -> float:
    return max(-MOST_LEAN_RAD, min(MOST_LEAN_RAD, math.atan(mps2 / GRAVITY_MPS2)))


def _against(mps: float, rad_per_mps: float) -> float:
    return max(-MOST_BRAKE_RAD, min(MOST_BRAKE_RAD, -rad_per_mps * mps))
