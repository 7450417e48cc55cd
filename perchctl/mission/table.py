"""The mission as one ordered table: the first transition that matches wins, safety on top.

The diagram and the table of docs/mission.md are drawn from `TABLE`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass, replace
from inspect import isfunction
from typing import TypeVar

from perchctl.errors import InvalidValue
from perchctl.extensions import error_at, load_extension
from perchctl.mission.battery import battery_shortfall, is_short_of_charge
from perchctl.mission.conditions import (
    SATURATED,
    contact_error,
    contact_tolerance_m,
    has_slipped,
    is_at_target,
    last_touch_error,
    max_press_thrust,
)
from perchctl.mission.context import HANGING_S, Context
from perchctl.mission.imu import PUSHED_S
from perchctl.mission.lander import (
    HELD,
    LOOKED_S,
    RestState,
    find_rest_state,
    hangs_with_motors_off,
    is_still_hanging,
)
from perchctl.mission.state import (
    BEFORE_CONTACT,
    BY_CAMERA,
    FLYING_PHASES,
    IN_THE_OPEN,
    Condition,
    Operator,
    Outcome,
    Phase,
    Severity,
)
from perchctl.profile import USED_LATENCY_S
from perchctl.vehicle import (
    CRASHED,
    FLYING,
    FRESH_S,
    LOCKED,
    TUMBLED,
    EmergencyStop,
    StopMotors,
)

Predicate = Callable[[Context], bool]
Reason = str | Callable[[Context], str]


@dataclass(frozen=True, eq=False)
class Transition:
    """A row of the table: from any of `phases`, if `when` returns True, to the phase `to`.

    `when` gets a `Context`. `reason`, a text or a function of it, is shown to the
    user; `stop` is what a transition into ABORTED sends at once.
    """

    name: str
    phases: Set[Phase]
    when: Predicate
    to: Phase
    reason: Reason
    severity: Severity = Severity.CONTINUE
    outcome: Outcome | None = None
    stop: EmergencyStop | StopMotors | None = None

    def waits_in(self, phase: Phase) -> bool:
        return self.to is phase and self.severity is Severity.HOLD

    def reason_text(self, c: Context) -> str:
        return self.reason if isinstance(self.reason, str) else self.reason(c)


T = TypeVar("T")
P, S, O, C = Phase, Severity, Outcome, Condition  # noqa: E741 - column names of the table below

# Where a transition applies.
AIR = FLYING_PHASES | {P.LANDING}
BEFORE_COMPLETION = BY_CAMERA | {P.PERCH}

KNOCKED_S = 0.04  # more than one sample of telemetry
LIFTED_M, SIDEWAYS_M = 0.05, 0.12
LOW_M, ASTRAY_LOW_M, ASTRAY_LANDING_M, ASTRAY_M = 0.3, 0.22, 0.4, 0.8
ASIDE_BY_LATENCY_MPS = 4.0
"""How far aside a take-off by the target may run for each second of the latency's sigma: by 0.1 s
that pictures are later than assumed, up to 0.2 m. Larger: a turned camera leads farther away."""
ABOVE_START_M = 0.1
OTHERWISE_S, BELOW_S, WEAK_S, UNSTOPPED_S = 0.1, 0.3, 2.0, 10.0
SWINGS_MPS = 0.5  # only swings of position control sink so fast
BLIND_PRESS_S = 1.25
HELD_S = 2.0  # by then the magnet has been told from others
BLIND_VARIANCE_M2PS2 = 0.02  # of the velocity: about 3 s after the last sight
UNCORRECTED = "the estimate's variance only grows; is the positioning system gone?"


# --- Whether the position, the pictures and their mounting can be relied on ---


def is_astray(c: Context) -> bool:
    """True if external positions in other axes than the vehicle's lead position control away from
    its setpoint (fault 11): farther than any draught carries it, or in swings."""
    setpoint, phase = c.state.setpoint, c.state.phase
    if c.profile.positioning.by == "deck" or not c.placed:
        return False
    if c.held_s(C.OTHERWISE) >= OTHERWISE_S or _swings(c):
        return True
    if setpoint is None:
        return False
    if phase is P.LANDING:
        touched = c.state.contact_z_m is not None or c.state.stopped_s is not None
        return not touched and _away_m(c) > ASTRAY_LANDING_M
    spare_m = ASIDE_BY_LATENCY_MPS * c.obs.delay_sigma_s if c.by_sight else 0.0
    if phase is P.APPROACH and c.height_m < LIFTED_M:
        return _away_m(c) > SIDEWAYS_M + spare_m
    ground = c.state.ground_m
    above_start = ground is not None and (
        math.hypot(setpoint.x_m - ground[0], setpoint.y_m - ground[1]) < ABOVE_START_M
    )
    only_climbs = above_start and phase in (P.APPROACH, P.SEARCH, P.ESTIMATE)
    is_pushed = c.obs.imu.t_s - c.obs.imu.pushed_s <= PUSHED_S  # by moving air
    stays = c.height_m < LOW_M or (only_climbs and not is_pushed)
    return _away_m(c) > (ASTRAY_LOW_M + spare_m if stays else ASTRAY_M)


def _swings(c: Context) -> bool:
    walked = c.state.phase in (P.ESTIMATE, P.ALIGN, P.ASCEND)
    return walked and c.profile.positioning.by == "mocap" and c.climb_mps < -SWINGS_MPS


def _away_m(c: Context) -> float:
    (x_m, y_m, _), setpoint = c.telemetry.position_m, c.state.setpoint
    return 0.0 if setpoint is None else math.hypot(x_m - setpoint.x_m, y_m - setpoint.y_m)


def astray_reason(c: Context) -> str:
    if _swings(c):
        return (
            f"it swings up and down, now at {-c.climb_mps:.1f} m/s: are the positions of the "
            f"motion capture late?"
        )
    cause = (
        "swapped axes in the motion capture, positions that are late, or a body that is turned in "
        "it; perchctl check --lift tells"
    )
    if c.by_sight:
        cause = "does camera.mount have the camera turned as it is?"
    return (
        f"position control leads astray, {_away_m(c):.2f} m aside at a height of {c.height_m:.2f} "
        f"m: {cause}"
    )


def is_position_lost(c: Context) -> bool:
    """True if no position came for `positioning.land_s`, or the estimate is useless earlier."""
    if c.position_age_s > c.profile.positioning.land_s or c.is_blown:
        return True
    return c.by_sight and c.position_is_stale and c.velocity_variance_m2ps2 > BLIND_VARIANCE_M2PS2


def position_loss_text(c: Context) -> str:
    """Text: for how long no external position was sent, and why."""
    if c.is_blown:
        return "pushed aside while the target was not seen"
    age_s, why = c.position_age_s, c.obs.position_problem
    if c.profile.positioning.by == "deck":
        why = why or UNCORRECTED
    text = f"no position for {age_s:.1f} s" if math.isfinite(age_s) else "no position has come"
    return f"{text}: {why}" if why else text


def is_outside_fence(c: Context) -> bool:
    """True if the vehicle is farther from its start than the fence allows."""
    if c.state.ground_m is None:
        return False
    x, y, _ = c.telemetry.position_m
    dx, dy = x - c.state.ground_m[0], y - c.state.ground_m[1]
    return math.hypot(dx, dy) > c.safety.fence_radius_m


def latency_reason(c: Context) -> str:
    camera = c.profile.camera
    assumed_s = camera.start_latency_s + c.obs.delay_s
    found = f"the pictures are {1e3 * (assumed_s + c.mismatch.later_s):.0f} ms old"
    if not c.proves:  # by late telemetry, pictures that are in time seem late
        return (
            f"pictures and telemetry do not fit each other, by {1e3 * c.mismatch.later_s:.0f} ms; "
            f"the telemetry is {c.telemetry_age_s:.1f} s old"
        )
    if isinstance(camera.latency_s, str):
        least_s, most_s = USED_LATENCY_S
        return (
            f"{found}; a measured latency (camera.latency_s) can be {1e3 * least_s:.0f} to "
            f"{1e3 * most_s:.0f} ms: find what delays them"
        )
    return f"{found}, not {1e3 * assumed_s:.0f} as camera.latency_s says: find what delays them"


def is_mounting_wrong(c: Context) -> bool:
    """True if the target moves along with the vehicle, or seems to lie below the vehicle."""
    below = c.held_s(C.TARGET_BELOW) >= BELOW_S
    return c.state.mount.is_wrong or c.mismatch.turn_rad != 0.0 or below


def mounting_reason(c: Context) -> str:
    turn_rad = c.mismatch.turn_rad
    if turn_rad or c.state.mount.is_wrong:
        turn_deg = 10 * round(math.degrees(turn_rad or c.state.mount.turn_rad) / 10.0)
        turn_deg = 180 if turn_deg == -180 else turn_deg
        text = (
            f"camera seems turned by about {turn_deg} deg from what the profile says: the target "
            f"moves with the vehicle; measure it with `perchctl calibrate mount`, or add "
            f"{turn_deg} to the last of camera.mount.rpy_deg"
        )
        capture = not turn_rad and c.profile.positioning.by == "mocap"
        return f"{text}; or swapped axes in the motion capture" if capture else text
    return (
        f"the target seems to lie {-c.error_z_m:.1f} m below the vehicle: camera.mount does not "
        f"look up"
    )


def not_found_reason(c: Context) -> str:
    text, why = "target not found in the allowed attempts", c.obs.camera_problem
    why = why or c.obs.target_refused
    return f"{text}: {why}" if why else text


# --- Whether something holds or blocks the vehicle, or its thrust is too weak ---


def is_held(c: Context) -> bool:
    """True if the target's magnet holds the vehicle already."""
    if c.held_s(C.HANGING) < HANGING_S:
        return False
    touched, radius_m = last_touch_error(c), c.planner.perch.contact_xy_m
    near = touched is not None and max(touched.aside_m, touched.sigma_m) <= radius_m
    return near or is_at_target(c)


