"""The one way down: for the planner's LANDING, the watchdog of a silent loop, and the rescue.

Pure: `step_landing(state, observation, profile) -> (state, command)`.

What lands by itself, has its weight on the magnet or is stopped goes on with that, whatever is
known. What still comes down does it by what is known and fresh, and by whether the vehicle may be
where the magnet holds it (the table of docs/mission.md). Nothing here climbs but a catch.

The vehicle's own landing follows a trajectory by its clock and then stops the motors, wherever it
is by then: it is ordered only where a position shows the vehicle away from the ceiling.
"""

from __future__ import annotations

import math
from enum import Enum

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.conditions import (
    contact_tolerance_m,
    has_slipped,
    lasting_conditions,
    update_conditions,
)
from perchctl.mission.context import FAR_BELOW_M, HANGING_S, PUT_RIGHT_S, Context
from perchctl.mission.guidance import (
    CATCH_STILL_ABOVE_M,
    LIFTED_M,
    STILL_THRUST,
    THRUST_MIN,
    Action,
    anchor_in_wind,
    catch_goal_above_m,
    catch_slip,
    clear_contact_below,
    hold_here,
    is_pressing,
    leave_press,
    limit_setpoint,
    release_by_thrust,
    step_towards,
    stop_motors,
)
from perchctl.mission.imu import (
    BIAS_MEMORY_S,
    REACH_M,
    UNSEEN_S,
    Vector,
    add_position_step,
    add_sighting,
    advance_reckoning,
    forget_means,
    learn_bias_at_rest,
    learn_velocity_bias,
)
from perchctl.mission.state import (
    IN_THE_OPEN,
    Condition,
    Observation,
    Phase,
    PlannerState,
    Severity,
)
from perchctl.profile import PlannerConfig, Profile
from perchctl.values import replace
from perchctl.vehicle import (
    FLYING,
    FULL_THRUST,
    HL_ACTIVE,
    Command,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
)


class RestState(Enum):
    """Where a vehicle with its motors off is, in words without a full stop."""

    HANGS = "the vehicle hangs on the magnet, its motors are off"
    HELD = "something holds the vehicle away from the target; the motors are off"
    STANDS = "the vehicle stands on the floor, its motors are off"
    UNKNOWN = "the motors are off; it is not known whether the vehicle hangs or stands"
    UNSEEN = "how it ended could not be confirmed: keep away from the vehicle"


LOOKED_S = 2.0  # a target far above has so long to show
HUNG_WITHIN_M = 0.3
CARRIED_WITHIN_M = 0.3  # what carries it so near below the target is the target
REPEAT_ORDER_S, LEAST_ORDERS, MAX_ORDERS = 0.3, 3, 6
"""Without its notify an order is not flown (docs/firmware.md, "Order without notify")."""
PLANNED_MPS, SETTLING_S = 0.35, 1.8  # of the own landing's quintic
PEAK_OF_MEAN = 1.875  # a quintic's largest speed over its mean
MOST_DRIFT_M = 1.0
PEELED_M = 0.1  # below the contact by so much, the magnet has let go
PEEL_BELOW_M, PEEL_S = 0.35, 4.0
DROPPING_MPS = -0.35
FALLING_G, FALLEN_MPS = 0.5, 1.0  # from 5 cm above the floor it drops no faster
FALLEN_BELOW_M = 0.4  # from higher up it is a cut in the air
HIGH_M, LOW_M, STAYED_M = 0.45, 0.3, 0.15
HELD = "held"  # the row of a landing since something held it
SINK_MPS, LOW_SINK_MPS, SLOW_BELOW_M = 0.7, 0.4, 0.6
"""By the gyroscope's offset it goes 2 m sideways in 4 s."""
MOST_GAIN_S_PER_M, LEAST_GAIN_S_PER_M, GAIN_AGE_S2_PER_M = 0.5, 0.2, 0.06
"""Part of the hover thrust for each m/s; an older speed wants less, or it swings."""
HOVER_MEMORY_S, HOVER_WITHIN, UNLEARNED_WITHIN = 0.3, 0.12, 0.35
LATEST_S, UNHEARD_PART, OWN_ESTIMATE_S = 1.0, 0.98, 1.5
"""Later telemetry no longer tells the speed; then a little less thrust lets it come down."""
ON_THE_SPOT_S = 0.6  # by setpoints at one place; no speed is left then
RAMP_PER_S, STILL_MPS = 0.25, 0.05  # what does not sink gets less and less thrust
LEAST_PART, MOST_RAW = 0.4, 60000.0
BRAKE_RAD_PER_MPS, MOST_BRAKE_RAD = 0.25, 0.22  # takes 2.5 % of the thrust
MOST_LEAN_RAD = 0.2
"""Against a wind of 6 m/s. Larger: a blow, or a wrong bias, throws the vehicle aside."""
BRAKED_AGE_S = 0.2  # an older speed is braked less, or it swings
UNSURE_MPS, UNSURE_MPS2, MOST_UNSURE_MPS = 0.05, 0.1, 0.3
"""An attitude error of 0.01 rad adds 0.1 m/s each second."""
LEVEL_FELT_S = 6.0  # an attitude error of before is not the present one
STOP_BELOW_M, RESTS_MPS = 0.05, 0.1
UNANSWERED_PART = 0.12  # of full thrust: no ramp leads farther
CARRIED_G, CARRIED_PART, AIRBORNE_G = 0.95, 0.88, 0.85
TOUCH_PART, TOUCH_S, TOUCH_BELOW_M = 0.5, 0.25, 0.7
"""A blow from below so near the floor is the floor."""
LEVEL_SPARE_S, UNHEARD_SPARE_S, LEVEL_MEAN_MPS = 2.0, 0.8, 0.35
AT_REST_S = 0.3


