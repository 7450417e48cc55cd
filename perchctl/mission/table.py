"""The mission as one ordered table: first match wins, safety rows on top.

The diagram and the table of docs/mission.md are drawn from `TABLE`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perchctl.mission.budget import why_short
from perchctl.mission.context import Context
from perchctl.mission.guards import (
    attempts_used,
    fence_broken,
    has_recovered,
    has_slipped,
    is_aligned,
    is_astray,
    is_beside_magnet,
    is_blocked,
    is_blocked_off_target,
    is_caught,
    is_held,
    is_held_elsewhere,
    is_lost,
    is_watched,
    latency_changed,
    left_jump_hold,
    mounted_wrong,
    pressed_blindly,
    presses_too_long,
    searched_out,
    settling_too_long,
    still_turns,
    too_little_left,
    too_weak,
    unsure,
    why_astray,
    why_beside_magnet,
    why_contact,
    why_hangs_at_contact,
    why_held,
    why_latency,
    why_mounted_wrong,
    why_not_found,
    why_pressed_blindly,
    why_unplaced,
)
from perchctl.mission.lander import (
    HELD,
    LOOKED_S,
    Finding,
    hangs_stopped,
    hangs_where_it_did,
    rest_finding,
    why_fell_unseen,
    why_landed,
    why_unknown,
)
from perchctl.mission.state import (
    FLYING_PHASES,
    Condition,
    MotorStop,
    Operator,
    Outcome,
    Phase,
    Severity,
)
from perchctl.vehicle import CRASHED, LOCKED, TUMBLED

Guard = Callable[[Context], bool]


@dataclass(frozen=True, eq=False)
class Row:
    """From any of `phases`, when `when` holds, to `to`.

    `reason` is shown to the user; `motor_stop` is what a row into ABORTED does to the motors.
    """

    name: str
    phases: frozenset[Phase]
    when: Guard
    to: Phase
    reason: str | Callable[[Context], str]
    severity: Severity = Severity.CONTINUE
    outcome: Outcome | None = None
    counts_attempt: bool = False
    motor_stop: MotorStop = MotorStop.NONE

    def explain(self, c: Context) -> str:
        return self.reason if isinstance(self.reason, str) else self.reason(c)


def risen(before: Severity, row: Severity) -> Severity:
    """The flight's severity after a row: from `LAND` on it only rises."""
    return max(before, row) if before >= Severity.LAND else row


P, S, O, C = Phase, Severity, Outcome, Condition  # noqa: E741 - column names of the table below

# --- The safety rows, gravest first -----------------------------------------------------------

KNOCKED_S = 0.04
"""More than one sample of telemetry."""

# Where a row applies.
AIR = FLYING_PHASES | {P.LANDING}
BY_CAMERA = frozenset({P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.RECOVER})
IN_THE_OPEN = BY_CAMERA | {P.APPROACH}
BEFORE_CONTACT = FLYING_PHASES - {P.COMPLETE}


def only(*phases: Phase) -> frozenset[Phase]:
    return frozenset(phases)


