"""The one way down: for the planner's LANDING, the watchdog of a silent loop, and the rescue.

Pure: `step_landing(state, observation, profile) -> (state, command)`.

A descent, a release or a motor stop that has begun is completed even if the evidence changes. What
still comes down does it by one of four policies, chosen in `descend` by what is known and fresh,
and by whether the magnet may hold the vehicle (the table of docs/mission.md):

- by position setpoints, straight down;
- level, by raw thrust on the vertical speed, without a position;
- by the vehicle's own landing, near the ground or where height, stream or loop are doubtful;
- peeled off the magnet by a setpoint below; if it does not let go, the weight is hung on it.

Nothing here climbs but a catch. The vehicle's own landing follows a trajectory by its clock and
then stops the motors, wherever it is by then: it is ordered only where a position shows the vehicle
away from the ceiling.
"""

from __future__ import annotations

import math

from perchctl.mission.belief import hover
from perchctl.mission.belief.contact import (
    HANGING,
    HANGING_S,
    ON_FLOOR,
    has_slipped,
    is_pressing,
)
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.belief.reckoning import MAGNET_REACH_M
from perchctl.mission.belief.thrust import LEAST_POSITION_THRUST
from perchctl.mission.belief.update import (
    STILL_THRUST,
    after_command,
    forget_evidence,
    give_up_position,
)
from perchctl.mission.context import Context
from perchctl.mission.level_descent import (
    LEAST_ORDERED_PART,
    PEELED_M,
    descend_level,
    waits_for_its_own_estimate,
)
from perchctl.mission.observation import Observation
from perchctl.mission.observe import observe
from perchctl.mission.phase import Claim, Phase, Severity
from perchctl.mission.release import (
    catch_goal_above_m,
    catch_slip,
    clear_contact_below,
    leave_press,
    release_by_thrust,
    stop_motors,
)
from perchctl.mission.setpoints import (
    Action,
    anchor_in_wind,
    hold_here,
    limit_setpoint,
    step_towards,
)
from perchctl.mission.state import PlannerState
from perchctl.profile import PlannerConfig, Profile
from perchctl.values import replace
from perchctl.vehicle import FLYING, HL_ACTIVE, Command, Idle, Land, RawThrust

MANEUVER = Maneuver(descends=True)

# --- by setpoints, and off the magnet ---
PEEL_BELOW_M = 0.35
"""The most that a setpoint is below the vehicle. Larger: what comes off the magnet falls."""
PEEL_S = 4.0
"""If the vehicle has not come off the magnet by then, it stops pulling and hangs its weight on it.
Larger: it pulls for longer, and falls if the magnet lets go late."""
DROPPING_MPS = -0.35
"""Vertical speed of a vehicle that falls off the magnet while it is peeled off."""
STOP_BELOW_M = 0.05
"""Height below which a descent by thrust stands, if it does not move."""
RESTS_MPS = 0.1
"""Vertical speed up to which it does not. Larger: motors stop while it still climbs or sinks."""
ON_FLOOR_S = 0.5
"""Time for which a vehicle has to stand still before its motors are stopped."""

# --- by the vehicle's own landing ---
REPEAT_ORDER_S = 0.3
"""Time between orders. Without its notify an order is not flown (docs/firmware.md, "Order without
notify")."""
LEAST_ORDERS = 3
"""So many orders until the telemetry may show that it lands."""
MAX_ORDERS = 6
"""No more."""
PLANNED_MPS = 0.35
"""Mean speed of its quintic."""
LANDING_MARGIN_S = 1.8
"""Time that the quintic is given beyond that."""
PEAK_OF_MEAN = 1.875
"""A quintic's largest speed over its mean."""
MOST_DRIFT_M = 1.0
"""The most that the height is thought to have drifted."""
FALLING_G = 0.5
"""Specific force below which it falls: no floor carries it."""
FALLEN_MPS = 1.0
"""From 5 cm above the floor it drops no faster."""
FALLEN_BELOW_M = 0.4
"""Motors that stop above are a cut in the air."""


