"""The mission as one ordered table: the first transition that matches wins, safety on top.

The diagram and the table of docs/mission.md are drawn from `TABLE`. Above it stand the
predicates and reasons that need more than a line.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.mission.battery import is_short_of_charge, why_short
from perchctl.mission.conditions import (
    SATURATED,
    contact_aside_m,
    contact_within_m,
    has_slipped,
    is_at_target,
    latency_changed,
    press_thrust,
    touched_aside_m,
)
from perchctl.mission.context import HANGING_S, Context
from perchctl.mission.imu import PUSHED_S
from perchctl.mission.lander import (
    HELD,
    LOOKED_S,
    Finding,
    hangs_stopped,
    hangs_where_it_did,
    rest_finding,
)
from perchctl.mission.mounting import describe_turn
from perchctl.mission.state import (
    BEFORE_CONTACT,
    FLYING_PHASES,
    Condition,
    MotorStop,
    Operator,
    Outcome,
    Phase,
    Severity,
)
from perchctl.vehicle import CRASHED, LOCKED, TUMBLED

Predicate = Callable[[Context], bool]


@dataclass(frozen=True, eq=False)
class Transition:
    """A row of the table: from any of `phases`, when `when` holds, to the phase `to`.

    `reason` is shown to the user; `motor_stop` is what a transition into ABORTED does to the
    motors.
    """

    name: str
    phases: frozenset[Phase]
    when: Predicate
    to: Phase
    reason: str | Callable[[Context], str]
    severity: Severity = Severity.CONTINUE
    outcome: Outcome | None = None
    counts_attempt: bool = False
    motor_stop: MotorStop = MotorStop.NONE

    def explain(self, c: Context) -> str:
        """The reason as a sentence without its end."""
        return self.reason if isinstance(self.reason, str) else self.reason(c)


def raise_severity(before: Severity, row: Severity) -> Severity:
    """The flight's severity after a transition: from `LAND` on it only rises."""
    return max(before, row) if before >= Severity.LAND else row


P, S, O, C = Phase, Severity, Outcome, Condition  # noqa: E741 - column names of the table below

# Where a transition applies.
AIR = FLYING_PHASES | {P.LANDING}
BY_CAMERA = frozenset({P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.RECOVER})
IN_THE_OPEN = BY_CAMERA | {P.APPROACH}
ONLY_UP = frozenset({P.APPROACH, P.SEARCH, P.ESTIMATE})
WALKED = frozenset({P.ESTIMATE, P.ALIGN, P.ASCEND})
_CAMERA_PHASES = BY_CAMERA - {P.RECOVER}

KNOCKED_S = 0.04  # more than one sample of telemetry
LIFTED_M, SIDEWAYS_M = 0.05, 0.12
LOW_M, ASTRAY_LOW_M, ASTRAY_LANDING_M, ASTRAY_M = 0.3, 0.22, 0.4, 0.8
"""While only a climb was ordered, a vehicle stays within a few centimetres (7 in simulated
flights); later a setpoint is walked ahead of it, and a gust may carry it half a metre."""
ABOVE_START_M = 0.1
OTHERWISE_S, BELOW_S, WEAK_S, UNSTOPPED_S = 0.1, 0.3, 2.0, 10.0
SWINGS_MPS = 0.5  # what hovers or walks up sinks so fast only if position control swings it
BLIND_PRESS_S = 1.25
HELD_S = 2.0  # by then a hold at the magnet has been told from any other
BLIND_VARIANCE_M2 = 0.02  # about 3 s after the last sight (docs/firmware.md, "Target as position")
NO_PICTURE_TEXT = "no picture for"
UNCORRECTED = "the estimate's variance only grows; is the positioning system gone?"


def only(*phases: Phase) -> frozenset[Phase]:
    """The phases as a set."""
    return frozenset(phases)


# --- Whether the position, the pictures and their mounting can be relied on ----------------------


