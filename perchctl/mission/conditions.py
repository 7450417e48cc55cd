"""The named conditions that the mission's table debounces.

A condition is true or false in one tick; `PlannerState.since` holds since when it has been
true without a break, and `Context.held(name)` tells for how long.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from perchctl.mission.context import Context
from perchctl.mission.state import Condition, Phase
from perchctl.profile import Profile
from perchctl.vehicle import FULL_THRUST

DESCENDED_M, HELD_WITHIN_M = 0.1, 0.1
CARRIED_ON_MPS = 0.1
"""By so much the height of a pressed vehicle may run away from the last sight's."""
TOUCHES_M = 0.001
"""By so much the touch itself moves the gear, whatever was known of it before."""
SHAKEN_M, SLIDES_MPS = 0.002, 0.01
"""An estimate by decks is off by so much after the blow on the ceiling, and by so much more for
each second without a sight."""
DRIFTED_M = 0.02
"""So far the estimate may have drifted up from the contact, and a slip counts all the same."""
PRESSED_M = 0.08
"""A setpoint so far above a vehicle that stands still presses it against something."""
HARD_CLIMB_MPS = 0.27
BELOW_M = 0.3
"""A target on the ceiling that seems so far below the vehicle is not there."""
KNOCKED_MPS = 0.5
"""Sideways, under the target: no draught gives a held vehicle so much."""
OTHERWISE_MPS = 0.15
"""True positions make at most 0.07, also those that are 0.15 s late."""
SATURATED = 0.98
"""Of the largest thrust: from here on nothing tells how much more it takes."""
LITTLE_LEFT = 0.93
"""A hover thrust above this part of the largest: full thrust is no sign of pressing then."""
SUPERVISOR_S = 5.0
"""The flying bit outlives the motors by 2 s (docs/firmware.md, "Supervisor")."""
PROVABLE = 0.99
"""Of the thrust that presses: so much at most is asked of a contact."""
STILL_MOTORS_THRUST = 5000
"""At and below it the motors stand still (docs/firmware.md, "Release in raw mode")."""


def _aligned(c: Context) -> bool:
    align = c.profile.planner.align
    return (
        c.fresh
        and c.error_xy_m <= align.xy_m
        and abs(c.error_yaw_rad) <= math.radians(align.yaw_deg)
    )


def _settled(c: Context) -> bool:
    """Under the target at the stand-off, slow, and seen by the small marker (fault 33)."""
    ascend = c.profile.planner.ascend
    return (
        c.fresh
        and c.small_is_fresh
        and c.error_z_m <= ascend.standoff_m + ascend.settle_z_m
        and c.error_xy_m <= ascend.settle_xy_m
        and abs(c.error_yaw_rad) <= math.radians(ascend.settle_yaw_deg)
        and c.speed_mps <= ascend.settle_speed_mps
    )


def _near_standoff(c: Context) -> bool:
    ascend = c.profile.planner.ascend
    return c.tracked and c.error_z_m <= ascend.standoff_m + ascend.settle_z_m


def _moves_otherwise(c: Context) -> bool:
    """The positions of a motion capture lead the estimate elsewhere than the vehicle feels to go:
    mirrored, turned or swapped axes, which a vehicle at rest cannot tell."""
    by_capture = c.profile.positioning.by == "mocap"
    return by_capture and math.hypot(*c.state.reckoning.beside_mps) > OTHERWISE_MPS


def _contact(c: Context) -> bool:
    """Position, acceleration and thrust together (fault 40).

    The gear is where the target is and has stopped; the accelerometer reads the
    one g of a body at rest; yet the thrust is above what hovering takes, so the
    ceiling must be carrying the difference.
    Where the target is the positioning system, its place is the last sight's, carried on; and
    that nothing climbs is felt, since an impact leaves the estimated speed a decimetre a second
    wrong (docs/firmware.md, "After the impact").
    """
    perch, tel = c.profile.planner.perch, c.obs.telemetry
    steady = abs(tel.velocity_mps[2]) <= perch.contact_speed_mps and c.placed
    felt_s = c.obs.t_s - c.obs.imu.steady_s
    return (
        abs(c.error_z_m) <= perch.contact_z_m + (CARRIED_ON_MPS * unseen_s(c) if c.by_sight else 0)
        and (steady or felt_s >= perch.contact_dwell_s)
        and abs(tel.acc_z_g - 1.0) <= perch.contact_acc_g
        and c.state.hover_thrust > 0
        and c.thrust_is_known
        and tel.thrust >= contact_thrust(c)
    )


def unseen_s(c: Context) -> float:
    """Since the exposure of the last sight."""
    return max(0.0, c.obs.t_s - c.state.reckoning.sight_s)