def step_landing(
    state: PlannerState | None, obs: Observation, profile: Profile
) -> tuple[PlannerState, Command]:
    """Fly one tick of the way down without the mission's table, for watchdog and rescue; the
    first call begins the landing. `state` is None if the planner has not run yet."""
    c = Context(state or PlannerState.on_ground(obs), obs, profile)
    c = remember_observation(begin_landing(c))
    state, command = act(c.evolve(since=update_conditions(c)))
    return replace(record_thrust_order(state, command), t_s=obs.t_s, last=obs.telemetry), command


def begin_landing(c: Context) -> Context:
    """The context in the phase LANDING; unchanged if the landing had begun before."""
    if c.state.phase is Phase.LANDING:
        return c
    new = c.evolve(
        phase=Phase.LANDING,
        entered_s=c.t_s,
        severity=max(c.state.severity, Severity.LAND),
        since=lasting_conditions(c.state.since),
        entry_m=c.telemetry.position_m,
        entry_yaw_rad=c.telemetry.yaw_rad,
        pressed=c.state.caught and is_pressing(c),
        ordered_s=None,
        orders=0,
    )
    return enter_landing(new, c.state)


def enter_landing(c: Context, old: PlannerState) -> Context:
    """The context with a landing's first state; `c` is in LANDING, `old` is the state before."""
    tel, stopped_s = c.telemetry, old.stopped_s
    heard = c.t_s - tel.t_s <= c.safety.proof_age_s
    ordered = heard and tel.has_bit(HL_ACTIVE) and not c.by_sight
    if ordered and not c.state.astray:
        c = c.evolve(orders=LEAST_ORDERS, ordered_s=c.t_s)
    elif heard and tel.thrust < 1 and stopped_s is None:
        # The motors were stopped, or never turned: nothing spins them up again.
        c = c.evolve(stopped_s=c.t_s)
    contact_z_m = old.contact_z_m
    if contact_z_m is None and (old.phase is Phase.PERCH or (c.state.pressed and c.by_sight)):
        # It may be in the magnet's reach, also below a sheet that hangs above an unseen ceiling:
        # it has to be seen below before it counts as free.
        contact_z_m = tel.position_m[2]
    # Where it stands still in the air, what holds it there goes down with it.
    c = anchor_in_wind(c)
    hover = _hover_thrust(old, c.obs)
    within = contact_z_m is not None or c.state.reckoning.below_m < REACH_M
    blind = _has_lost_its_position(c)
    c = c.evolve(
        reach_s=old.t_s if within and old.reach_s is None else old.reach_s,
        contact_z_m=contact_z_m,
        level_hover=hover,
        hover_thrust=hover,
        level_within=HOVER_WITHIN if old.hover_thrust else UNLEARNED_WITHIN,
    )
    return give_up_position(c) if blind else c


# --- What is known ---


def _knows_its_place(c: Context) -> bool:
    if c.state.astray or c.state.blind_s is not None or (c.by_sight and not _is_sighted(c)):
        return False
    # Without a vertical speed raw thrust would be blind, and the vehicle's own landing is left.
    heard = c.attitude_age_s <= c.safety.telemetry_hold_s
    return not (c.state.heading_lost and (c.by_sight or heard))


def _is_doubtful(c: Context) -> bool:
    """True if the height, the stream or this loop cannot be relied on."""
    safety = c.safety
    return (
        c.obs.link_problem is not None
        or c.telemetry_age_s > safety.telemetry_hold_s
        or c.state.jump_s is not None
        or c.obs.loop_late_s > safety.loop_late_hold_s
    )


def _is_sighted(c: Context) -> bool:
    """True if the position by the target is good enough to come down by."""
    return c.located and not c.is_blown and not _is_doubtful(c)


def _has_lost_its_position(c: Context) -> bool:
    return not (_is_sighted(c) if c.by_sight else c.located or c.state.astray)