def is_astray(c: Context) -> bool:
    """True if position control leads away from its setpoint, by external positions in other axes
    than the vehicle's, which a vehicle at rest does not show (fault 11).

    That is a step sideways at take-off, where only a climb was ordered; later a way farther than
    any draught carries it; in a landing that began for another reason, too, which would speed up
    until it tilts over."""
    setpoint = c.state.setpoint
    if c.profile.positioning.by == "deck" or not c.placed:
        return False
    if c.held(C.OTHERWISE) >= OTHERWISE_S or _swings(c):
        return True
    if setpoint is None:
        return False
    touched = c.state.contact_z_m is not None or c.state.stopped_s is not None
    if c.state.phase is P.LANDING and touched:
        return False
    away_m = _away_m(c)
    if c.state.phase is P.APPROACH and c.height_m < LIFTED_M:
        return away_m > SIDEWAYS_M
    if c.state.phase is P.LANDING:
        return away_m > ASTRAY_LANDING_M
    is_pushed = c.obs.imu.t_s - c.obs.imu.pushed_s <= PUSHED_S  # by moving air
    stays = c.height_m < LOW_M or (_only_climbs(c) and not is_pushed)
    return away_m > (ASTRAY_LOW_M if stays else ASTRAY_M)


def _swings(c: Context) -> bool:
    """True if it sinks fast in a phase that walks it: a motion capture that is late swings it."""
    by_capture = c.profile.positioning.by == "mocap"
    return by_capture and c.state.phase in WALKED and c.climb_mps < -SWINGS_MPS


def _only_climbs(c: Context) -> bool:
    """True if its setpoint is still above the place of its take-off."""
    setpoint, ground = c.state.setpoint, c.state.ground_m
    if setpoint is None or ground is None or c.state.phase not in ONLY_UP:
        return False
    return math.hypot(setpoint.x_m - ground[0], setpoint.y_m - ground[1]) < ABOVE_START_M


def _away_m(c: Context) -> float:
    (x_m, y_m, _), setpoint = c.obs.telemetry.position_m, c.state.setpoint
    return 0.0 if setpoint is None else math.hypot(x_m - setpoint.x_m, y_m - setpoint.y_m)


def why_astray(c: Context) -> str:
    if c.by_sight:
        return (
            f"the position goes {_away_m(c):.2f} m aside at a height of {c.height_m:.2f} m: does "
            f"camera.mount have the camera turned as it is?"
        )
    if _swings(c):
        return (
            f"it swings up and down, now at {-c.climb_mps:.1f} m/s: are the positions of the "
            f"motion capture late?"
        )
    what = f"the position goes {_away_m(c):.2f} m aside"
    if c.held(C.OTHERWISE) >= 0.0:
        what = "the position moves otherwise than the accelerometer feels"
    return (
        f"{what} at a height of {c.height_m:.2f} m: swapped axes "
        f"in the motion capture, or a body that is turned in it; perchctl check --lift tells"
    )


def is_lost(c: Context) -> bool:
    """True if no position has come for so long that none is waited for any more; by the target
    alone, by the estimate's own variance, too."""
    if c.position_age_s > c.profile.positioning.land_s or c.is_blown:
        return True
    return c.by_sight and c.position_is_stale and c.variance_m2 > BLIND_VARIANCE_M2


def unplaced_text(c: Context) -> str:
    """The words for how long no external position was sent, and why."""
    if c.is_blown:
        return "pushed aside while the target was not seen"
    age_s, why = c.position_age_s, c.obs.position_problem
    if c.profile.positioning.by == "deck":
        why = why or UNCORRECTED
    text = f"no position for {age_s:.1f} s" if math.isfinite(age_s) else "no position has come"
    return f"{text}: {why}" if why else text


def left_jump_hold(c: Context) -> bool:
    """True if the vehicle was held long enough since its estimate jumped."""
    jump = c.state.jump_s
    return jump is not None and c.obs.t_s - jump >= c.profile.safety.jump_hold_s


def fence_broken(c: Context) -> bool:
    """True if the vehicle is farther from its take-off than the fence allows."""
    if c.state.ground_m is None:
        return False
    x, y, _ = c.obs.telemetry.position_m
    dx, dy = x - c.state.ground_m[0], y - c.state.ground_m[1]
    return math.hypot(dx, dy) > c.profile.safety.fence_radius_m


