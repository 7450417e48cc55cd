"""The way down: by position setpoints as long as height and link can be trusted, the rest by
the vehicle's own landing, which needs no further packet.

What hangs on the magnet is first peeled off: the setpoint goes down and the thrust with it.
Where the magnet holds all the same, a landing would drop the vehicle when its trajectory
ends; then the whole weight is put on the magnet instead, and watched.
"""

from __future__ import annotations

import math

from perchctl.mission.context import HANGING_S, Context
from perchctl.mission.guards import has_slipped
from perchctl.mission.guidance import hold_here, limited, unpressed, walk
from perchctl.mission.level import can_level, level_down
from perchctl.mission.release import (
    Acted,
    catch,
    catch_above_m,
    left_contact,
    let_go,
    stop_motors,
)
from perchctl.mission.state import Condition
from perchctl.profile import LandingConfig
from perchctl.values import replace
from perchctl.vehicle import Idle, Land, Telemetry

REPEAT_ORDER_S = 0.3
LEAST_ORDERS, MAX_ORDERS = 3, 6
"""An order without its notify shows *HL active* and is not flown, and 2 s later the vehicle
is cut (docs/firmware.md, "Order without notify"): no telemetry tells a lost notify, so the
pair is sent three times, and more often while nothing shows."""
PLANNED_MPS, SETTLING_S = 0.35, 1.8
"""The quintic's largest speed, and time added for its begin: it starts at rest, while the
vehicle comes sinking, and what the vehicle then catches up with must be slow."""
MOST_DRIFT_M = 1.0
BLIND_DRIFT_MPS = 0.08
"""Of a height that no position from outside corrects: the most that 40 simulated landings had."""
UNKNOWN_M = 1.0
"""The height to come down from where none is known."""
PEELED_M = 0.1
"""Below the contact by so much, the magnet has let go."""
PEEL_BELOW_M, PEEL_BLIND_S = 0.35, 4.0
DROPPING_MPS = -0.35
OVERDUE = 0.5
"""Of the landing's time: what is up there by then is left to its own landing."""
FALLING_G, FALLEN_MPS = 0.5, 1.0
"""A landing that ends 5 cm above the floor drops it no faster, and is over."""
FALLEN_BELOW_M = 0.4
"""By an estimate that is placed, such an end is not higher up: that is a cut in the air."""
_PEAK_OF_MEAN = 1.875
"""Of a quintic from rest to rest: its largest speed over its mean."""


def own_landing(
    landing: LandingConfig,
    ground_z_m: float,
    flown_s: float,
    newest: Telemetry | None,
    blind_s: float = 0.0,
) -> Land:
    """The order for the vehicle's own landing, which follows a quintic from rest to rest.

    It aims below the ground, and the lower the longer the estimate has had to drift: the
    motors stop at the trajectory's end, and over a floor that lies lower they would drop it.
    It never aims above where the estimate has the vehicle, which may be far below the ground by
    now: that would be a climb. `blind_s`: for how long no position from outside has come; until
    the floor none will, so it aims deeper in the same time, which is faster.
    """
    z_m = math.nan if newest is None else newest.position_m[2]
    below_m = landing.undershoot_m + min(MOST_DRIFT_M, landing.drift_mps * max(0.0, flown_s))
    known = math.isfinite(z_m)
    aim_m = (min(ground_z_m, z_m) if known else ground_z_m) - below_m
    way_m = z_m - aim_m if known else UNKNOWN_M
    lasts_s = SETTLING_S + _PEAK_OF_MEAN * way_m / PLANNED_MPS
    if blind_s > 0.0:
        aim_m -= min(MOST_DRIFT_M, BLIND_DRIFT_MPS * (blind_s + lasts_s))
    return Land(aim_m, lasts_s)


def landing(c: Context) -> Acted:
    state = c.state
    if state.stopped_s is not None:
        return _hang_on(c) if state.contact_z_m is not None else stop_motors(c)
    level = (state.heading_lost or state.blind_s is not None) and can_level(c)
    if not level and not state.caught:
        if (caught := catch(c)) is not None:
            return caught
        state = replace(state, caught=True)
        c = Context(state, c.obs, c.profile)
    if c.proves and c.held(Condition.ON_FLOOR) >= 0.5:
        return stop_motors(c)
    if state.released_s is not None:
        return _hang_on(c)
    if _drops(c):
        return _caught_again(c)
    if c.held(Condition.HANGING) >= HANGING_S and state.orders == 0:
        return let_go(c)
    if level:
        # A blind estimate slides away from a ceiling that holds the vehicle.
        return level_down(left_contact(c, PEELED_M) if c.placed or state.blind_s is None else c)
    state, away = unpressed(c)
    if away is not None and not _doubtful(c):
        return state, away
    c = Context(state, c.obs, c.profile)
    low = c.height_m <= c.profile.planner.landing.handover_m
    # When its time is over nothing is sent any more: by then it must be landing by itself.
    overdue = c.in_phase_s > OVERDUE * c.profile.planner.landing.timeout_s
    if state.orders or overdue or (not _is_peeling(c) and (low or _doubtful(c))):
        return _by_itself(c)
    return _by_setpoints(c)