def is_in_magnet_reach(c: Context) -> bool:
    """True if the magnet may hold the vehicle: after a contact, or once reckoned near."""
    return c.state.contact_z_m is not None or c.state.reach_s is not None


def is_motor_borne(c: Context) -> bool:
    """True until the release by raw thrust begins or the motors are stopped."""
    return c.state.released_s is None and c.state.stopped_s is None


def find_rest_state(c: Context) -> RestState:
    """Return where the vehicle is, once its motors are off: by a position, by the picture of a
    target far above, or by the falls measured since the vehicle came into the magnet's reach."""
    tel, state = c.telemetry, c.state
    if _is_held_elsewhere(c):
        return RestState.HELD
    if c.by_sight or not c.placed:
        if c.tracked and c.far_below_target:
            return RestState.STANDS
        return _by_fall(c, state.reach_s)
    high = state.entry_m[2] - state.ground_z_m > HIGH_M
    stayed = high and not c.far_below_target and state.entry_m[2] - tel.position_m[2] < STAYED_M
    if stayed or (c.height_m > LOW_M and not c.far_below_target and state.contact_z_m is not None):
        return RestState.HANGS
    return RestState.STANDS


def _is_held_elsewhere(c: Context) -> bool:
    state = c.state
    if state.phase is not Phase.LANDING:
        return False
    if c.placed and state.entry_m[2] - c.telemetry.position_m[2] >= STAYED_M:
        return False
    if state.row == HELD:
        return c.obs.imu.fell_s <= state.entered_s
    below = contact_tolerance_m(c) < c.error_z_m <= FAR_BELOW_M and state.contact is None
    by_position = c.placed and not c.by_sight and state.jump_s is None and c.height_m > HIGH_M
    return below and (c.fresh or by_position)


def _by_fall(c: Context, since_s: float | None) -> RestState:
    """Return where a vehicle is that came within the magnet's reach at `since_s`, if ever: by the
    falls since, and the silences that could hide one."""
    imu, reckoning = c.obs.imu, c.state.reckoning
    down_s = max(imu.fell_s, -math.inf if c.state.touch_s is None else c.state.touch_s)
    unsure = reckoning.unsure_s > max(down_s, reckoning.sight_s)  # a sight ends the doubt
    if since_s is None or down_s > since_s:
        return RestState.UNKNOWN if unsure else RestState.STANDS
    came_unheard = unsure and reckoning.unsure_s <= since_s
    return RestState.UNKNOWN if came_unheard or imu.gap_s > since_s else RestState.HANGS


def is_still_hanging(c: Context) -> bool:
    """True if a position shows the vehicle at its contact, or the accelerometer shows no fall."""
    contact_z_m, tel = c.state.contact_z_m, c.telemetry
    if not c.by_sight and c.placed and contact_z_m is not None:
        falls = tel.velocity_mps[2] < -c.planner.complete.slip_mps
        if not falls and contact_z_m - tel.position_m[2] <= HUNG_WITHIN_M:
            return True
    return _by_fall(c, c.state.reach_s) is RestState.HANGS


def hangs_with_motors_off(c: Context) -> bool:
    """True if the motors were stopped while the vehicle hung, and it still hangs."""
    stopped_s, landing = c.state.stopped_s, c.state.phase is Phase.LANDING
    if stopped_s is None or (landing and stopped_s >= c.state.entered_s and c.state.orders == 0):
        return False
    return is_still_hanging(c)


# --- What is remembered ---


def remember_observation(c: Context) -> Context:
    """The context with its state updated from its observation, for every kind of landing."""
    state, obs = c.state, c.obs
    if state.last is not None and obs.t_s - state.t_s > c.profile.positioning.hold_s:
        kept = lasting_conditions(state.since)
        off_s = max(obs.imu.off_s, obs.imu.silent_s)
        if Condition.DOWN in state.since and math.isfinite(off_s):
            # All samples of the hang have come, and in none do the motors turn: else a loop that
            # hangs in every turn would never see a landing end.
            kept[Condition.DOWN] = max(off_s, state.since[Condition.DOWN])
        # A catch is over, and its setpoint far above with it: held, it would press.
        setpoint = state.setpoint if state.caught else None
        stale_s = obs.t_s if c.by_sight else state.stale_s
        c = c.evolve(since=kept, stale_s=stale_s, caught=True, setpoint=setpoint)
    if c.position_is_stale:
        c = c.evolve(stale_s=obs.t_s)
    if obs.jumped:
        c = c.with_state(_jumped(c.state, obs))
    if obs.turned_rad > math.radians(c.safety.heading_lost_deg):
        c = c.evolve(heading_lost=True, hover_thrust=_hover_thrust(c.state, obs))
    c = c.with_state(_reckon(_answered(c)))
    comes_down = c.state.phase is Phase.LANDING and is_motor_borne(c)
    if comes_down and c.state.blind_s is None and _has_lost_its_position(c):
        return give_up_position(c)
    return c


