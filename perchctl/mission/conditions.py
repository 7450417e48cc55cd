"""The named conditions that the mission's table debounces.

A condition is true or false in one tick; `PlannerState.since` holds since when it has been
true without a break, and `Context.held_s(name)` tells for how long.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from perchctl.mission.context import Context
from perchctl.mission.guidance import THRUST_MIN
from perchctl.mission.state import Condition, ContactError, Phase
from perchctl.profile import Profile
from perchctl.vehicle import FLYING, FULL_THRUST, LOW_POWER, NO_BATTERY_READING_V

DESCENDED_M, HELD_WITHIN_M = 0.1, 0.1
CARRIED_ON_MPS = 0.1  # a pressed vehicle's height may run away by this
TOUCHES_M = 0.001  # by which the touch itself moves the gear
SHAKEN_M, SLIDES_MPS = 0.002, 0.01  # by decks: by the blow, each second
DRIFTED_M = 0.02  # a slip counts though the estimate has drifted up by this
PRESSED_M = 0.08  # a setpoint so far above a still vehicle presses it
HARD_CLIMB_MPS = 0.27
BELOW_M = 0.3  # no target on the ceiling can be so far below the vehicle
KNOCKED_MPS = 0.5  # sideways: no draught gives so much
OTHERWISE_MPS = 0.15  # true positions make at most 0.07
SATURATED = 0.98  # of the full thrust: how much more it takes is unknown
LITTLE_LEFT = 0.93  # of the full thrust: on more it is no sign of a press
SUPERVISOR_S = 5.0  # the flying bit outlives the motors by 2 s
MOST_HOLDING = 0.8  # of the hover thrust: with more the air under the ceiling may hold the vehicle
PROVABLE = 0.99  # of the pressing thrust: a contact's proof asks for no more
STILL_MOTORS_THRUST = 5000  # and less stops them
FALLING_MPS = -0.05


def _settled(c: Context) -> bool:
    """True if it is slow under the target at the stand-off, by the small marker (fault 33)."""
    ascend = c.planner.ascend
    return (
        c.fresh
        and c.small_is_fresh
        and c.is_near_standoff
        and c.error_xy_m <= ascend.settle_xy_m
        and abs(c.error_yaw_rad) <= math.radians(ascend.settle_yaw_deg)
        and c.speed_mps <= ascend.settle_speed_mps
    )


def _moves_otherwise(c: Context) -> bool:
    """True if the estimate follows a motion capture against the accelerometer."""
    by_capture = c.profile.positioning.by == "mocap"
    return by_capture and math.hypot(*c.state.reckoning.beside_mps) > OTHERWISE_MPS


def _contact(c: Context) -> bool:
    """True if position, acceleration and thrust together show a contact (fault 40).

    The gear has stopped at the target's height, the accelerometer reads one g, and the thrust is
    above what hovering takes: the ceiling must carry the difference.
    """
    perch, tel = c.planner.perch, c.telemetry
    steady = abs(tel.velocity_mps[2]) <= perch.contact_speed_mps and c.placed
    felt_s = c.t_s - c.obs.imu.steady_s
    wanted = perch.contact_thrust_ratio * c.state.hover_thrust  # as far as there is more
    return (
        abs(c.error_z_m)
        <= perch.contact_z_m + (CARRIED_ON_MPS * sight_age_s(c) if c.by_sight else 0)
        and (steady or felt_s >= perch.contact_dwell_s)
        and c.reads_one_g
        and c.state.hover_thrust > 0
        and c.thrust_is_known
        and tel.thrust >= min(wanted, PROVABLE * max_press_thrust(c.profile))
    )


def sight_age_s(c: Context) -> float:
    """Seconds since the exposure of the last picture with the target."""
    return max(0.0, c.t_s - c.state.reckoning.sight_s)


def contact_error(c: Context) -> ContactError:
    """The gear's distance from the target's axis, and its sigma, which with decks grows after the
    last sight: the estimate drifts, and the impact on the ceiling shakes it."""
    reckoning = c.state.reckoning
    sigma_m = math.hypot(reckoning.aside_sigma_m, TOUCHES_M, *reckoning.stepped_m)
    if c.profile.positioning.by == "deck" and c.placed:
        sigma_m = math.hypot(sigma_m, SHAKEN_M, SLIDES_MPS * sight_age_s(c))
    return ContactError(math.hypot(*reckoning.aside_m), sigma_m)


def last_touch_error(c: Context) -> ContactError | None:
    """The `contact_error` of the last touch, in RECOVER only; None with a fresh sight, or once
    motion capture shows that the vehicle has left the place of that touch."""
    state = c.state
    if state.phase is not Phase.RECOVER or state.contact is None or c.fresh:
        return None
    x_m, y_m, _ = c.telemetry.position_m
    away_m = math.hypot(x_m - state.entry_m[0], y_m - state.entry_m[1])
    by_capture = c.profile.positioning.by == "mocap" and c.placed
    if by_capture and away_m > c.planner.perch.contact_xy_m:
        return None
    return state.contact


def contact_tolerance_m(c: Context) -> float:
    """The height difference (m) between gear and target up to which the gear is in contact."""
    planner = c.planner
    drift_mps = CARRIED_ON_MPS if c.by_sight else planner.landing.drift_mps
    return planner.perch.contact_z_m + min(planner.perch.contact_z_m, drift_mps * sight_age_s(c))


def is_at_target(c: Context) -> bool:
    """True if the gear is surely in the magnet's reach."""
    near = contact_error(c).is_within(c.planner.perch.contact_xy_m)
    return near and abs(c.error_z_m) <= contact_tolerance_m(c)