def is_held_elsewhere(c: Context) -> bool:
    """True if something holds the vehicle off the target's height, or beside the target."""
    touched = last_touch_error(c)
    error = touched or contact_error(c)
    at_its_height = touched is not None or abs(c.error_z_m) <= contact_tolerance_m(c)
    beside = error.aside_m - 2.0 * error.sigma_m > c.planner.perch.contact_xy_m
    return c.held_s(C.HANGING) >= HELD_S and (beside or not at_its_height)


def is_blocked(c: Context) -> bool:
    """True if the vehicle has pressed against something for `safety.blocked_s`."""
    return c.held_s(C.BLOCKED) >= c.safety.blocked_s


def is_blocked_off_target(c: Context) -> bool:
    """True if the vehicle is blocked, and not where a press would prove the contact."""
    pressing = c.state.phase is P.PERCH
    return is_blocked(c) and not (pressing and abs(c.error_z_m) <= contact_tolerance_m(c))


def lacks_press_thrust(c: Context) -> bool:
    """True if no thrust is left to press with: seen at full thrust, or known before the press."""
    if c.state.pressed:
        return False
    if c.held_s(C.SATURATED) >= WEAK_S:
        return True
    near = c.state.phase is P.ASCEND and c.held_s(C.NEAR_STANDOFF) >= 0.0
    return near and c.state.hover_thrust > SATURATED * max_press_thrust(c.profile)