def record_thrust_order(state: PlannerState, command: Command) -> PlannerState:
    """The state with `raw_order` set by `command`: its raw thrust, or None for a setpoint."""
    if isinstance(command, RawThrust):
        return replace(state, raw_order=command.thrust)
    if isinstance(command, Idle):
        return state
    return replace(state, raw_order=None, unanswered_s=None)


def _answered(c: Context) -> Context:
    """The tick with since when the thrust differs from the order."""
    order = c.state.raw_order
    if order is None:
        return c
    wanted = 0.0 if order < STILL_THRUST else min(MOST_RAW, order)
    apart = abs(c.telemetry.thrust - wanted) > UNANSWERED_PART * FULL_THRUST
    since_s = c.t_s if c.state.unanswered_s is None else c.state.unanswered_s
    c = c.evolve(unanswered_s=since_s if apart else None)
    return c if c.thrust_is_known else c.evolve(unread_s=c.t_s)


def give_up_position(c: Context) -> Context:
    """The context from which on only accelerometer and attitude are used, for good."""
    hover = _hover_thrust(c.state, c.obs)
    return c.evolve(blind_s=c.t_s, blind_height_m=c.height_m, hover_thrust=hover)


def _reckon(c: Context) -> PlannerState:
    state, obs = c.state, c.obs
    believed = c.placed and c.proves and state.blind_s is None and state.jump_s is None
    astray = state.astray and not c.by_sight
    new = advance_reckoning(
        state.reckoning,
        obs.imu,
        obs.telemetry,
        believed=believed,
        astray=astray,
        corrected=c.is_corrected,
        # What moves it while no sight corrects its estimate is no bias of the accelerometer.
        pushed=c.by_sight and not c.is_corrected,
    )
    if (
        believed
        and c.is_corrected
        and state.phase in IN_THE_OPEN
        and c.height_m > LIFTED_M
        and state.last
    ):
        new = learn_velocity_bias(new, state.last, obs.telemetry)
    else:
        new = forget_means(new)
    if c.located and not c.by_sight and state.last is not None:
        new = add_position_step(new, state.last, obs.telemetry)
    rests = obs.t_s - obs.imu.steady_s >= AT_REST_S and obs.t_s - obs.imu.fell_s > HANGING_S
    if state.contact_z_m is not None and new.below_m < REACH_M and rests:
        blown = obs.t_s - obs.imu.steady_aside_s < AT_REST_S
        x_mps, y_mps, _ = new.velocity_mps
        new = replace(new, velocity_mps=(x_mps, y_mps, 0.0) if blown else (0.0, 0.0, 0.0))
        if not blown:
            new = learn_bias_at_rest(new, state.reckoning.imu, obs.imu)
        if obs.telemetry.thrust < 1:  # it hangs, and what hangs stays where it is
            old = state.reckoning
            new = replace(new, aside_m=old.aside_m, aside_sigma_m=old.aside_sigma_m)
    felt, late = obs.felt, c.mismatch.later_s != 0.0
    if felt is not None and (state.reckoning.imu is None or felt.t_s > state.reckoning.imu.t_s):
        # Late pictures have led the estimate's height astray, too.
        climb_mps = felt.climb_mps if late else None
        climb_mps = new.velocity_mps[2] if climb_mps is None else climb_mps
        new = replace(
            new,
            velocity_mps=(*felt.velocity_mps, climb_mps),
            bias_mps2=(*felt.bias_mps2, new.bias_mps2[2]),
        )
    target = obs.target
    if target is not None:
        seen = obs.new_frame and target.measured
        if seen or (c.placed and not c.by_sight):
            yaw_rad, (ex, ey, ez) = obs.telemetry.yaw_rad, target.e_m
            cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
            sigma_m = float(max(target.sigma_m[:2]))
            aside_m = (float(cos * ex - sin * ey), float(sin * ex + cos * ey))
            if not seen and state.stale_s is not None and state.stale_s >= target.measured_s:
                aside_m, sigma_m = new.aside_m, new.aside_sigma_m
            new = add_sighting(new, target.measured_s, aside_m, float(ez), sigma_m)
            if seen and target.measured_s > new.stepped_s:
                new = replace(new, stepped_m=(0.0, 0.0))
    held_s = c.held_s(Condition.CARRIED)
    flies = state.phase is not Phase.LANDING
    near = c.by_sight and flies and new.below_m < CARRIED_WITHIN_M
    if near and held_s >= c.planner.perch.contact_dwell_s:
        # It is at the target; late pictures show it lower.
        new = replace(
            new,
            below_m=min(0.0, new.below_m),
            nearest_m=min(0.0, new.nearest_m),
            velocity_mps=(*new.velocity_mps[:2], 0.0),
        )
    reach_s = state.reach_s
    if is_motor_borne(c):  # what is released or stopped moves no more
        # After the floor was touched nothing climbs, whatever was reckoned since.
        near = new.below_m < REACH_M and state.touch_s is None
        within = state.contact_z_m is not None or near
        # Caught below the magnet it may be drawn to it again: an earlier fall proves nothing then.
        again = reach_s is not None and obs.imu.fell_s > reach_s and new.below_m < REACH_M
        reach_s = (obs.t_s if reach_s is None or again else reach_s) if within else None
    down_m = 0.0
    if state.blind_s is not None and state.reckoning.imu is not None:
        dt_s = max(0.0, min(0.5, obs.imu.t_s - state.reckoning.imu.t_s))
        down_m = new.velocity_mps[2] * dt_s
        last, tel = state.last, obs.telemetry
        heard_again = obs.imu.silent_s > state.reckoning.imu.t_s and c.proves and not obs.jumped
        if heard_again and last is not None and tel.start == last.start:
            down_m = tel.position_m[2] - last.position_m[2]
    return replace(
        state, reckoning=new, reach_s=reach_s, blind_height_m=state.blind_height_m + down_m
    )