def max_press_thrust(profile: Profile) -> float:
    """The largest thrust that a press can have, 0..65535."""
    perch = profile.planner.perch
    return float(perch.thrust) if perch.mode == "raw" else FULL_THRUST


def is_hover_thrust(c: Context) -> bool:
    """True if the thrust is hover thrust: nothing carries, presses or accelerates the vehicle."""
    tel, setpoint = c.telemetry, c.state.setpoint
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


def _is_carried(c: Context) -> bool:
    """True if the thrust could not carry the vehicle.

    Position mode goes no lower than `THRUST_MIN`, which is more than `hold_ratio` of the hover
    thrust where the motors are strong: then that is what proves the hold.
    """
    most = c.planner.complete.hold_ratio * c.state.hover_thrust
    if MOST_HOLDING * c.state.hover_thrust >= THRUST_MIN:
        most = max(most, THRUST_MIN)
    return c.thrust_is_known and c.state.hover_thrust > 0 and c.telemetry.thrust <= most


def _magnet_slips(c: Context) -> bool:
    """True if it falls away from the proven contact, by position or by acceleration."""
    complete, tel = c.planner.complete, c.telemetry
    if c.state.contact_z_m is None or not c.is_sinking(complete.slip_mps):
        return False
    above_m = tel.position_m[2] - c.state.contact_z_m
    return not c.placed or above_m < DRIFTED_M or tel.acc_z_g < complete.slip_acc_g


def _still(c: Context) -> bool:
    """True if it does not move, and something carries it: the accelerometer reads one g."""
    return c.reads_one_g and (abs(c.telemetry.velocity_mps[2]) < 0.05 or not c.placed)


def _weight_hangs(c: Context) -> bool:
    """True if the motors stand still, and the vehicle hangs where it made contact."""
    return (
        c.state.released_s is not None
        and (c.telemetry.thrust <= STILL_MOTORS_THRUST or not c.thrust_is_known)
        and _still(c)
        and not _magnet_slips(c)
    )


def _hanging(c: Context) -> bool:
    """True if something holds it up: it is still, off the floor, on a thrust that could not carry
    it. Without a position a magnet looks like the floor; the slow release suits both."""
    tel, complete = c.telemetry, c.planner.complete
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
    stayed = c.state.entry_m[2] - tel.position_m[2] < HELD_WITHIN_M and not c.far_below_target
    return held and (at_contact or at_target or stayed)


def _down(c: Context) -> bool:
    """True if the motors are off, and the supervisor agrees, or has not changed its word long."""
    stopped_s = c.state.stopped_s
    long_off = stopped_s is not None and c.t_s - stopped_s > SUPERVISOR_S
    return c.telemetry.thrust < 1 and (not c.telemetry.has_bit(FLYING) or long_off)


def _on_floor(c: Context) -> bool:
    """True if it does not move on a thrust that could not carry it, low or come down: a drifting
    estimate may place the floor anywhere."""
    near_target = c.obs.target is not None and abs(c.error_z_m) <= 0.3
    came_down_m = c.state.entry_m[2] - c.telemetry.position_m[2]
    came_down = c.state.phase is Phase.LANDING and came_down_m > DESCENDED_M
    low = c.height_m < c.planner.landing.handover_m or (came_down and c.state.contact_z_m is None)
    return _is_carried(c) and low and not near_target and _still(c)


def _blocked(c: Context) -> bool:
    """True if it is pressed against something: the setpoint is above, the thrust at its limit or
    above what hovering takes, and nothing moves."""
    setpoint, tel, safety = c.state.setpoint, c.telemetry, c.safety
    if setpoint is None or setpoint.z_m - tel.position_m[2] < PRESSED_M:
        return False
    hover = c.state.hover_thrust
    pressing = hover < LITTLE_LEFT * FULL_THRUST and (
        tel.thrust >= SATURATED * FULL_THRUST
        or (hover > 0 and tel.thrust >= safety.blocked_thrust_ratio * hover)
    )
    return pressing and c.height_m > 0.15 and _still(c)


def _carried(c: Context) -> bool:
    """True if accelerometer and thrust alone show that something carries or presses it: by much
    more or much less thrust than hovering takes it would rise or sink in the air."""
    tel, perch, hover = c.telemetry, c.planner.perch, c.state.hover_thrust
    apart = (c.safety.blocked_thrust_ratio - 1.0) * hover
    pressed = tel.thrust >= min(hover + apart, SATURATED * FULL_THRUST)
    return (
        0 < hover < LITTLE_LEFT * FULL_THRUST
        and c.thrust_is_known
        and (pressed or tel.thrust <= hover - apart)
        and c.reads_one_g
        and c.t_s - c.obs.imu.steady_s >= perch.contact_dwell_s
    )