# --- Attempts, the press and the release ---


def is_aligned(c: Context) -> bool:
    return c.held_s(C.ALIGNED) >= c.planner.align.dwell_s


def has_recovered(c: Context) -> bool:
    """True if the vehicle has been steady for long enough, away from its contact."""
    dwell_s = c.planner.recover.dwell_s
    steady = c.held_s(C.STEADY) >= dwell_s and c.in_phase_s >= dwell_s
    return steady and c.state.contact_z_m is None


def unsteady_reason(c: Context) -> str:
    """Text: what kept a recovering vehicle from being steady, as it was seen; no cause is known."""
    seen = [f"it moves at {c.speed_mps:.2f} m/s"] if math.isfinite(c.speed_mps) else []
    if c.placed and c.state.setpoint is not None:
        seen.append(f"it is {_away_m(c):.2f} m beside its setpoint")
    if c.state.contact_z_m is not None:
        seen.append("it has not come away from its contact")
    text = f"not steady {c.planner.recover.timeout_s:g} s after the attempt"
    return f"{text}: {', '.join(seen)}" if seen else text


def lacks_charge_to_begin(c: Context) -> bool:
    """True if an attempt or a retry is due, and the battery has not enough charge for it."""
    begins = is_aligned(c) if c.state.phase is P.ALIGN else has_recovered(c)
    return begins and c.state.attempts < c.planner.attempts and is_short_of_charge(c)


def is_in_contact(c: Context) -> bool:
    return c.held_s(C.CONTACT) >= c.planner.perch.contact_dwell_s


def contact_reason(c: Context) -> str:
    by = "position, acceleration and thrust"
    if not c.placed:
        by = f"acceleration and thrust, {position_loss_text(c)}"
    return f"contact proven by {by}; {contact_error(c).text}"


