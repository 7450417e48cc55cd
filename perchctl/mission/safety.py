"""The mission's safety rows, gravest first: they stand above all others
(`perchctl.mission.table`)."""

from __future__ import annotations

from perchctl.mission.guards import (
    fence_broken,
    is_astray,
    latency_changed,
    left_jump_hold,
    mounted_wrong,
    unsure,
    why_astray,
    why_latency,
    why_mounted_wrong,
    why_unplaced,
)
from perchctl.mission.hold import is_lost
from perchctl.mission.lander import hangs_stopped
from perchctl.mission.row import Row
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

P, S, O, C = Phase, Severity, Outcome, Condition  # noqa: E741 - column names of the rows below

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