SAFETY: tuple[Row, ...] = (
    Row(
        "operator-stop", AIR, lambda c: c.obs.operator >= Operator.STOP, P.ABORTED,
        "second Ctrl-C: emergency stop", S.STOP, O.EMERGENCY,
        motor_stop=MotorStop.EMERGENCY,
    ),
    Row(
        "hung-but-locked", only(P.COMPLETE, P.LANDING),
        lambda c: c.obs.telemetry.has(LOCKED) and hangs_stopped(c), P.PERCHED,
        "hanging, but the supervisor has locked the vehicle: restart it before the next flight",
        outcome=O.PERCHED,
    ),
    Row(
        "locked", AIR, lambda c: c.obs.telemetry.has(LOCKED), P.ABORTED,
        "the supervisor has locked the vehicle: inspect and restart it", S.STOP, O.SAFETY,
        motor_stop=MotorStop.PLAIN,
    ),
    Row(
        "tumbled", AIR, lambda c: c.obs.telemetry.has(TUMBLED), P.ABORTED,
        "the vehicle has tumbled: inspect and restart it", S.STOP, O.SAFETY,
        motor_stop=MotorStop.PLAIN,
    ),
    Row(
        "crashed", AIR, lambda c: c.obs.telemetry.has(CRASHED), P.ABORTED,
        "the supervisor reports a crash: inspect and restart the vehicle", S.STOP, O.SAFETY,
        motor_stop=MotorStop.PLAIN,
    ),
    Row(
        "tilted", AIR,
        lambda c: c.held(C.TILTED) >= c.profile.safety.tilt_debounce_s
        and c.state.stopped_s is None,
        P.ABORTED, "tilted beyond the limit: motors cut", S.STOP, O.SAFETY,
        motor_stop=MotorStop.EMERGENCY,
    ),
    Row(
        "operator-land", FLYING_PHASES, lambda c: c.obs.operator >= Operator.LAND, P.LANDING,
        "the operator asked to land", S.LAND, O.OPERATOR,
    ),
    Row(
        "link-lost", FLYING_PHASES, lambda c: c.obs.link_problem is not None, P.LANDING,
        lambda c: f"link lost: {c.obs.link_problem}", S.LAND, O.SAFETY,
    ),
    Row(
        "telemetry-stale", FLYING_PHASES,
        lambda c: c.telemetry_age_s > c.profile.safety.telemetry_land_s, P.LANDING,
        lambda c: f"no telemetry for {c.telemetry_age_s:.1f} s", S.LAND, O.SAFETY,
    ),
    Row(
        "heading-lost", BEFORE_CONTACT, lambda c: c.state.heading_lost, P.LANDING,
        "the estimated heading jumped: down level, by thrust alone", S.LAND, O.SAFETY,
    ),
    Row(
        "position-astray", IN_THE_OPEN | {P.LANDING}, is_astray, P.LANDING, why_astray, S.LAND,
        O.SAFETY,
    ),
    Row(
        "position-lost", IN_THE_OPEN | {P.PERCH}, is_lost, P.LANDING, why_unplaced, S.LAND,
        O.SAFETY,
    ),
    Row(
        "estimator-jump", BEFORE_CONTACT, left_jump_hold, P.LANDING,
        "the state estimate jumped: landing where it is", S.LAND, O.SAFETY,
    ),
    Row(
        "estimate-unsure", IN_THE_OPEN,
        lambda c: c.held(C.UNSURE) >= c.profile.safety.variance_land_s, P.LANDING,
        lambda c: f"{unsure(c)}: is the positioning system gone?", S.LAND, O.SAFETY,
    ),
    Row(
        "battery-low", BEFORE_CONTACT,
        lambda c: c.held(C.BATTERY_LOW) >= c.profile.safety.battery_debounce_s, P.LANDING,
        lambda c: f"battery at {c.obs.telemetry.battery_v:.2f} V under load", S.LAND, O.SAFETY,
    ),
    Row(
        "battery-unknown", BEFORE_CONTACT,
        lambda c: c.obs.battery_age_s > c.profile.safety.battery_stale_s, P.LANDING,
        "the battery's reading stands still", S.LAND, O.SAFETY,
    ),
    Row(
        "latency", IN_THE_OPEN, latency_changed, P.LANDING, why_latency, S.LAND, O.SAFETY,
    ),
    Row(
        "mounting", IN_THE_OPEN, mounted_wrong, P.LANDING, why_mounted_wrong, S.LAND, O.SAFETY,
    ),
    Row(
        "height-limit", BEFORE_CONTACT,
        lambda c: c.height_m > c.profile.safety.max_height_m, P.LANDING,
        lambda c: f"height {c.height_m:.2f} m is above the limit", S.LAND, O.SAFETY,
    ),
    Row(
        "fence", BEFORE_CONTACT, fence_broken, P.LANDING, "outside the fence", S.LAND, O.SAFETY,
    ),
    Row(
        "camera-gone", BY_CAMERA,
        lambda c: c.obs.camera_age_s > c.profile.safety.camera_land_s, P.LANDING,
        lambda c: c.obs.camera_problem or f"no picture for {c.obs.camera_age_s:.1f} s",
        S.LAND, O.SAFETY,
    ),
    Row(
        "loop-late", FLYING_PHASES,
        lambda c: c.obs.loop_late_s > c.profile.safety.loop_late_land_s, P.LANDING,
        lambda c: f"the control loop was {c.obs.loop_late_s:.1f} s late", S.LAND, O.SAFETY,
    ),
    Row(
        "markers-disagree", BY_CAMERA,
        lambda c: c.obs.disagreeing_frames >= c.profile.merge.disagreement_frames, P.LANDING,
        "large and small marker contradict each other: check the printed sizes in the "
        "profile and the camera's calibration",
        S.LAND, O.SAFETY,
    ),
    Row(
        "log-lost", BEFORE_CONTACT,
        lambda c: c.profile.safety.land_on_log_error and c.obs.log_problem is not None,
        P.LANDING, lambda c: f"flight log: {c.obs.log_problem}", S.LAND, O.SAFETY,
    ),
    Row(
        "time-over", BEFORE_CONTACT,
        lambda c: c.obs.t_s - c.state.started_s > c.profile.planner.perching_time_s, P.LANDING,
        "the perching time is over", S.LAND, O.ATTEMPTS_USED_UP,
    ),
)  # fmt: skip