def step_landing(
    state: PlannerState | None, obs: Observation, profile: Profile
) -> tuple[PlannerState, Command]:
    """Fly one tick of the way down without the mission's table, for watchdog and rescue; the
    first call begins the landing. `state` is None if the planner has not run yet."""
    state = state or PlannerState.on_ground(obs, profile)
    state = replace(state, belief=state.belief.seen(obs, profile))
    state = observe(begin_landing(state), obs, profile, MANEUVER)
    return remember_command(*act(Context(state)))


def remember_command(state: PlannerState, command: Command) -> tuple[PlannerState, Command]:
    """The state at the end of a tick that has decided on `command`, and the command."""
    order = state.raw_order
    if not isinstance(command, Idle):
        order = command.thrust if isinstance(command, RawThrust) else None
    belief = after_command(state.belief, command)
    return replace(state, belief=belief, raw_order=order, t_s=belief.obs.t_s), command


def begin_landing(state: PlannerState) -> PlannerState:
    """The state in the phase LANDING; unchanged if the landing had begun before."""
    if state.phase is Phase.LANDING:
        return state
    b, tel = state.belief, state.belief.telemetry
    new = replace(
        state,
        phase=Phase.LANDING,
        entry=replace(state.entry, t_s=b.obs.t_s, position_m=tel.position_m, yaw_rad=tel.yaw_rad),
        severity=max(state.severity, Severity.LAND),
        since={},
        belief=forget_evidence(b),
        pressed=state.catch_above_m is None and is_pressing(b),
        ordered_s=None,
        orders=0,
    )
    return enter_landing(new, state)


def enter_landing(state: PlannerState, before: PlannerState) -> PlannerState:
    """The state at the begin of a landing; `before`: the state before it."""
    b, tel, old = state.belief, state.belief.telemetry, before.belief
    heard = b.attitude_age_s <= b.profile.safety.proof_age_s
    if heard and tel.has_bit(HL_ACTIVE) and not b.by_target and not b.diverged:
        state = replace(state, orders=LEAST_ORDERS, ordered_s=b.obs.t_s)
    elif heard and tel.thrust < 1 and before.stopped_s is None:
        # The motors were stopped, or never turned: nothing spins them up again.
        state = replace(state, stopped_s=b.obs.t_s)
    contact_z_m = old.contact_z_m
    pressed_unseen = state.pressed and b.by_target
    if contact_z_m is None and (before.phase is Phase.PERCH or pressed_unseen):
        # It may be in the magnet's reach, also below a sheet that hangs above an unseen ceiling:
        # it has to be seen below before it counts as free.
        contact_z_m = tel.position_m[2]
    # Where it stands still in the air, what holds it there goes down with it.
    state = anchor_in_wind(Context(state))
    within = contact_z_m is not None or b.reckoning.below_m < MAGNET_REACH_M
    lost = b.has_lost_its_position
    b = replace(
        b,
        reach_s=before.t_s if within and old.reach_s is None else old.reach_s,
        contact_z_m=contact_z_m,
        hover=hover.best_estimate(old),
    )
    return replace(state, belief=give_up_position(b) if lost else b)


def act(c: Context) -> Action:
    """The landing's new state and command: by proof of a fall or of standing, else a descent."""
    state = c.state
    if _falls_free(c):
        return _caught_again(c)
    if state.stopped_s is None and state.catch_above_m is not None:
        if (caught := _catch(c)) is not None:
            return caught
        c = Context(replace(state, catch_above_m=None))
    if c.state.stopped_s is not None or _stands(c):
        return stop_motors(c)
    if c.state.released_s is not None:
        return _weight_on_magnet(c)
    if c.state.orders:  # to change a landing of its own costs height
        return _own_landing(c)
    return _release(c) if c.held_s(HANGING) >= HANGING_S else descend(c)