def stopped_for_s(c: Context) -> float:
    """Seconds since the first order to stop the motors; -1 before that order."""
    return -1.0 if c.state.stopped_s is None else c.t_s - c.state.stopped_s


def release_monitored(c: Context) -> bool:
    """True if the motors have been off for as long as a perched vehicle is monitored."""
    return stopped_for_s(c) >= c.planner.complete.watch_s and c.held_s(C.DOWN) >= 0.1


def rests_as(state: RestState) -> Predicate:
    """The predicate that the motors are off and the vehicle is in this rest state."""
    return lambda c: c.held_s(C.DOWN) >= 0.1 and find_rest_state(c) is state


# --- Why the vehicle is held in place ---


def hold_reason(c: Context) -> str:
    """Return why the vehicle must stay where it is in this tick, or the empty string."""
    phase = c.state.phase
    if phase in IN_THE_OPEN and c.position_is_stale:
        return position_loss_text(c)
    if phase not in BY_CAMERA:
        return ""
    if c.telemetry_age_s > c.safety.telemetry_hold_s:
        return f"telemetry is {c.telemetry_age_s:.1f} s old"
    if c.state.jump_s is not None:
        return "the state estimate jumped"
    if c.is_unsure:
        return f"the state estimate is unsure ({unsure_text(c)})"
    if c.obs.loop_late_s > c.safety.loop_late_hold_s:
        return f"the control loop is {c.obs.loop_late_s:.1f} s late"
    if phase is not P.RECOVER and c.obs.camera_age_s > c.safety.camera_hold_s:
        return no_picture_reason(c)
    return ""


def unsure_text(c: Context) -> str:
    """Text: the variance by which the estimate is unsure, and the most that is allowed."""
    what, variance, unit = "velocity", c.velocity_variance_m2ps2, "(m/s)^2"
    most = c.safety.flight_velocity_variance_m2ps2
    if variance <= most:
        what = "height" if c.profile.positioning.by == "deck" else "position"
        variance, most, unit = c.position_variance_m2, c.safety.flight_variance_m2, "m^2"
    if math.isinf(variance):
        return f"the {what}'s variance is not known"
    return f"the {what}'s variance is {variance:.2g} {unit}, at most {most:g} allowed"


def no_picture_reason(c: Context) -> str:
    return c.obs.camera_problem or f"no picture for {c.obs.camera_age_s:.1f} s"


def unconfirmed_reason(c: Context) -> str:
    age_s, proof_age_s = c.attitude_age_s, c.safety.proof_age_s
    if age_s > FRESH_S:
        cause = f"the newest telemetry is {age_s:.1f} s old"
    elif c.telemetry.has_bit(FLYING) or c.telemetry.thrust >= 1:
        cause = "by its telemetry the vehicle still flies"
    elif age_s > proof_age_s:
        cause = f"the telemetry is {age_s:.2f} s old, and at most {proof_age_s:g} s old is proof"
    else:
        cause = "by its telemetry the vehicle does not rest yet"
    return f"the landing was not confirmed in time: {cause}"


# --- The ways out of the mission ---


def motor_cut_row(
    name: str, when: Predicate, reason: str, outcome: Outcome = O.SAFETY
) -> Transition:
    """A row of the table: cut and lock the motors at once, in any airborne phase."""
    return Transition(name, AIR, when, P.ABORTED, reason, S.STOP, outcome, stop=EmergencyStop())


def end_row(name: str, bit: int, reason: str) -> Transition:
    """A row of the table: the supervisor set `bit`, so stop the motors and abort."""

    def when(c: Context) -> bool:
        return c.telemetry.has_bit(bit)

    return Transition(name, AIR, when, P.ABORTED, reason, S.STOP, O.SAFETY, stop=StopMotors())


def land_row(
    name: str, phases: Set[Phase], when: Predicate, reason: Reason, outcome: Outcome = O.SAFETY
) -> Transition:
    """A row of the table: finish the mission and begin the way down."""
    return Transition(name, phases, when, P.LANDING, reason, S.LAND, outcome)


def back_off_row(name: str, phases: Set[Phase], when: Predicate, reason: Reason) -> Transition:
    """A row of the table: the attempt failed, so descend a little and try again."""
    return Transition(name, phases, when, P.RECOVER, reason, S.BACK_OFF)


def give_up_row(name: str, when: Predicate, reason: Reason) -> Transition:
    """A row of the table: the landing was not completed normally."""
    return Transition(name, {P.LANDING}, when, P.ABORTED, reason, S.LAND, O.SAFETY)