# --- The whole table ---------------------------------------------------------------------------

TABLE: tuple[Row, ...] = (
    *SAFETY,
    # --- the magnet may catch early ---------------------------------------------
    Row(
        "caught", only(P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER),
        is_caught, P.COMPLETE, "hanging on the magnet already",
    ),
    Row(
        HELD, only(P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER),
        is_held_elsewhere, P.LANDING, why_held, S.LAND, O.SAFETY,
    ),
    Row(
        "hangs-at-contact", only(P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER),
        is_held, P.LANDING, why_hangs_at_contact, S.LAND, O.SAFETY,
    ),
    # --- something is in the way -----------------------------------------------
    Row(
        "cannot-rise", only(P.APPROACH), lambda c: is_blocked(c) or too_weak(c), P.LANDING,
        lambda c: f"pressed at {c.height_m:.2f} m: something is above, or the thrust is weak",
        S.LAND, O.SAFETY,
    ),
    Row(
        "blocked", only(P.SEARCH, P.ESTIMATE, P.ALIGN, P.ASCEND, P.PERCH, P.RECOVER),
        is_blocked_off_target, P.RECOVER,
        lambda c: f"pressed against something at {c.height_m:.2f} m"
        + ("" if c.state.hover_thrust else ", or the thrust is weak"), S.BACK_OFF,
        counts_attempt=True,
    ),
    Row(
        "too-weak", BY_CAMERA, too_weak, P.LANDING,
        "hovering takes all the thrust: the vehicle is too heavy, the battery too low, or "
        "something is above", S.LAND, O.SAFETY,
    ),
    # --- phase 1: approach ---------------------------------------------------
    Row(
        "approached", only(P.APPROACH), lambda c: c.held(C.AT_TAKEOFF_HEIGHT) >= 0.3, P.SEARCH,
        "hovering in the perching area",
    ),
    Row(
        "approach-timeout", only(P.APPROACH),
        lambda c: c.in_phase_s > c.profile.planner.approach_timeout_s, P.LANDING,
        lambda c: f"take-off reached only {c.height_m:.2f} m", S.LAND, O.SAFETY,
    ),
    # --- phase 2: search -----------------------------------------------------
    Row(
        "found", only(P.SEARCH),
        lambda c: c.state.confirmed >= c.profile.planner.search.confirm_frames, P.ESTIMATE,
        "target seen",
    ),
    Row(
        "searched-out", only(P.SEARCH), searched_out, P.LANDING, why_not_found,
        S.LAND, O.TARGET_NOT_FOUND,
    ),
    # --- phase 3: estimate ---------------------------------------------------
    Row(
        "estimate-lost", only(P.ESTIMATE),
        lambda c: c.held(C.UNTRACKED) > 1.0
        or c.in_phase_s > c.profile.planner.estimate.timeout_s,
        P.SEARCH, "the target's pose does not settle", S.HOLD,
    ),
    Row(
        "estimated", only(P.ESTIMATE),
        lambda c: c.held(C.ESTIMATED) >= c.profile.planner.estimate.dwell_s, P.ALIGN,
        "pose is steady",
    ),
    # --- phase 4: align ------------------------------------------------------
    Row(
        "align-lost", only(P.ALIGN), lambda c: not c.tracked, P.SEARCH,
        "target lost in alignment", S.HOLD,
    ),
    Row(
        "align-timeout", only(P.ALIGN),
        lambda c: c.in_phase_s > c.profile.planner.align.timeout_s, P.RECOVER,
        "alignment took too long", S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "too-little-left", only(P.ALIGN, P.RECOVER), too_little_left, P.LANDING, why_short,
        S.LAND, O.SAFETY,
    ),
    Row(
        "aligned", only(P.ALIGN), is_aligned, P.ASCEND, "aligned in position and heading",
    ),
    # --- phase 5: ascend -----------------------------------------------------
    Row(
        "ascend-lost", only(P.ASCEND), lambda c: not c.tracked, P.RECOVER,
        "target lost in ascent", S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "outside-cone", only(P.ASCEND),
        lambda c: c.error_xy_m > c.cone_m, P.ALIGN,
        "drifted out of the cone", S.HOLD,
    ),
    Row(
        "ascend-timeout", only(P.ASCEND),
        lambda c: c.in_phase_s > c.profile.planner.ascend.timeout_s or settling_too_long(c),
        P.RECOVER, "does not settle under the target", S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "settled", only(P.ASCEND),
        lambda c: c.held(C.SETTLED) >= c.profile.planner.ascend.settle_dwell_s, P.PERCH,
        "settled at the stand-off",
    ),
    # --- phase 6: perch ------------------------------------------------------
    Row(
        "beside-the-magnet", only(P.PERCH), is_beside_magnet, P.RECOVER, why_beside_magnet,
        S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "contact", only(P.PERCH),
        lambda c: c.held(C.CONTACT) >= c.profile.planner.perch.contact_dwell_s, P.COMPLETE,
        why_contact,
    ),
    Row(
        "pressed-blindly", only(P.PERCH), pressed_blindly, P.RECOVER, why_pressed_blindly,
        S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "knocked-aside", only(P.PERCH), lambda c: c.held(C.KNOCKED) >= KNOCKED_S, P.RECOVER,
        "pushed aside under the target", S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "no-contact", only(P.PERCH), presses_too_long, P.RECOVER, "no proof of contact",
        S.BACK_OFF, counts_attempt=True,
    ),
    # --- phase 7: completion -------------------------------------------------
    Row(
        "slipped", only(P.COMPLETE), has_slipped, P.RECOVER,
        lambda c: "slipped while hanging" if c.state.stopped_s else "the magnet does not hold",
        S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "not-released", only(P.COMPLETE),
        lambda c: c.state.stopped_s is None
        and c.in_phase_s > c.profile.planner.complete.release_timeout_s,
        P.RECOVER, "the thrust could not be released", S.BACK_OFF, counts_attempt=True,
    ),
    Row(
        "perched", only(P.COMPLETE), lambda c: is_watched(c) and hangs_where_it_did(c), P.PERCHED,
        "hanging still with the motors off", outcome=O.PERCHED,
    ),
    Row(
        "fell-unseen", only(P.COMPLETE), is_watched, P.LANDING, why_fell_unseen, S.LAND, O.SAFETY,
    ),
    Row(
        "not-stopped", only(P.COMPLETE), still_turns, P.LANDING,
        lambda c: f"motors stopped, but their thrust still reads {c.obs.telemetry.thrust:.0f}",
        S.LAND, O.SAFETY,
    ),
    # --- the failed attempt --------------------------------------------------
    Row(
        "attempts-used", only(P.RECOVER),
        lambda c: attempts_used(c) and c.in_phase_s > 0.5, P.LANDING,
        "all perching attempts are used up", S.LAND, O.ATTEMPTS_USED_UP,
    ),
    Row(
        "recovered", only(P.RECOVER), has_recovered, P.ESTIMATE,
        "steady again, trying once more",
    ),
    Row(
        "recover-timeout", only(P.RECOVER),
        lambda c: c.in_phase_s > c.profile.planner.recover.timeout_s, P.LANDING,
        "the vehicle does not become steady", S.LAND, O.SAFETY,
    ),
    # --- landing ---------------------------------------------------------------
    Row(
        "hung", only(P.LANDING),
        lambda c: c.held(C.DOWN) >= 0.1 and rest_finding(c) is Finding.HANGS, P.PERCHED,
        "hanging with the motors off",
    ),
    Row(
        "landed", only(P.LANDING),
        lambda c: c.held(C.DOWN) >= 0.1 and rest_finding(c) is Finding.STANDS, P.LANDED, why_landed,
    ),
    Row(
        "held-elsewhere", only(P.LANDING),
        lambda c: c.held(C.DOWN) >= 0.1 and rest_finding(c) is Finding.HELD, P.ABORTED,
        "motors off; something holds it where its estimate has no target: look before you touch it",
        S.LAND, O.SAFETY,
    ),
    Row(
        "hangs-or-stands", only(P.LANDING), lambda c: c.held(C.DOWN) >= LOOKED_S, P.ABORTED,
        why_unknown, S.LAND, O.SAFETY,
    ),
    Row(
        "landing-timeout", only(P.LANDING),
        lambda c: c.in_phase_s > c.profile.planner.landing.timeout_s, P.ABORTED,
        "the landing was not confirmed in time", S.LAND, O.SAFETY,
    ),
)  # fmt: skip
_ROWS_OF = {phase: tuple(row for row in TABLE if phase in row.phases) for phase in Phase}


def first_match(c: Context, table: tuple[Row, ...] = TABLE) -> Row | None:
    """The first row that applies to the phase, or None to stay. Whatever the table says, one that
    would lead from a landing to a flying phase is passed over."""
    landing = c.state.severity >= Severity.LAND
    for row in _ROWS_OF[c.state.phase] if table is TABLE else table:
        undoes = landing and row.to in FLYING_PHASES
        if not undoes and c.state.phase in row.phases and row.when(c):
            return row
    return None