def _jumped(state: PlannerState, obs: Observation) -> PlannerState:
    """The estimate's world has moved, the vehicle has not: ground, contact and all that is
    remembered move with it. Not where samples are missing before the step, since the vehicle may
    have moved, nor where external positions have come again and the step ends a drift."""
    tel, last = obs.telemetry, state.last
    if last is None:
        return replace(state, jump_s=obs.t_s if state.jump_s is None else state.jump_s)
    x, y, z = tel.position_m
    vx, vy, vz = tel.velocity_mps
    dt_s = tel.t_s - tel.behind_s - (last.t_s - last.behind_s)
    lx, ly, lz = last.position_m
    moved_m = (x - lx - vx * dt_s, y - ly - vy * dt_s, z - lz - vz * dt_s)
    put_right = state.stale_s is not None and obs.t_s - state.stale_s <= PUT_RIGHT_S
    if dt_s > UNSEEN_S or put_right:
        moved_m = (0.0, 0.0, 0.0)
    setpoint, contact_z_m, blocked_z_m = state.setpoint, state.contact_z_m, state.blocked_z_m
    if state.phase is Phase.LANDING and state.orders and tel.thrust >= 1:
        state = replace(
            state,
            entered_s=obs.t_s,
            orders=0,
            ordered_s=None,
            caught=False,
            catch_goal_above_m=CATCH_STILL_ABOVE_M,
        )
    if setpoint is not None:
        z_m = z if contact_z_m is None else setpoint.z_m + moved_m[2]
        setpoint = PositionSetpoint(x, y, z_m, tel.yaw_rad)
    return replace(
        state,
        reckoning=forget_means(state.reckoning),
        setpoint=setpoint,
        ground_m=None if state.ground_m is None else _moved(state.ground_m, moved_m),
        entry_m=_moved(state.entry_m, moved_m),
        contact_z_m=None if contact_z_m is None else contact_z_m + moved_m[2],
        blocked_z_m=None if blocked_z_m is None else blocked_z_m + moved_m[2],
        jump_s=obs.t_s if state.jump_s is None else state.jump_s,
    )


def _moved(place: Vector, by_m: Vector) -> Vector:
    return (place[0] + by_m[0], place[1] + by_m[1], place[2] + by_m[2])


def _hover_thrust(state: PlannerState, obs: Observation) -> float:
    tel = obs.telemetry
    measured = max(THRUST_MIN, tel.thrust / min(1.5, max(0.75, tel.acc_z_g)))
    return state.hover_thrust or obs.imu.hover_thrust or measured


# --- What is commanded ---


def act(c: Context) -> Action:
    """The landing's new state and command: by proof of a fall or of standing, else a descent."""
    state = c.state
    if _falls_free(c):
        return _caught_again(c)
    if state.stopped_s is None and not state.caught:
        if (caught := _catch(c)) is not None:
            return caught
        c = c.with_state(replace(state, caught=True))
    if c.state.stopped_s is not None or _stands(c):
        return stop_motors(c)
    if c.state.released_s is not None:
        return _weight_on_magnet(c)
    if c.state.orders:  # to change a landing of its own costs height
        return _own_landing(c)
    return release_by_thrust(c) if c.held_s(Condition.HANGING) >= HANGING_S else _descend(c)