def unsure(c: Context) -> str:
    limit_m2 = c.profile.safety.flight_variance_m2
    return f"the position's variance is {c.variance_m2:.2g} m^2, at most {limit_m2:g} allowed"


def why_latency(c: Context) -> str:
    assumed_s = c.profile.camera.start_latency_s + c.obs.delay_s
    found_s = assumed_s + (0.0 if c.obs.mismatch is None else c.obs.mismatch.later_s)
    return (
        f"the pictures are {1e3 * found_s:.0f} ms old, not {1e3 * assumed_s:.0f} as "
        f"camera.latency_s has it: find what delays them"
    )


def mounted_wrong(c: Context) -> bool:
    """True if the target moves with the vehicle, or seems to lie below it."""
    below = c.held(C.TARGET_BELOW) >= BELOW_S
    return c.state.mount.wrong or _measured_turn_rad(c) != 0.0 or below


def _measured_turn_rad(c: Context) -> float:
    return 0.0 if c.obs.mismatch is None else c.obs.mismatch.turn_rad


def why_mounted_wrong(c: Context) -> str:
    if turn_rad := _measured_turn_rad(c):
        return describe_turn(turn_rad)
    if c.state.mount.wrong:
        text = describe_turn(c.state.mount.turn_rad)
        by_capture = c.profile.positioning.by == "mocap"
        return f"{text}; or swapped axes in the motion capture" if by_capture else text
    return (
        f"the target seems to lie {-c.error_z_m:.1f} m below the vehicle: camera.mount does not "
        f"look up"
    )


def why_not_found(c: Context) -> str:
    text = "target not found in the allowed attempts"
    if c.obs.camera_problem:
        return f"{text} ({c.obs.camera_problem})"
    if c.obs.target_refused:
        return f"{text}: {c.obs.target_refused}"
    if c.target_m is not None and c.state.mount.open:
        return f"{text}, though it was seen before: does camera.mount fit the camera?"
    return text


# --- Whether something holds or blocks the vehicle, or its thrust is too weak --------------------


def is_caught(c: Context) -> bool:
    """True if the target's magnet holds it already: it hangs at the target, or where it met the
    target's height, within the magnet's radius as far as its place there was known."""
    if c.held(C.HANGING) < HANGING_S:
        return False
    touched = touched_aside_m(c)
    radius_m = c.profile.planner.perch.contact_xy_m
    return is_at_target(c) or (touched is not None and max(touched) <= radius_m)


def is_held(c: Context) -> bool:
    """True if something holds it: the magnet, a hand, a net, another ceiling."""
    return c.held(C.HANGING) >= HELD_S


def is_held_elsewhere(c: Context) -> bool:
    """True if something else than the target's magnet holds it: at another height than the
    target's, or surely beside the magnet (two standard deviations)."""
    touched = touched_aside_m(c)
    aside_m, sigma_m = touched or contact_aside_m(c)
    at_its_height = touched is not None or abs(c.error_z_m) <= contact_within_m(c)
    beside = aside_m - 2.0 * sigma_m > c.profile.planner.perch.contact_xy_m
    return is_held(c) and (beside or not at_its_height)


def why_held(c: Context) -> str:
    aside_m, sigma_m = contact_aside_m(c)
    if c.obs.target is None or not math.isfinite(sigma_m):
        return "something holds it, and where the target is is not known"
    below = f"{abs(c.error_z_m):.2f} m {'below' if c.error_z_m >= 0.0 else 'above'}"
    return f"something holds it {below} and {aside_m:.2f} m aside of the target"


def why_hangs_at_contact(c: Context) -> str:
    aside_m, sigma_m = touched_aside_m(c) or contact_aside_m(c)
    if not math.isfinite(sigma_m):
        return "it hangs at the target's height, how far aside of it is not known"
    return (
        f"it hangs at the target's height, {1e3 * aside_m:.0f} +- {1e3 * sigma_m:.0f} mm aside of "
        f"it: that may be its magnet"
    )