TABLE: tuple[Transition, ...] = (
    # --- the safety rows, gravest first ---
    motor_cut_row(
        "operator-stop",
        lambda c: c.obs.operator >= Operator.STOP,
        "the operator cut the motors",
        O.EMERGENCY,
    ),
    Transition(
        "hung-but-locked",
        {P.COMPLETE, P.LANDING},
        lambda c: c.telemetry.has_bit(LOCKED) and hangs_with_motors_off(c),
        P.PERCHED,
        "hanging, but the supervisor has locked the vehicle: restart it before the next flight",
        outcome=O.PERCHED,
    ),
    end_row("locked", LOCKED, "the supervisor has locked the vehicle: inspect and restart it"),
    end_row("tumbled", TUMBLED, "the vehicle has tumbled: inspect and restart it"),
    end_row("crashed", CRASHED, "the supervisor reports a crash: inspect and restart the vehicle"),
    motor_cut_row(
        "tilted",
        lambda c: c.held_s(C.TILTED) >= c.safety.tilt_debounce_s and c.state.stopped_s is None,
        "tilted beyond the limit: motors cut",
    ),
    land_row(
        "operator-land",
        FLYING_PHASES,
        lambda c: c.obs.operator >= Operator.LAND,
        "the operator asked to land",
        O.OPERATOR,
    ),
    land_row(
        "link-lost",
        FLYING_PHASES,
        lambda c: c.obs.link_problem is not None,
        lambda c: f"link lost: {c.obs.link_problem}",
    ),
    land_row(
        "telemetry-stale",
        FLYING_PHASES,
        lambda c: c.telemetry_age_s > c.safety.telemetry_land_s,
        lambda c: f"the newest telemetry is {c.telemetry_age_s:.1f} s old",
    ),
    land_row(
        "heading-lost",
        BEFORE_CONTACT,
        lambda c: c.state.heading_lost,
        "the estimated heading jumped: down level, by thrust alone",
    ),
    land_row("position-astray", IN_THE_OPEN | {P.LANDING}, is_astray, astray_reason),
    land_row(
        "position-lost",
        IN_THE_OPEN | {P.PERCH},
        is_position_lost,
        lambda c: f"{position_loss_text(c)}; down level, by thrust alone",
    ),
    land_row(
        "estimator-jump",
        BEFORE_CONTACT,
        lambda c: c.state.jump_s is not None and c.t_s - c.state.jump_s >= c.safety.jump_hold_s,
        "the state estimate jumped: landing where it is",
    ),
    land_row(
        "estimate-unsure",
        IN_THE_OPEN,
        lambda c: c.held_s(C.UNSURE) >= c.safety.variance_land_s,
        lambda c: f"{unsure_text(c)}: is the positioning system gone?",
    ),
    land_row(
        "battery-low",
        BEFORE_CONTACT,
        lambda c: c.held_s(C.BATTERY_LOW) >= c.safety.battery_debounce_s,
        lambda c: f"battery at {c.telemetry.battery_v:.2f} V under load",
    ),
    land_row(
        "battery-unknown",
        BEFORE_CONTACT,
        lambda c: c.obs.battery_age_s > c.safety.battery_stale_s,
        "the battery's reading stands still",
    ),
    land_row("latency", IN_THE_OPEN, lambda c: c.mismatch.later_s != 0.0, latency_reason),
    land_row("mounting", IN_THE_OPEN, is_mounting_wrong, mounting_reason),
    land_row(
        "height-limit",
        BEFORE_CONTACT,
        lambda c: c.height_m > c.safety.max_height_m,
        lambda c: f"height {c.height_m:.2f} m is above the limit",
    ),
    land_row("fence", BEFORE_CONTACT, is_outside_fence, "outside the fence"),
    land_row(
        "camera-gone",
        BY_CAMERA,
        lambda c: c.obs.camera_age_s > c.safety.camera_land_s,
        no_picture_reason,
    ),
    land_row(
        "loop-late",
        FLYING_PHASES,
        lambda c: c.obs.loop_late_s > c.safety.loop_late_land_s,
        lambda c: f"the control loop was {c.obs.loop_late_s:.1f} s late",
    ),
    land_row(
        "markers-disagree",
        BY_CAMERA,
        lambda c: c.obs.disagreeing_frames >= c.profile.merge.disagreement_frames,
        "large and small marker contradict each other: check the printed sizes in the "
        "profile and the camera's calibration",
    ),
    land_row(
        "log-lost",
        BEFORE_CONTACT,
        lambda c: c.safety.land_on_log_error and c.obs.log_problem is not None,
        lambda c: f"flight log: {c.obs.log_problem}",
    ),
    land_row(
        "time-over",
        BEFORE_CONTACT,
        lambda c: c.t_s - c.state.started_s > c.planner.perching_time_s,
        "the perching time is over",
        O.ATTEMPTS_USED_UP,
    ),
    # --- the magnet may catch early ---
    Transition("caught", BEFORE_COMPLETION, is_held, P.COMPLETE, "hanging on the magnet already"),
    land_row(
        HELD, BEFORE_COMPLETION, is_held_elsewhere, "something holds it where the target is not"
    ),
    land_row(
        "hangs-at-contact",
        BEFORE_COMPLETION,
        lambda c: c.held_s(C.HANGING) >= HELD_S,
        lambda c: (
            f"it hangs at the target's height, {(last_touch_error(c) or contact_error(c)).text}: "
            f"that may be its magnet"
        ),
    ),
    # --- something is in the way ---
    land_row(
        "cannot-rise",
        {P.APPROACH},
        lambda c: is_blocked(c) or lacks_press_thrust(c),
        lambda c: f"pressed at {c.height_m:.2f} m: something is above, or the thrust is weak",
    ),
    back_off_row(
        "blocked",
        BEFORE_COMPLETION,
        is_blocked_off_target,
        lambda c: (
            f"pressed against something at {c.height_m:.2f} m"
            + ("" if c.state.hover_thrust else ", or the thrust is weak")
        ),
    ),
    land_row(
        "too-weak",
        BY_CAMERA,
        lacks_press_thrust,
        "hovering takes all the thrust: the vehicle is too heavy, the battery too low, or "
        "something is above",
    ),
    # --- phase 1: approach ---
    Transition(
        "approached",
        {P.APPROACH},
        lambda c: c.held_s(C.AT_TAKEOFF_HEIGHT) >= 0.3,
        P.SEARCH,
        "hovering in the perching area",
    ),
    land_row(
        "approach-timeout",
        {P.APPROACH},
        lambda c: c.in_phase_s > c.planner.approach_timeout_s,
        lambda c: f"take-off reached only {c.height_m:.2f} m",
    ),
    # --- phase 2: search ---
    Transition(
        "found",
        {P.SEARCH},
        lambda c: c.state.confirmed >= c.planner.search.confirm_frames,
        P.ESTIMATE,
        "target seen",
    ),
    land_row(
        "searched-out",
        {P.SEARCH},
        lambda c: c.state.searches >= c.planner.search.attempts,
        not_found_reason,
        O.TARGET_NOT_FOUND,
    ),
    # --- phase 3: estimate ---
    Transition(
        "estimate-lost",
        {P.ESTIMATE},
        lambda c: c.held_s(C.UNTRACKED) > 1.0 or c.in_phase_s > c.planner.estimate.timeout_s,
        P.SEARCH,
        "the target's pose does not settle",
        S.HOLD,
    ),
    Transition(
        "estimated",
        {P.ESTIMATE},
        lambda c: c.held_s(C.ESTIMATED) >= c.planner.estimate.dwell_s,
        P.ALIGN,
        "pose is steady",
    ),
    # --- phase 4: align ---
    Transition(
        "align-lost",
        {P.ALIGN},
        lambda c: not c.tracked,
        P.SEARCH,
        "target lost in alignment",
        S.HOLD,
    ),
    back_off_row(
        "align-timeout",
        {P.ALIGN},
        lambda c: c.in_phase_s - c.state.waited_s > c.planner.align.timeout_s,
        "alignment took too long",
    ),
    land_row("too-little-left", {P.ALIGN, P.RECOVER}, lacks_charge_to_begin, battery_shortfall),
    Transition("aligned", {P.ALIGN}, is_aligned, P.ASCEND, "aligned in position and heading"),
    # --- phase 5: ascend ---
    back_off_row("ascend-lost", {P.ASCEND}, lambda c: not c.tracked, "target lost in ascent"),
    Transition(
        "outside-cone",
        {P.ASCEND},
        lambda c: c.error_xy_m > c.cone_m,
        P.ALIGN,
        "drifted out of the cone",
        S.HOLD,
    ),
    back_off_row(
        "ascend-timeout",
        {P.ASCEND},
        lambda c: (
            c.in_phase_s > c.planner.ascend.timeout_s
            or c.held_s(C.NEAR_STANDOFF) > c.planner.ascend.settle_timeout_s
        ),
        "does not settle under the target",
    ),
    Transition(
        "settled",
        {P.ASCEND},
        lambda c: c.held_s(C.SETTLED) >= c.planner.ascend.settle_dwell_s,
        P.PERCH,
        "settled at the stand-off",
    ),
    # --- phase 6: perch ---
    back_off_row(
        "beside-the-magnet",
        {P.PERCH},
        lambda c: is_in_contact(c) and not contact_error(c).is_within(c.planner.perch.contact_xy_m),
        lambda c: f"contact {contact_error(c).text}",
    ),
    Transition("contact", {P.PERCH}, is_in_contact, P.COMPLETE, contact_reason),
    back_off_row(
        # The last centimetres are flown unseen: by the target alone, by dead reckoning.
        "pressed-blindly",
        {P.PERCH},
        lambda c: c.by_sight and c.position_age_s > BLIND_PRESS_S,
        lambda c: f"no contact {c.position_age_s:.1f} s after the last sight of the target",
    ),
    back_off_row(
        "knocked-aside",
        {P.PERCH},
        lambda c: c.held_s(C.KNOCKED) >= KNOCKED_S,
        "pushed aside under the target",
    ),
    back_off_row(
        # Not in time, or not before the next turn of a loop as late as this one.
        "no-contact",
        {P.PERCH},
        lambda c: c.in_phase_s + c.obs.loop_late_s > c.planner.perch.timeout_s,
        "no proof of contact",
    ),
    # --- phase 7: completion ---
    back_off_row(
        "slipped",
        {P.COMPLETE},
        has_slipped,
        lambda c: "slipped while hanging" if c.state.stopped_s else "the magnet does not hold",
    ),
    back_off_row(
        "not-released",
        {P.COMPLETE},
        lambda c: c.state.stopped_s is None and c.in_phase_s > c.planner.complete.release_timeout_s,
        "the thrust could not be released",
    ),
    Transition(
        "perched",
        {P.COMPLETE},
        lambda c: release_monitored(c) and is_still_hanging(c),
        P.PERCHED,
        "hanging still with the motors off",
        outcome=O.PERCHED,
    ),
    land_row(
        "fell-unseen", {P.COMPLETE}, release_monitored, "it is not known to hang where it did"
    ),
    land_row(
        "not-stopped",
        {P.COMPLETE},
        lambda c: stopped_for_s(c) > c.planner.complete.watch_s + UNSTOPPED_S,
        lambda c: f"motors stopped, but their thrust still reads {c.telemetry.thrust:.0f}",
    ),
    # --- the failed attempt ---
    land_row(
        "attempts-used",
        {P.RECOVER},
        lambda c: c.state.attempts >= c.planner.attempts and c.in_phase_s > 0.5,
        "all perching attempts are used up",
        O.ATTEMPTS_USED_UP,
    ),
    Transition(
        "recovered",
        {P.RECOVER},
        has_recovered,
        P.ESTIMATE,
        "steady again, trying once more",
    ),
    land_row(
        "recover-timeout",
        {P.RECOVER},
        lambda c: c.in_phase_s > c.planner.recover.timeout_s,
        unsteady_reason,
    ),
    # --- landing ---
    Transition(
        "hung",
        {P.LANDING},
        rests_as(RestState.HANGS),
        P.PERCHED,
        "hanging with the motors off",
    ),
    Transition(
        "landed",
        {P.LANDING},
        rests_as(RestState.STANDS),
        P.LANDED,
        lambda c: (
            "motors off"
            + ("" if c.state.blind_s is None else "; it was felt to come down to the floor")
        ),
    ),
    give_up_row(
        "held-elsewhere",
        rests_as(RestState.HELD),
        "motors off; something holds it where its estimate has no target: look before you touch it",
    ),
    give_up_row(
        "hangs-or-stands",
        lambda c: c.held_s(C.DOWN) >= LOOKED_S,
        "motors off; the telemetry was silent for as long as a fall takes, and it is not known "
        "whether it hangs or stands: look before you touch it",
    ),
    give_up_row(
        "landing-timeout",
        lambda c: c.in_phase_s > c.planner.landing.timeout_s,
        unconfirmed_reason,
    ),
)