def _descend(c: Context) -> Action:
    """Come down level, by thrust, unless the place is known.

    In the magnet's reach a setpoint below takes the thrust to its least, and what that does not
    move is given to the magnet. Else sink by setpoints to the hand-over, and from there by the
    vehicle's own landing: at once where height, stream or loop are doubtful. By the target it would
    follow an estimate that rests on pictures, to an unmeasured floor: then it is level from there.
    """
    if not _knows_its_place(c):
        return _level(c)
    landing, in_reach, doubtful = c.planner.landing, is_in_magnet_reach(c), _is_doubtful(c)
    if c.by_sight or not (in_reach or doubtful):
        state, away = leave_press(c)
        if away is not None:
            return state, away
        c = c.with_state(state)
    low = c.height_m <= landing.handover_m
    if in_reach:
        gives_up = c.in_phase_s > PEEL_S and (c.imu_proves or not doubtful)
        return release_by_thrust(c) if gives_up else _by_setpoints(c)
    if c.by_sight:
        return _level(c) if c.state.level_thrust or low else _by_setpoints(c)
    overdue = c.in_phase_s > landing.setpoint_time_s
    return _own_landing(c) if doubtful or overdue or low else _by_setpoints(c)


def _falls_free(c: Context) -> bool:
    if not c.imu_proves:
        return False
    if not is_motor_borne(c):
        return is_in_magnet_reach(c) and has_slipped(c)
    if c.state.orders:
        return False
    return c.state.contact_z_m is not None and c.state.caught and c.is_sinking(-DROPPING_MPS)


def _stands(c: Context) -> bool:
    """True if it is on the floor, by proof."""
    if c.proves and c.held_s(Condition.ON_FLOOR) >= 0.5:
        return True
    level = c.by_sight and c.placed and c.state.blind_s is None and c.state.level_thrust > 0.0
    low = c.height_m < STOP_BELOW_M and not is_in_magnet_reach(c)
    return level and low and c.climb_mps > -RESTS_MPS


def _caught_again(c: Context) -> Action:
    """The landing, begun anew below, with a catch."""
    tel = c.telemetry
    state = replace(
        c.state,
        released_s=None,
        stopped_s=None,
        contact_z_m=None,
        reach_s=None,
        caught=False,
        pressed=False,
        catch_goal_above_m=catch_goal_above_m(c.state.hover_thrust, tel.thrust),
        setpoint=None,
        ordered_s=None,
        orders=0,
        level_thrust=0.0,
        entered_s=c.t_s,
        entry_m=tel.position_m,
        entry_yaw_rad=tel.yaw_rad,
        reckoning=replace(c.state.reckoning, below_m=math.inf),
    )
    c = c.with_state(state)
    return _catch(c) or _descend(c)


def _catch(c: Context) -> Action | None:
    """A catch by position; None without a heading, or astray."""
    return None if c.state.heading_lost or c.state.astray else catch_slip(c)


def _by_setpoints(c: Context) -> Action:
    """Sink straight down at the landing's speed, from where the landing began."""
    landing, state = c.planner.landing, c.state
    here = hold_here(c)
    start = state.setpoint if state.caught and state.setpoint is not None else here
    start = replace(start, z_m=min(start.z_m, here.z_m))
    x, y, _ = state.entry_m
    goal = replace(start, x_m=x, y_m=y, z_m=state.ground_z_m + 0.5 * landing.handover_m)
    setpoint = step_towards(c.evolve(setpoint=start), goal, down_mps=landing.speed_mps)
    if c.telemetry_age_s <= c.safety.telemetry_hold_s:
        setpoint = replace(setpoint, z_m=max(setpoint.z_m, here.z_m - PEEL_BELOW_M))
    state = replace(clear_contact_below(c, PEELED_M).state, setpoint=setpoint, caught=True)
    dx, dy = state.integral_m
    sent = replace(setpoint, x_m=setpoint.x_m + dx, y_m=setpoint.y_m + dy)
    return state, limit_setpoint(c, sent)


def onboard_landing(planner: PlannerConfig, ground_z_m: float, flown_s: float, z_m: float) -> Land:
    """The order for the firmware's own landing from height `z_m`, a quintic from rest to rest.

    The goal is below the ground, by more the longer the flight (`flown_s`) and so the drift, and
    never above the vehicle: at the trajectory's end the motors stop.
    """
    drifted_m = min(MOST_DRIFT_M, planner.landing.drift_mps * max(0.0, flown_s))
    aim_m = min(ground_z_m, z_m) - (planner.landing.undershoot_m + drifted_m)
    return Land(aim_m, SETTLING_S + PEAK_OF_MEAN * (z_m - aim_m) / PLANNED_MPS)


def _own_landing(c: Context) -> Action:
    tel = c.telemetry
    state, away = leave_press(c)
    if away is not None and not _is_doubtful(c) and not state.orders:
        return state, away
    ends = state.orders >= LEAST_ORDERS and not (c.placed and c.height_m >= FALLEN_BELOW_M)
    carried = tel.acc_z_g > FALLING_G or (ends and tel.velocity_mps[2] > -FALLEN_MPS)
    if c.imu_proves and tel.thrust < 1 and carried and (state.orders or not tel.has_bit(FLYING)):
        return state, Idle()  # on the floor: another order would spin the motors up again
    waited = math.inf if state.ordered_s is None else c.t_s - state.ordered_s
    seen = state.orders >= LEAST_ORDERS and c.imu_proves and tel.has_bit(HL_ACTIVE)
    if not seen and waited > REPEAT_ORDER_S and state.orders < MAX_ORDERS:
        flown_s = c.t_s - state.started_s
        order = onboard_landing(c.planner, state.ground_z_m, flown_s, tel.position_m[2])
        return replace(state, ordered_s=c.t_s, orders=state.orders + 1, setpoint=None), order
    return state, Idle()