def is_blocked(c: Context) -> bool:
    """True if it has been pressed against something for long enough."""
    return c.held(C.BLOCKED) >= c.profile.safety.blocked_s


def is_blocked_off_target(c: Context) -> bool:
    """True if it is blocked, and in the press so far from the target's height that no contact can
    be proven."""
    pressing = c.state.phase is P.PERCH
    return is_blocked(c) and not (pressing and abs(c.error_z_m) <= contact_within_m(c))


def too_weak(c: Context) -> bool:
    """True if no thrust is left to press with: seen at full thrust, or known before the press. A
    press that it backs off from explains full thrust."""
    if c.state.pressed:
        return False
    if c.held(C.SATURATED) >= WEAK_S:
        return True
    near = c.state.phase is P.ASCEND and c.held(C.NEAR_STANDOFF) >= 0.0
    return near and c.state.hover_thrust > SATURATED * press_thrust(c.profile)


# --- Attempts, the press and the release ---------------------------------------------------------


def attempts_used(c: Context) -> bool:
    return c.state.attempts >= c.profile.planner.attempts


def is_aligned(c: Context) -> bool:
    return c.held(C.ALIGNED) >= c.profile.planner.align.dwell_s


def has_recovered(c: Context) -> bool:
    """True if it has been steady for long enough, away from what it touched."""
    dwell_s = c.profile.planner.recover.dwell_s
    steady = c.held(C.STEADY) >= dwell_s and c.in_phase_s >= dwell_s
    return steady and c.state.contact_z_m is None


def too_little_left(c: Context) -> bool:
    """True if an attempt would begin, or begin anew, and the battery has not enough for it."""
    begins = is_aligned(c) if c.state.phase is P.ALIGN else has_recovered(c)
    return begins and not attempts_used(c) and is_short_of_charge(c)


def is_beside_magnet(c: Context) -> bool:
    """True of a contact farther aside than the magnet reaches, or at an unknown place."""
    if c.held(C.CONTACT) < c.profile.planner.perch.contact_dwell_s:
        return False
    aside_m, sigma_m = contact_aside_m(c)
    return not aside_m + sigma_m <= c.profile.planner.perch.contact_xy_m


def why_beside_magnet(c: Context) -> str:
    aside_m, sigma_m = contact_aside_m(c)
    if not math.isfinite(sigma_m):
        return "contact, but how far aside of the target is not known"
    return f"contact {1e3 * aside_m:.0f} +- {1e3 * sigma_m:.0f} mm aside of the target"


def why_contact(c: Context) -> str:
    aside_m, sigma_m = contact_aside_m(c)
    by = "position, acceleration and thrust"
    if not c.placed:
        by = f"acceleration and thrust, {unplaced_text(c)}"
    return f"contact proven by {by}; {1e3 * aside_m:.1f} +- {1e3 * sigma_m:.1f} mm off centre"


def stopped_for_s(c: Context) -> float:
    """Seconds since the first order to stop the motors; -1 before one."""
    return -1.0 if c.state.stopped_s is None else c.obs.t_s - c.state.stopped_s


def release_monitored(c: Context) -> bool:
    """True if the motors have been off for as long as a perched vehicle is monitored."""
    monitored = stopped_for_s(c) >= c.profile.planner.complete.watch_s
    return monitored and c.held(C.DOWN) >= 0.1


def why_fell_unseen(c: Context) -> str:
    if c.placed or c.state.reach_s is None or c.obs.imu.fell_s > c.state.reach_s:
        return "it is not where it hung before"
    return "the telemetry was silent: whether it still hangs is not known"


def is_off_as(finding: Finding) -> Predicate:
    """The predicate that the motors are off, and that the vehicle is found to hang or stand so."""
    return lambda c: c.held(C.DOWN) >= 0.1 and rest_finding(c) is finding


# --- Why the vehicle is held in place ------------------------------------------------------------