def contact_aside_m(c: Context) -> tuple[float, float]:
    """How far the gear is from the target's axis, and the standard deviation of that.

    By decks the place of the last sight is carried on by an estimate that slides, and that the blow
    on the ceiling shakes; where no position comes, `reckoned` has counted that already. A step of
    the estimate since the last sight makes the place unsure by as much: before it or after it the
    estimate was wrong."""
    reckoning = c.state.reckoning
    sigma_m = math.hypot(reckoning.aside_sigma_m, TOUCHES_M, *reckoning.stepped_m)
    if c.profile.positioning.by == "deck" and c.placed:
        sigma_m = math.hypot(sigma_m, SHAKEN_M, SLIDES_MPS * unseen_s(c))
    return math.hypot(*reckoning.aside_m), sigma_m


def touched_aside_m(c: Context) -> tuple[float, float] | None:
    """The same as it was when it touched something at the target's height and backed off: what has
    not left since is still there, wherever decks let the estimate slide to. None where it has left,
    and where a sight of now or a motion capture tells its place."""
    state = c.state
    if state.phase is not Phase.RECOVER or state.contact_aside_m is None or c.fresh:
        return None
    x_m, y_m, _ = c.obs.telemetry.position_m
    away_m = math.hypot(x_m - state.entry_m[0], y_m - state.entry_m[1])
    by_capture = c.profile.positioning.by == "mocap" and c.placed
    if by_capture and away_m > c.profile.planner.perch.contact_xy_m:
        return None
    return state.contact_aside_m, state.contact_sigma_m


def contact_within_m(c: Context) -> float:
    """How far from the target's height a gear may seem to be that touches it: the contact's
    tolerance, and what the estimate may have drifted by since the last sight, bounded."""
    planner = c.profile.planner
    drift_mps = CARRIED_ON_MPS if c.by_sight else planner.landing.drift_mps
    return planner.perch.contact_z_m + min(planner.perch.contact_z_m, drift_mps * unseen_s(c))


def is_at_target(c: Context) -> bool:
    """Whether the gear is where the target's magnet can hold it: at its height, and within the
    magnet's radius of its axis. What is not known is not there."""
    aside_m, sigma_m = contact_aside_m(c)
    near = aside_m + sigma_m <= c.profile.planner.perch.contact_xy_m
    return near and abs(c.error_z_m) <= contact_within_m(c)


def press_thrust(profile: Profile) -> float:
    """The most that a press can have."""
    perch = profile.planner.perch
    return float(perch.thrust) if perch.mode == "raw" else FULL_THRUST


def contact_thrust(c: Context) -> float:
    """What proves a contact: more than hovering takes, as far as there is more."""
    wanted = c.profile.planner.perch.contact_thrust_ratio * c.state.hover_thrust
    return min(wanted, PROVABLE * press_thrust(c.profile))


def hovers(c: Context) -> bool:
    """Whether the thrust is what hovering takes: carried by nothing, pressed to nothing, not
    at its limit, and hardly accelerated."""
    tel, setpoint = c.obs.telemetry, c.state.setpoint
    vz = tel.velocity_mps[2]
    stuck = setpoint is not None and setpoint.z_m - tel.position_m[2] > PRESSED_M and vz < 0.05
    return (
        c.proves
        and c.placed
        and 1000 <= tel.thrust < SATURATED * FULL_THRUST
        and c.speed_mps < 0.3
        and abs(vz) < HARD_CLIMB_MPS
        and abs(tel.acc_z_g - 1.0) < 0.1
        and not stuck
    )


def _magnet_holds(c: Context) -> bool:
    """The vehicle stays up on a thrust that could not carry it."""
    held = _is_carried(c) and not _slipping(c)
    return held and (c.placed or _still(c))


def _is_carried(c: Context) -> bool:
    """Whether the thrust could not carry the vehicle."""
    most = c.profile.planner.complete.hold_ratio * c.state.hover_thrust
    return c.thrust_is_known and c.state.hover_thrust > 0 and c.obs.telemetry.thrust <= most


def _slipping(c: Context) -> bool:
    """Falling away from the proven contact, by position or by acceleration.

    With the motors still, at the first sign: a fall is caught at the cost of the height it
    has made by then (docs/firmware.md, "Catching a slip")."""
    complete, tel = c.profile.planner.complete, c.obs.telemetry
    if c.state.contact_z_m is None:
        return False
    if not c.sinks(complete.slip_mps):
        return False
    above_m = tel.position_m[2] - c.state.contact_z_m
    return not c.placed or above_m < DRIFTED_M or tel.acc_z_g < complete.slip_acc_g