def first_transition(c: Context, table: tuple[Transition, ...] = TABLE) -> Transition | None:
    """The first transition that applies, or None to stay. Whatever the table says, a transition
    from a landing to a flying phase is skipped. Your own waiting row blocks the later `CONTINUE`
    rows; it is returned if no other row applies."""
    landing, phase = c.state.severity >= Severity.LAND, c.state.phase
    waits: Transition | None = None
    for row in table:
        undoes = landing and row.to in FLYING_PHASES
        goes_on = waits is not None and row.severity is Severity.CONTINUE
        if undoes or goes_on or phase not in row.phases or not row.when(c):
            continue
        if not row.waits_in(phase):
            return row
        waits = waits or row
    return waits


# --- Your own rows ---


ALLOWED = frozenset(
    (phase, row.to, row.severity)
    for row in TABLE
    for phase in row.phases & BEFORE_CONTACT - {row.to}
    if row.severity >= Severity.HOLD and not row.to.is_over
) | {(P.ALIGN, P.ALIGN, S.HOLD)}
"""What your own row may do, by phase, next phase and severity: wait in ALIGN, or what the table
itself does to interrupt a mission. None climbs, stops a motor, or proves a contact."""


def add_rows(
    rows: Iterable[Transition], table: tuple[Transition, ...] = TABLE
) -> tuple[Transition, ...]:
    """The table with your own rows, in their order, behind all safety rows and before the
    mission's. Each waits in ALIGN, or leads back, to RECOVER or down, by `ALLOWED`; in COMPLETE and
    LANDING none applies.

    Raises InvalidValue for a row that may do more, is no valid `Transition`, or whose name is
    taken; in flight, for a row whose functions raise, whereupon the vehicle lands.
    """
    names, own = {row.name for row in table}, list[Transition]()
    for row in rows if isinstance(rows, Iterable) else (rows,):
        _check_types(row)
        if row.name in names:
            raise InvalidValue(f"row {row.name!r}: another row has that name; rename it")
        names.add(row.name)
        for phase in row.phases:
            if (phase, row.to, row.severity) not in ALLOWED:
                may = sorted(f"{to.name} ({how.name})" for at, to, how in ALLOWED if at is phase)
                raise InvalidValue(
                    f"row {row.name!r} leads from {phase.name} to {row.to.name} "
                    f"({row.severity.name}); allowed there are {', '.join(may) or 'none'}"
                )
        if row.stop is not None or row.outcome is not None:
            raise InvalidValue(f"row {row.name!r} may have neither a stop nor an outcome")
        outcome = Outcome.SAFETY if row.to is Phase.LANDING else None
        when, reason = _named(row.name, row.when), _named(row.name, row.reason_text)
        phases = frozenset(row.phases)  # which cannot change in flight
        own.append(replace(row, phases=phases, when=when, reason=reason, outcome=outcome))
    at = next(i for i, row in enumerate(table) if row.name == "approached")
    return (*table[:at], *own, *table[at:])