def hold_reason(c: Context) -> str:
    """Why the vehicle must stay where it is in this tick, or the empty string."""
    phase, safety = c.state.phase, c.profile.safety
    # A take-off goes on by what is known; without a position nothing is.
    if phase in IN_THE_OPEN and c.position_is_stale:
        return unplaced_text(c)
    if phase not in BY_CAMERA:
        return ""
    if c.telemetry_age_s > safety.telemetry_hold_s:
        return f"telemetry is {c.telemetry_age_s:.1f} s old"
    if c.state.jump_s is not None:
        return "the state estimate jumped"
    if c.variance_m2 > safety.flight_variance_m2:
        return f"the state estimate is unsure (variance {c.variance_m2:.2g} m^2)"
    if c.obs.loop_late_s > safety.loop_late_hold_s:
        return f"the control loop is {c.obs.loop_late_s:.1f} s late"
    if phase in _CAMERA_PHASES and c.obs.camera_age_s > safety.camera_hold_s:
        return c.obs.camera_problem or f"{NO_PICTURE_TEXT} {c.obs.camera_age_s:.1f} s"
    return ""


# --- The three ways out of the mission ------------------------------------------------------------


def stops(
    name: str, when: Predicate, reason: str, motor_stop: MotorStop, outcome: Outcome = O.SAFETY
) -> Transition:
    """The motors are stopped, wherever in the air it is."""
    return Transition(
        name, AIR, when, P.ABORTED, reason, S.STOP, outcome, motor_stop=motor_stop
    )  # fmt: skip


def lands(
    name: str,
    phases: frozenset[Phase],
    when: Predicate,
    reason: str | Callable[[Context], str],
    outcome: Outcome = O.SAFETY,
) -> Transition:
    """The flight is over: the way down begins."""
    return Transition(name, phases, when, P.LANDING, reason, S.LAND, outcome)


def backs_off(
    name: str,
    phases: frozenset[Phase],
    when: Predicate,
    reason: str | Callable[[Context], str],
) -> Transition:
    """The attempt has failed: down a little, and another one."""
    return Transition(name, phases, when, P.RECOVER, reason, S.BACK_OFF, counts_attempt=True)


# --- The safety rows, gravest first --------------------------------------------------------------