def _still(c: Context) -> bool:
    """Not moving, and carried by something: the accelerometer reads one g. It alone tells while
    no position corrects the speed."""
    tel = c.obs.telemetry
    at_rest = abs(tel.acc_z_g - 1.0) <= c.profile.planner.perch.contact_acc_g
    return at_rest and (abs(tel.velocity_mps[2]) < 0.05 or not c.placed)


def _weight_hangs(c: Context) -> bool:
    """The motors stand still, and the vehicle hangs where it made contact."""
    return (
        c.state.released_s is not None
        and (c.obs.telemetry.thrust <= STILL_MOTORS_THRUST or not c.thrust_is_known)
        and _still(c)
        and not _slipping(c)
    )


def _hanging(c: Context) -> bool:
    """Held up by something, wherever the mission is: still, off the floor, on a thrust that could
    not carry the vehicle. Whether that is the target's magnet, `is_at_target` tells.

    Where no position comes from outside nothing tells a magnet from the floor. Either carries
    it, and what follows, a slow release under watch, suits both."""
    tel, complete = c.obs.telemetry, c.profile.planner.complete
    if not c.placed:
        return _is_carried(c) and _still(c)
    held = _is_carried(c) and c.height_m > 0.3 and _still(c)
    if c.state.phase is not Phase.LANDING:
        return held
    at_contact = (
        c.state.contact_z_m is not None
        and abs(tel.position_m[2] - c.state.contact_z_m) <= complete.slip_m
    )
    at_target = c.obs.target is not None and abs(c.error_z_m) <= 0.15
    # A landing that does not come down is held, wherever the target was thought to be.
    stayed = c.state.entry_m[2] - tel.position_m[2] < HELD_WITHIN_M and not c.far_below_target
    return held and (at_contact or at_target or stayed)


def _steady(c: Context) -> bool:
    return c.speed_mps <= c.profile.planner.recover.steady_mps


def _at_takeoff_height(c: Context) -> bool:
    return (
        c.height_m >= 0.8 * c.profile.planner.takeoff_height_m
        and c.speed_mps <= 0.25
        and c.state.setpoint is not None
    )


def _estimated(c: Context) -> bool:
    return c.fresh and c.state.target_spread_m <= c.profile.planner.estimate.spread_m


def _tilted(c: Context) -> bool:
    """By attitudes that are fresh; the position's packet does not matter to it."""
    safety = c.profile.safety
    if c.obs.t_s - c.obs.telemetry.t_s > safety.proof_age_s:
        return False
    return c.tilt_rad > math.radians(safety.max_tilt_deg)


def _down(c: Context) -> bool:
    """Motors off by the telemetry, and the supervisor agrees that nothing flies; its word is
    old where it has not agreed for long."""
    stopped_s = c.state.stopped_s
    long_off = stopped_s is not None and c.obs.t_s - stopped_s > SUPERVISOR_S
    return c.obs.telemetry.thrust < 1 and (not c.flying or long_off)


def _on_floor(c: Context) -> bool:
    """Low, or come down from where the landing began, since a drifting estimate has the floor
    anywhere; not moving, and on a thrust that could not carry the vehicle."""
    near_target = c.obs.target is not None and abs(c.error_z_m) <= 0.3
    came_down_m = c.state.entry_m[2] - c.obs.telemetry.position_m[2]
    came_down = c.state.phase is Phase.LANDING and came_down_m > DESCENDED_M
    low = c.height_m < c.profile.planner.landing.handover_m or (
        came_down and c.state.contact_z_m is None
    )
    return _is_carried(c) and low and not near_target and _still(c)


def _blocked(c: Context) -> bool:
    """Pressed against something: the setpoint is above, the thrust at its limit or above
    what hovering takes, and nothing moves. Where hovering takes nearly all there is, the limit
    tells nothing."""
    setpoint, tel, safety = c.state.setpoint, c.obs.telemetry, c.profile.safety
    if setpoint is None or setpoint.z_m - tel.position_m[2] < PRESSED_M:
        return False
    hover = c.state.hover_thrust
    pressing = hover < LITTLE_LEFT * FULL_THRUST and (
        tel.thrust >= SATURATED * FULL_THRUST
        or (hover > 0 and tel.thrust >= safety.blocked_thrust_ratio * hover)
    )
    return pressing and c.height_m > 0.15 and _still(c)