def _saturated(c: Context) -> bool:
    full = c.telemetry.thrust >= SATURATED * FULL_THRUST
    return full and -0.15 < c.climb_mps < 0.05


def _battery_is_low(c: Context) -> bool:
    """True if the firmware reports low power, or a measured voltage is low."""
    tel = c.telemetry
    known = tel.battery_v >= NO_BATTERY_READING_V
    low = known and tel.battery_v < c.safety.min_load_v
    return tel.battery_state == LOW_POWER or low


CONDITIONS: dict[Condition, Callable[[Context], bool]] = {
    Condition.AT_TAKEOFF_HEIGHT: lambda c: (
        c.height_m >= 0.8 * c.planner.takeoff_height_m
        and c.speed_mps <= 0.25
        and c.state.setpoint is not None
    ),
    Condition.ESTIMATED: lambda c: (
        c.fresh and c.state.target_spread_m <= c.planner.estimate.spread_m
    ),
    Condition.ALIGNED: lambda c: (
        c.fresh
        and c.error_xy_m <= c.planner.align.xy_m
        and abs(c.error_yaw_rad) <= math.radians(c.planner.align.yaw_deg)
    ),
    Condition.UNTRACKED: lambda c: not c.tracked,
    Condition.NEAR_STANDOFF: lambda c: c.tracked and c.is_near_standoff,
    Condition.SETTLED: _settled,
    Condition.CONTACT: _contact,
    Condition.MAGNET_HOLDS: lambda c: (
        _is_carried(c) and not _magnet_slips(c) and (c.placed or _still(c))
    ),
    Condition.SLIPPING: _magnet_slips,
    Condition.HANGING: _hanging,
    Condition.STEADY: lambda c: c.speed_mps <= c.planner.recover.steady_mps,
    Condition.TILTED: lambda c: c.imu_proves and c.tilt_rad > math.radians(c.safety.max_tilt_deg),
    Condition.DOWN: _down,
    Condition.ON_FLOOR: _on_floor,
    Condition.WEIGHT_HANGS: _weight_hangs,
    Condition.BLOCKED: _blocked,
    Condition.CARRIED: _carried,
    Condition.KNOCKED: lambda c: c.placed and math.hypot(*c.velocity_mps[:2]) > KNOCKED_MPS,
    Condition.SATURATED: _saturated,
    Condition.UNSURE: lambda c: c.is_unsure,
    Condition.TARGET_BELOW: lambda c: c.fresh and c.error_z_m < -BELOW_M,
    Condition.BATTERY_LOW: _battery_is_low,
    Condition.OTHERWISE: _moves_otherwise,
}
C = Condition
LASTING = frozenset({C.BATTERY_LOW, C.TILTED, C.UNSURE, C.SATURATED, C.CARRIED, C.OTHERWISE})
"""The vehicle's own, whatever the phase, and however it is held."""
BY_PLACE = frozenset({C.HANGING, C.CONTACT, C.ON_FLOOR})
"""Proofs that rest on the position: these count only while it is measured."""
PROOFS = BY_PLACE | {C.MAGNET_HOLDS, C.WEIGHT_HANGS, C.DOWN, C.CARRIED, C.SATURATED}
"""What may stop the motors or end a flight: these count over fresh telemetry only."""


def update_conditions(c: Context) -> dict[Condition, float]:
    """`PlannerState.since` after this tick: when each condition that holds now began."""
    old, now_s, void = c.state.since, c.t_s, _void(c)
    return {
        name: old.get(name, now_s)
        for name, holds in CONDITIONS.items()
        if name not in void and holds(c)
    }


def lasting_conditions(since: dict[Condition, float]) -> dict[Condition, float]:
    """The entries of `since`, condition to start, that outlast a change of phase, or a hold."""
    return {name: s for name, s in since.items() if name in LASTING}


def _void(c: Context) -> frozenset[Condition]:
    """The conditions that rest on what is not fresh in this tick."""
    void: frozenset[Condition] = frozenset()
    if not c.imu_proves:
        void = PROOFS
    elif not c.placed:
        void = BY_PLACE
        if c.by_sight and c.state.phase is Phase.PERCH:
            void = void - {C.CONTACT}  # by the last sight's place, for a while
    if c.state.phase is not Phase.LANDING:
        return void
    # In a landing it begins a release, which goes on over fresh telemetry only. Late telemetry may
    # begin it, and so may a missing position: else the vehicle would hang there until it is cut.
    late = c.attitude_age_s > c.safety.telemetry_hold_s
    return void | {C.HANGING} if late else void - {C.HANGING}


# --- What both the table and the way down ask ---


def has_slipped(c: Context) -> bool:
    """True if the vehicle has slipped off its contact: debounced, but at once in free fall."""
    tel, complete = c.telemetry, c.planner.complete
    falls = c.state.released_s is not None and tel.acc_z_g < complete.slip_acc_g
    if falls and c.imu_proves and c.climb_mps < FALLING_MPS:
        return True
    return c.held_s(C.SLIPPING) >= complete.slip_dwell_s