SAFETY: tuple[Transition, ...] = (
    stops(
        "operator-stop", lambda c: c.obs.operator >= Operator.STOP,
        "second Ctrl-C: emergency stop", MotorStop.EMERGENCY, O.EMERGENCY,
    ),
    Transition(
        "hung-but-locked", only(P.COMPLETE, P.LANDING),
        lambda c: c.obs.telemetry.has(LOCKED) and hangs_stopped(c), P.PERCHED,
        "hanging, but the supervisor has locked the vehicle: restart it before the next flight",
        outcome=O.PERCHED,
    ),
    stops(
        "locked", lambda c: c.obs.telemetry.has(LOCKED),
        "the supervisor has locked the vehicle: inspect and restart it", MotorStop.PLAIN,
    ),
    stops(
        "tumbled", lambda c: c.obs.telemetry.has(TUMBLED),
        "the vehicle has tumbled: inspect and restart it", MotorStop.PLAIN,
    ),
    stops(
        "crashed", lambda c: c.obs.telemetry.has(CRASHED),
        "the supervisor reports a crash: inspect and restart the vehicle", MotorStop.PLAIN,
    ),
    stops(
        "tilted",
        lambda c: c.held(C.TILTED) >= c.profile.safety.tilt_debounce_s
        and c.state.stopped_s is None,
        "tilted beyond the limit: motors cut", MotorStop.EMERGENCY,
    ),
    lands(
        "operator-land", FLYING_PHASES, lambda c: c.obs.operator >= Operator.LAND,
        "the operator asked to land", O.OPERATOR,
    ),
    lands(
        "link-lost", FLYING_PHASES, lambda c: c.obs.link_problem is not None,
        lambda c: f"link lost: {c.obs.link_problem}",
    ),
    lands(
        "telemetry-stale", FLYING_PHASES,
        lambda c: c.telemetry_age_s > c.profile.safety.telemetry_land_s,
        lambda c: f"no telemetry for {c.telemetry_age_s:.1f} s",
    ),
    lands(
        "heading-lost", BEFORE_CONTACT, lambda c: c.state.heading_lost,
        "the estimated heading jumped: down level, by thrust alone",
    ),
    lands("position-astray", IN_THE_OPEN | {P.LANDING}, is_astray, why_astray),
    lands(
        "position-lost", IN_THE_OPEN | {P.PERCH}, is_lost,
        lambda c: f"{unplaced_text(c)}; down level, by thrust alone",
    ),
    lands(
        "estimator-jump", BEFORE_CONTACT, left_jump_hold,
        "the state estimate jumped: landing where it is",
    ),
    lands(
        "estimate-unsure", IN_THE_OPEN,
        lambda c: c.held(C.UNSURE) >= c.profile.safety.variance_land_s,
        lambda c: f"{unsure(c)}: is the positioning system gone?",
    ),
    lands(
        "battery-low", BEFORE_CONTACT,
        lambda c: c.held(C.BATTERY_LOW) >= c.profile.safety.battery_debounce_s,
        lambda c: f"battery at {c.obs.telemetry.battery_v:.2f} V under load",
    ),
    lands(
        "battery-unknown", BEFORE_CONTACT,
        lambda c: c.obs.battery_age_s > c.profile.safety.battery_stale_s,
        "the battery's reading stands still",
    ),
    lands("latency", IN_THE_OPEN, latency_changed, why_latency),
    lands("mounting", IN_THE_OPEN, mounted_wrong, why_mounted_wrong),
    lands(
        "height-limit", BEFORE_CONTACT, lambda c: c.height_m > c.profile.safety.max_height_m,
        lambda c: f"height {c.height_m:.2f} m is above the limit",
    ),
    lands("fence", BEFORE_CONTACT, fence_broken, "outside the fence"),
    lands(
        "camera-gone", BY_CAMERA, lambda c: c.obs.camera_age_s > c.profile.safety.camera_land_s,
        lambda c: c.obs.camera_problem or f"no picture for {c.obs.camera_age_s:.1f} s",
    ),
    lands(
        "loop-late", FLYING_PHASES, lambda c: c.obs.loop_late_s > c.profile.safety.loop_late_land_s,
        lambda c: f"the control loop was {c.obs.loop_late_s:.1f} s late",
    ),
    lands(
        "markers-disagree", BY_CAMERA,
        lambda c: c.obs.disagreeing_frames >= c.profile.merge.disagreement_frames,
        "large and small marker contradict each other: check the printed sizes in the "
        "profile and the camera's calibration",
    ),
    lands(
        "log-lost", BEFORE_CONTACT,
        lambda c: c.profile.safety.land_on_log_error and c.obs.log_problem is not None,
        lambda c: f"flight log: {c.obs.log_problem}",
    ),
    lands(
        "time-over", BEFORE_CONTACT,
        lambda c: c.obs.t_s - c.state.started_s > c.profile.planner.perching_time_s,
        "the perching time is over", O.ATTEMPTS_USED_UP,
    ),
)  # fmt: skip

# --- The whole table -----------------------------------------------------------------------------

BEFORE_COMPLETION = only(P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER)