def descend(c: Context) -> Action:
    """Come down by one of the four policies.

    Without a position the descent is level from the start. In the magnet's reach the setpoint is
    lowered until the vehicle peels off; if it does not, its weight is put on the magnet. Elsewhere
    it descends by setpoints to `handover_m` and from there by the firmware's own landing, or by
    that landing at once if height, telemetry or loop cannot be relied on. With the target as the
    positioning system there is no such landing, since its trajectory would follow the camera's
    estimate to a floor of unknown height: from `handover_m` on the descent is level.
    """
    b = c.belief
    if not b.knows_its_place:
        return _level(c)
    landing, in_reach, doubtful = c.planner.landing, b.is_in_magnet_reach, b.is_doubtful
    if b.by_target or not (in_reach or doubtful):
        state, away = leave_press(c)
        if away is not None:
            return state, away
        c = Context(state)
    low = b.height_m <= landing.handover_m
    if in_reach:
        gives_up = c.in_phase_s > PEEL_S and (b.imu_proves or not doubtful)
        return _release(c) if gives_up else _by_setpoints(c)
    if b.by_target:
        return _level(c) if c.state.descent.thrust or low else _by_setpoints(c)
    overdue = c.in_phase_s > landing.setpoint_time_s
    return _own_landing(c) if doubtful or overdue or low else _by_setpoints(c)


def is_landing_over(c: Context) -> bool:
    """True if a landing is over: its raw thrust is at its least, or its setpoint at the floor.
    Without a stop the firmware would lock the vehicle."""
    setpoint, ground_m = c.state.setpoint, c.belief.ground_m
    if setpoint is not None and ground_m is not None:
        low = setpoint.z_m <= ground_m[2] + c.planner.landing.handover_m
        if low and Claim.UNCONFIRMED in c.state.entry.claims:
            return True
    return 0.0 < c.state.descent.thrust <= LEAST_ORDERED_PART * c.belief.hover_thrust + 1.0


# --- A fall, and what stands ---


def _falls_free(c: Context) -> bool:
    b, state = c.belief, c.state
    if not b.imu_proves:
        return False
    if not state.is_motor_borne:
        return b.is_in_magnet_reach and has_slipped(b)
    if state.orders:
        return False
    caught = state.catch_above_m is None
    return b.contact_z_m is not None and caught and b.is_sinking(-DROPPING_MPS)


def _stands(c: Context) -> bool:
    """True if it is on the floor, by proof."""
    b = c.belief
    if b.proves and c.held_s(ON_FLOOR) >= ON_FLOOR_S:
        return True
    placed = b.by_target and b.position_valid and b.dead_reckoned_s is None
    low = b.height_m < STOP_BELOW_M and not b.is_in_magnet_reach
    return placed and c.state.descent.thrust > 0.0 and low and abs(b.climb_mps) < RESTS_MPS


def _caught_again(c: Context) -> Action:
    """The landing, begun anew below, with a catch."""
    tel, b = c.telemetry, c.belief
    belief = replace(
        b, contact_z_m=None, reach_s=None, reckoning=replace(b.reckoning, below_m=math.inf)
    )
    state = replace(
        c.state,
        belief=belief,
        released_s=None,
        stopped_s=None,
        pressed=False,
        catch_above_m=catch_goal_above_m(b.hover_thrust, tel.thrust),
        setpoint=None,
        ordered_s=None,
        orders=0,
        descent=replace(c.state.descent, thrust=0.0),
        entry=replace(c.state.entry, t_s=c.t_s, position_m=tel.position_m, yaw_rad=tel.yaw_rad),
    )
    c = Context(state)
    return _catch(c) or descend(c)


def _catch(c: Context) -> Action | None:
    """A catch by position; None without a heading, or with positions that have diverged."""
    return None if c.belief.heading_lost or c.belief.diverged else catch_slip(c)


# --- The four policies ---