def _hang_on(c: Context) -> Acted:
    """Released or stopped at the ceiling; a slip is caught, and the landing goes on below."""
    if has_slipped(c):
        return _caught_again(c)
    return let_go(c) if c.state.stopped_s is None else stop_motors(c)


def _drops(c: Context) -> bool:
    """Peeled off with too little thrust left to go on down slowly."""
    at_ceiling = c.state.contact_z_m is not None and c.state.orders == 0
    return at_ceiling and c.proves and c.sinks(-DROPPING_MPS)


def _caught_again(c: Context) -> Acted:
    """It is free of the magnet, and falls: the landing begins anew below."""
    tel = c.obs.telemetry
    state = replace(
        c.state, released_s=None, stopped_s=None, contact_z_m=None, caught=False, pressed=False,
        catch_above_m=catch_above_m(c.state.hover_thrust, tel.thrust),
        setpoint=None, ordered_s=None, orders=0,
        entered_s=c.obs.t_s, entry_m=tel.position_m, entry_yaw_rad=tel.yaw_rad,
    )  # fmt: skip
    c = Context(state, c.obs, c.profile)
    return catch(c) or _by_setpoints(c)


def _is_peeling(c: Context) -> bool:
    """At the ceiling, a landing of the vehicle's own would run by its clock and end with the
    motors off up there: first setpoints below, for a while also blindly."""
    if c.state.contact_z_m is None:
        return False
    seen = c.obs.link_problem is None and c.telemetry_age_s <= c.profile.safety.telemetry_hold_s
    return seen or c.in_phase_s < PEEL_BLIND_S


def _doubtful(c: Context) -> bool:
    """Whether the height, the stream or this loop cannot be relied on."""
    safety = c.profile.safety
    return (
        c.obs.link_problem is not None
        or c.telemetry_age_s > safety.telemetry_hold_s
        or c.state.jump_s is not None
        or c.obs.loop_late_s > safety.loop_late_hold_s
    )


def _by_setpoints(c: Context) -> Acted:
    """Straight down at the landing's speed, where it was when the landing began."""
    landing_config, state = c.profile.planner.landing, c.state
    here = hold_here(c)
    start = state.setpoint if state.caught and state.setpoint is not None else here
    # A setpoint far above (the press, a search step) must not be walked down slowly.
    start = replace(start, z_m=min(start.z_m, here.z_m))
    x, y, _ = state.entry_m
    ground_z = state.ground_m[2] if state.ground_m else 0.0
    goal = replace(start, x_m=x, y_m=y, z_m=ground_z + 0.5 * landing_config.handover_m)
    setpoint = walk(
        start,
        goal,
        c.obs.t_s - state.t_s,
        xy_mps=c.profile.planner.align.speed_mps,
        up_mps=0.0,
        down_mps=landing_config.speed_mps,
        yaw_rate_radps=0.0,
    )
    # A vehicle that does not follow is not pulled by a setpoint that runs away from it,
    # beyond what takes the thrust down to its least.
    setpoint = replace(setpoint, z_m=max(setpoint.z_m, here.z_m - PEEL_BELOW_M))
    state = replace(left_contact(c, PEELED_M).state, setpoint=setpoint, caught=True)
    return state, limited(c, setpoint)


def _by_itself(c: Context) -> Acted:
    """The vehicle's own landing, given again while it shows no effect."""
    landing_config, state = c.profile.planner.landing, c.state
    tel = c.obs.telemetry
    # Where it has been given often enough, a short fall is its end, and not that it was lost:
    # near the floor, or where nothing tells how near that is.
    ends = state.orders >= LEAST_ORDERS and not (c.placed and c.height_m >= FALLEN_BELOW_M)
    carried = tel.acc_z_g > FALLING_G or (ends and tel.velocity_mps[2] > -FALLEN_MPS)
    if c.proves and c.obs.telemetry.thrust < 1 and carried and (state.orders or not c.flying):
        return state, Idle()  # on the floor: another order would spin the motors up again
    ground_z = state.ground_m[2] if state.ground_m else 0.0
    waited = math.inf if state.ordered_s is None else c.obs.t_s - state.ordered_s
    seen = state.orders >= LEAST_ORDERS and c.proves and c.high_level_active
    if not seen and waited > REPEAT_ORDER_S and state.orders < MAX_ORDERS:
        flown_s = c.obs.t_s - state.started_s
        blind_s = 0.0 if c.placed else c.obs.position_age_s
        order = own_landing(landing_config, ground_z, flown_s, tel, blind_s)
        return replace(state, ordered_s=c.obs.t_s, orders=state.orders + 1, setpoint=None), order
    return state, Idle()