TABLE: tuple[Transition, ...] = (
    *SAFETY,
    # --- the magnet may catch early ---------------------------------------------
    Transition(
        "caught", BEFORE_COMPLETION, is_caught, P.COMPLETE, "hanging on the magnet already",
    ),
    lands(HELD, BEFORE_COMPLETION, is_held_elsewhere, why_held),
    lands("hangs-at-contact", BEFORE_COMPLETION, is_held, why_hangs_at_contact),
    # --- something is in the way -----------------------------------------------
    lands(
        "cannot-rise", only(P.APPROACH), lambda c: is_blocked(c) or too_weak(c),
        lambda c: f"pressed at {c.height_m:.2f} m: something is above, or the thrust is weak",
    ),
    backs_off(
        "blocked", BEFORE_COMPLETION, is_blocked_off_target,
        lambda c: f"pressed against something at {c.height_m:.2f} m"
        + ("" if c.state.hover_thrust else ", or the thrust is weak"),
    ),
    lands(
        "too-weak", BY_CAMERA, too_weak,
        "hovering takes all the thrust: the vehicle is too heavy, the battery too low, or "
        "something is above",
    ),
    # --- phase 1: approach ---------------------------------------------------
    Transition(
        "approached", only(P.APPROACH), lambda c: c.held(C.AT_TAKEOFF_HEIGHT) >= 0.3, P.SEARCH,
        "hovering in the perching area",
    ),
    lands(
        "approach-timeout", only(P.APPROACH),
        lambda c: c.in_phase_s > c.profile.planner.approach_timeout_s,
        lambda c: f"take-off reached only {c.height_m:.2f} m",
    ),
    # --- phase 2: search -----------------------------------------------------
    Transition(
        "found", only(P.SEARCH),
        lambda c: c.state.confirmed >= c.profile.planner.search.confirm_frames, P.ESTIMATE,
        "target seen",
    ),
    lands(
        "searched-out", only(P.SEARCH),
        lambda c: c.state.searches >= c.profile.planner.search.attempts, why_not_found,
        O.TARGET_NOT_FOUND,
    ),
    # --- phase 3: estimate ---------------------------------------------------
    Transition(
        "estimate-lost", only(P.ESTIMATE),
        lambda c: c.held(C.UNTRACKED) > 1.0
        or c.in_phase_s > c.profile.planner.estimate.timeout_s,
        P.SEARCH, "the target's pose does not settle", S.HOLD,
    ),
    Transition(
        "estimated", only(P.ESTIMATE),
        lambda c: c.held(C.ESTIMATED) >= c.profile.planner.estimate.dwell_s, P.ALIGN,
        "pose is steady",
    ),
    # --- phase 4: align ------------------------------------------------------
    Transition(
        "align-lost", only(P.ALIGN), lambda c: not c.tracked, P.SEARCH,
        "target lost in alignment", S.HOLD,
    ),
    backs_off(
        "align-timeout", only(P.ALIGN),
        lambda c: c.in_phase_s > c.profile.planner.align.timeout_s, "alignment took too long",
    ),
    lands("too-little-left", only(P.ALIGN, P.RECOVER), too_little_left, why_short),
    Transition(
        "aligned", only(P.ALIGN), is_aligned, P.ASCEND, "aligned in position and heading",
    ),
    # --- phase 5: ascend -----------------------------------------------------
    backs_off(
        "ascend-lost", only(P.ASCEND), lambda c: not c.tracked, "target lost in ascent",
    ),
    Transition(
        "outside-cone", only(P.ASCEND), lambda c: c.error_xy_m > c.cone_m, P.ALIGN,
        "drifted out of the cone", S.HOLD,
    ),
    backs_off(
        "ascend-timeout", only(P.ASCEND),
        lambda c: c.in_phase_s > c.profile.planner.ascend.timeout_s
        or c.held(C.NEAR_STANDOFF) > c.profile.planner.ascend.settle_timeout_s,
        "does not settle under the target",
    ),
    Transition(
        "settled", only(P.ASCEND),
        lambda c: c.held(C.SETTLED) >= c.profile.planner.ascend.settle_dwell_s, P.PERCH,
        "settled at the stand-off",
    ),
    # --- phase 6: perch ------------------------------------------------------
    backs_off("beside-the-magnet", only(P.PERCH), is_beside_magnet, why_beside_magnet),
    Transition(
        "contact", only(P.PERCH),
        lambda c: c.held(C.CONTACT) >= c.profile.planner.perch.contact_dwell_s, P.COMPLETE,
        why_contact,
    ),
    backs_off(
        # The last centimetres are flown unseen: by the target alone, by dead reckoning.
        "pressed-blindly", only(P.PERCH), lambda c: c.by_sight and c.position_age_s > BLIND_PRESS_S,
        lambda c: f"no contact {c.position_age_s:.1f} s after the last sight of the target",
    ),
    backs_off(
        "knocked-aside", only(P.PERCH), lambda c: c.held(C.KNOCKED) >= KNOCKED_S,
        "pushed aside under the target",
    ),
    backs_off(
        # Not in time, or not before the next turn of a loop as late as this one.
        "no-contact", only(P.PERCH),
        lambda c: c.in_phase_s + c.obs.loop_late_s > c.profile.planner.perch.timeout_s,
        "no proof of contact",
    ),
    # --- phase 7: completion -------------------------------------------------
    backs_off(
        "slipped", only(P.COMPLETE), has_slipped,
        lambda c: "slipped while hanging" if c.state.stopped_s else "the magnet does not hold",
    ),
    backs_off(
        "not-released", only(P.COMPLETE),
        lambda c: c.state.stopped_s is None
        and c.in_phase_s > c.profile.planner.complete.release_timeout_s,
        "the thrust could not be released",
    ),
    Transition(
        "perched", only(P.COMPLETE), lambda c: release_monitored(c) and hangs_where_it_did(c),
        P.PERCHED, "hanging still with the motors off", outcome=O.PERCHED,
    ),
    lands("fell-unseen", only(P.COMPLETE), release_monitored, why_fell_unseen),
    lands(
        "not-stopped", only(P.COMPLETE),
        lambda c: stopped_for_s(c) > c.profile.planner.complete.watch_s + UNSTOPPED_S,
        lambda c: f"motors stopped, but their thrust still reads {c.obs.telemetry.thrust:.0f}",
    ),
    # --- the failed attempt --------------------------------------------------
    lands(
        "attempts-used", only(P.RECOVER), lambda c: attempts_used(c) and c.in_phase_s > 0.5,
        "all perching attempts are used up", O.ATTEMPTS_USED_UP,
    ),
    Transition(
        "recovered", only(P.RECOVER), has_recovered, P.ESTIMATE,
        "steady again, trying once more",
    ),
    lands(
        "recover-timeout", only(P.RECOVER),
        lambda c: c.in_phase_s > c.profile.planner.recover.timeout_s,
        "the vehicle does not become steady",
    ),
    # --- landing ---------------------------------------------------------------
    Transition(
        "hung", only(P.LANDING), is_off_as(Finding.HANGS), P.PERCHED,
        "hanging with the motors off",
    ),
    Transition(
        "landed", only(P.LANDING), is_off_as(Finding.STANDS), P.LANDED,
        lambda c: "motors off"
        + ("" if c.state.blind_s is None else "; it was felt to come down to the floor"),
    ),
    Transition(
        "held-elsewhere", only(P.LANDING), is_off_as(Finding.HELD), P.ABORTED,
        "motors off; something holds it where its estimate has no target: look before you touch it",
        S.LAND, O.SAFETY,
    ),
    Transition(
        "hangs-or-stands", only(P.LANDING), lambda c: c.held(C.DOWN) >= LOOKED_S, P.ABORTED,
        "motors off; the telemetry was silent for as long as a fall takes, and it is not known "
        "whether it hangs or stands: look before you touch it", S.LAND, O.SAFETY,
    ),
    Transition(
        "landing-timeout", only(P.LANDING),
        lambda c: c.in_phase_s > c.profile.planner.landing.timeout_s, P.ABORTED,
        "the landing was not confirmed in time", S.LAND, O.SAFETY,
    ),
)  # fmt: skip
_ROWS_OF = {phase: tuple(row for row in TABLE if phase in row.phases) for phase in Phase}


def first_match(c: Context, table: tuple[Transition, ...] = TABLE) -> Transition | None:
    """The first transition that applies, or None to stay. Whatever the table says, one that would
    lead from a landing to a flying phase is passed over."""
    landing = c.state.severity >= Severity.LAND
    for row in _ROWS_OF[c.state.phase] if table is TABLE else table:
        undoes = landing and row.to in FLYING_PHASES
        if not undoes and c.state.phase in row.phases and row.when(c):
            return row
    return None