def _level(c: Context) -> Action:
    """Sink level by raw thrust on the vertical speed, tilted against the sideways speed. What does
    not sink gets less and less thrust: it sinks, the magnet lets go, or the floor proves itself."""
    state, tel = c.state, c.telemetry
    dt_s = max(0.0, min(0.1, c.t_s - state.t_s))
    age_s = max(1e-3, dt_s, c.attitude_age_s)
    unheard = age_s > LATEST_S
    unlearned = state.level_thrust == 0.0 and state.level_within == UNLEARNED_WITHIN
    if unheard and unlearned and c.in_phase_s < OWN_ESTIMATE_S:
        return _by_setpoints(c)
    held = tel.t_s < state.entered_s - ON_THE_SPOT_S
    climb_mps = (0.0 if held else c.climb_mps) + state.under_way_mps
    hover = _learned_hover(c, dt_s)
    height_m = c.height_m if state.blind_s is None else state.blind_height_m
    height_m += min(0.0, climb_mps) * age_s
    # Late pictures may show the floor half a metre too far.
    low = height_m <= SLOW_BELOW_M or c.mismatch.later_s != 0.0
    sink_mps = LOW_SINK_MPS if low else SINK_MPS
    gain = GAIN_AGE_S2_PER_M / max(1e-3, c.attitude_age_s)
    gain = max(LEAST_GAIN_S_PER_M, min(MOST_GAIN_S_PER_M, gain))
    thrust = hover * (1.0 - gain * (climb_mps + sink_mps)) / max(0.8, math.cos(c.tilt_rad))
    touch_s = state.touch_s
    if touch_s is None and c.t_s - c.obs.imu.blow_s < TOUCH_S and height_m < TOUCH_BELOW_M:
        touch_s = c.t_s
    if unheard:
        thrust *= UNHEARD_PART
    touched_s = math.inf if touch_s is None else c.t_s - touch_s
    # In the air the accelerometer reads what the thrust gives, on the floor one g.
    if touched_s >= TOUCH_S and c.imu_proves and tel.acc_z_g < 0.5 * (1.0 + tel.thrust / hover):
        touch_s = None  # it falls with its thrust: that was no floor
    carried = c.imu_proves and tel.acc_z_g > CARRIED_G and tel.thrust < CARRIED_PART * hover
    overdue = _is_overdue(c) and not (c.imu_proves and tel.acc_z_g < AIRBORNE_G)
    before = state.level_thrust or hover
    if touched_s < TOUCH_S:
        thrust = TOUCH_PART * hover
    elif touch_s is not None or carried or climb_mps > -STILL_MPS or overdue:
        thrust = min(thrust, before - RAMP_PER_S * hover * dt_s)
    thrust = max(LEAST_PART * hover, min(MOST_RAW, thrust))
    # The speed that orders have given since the newest sample.
    shown_s = 0.0 if state.last is None else max(0.0, tel.t_s - state.level_sample_s)
    gained_mps = GRAVITY_MPS2 * (thrust / hover - 1.0) * dt_s
    under_way_mps = state.under_way_mps * max(0.0, 1.0 - shown_s / age_s) + gained_mps
    state = replace(
        clear_contact_after_fall(c).state,
        hover_thrust=hover,
        level_thrust=thrust,
        touch_s=touch_s,
        level_hover=state.level_hover or state.hover_thrust,
        under_way_mps=under_way_mps,
        level_sample_s=tel.t_s,
        setpoint=None,
        orders=0,
        caught=True,
    )
    roll_rad, pitch_rad = (0.0, 0.0) if touch_s is not None else _braking(c)
    return state, RawThrust(int(thrust), roll_rad, pitch_rad)


def is_landing_over(c: Context) -> bool:
    """True if a landing is over: its raw thrust is at its least, or its setpoint at the floor.
    Without a stop the firmware would lock the vehicle."""
    setpoint, ground_m = c.state.setpoint, c.state.ground_m
    if setpoint is not None and ground_m is not None:
        landing = c.planner.landing
        if c.state.row == "landing-timeout" and setpoint.z_m <= ground_m[2] + landing.handover_m:
            return True
    return 0.0 < c.state.level_thrust <= LEAST_PART * c.state.hover_thrust + 1.0