def _carried(c: Context) -> bool:
    """By what is felt alone: much more or much less than hovering takes, and one g over a steady
    speed. In the air it would rise or sink, whatever late pictures say of its place."""
    tel, perch, hover = c.obs.telemetry, c.profile.planner.perch, c.state.hover_thrust
    apart = (c.profile.safety.blocked_thrust_ratio - 1.0) * hover
    pressed = tel.thrust >= min(hover + apart, SATURATED * FULL_THRUST)
    return (
        0 < hover < LITTLE_LEFT * FULL_THRUST
        and c.thrust_is_known
        and (pressed or tel.thrust <= hover - apart)
        and abs(tel.acc_z_g - 1.0) <= perch.contact_acc_g
        and c.obs.t_s - c.obs.imu.steady_s >= perch.contact_dwell_s
    )


def _knocked(c: Context) -> bool:
    vx, vy, _ = c.obs.telemetry.velocity_mps
    return c.proves and c.placed and math.hypot(vx, vy) > KNOCKED_MPS


def _saturated(c: Context) -> bool:
    """All the thrust there is, and it does not rise (nor is it just being caught)."""
    full = c.obs.telemetry.thrust >= SATURATED * FULL_THRUST
    return full and -0.15 < c.climb_mps < 0.05


CONDITIONS: dict[Condition, Callable[[Context], bool]] = {
    Condition.AT_TAKEOFF_HEIGHT: _at_takeoff_height,
    Condition.ESTIMATED: _estimated,
    Condition.ALIGNED: _aligned,
    Condition.UNTRACKED: lambda c: not c.tracked,
    Condition.NEAR_STANDOFF: _near_standoff,
    Condition.SETTLED: _settled,
    Condition.CONTACT: _contact,
    Condition.MAGNET_HOLDS: _magnet_holds,
    Condition.SLIPPING: _slipping,
    Condition.HANGING: _hanging,
    Condition.STEADY: _steady,
    Condition.TILTED: _tilted,
    Condition.DOWN: _down,
    Condition.ON_FLOOR: _on_floor,
    Condition.WEIGHT_HANGS: _weight_hangs,
    Condition.BLOCKED: _blocked,
    Condition.CARRIED: _carried,
    Condition.KNOCKED: _knocked,
    Condition.SATURATED: _saturated,
    Condition.UNSURE: lambda c: c.variance_m2 > c.profile.safety.flight_variance_m2,
    Condition.TARGET_BELOW: lambda c: c.fresh and c.error_z_m < -BELOW_M,
    Condition.BATTERY_LOW: lambda c: c.battery_is_low,
    Condition.OTHERWISE: _moves_otherwise,
}
KEPT_OVER_A_CHANGE = (
    Condition.BATTERY_LOW,
    Condition.TILTED,
    Condition.UNSURE,
    Condition.SATURATED,
    Condition.CARRIED,
    Condition.OTHERWISE,
)
"""The vehicle's own, whatever the phase, and however it is held."""

_NONE: frozenset[Condition] = frozenset()

PROOFS = frozenset(
    {
        Condition.HANGING,
        Condition.CONTACT,
        Condition.MAGNET_HOLDS,
        Condition.WEIGHT_HANGS,
        Condition.DOWN,
        Condition.ON_FLOOR,
        Condition.CARRIED,
        Condition.SATURATED,
    }
)
"""What may stop the motors or end a flight: it counts over fresh telemetry only."""

BY_PLACE = frozenset({Condition.HANGING, Condition.CONTACT, Condition.ON_FLOOR})
"""Proofs that say where the vehicle is: where its position comes from outside they count only
while it does. The others have the accelerometer to go by."""


def conditions_since(c: Context) -> dict[Condition, float]:
    """`PlannerState.since` of this tick. A condition seen while the vehicle is held
    in place for a fault does not count, a proof in old telemetry neither."""
    old, now_s, void = c.state.since, c.obs.t_s, _void(c)
    return {
        name: old.get(name, now_s)
        for name, holds in CONDITIONS.items()
        if name not in void and holds(c)
    }


def _void(c: Context) -> frozenset[Condition]:
    """Those that do not count in this tick, whatever they say: each asks for the freshness of what
    it rests on. A position block that is dead voids what rests on a place, and no more."""
    if not c.imu_proves:
        void = PROOFS
    elif c.placed:
        void = _NONE
    else:
        void = BY_PLACE
        if c.by_sight and c.state.phase is Phase.PERCH:
            void = void - {Condition.CONTACT}  # by the last sight's place, for a while
    if c.state.phase is not Phase.LANDING:
        return void
    # In a landing it begins a release, which goes on over fresh telemetry only: late telemetry
    # may do that, where the vehicle would else hang there until it is cut.
    # By the same right it goes on without a position.
    late = c.attitude_age_s > c.profile.safety.telemetry_hold_s
    return void | {Condition.HANGING} if late else void - {Condition.HANGING}