def _check_types(row: object) -> None:
    """Raise InvalidValue for what is no valid `Transition`."""
    if not (
        isinstance(row, Transition)
        and isinstance(row.phases, Set)
        and row.phases
        and all(isinstance(phase, Phase) for phase in (*row.phases, row.to))
        and isinstance(row.severity, Severity)
        and callable(row.when)
        and (isinstance(row.reason, str) or callable(row.reason))
    ):
        raise InvalidValue(
            f"row {getattr(row, 'name', row)!r} must be a Transition: phases a set of Phase, to a "
            f"Phase, severity a Severity, when a function, reason a text"
        )


def _named(name: str, function: Callable[[Context], T]) -> Callable[[Context], T]:
    """The function of your own row; its errors name the row. Raises InvalidValue."""

    def call(c: Context) -> T:
        try:
            return function(c)
        except Exception as error:
            raise InvalidValue(f"your own row {name!r} raised {error_at(error)}") from error

    return call


def table_of(name: str | None) -> tuple[Transition, ...]:
    """The table of one flight, with the rows that a profile's `planner.rows` names: some, or a
    function that returns some. Errors: as `add_rows`, NotFound."""
    if name is None:
        return TABLE
    own = load_extension(name, "planner.rows")
    try:
        # A log's profile may name anything.
        own = own() if isfunction(own) else own
    except Exception as error:
        raise InvalidValue(f"planner.rows: {name} raised {error_at(error)}") from error
    return add_rows(own)