def _by_setpoints(c: Context) -> Action:
    """Sink straight down at the landing's speed, from where the landing began."""
    landing, state, b = c.planner.landing, c.state, c.belief
    here = hold_here(c)
    start = here
    if state.catch_above_m is None and state.setpoint is not None:
        start = state.setpoint
    start = replace(start, z_m=min(start.z_m, here.z_m))
    x, y, _ = state.entry.position_m
    goal = replace(start, x_m=x, y_m=y, z_m=b.ground_z_m + 0.5 * landing.handover_m)
    setpoint = step_towards(c, start, goal, down_mps=landing.speed_mps, turns=False)
    if b.telemetry_age_s <= c.safety.telemetry_hold_s:
        setpoint = replace(setpoint, z_m=max(setpoint.z_m, here.z_m - PEEL_BELOW_M))
    state = clear_contact_below(state, PEELED_M)
    state = replace(state, setpoint=setpoint, catch_above_m=None)
    dx, dy = state.integral_m
    sent = replace(setpoint, x_m=setpoint.x_m + dx, y_m=setpoint.y_m + dy)
    return state, limit_setpoint(c, sent)


def _level(c: Context) -> Action:
    """Sink level by raw thrust; by setpoints for a while if no thrust to sink by is known."""
    return _by_setpoints(c) if waits_for_its_own_estimate(c) else descend_level(c)


def onboard_landing(planner: PlannerConfig, ground_z_m: float, flown_s: float, z_m: float) -> Land:
    """The order for the firmware's own landing from height `z_m`, a quintic from rest to rest.

    The goal is below the ground, by more the longer the flight (`flown_s`) and so the drift, and
    never above the vehicle: at the trajectory's end the motors stop.
    """
    drifted_m = min(MOST_DRIFT_M, planner.landing.drift_mps * max(0.0, flown_s))
    aim_m = min(ground_z_m, z_m) - (planner.landing.undershoot_m + drifted_m)
    return Land(aim_m, LANDING_MARGIN_S + PEAK_OF_MEAN * (z_m - aim_m) / PLANNED_MPS)


def _own_landing(c: Context) -> Action:
    """Order the vehicle's own landing until the telemetry shows that it is flown."""
    tel, b = c.telemetry, c.belief
    state, away = leave_press(c)
    if away is not None and not b.is_doubtful and not state.orders:
        return state, away
    ends = state.orders >= LEAST_ORDERS and not (b.position_valid and b.height_m >= FALLEN_BELOW_M)
    carried = tel.acc_z_g > FALLING_G or (ends and tel.velocity_mps[2] > -FALLEN_MPS)
    if b.imu_proves and tel.thrust < 1 and carried and (state.orders or not tel.has_bit(FLYING)):
        return state, Idle()  # on the floor: another order would spin the motors up again
    waited = math.inf if state.ordered_s is None else c.t_s - state.ordered_s
    seen = state.orders >= LEAST_ORDERS and b.imu_proves and tel.has_bit(HL_ACTIVE)
    if not seen and waited > REPEAT_ORDER_S and state.orders < MAX_ORDERS:
        flown_s = c.t_s - state.started_s
        order = onboard_landing(c.planner, b.ground_z_m, flown_s, tel.position_m[2])
        return replace(state, ordered_s=c.t_s, orders=state.orders + 1, setpoint=None), order
    return state, Idle()


def _release(c: Context) -> Action:
    """Put the weight on the magnet; by older samples than a perch takes."""
    return release_by_thrust(c, late_s=c.safety.telemetry_hold_s)


def _weight_on_magnet(c: Context) -> Action:
    """Put the whole weight on whatever carries it, and monitor that; without telemetry order what
    carries most of it: what hangs stays, what has fallen does not rise."""
    if c.belief.attitude_age_s <= c.safety.telemetry_hold_s:
        return _release(c)
    part = LEAST_ORDERED_PART * c.belief.hover_thrust
    thrust = int(max(STILL_THRUST, min(LEAST_POSITION_THRUST, part)))
    return replace(c.state, released_s=c.t_s), RawThrust(thrust)