def clear_contact_after_fall(c: Context) -> Context:
    """The context; without its contact once a position shows the vehicle lower, or after a fall."""
    if c.placed and c.state.blind_s is None:
        return clear_contact_below(c, PEELED_M)
    reach_s = c.state.reach_s
    if reach_s is not None and c.obs.imu.fell_s > max(reach_s, c.state.entered_s):
        reckoning = replace(c.state.reckoning, below_m=math.inf)
        blind_s = None if c.state.blind_s is None else c.t_s
        state = replace(
            c.state, contact_z_m=None, reach_s=None, reckoning=reckoning, blind_s=blind_s
        )
        return c.with_state(state)
    return c


def _learned_hover(c: Context, dt_s: float) -> float:
    state, tel = c.state, c.telemetry
    first = state.level_hover or state.hover_thrust
    within = state.level_within
    if c.attitude_age_s > LATEST_S or not 0.7 <= tel.acc_z_g <= 1.3 or tel.thrust < 0.5 * first:
        return state.hover_thrust
    if is_in_magnet_reach(c) or state.touch_s is not None:
        return state.hover_thrust
    felt = tel.thrust / tel.acc_z_g
    memory_s = HOVER_MEMORY_S if within == HOVER_WITHIN else 0.5 * HOVER_MEMORY_S
    hover = state.hover_thrust + (felt - state.hover_thrust) * min(1.0, dt_s / memory_s)
    return min((1.0 + within) * first, max((1.0 - within) * first, hover))


def _is_overdue(c: Context) -> bool:
    """True if it was blind for so long that it has come down, or hangs."""
    if c.state.blind_s is None and not c.state.astray:
        return False
    way_m = max(0.0, c.state.entry_m[2] - c.state.ground_z_m)
    began_s = max(c.state.blind_s or 0.0, c.state.entered_s)
    heard = c.attitude_age_s <= LATEST_S
    spare_s = LEVEL_SPARE_S if heard else UNHEARD_SPARE_S
    if not heard and c.state.level_within == UNLEARNED_WITHIN:
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
    if c.state.heading_lost or is_in_magnet_reach(c):
        return 0.0, 0.0
    reckoning, yaw_rad = c.state.reckoning, c.telemetry.yaw_rad
    x_mps, y_mps, _ = reckoning.velocity_mps
    speed_mps = max(1e-6, math.hypot(x_mps, y_mps))
    blind_s = 0.0 if c.state.blind_s is None else c.t_s - c.state.blind_s
    felt_s = math.inf if c.obs.felt is None else c.t_s - c.obs.felt.t_s
    unsure_mps = min(MOST_UNSURE_MPS, UNSURE_MPS + UNSURE_MPS2 * min(blind_s, felt_s))
    part = max(0.0, 1.0 - unsure_mps / speed_mps)
    part *= min(1.0, BRAKED_AGE_S / max(1e-3, c.attitude_age_s))
    ahead_mps, left_mps = _in_heading(part * x_mps, part * y_mps, yaw_rad)
    (bias_x_mps2, bias_y_mps2, _), (x_mps2, y_mps2) = reckoning.bias_mps2, reckoning.aside_mps2
    known = 0.0 if c.state.astray else min(1.0, reckoning.held_s / BIAS_MEMORY_S)
    counts = known + (1.0 - known) * max(0.0, 1.0 - felt_s / LEVEL_FELT_S)
    ahead_mps2, left_mps2 = _in_heading(
        counts * bias_x_mps2 - known * x_mps2, counts * bias_y_mps2 - known * y_mps2, yaw_rad
    )
    roll_rad, pitch_rad = c.obs.imu.misled_rad
    return (
        _against(-left_mps) - _lean_rad(left_mps2) + roll_rad,
        _against(ahead_mps) + _lean_rad(ahead_mps2) + pitch_rad,
    )


def _in_heading(x: float, y: float, yaw_rad: float) -> tuple[float, float]:
    """World x and y as ahead and left of a vehicle with this heading."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return x * cos + y * sin, y * cos - x * sin


def _lean_rad(mps2: float) -> float:
    return max(-MOST_LEAN_RAD, min(MOST_LEAN_RAD, math.atan(mps2 / GRAVITY_MPS2)))


def _against(mps: float) -> float:
    return max(-MOST_BRAKE_RAD, min(MOST_BRAKE_RAD, -BRAKE_RAD_PER_MPS * mps))


def _weight_on_magnet(c: Context) -> Action:
    """Put the whole weight on whatever carries it, and monitor that; without telemetry order what
    carries most of it: what hangs stays, what has fallen does not rise."""
    if c.attitude_age_s <= c.safety.telemetry_hold_s:
        return release_by_thrust(c)
    thrust = int(max(STILL_THRUST, min(THRUST_MIN, LEAST_PART * c.state.hover_thrust)))
    return replace(c.state, released_s=c.t_s), RawThrust(thrust)
