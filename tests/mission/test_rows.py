"""Each row of the mission's table decides something: its case ends otherwise without it."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from perchctl.errors import InvalidValue, PerchError
from perchctl.mission import (
    CameraImuMismatch,
    GearToTargetDistance,
    ImuMotion,
    Observation,
    OperatorRequest,
    Outcome,
    Phase,
    planner,
)
from perchctl.mission.belief.mounting import (
    MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG,
    CameraMountingMonitor,
)
from perchctl.mission.phase import PRE_LANDING_PHASES, Severity
from perchctl.mission.phases.align import ALIGNED, MAX_WAIT_FOR_CLIMB_PERMISSION_S
from perchctl.mission.table import (
    TABLE,
    TRANSITIONS_ALLOWED_FOR_USER_ROWS,
    Transition,
    add_rows,
    find_first_matching_transition,
    load_table,
)
from perchctl.vehicle import (
    CRASHED,
    LOCKED,
    TUMBLED,
    Command,
    EmergencyStop,
    Idle,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from tests.helpers.mission import (
    AIRBORNE,
    BY_TARGET,
    CEILING_M,
    FINE_BATTERY,
    HOVER_THRUST,
    HOVERING,
    IN_CORRIDOR,
    MOCAP,
    PROFILE,
    READY,
    changed,
    context_at,
    observation,
    remembering,
    state_in,
    target_at,
)
from tests.mission.rig import BEGIN_S, TICK_S, Look, at, times

P, O = Phase, Outcome  # noqa: E741 - column names of the cases below
CONTACT_Z_M = CEILING_M - PROFILE.vehicle.gear_body_m[2]
STANDOFF_Z_M = CONTACT_Z_M - PROFILE.planner.ascend.standoff_m


@dataclass(frozen=True)
class Case:
    """One row's case: from `phase`, with what is observed for `lasts_s`, the mission enters
    `to`, with that outcome and that last command; and by `row`, where another one below it would
    lead there, too, and say something else."""

    phase: Phase
    to: Phase
    look: Look
    lasts_s: float = 0.1
    outcome: Outcome | None = None
    command: type[Command] | None = None  # type: ignore[valid-type]
    state: dict[str, Any] = field(default_factory=dict)
    z_m: float = 1.0
    profile: Any = PROFILE
    row: str | None = None

    def holds(self, table: tuple[Transition, ...] = TABLE) -> bool:
        state = remembering(state_in(self.phase, BEGIN_S, self.z_m), **self.state)
        for t_s in times(max(2 * TICK_S, self.lasts_s)):
            state, command = planner.step_mission(state, self.look(t_s), self.profile, table)
            if state.phase is self.to:
                fits = self.command is None or isinstance(command, self.command)
                fits = fits and self.row in (None, state.transition_name)
                return fits and state.outcome is self.outcome
        return False


def seen(z_m: float = 1.0, **obs: Any) -> Look:
    return at(z_m, obs=obs)


def unseen(z_m: float = 1.0, sigma_m: float = 1e-3, **tel: Any) -> Look:
    """The target is where it was, but no longer tracked."""

    remembered = target_at(
        BEGIN_S, body_m=(0.0, 0.0, z_m), is_measured_in_newest_frame=False, tracked=False,
        last_measured_at_s=BEGIN_S - 1.0, sigma_m=np.full(3, sigma_m),
    )  # fmt: skip
    return at(z_m, obs={"target": remembered}, **tel)


def aside(x_m: float, z_m: float = 1.0, **changes: Any) -> Look:
    """The vehicle beside the target."""

    return at(position_m=(x_m, 0.0, z_m), **changes)


def old(look: Look, since_s: float) -> Look:
    """Observations whose telemetry stays at a time."""

    def aged(t_s: float) -> Observation:
        obs = look(t_s)
        return replace(obs, telemetry=replace(obs.telemetry, t_s=since_s))

    return aged


def blind(look: Look) -> Look:
    """Without any target."""
    return lambda t_s: replace(look(t_s), target=None)


def unknown(t_s: float) -> Observation:
    """Motors off, neither the target nor a position of late, and a silence not long ago."""
    obs = replace(at(CONTACT_Z_M, **OFF)(t_s), external_position_age_s=3.0, target=None)
    return replace(obs, imu=ImuMotion(t_s=t_s, last_gap_that_may_hide_fall_ended_at_s=BEGIN_S))


LAND_ON_LOG = changed({"safety.land_on_log_error": True})
QUIET = HOVER_THRUST * 0.5
PRESSED = HOVER_THRUST * 1.12
FULL = 65535.0
LONGEST_WAIT_S = MAX_WAIT_FOR_CLIMB_PERMISSION_S + 0.2
OFF = {"thrust": 0.0, "supervisor": READY}

# row of the table: its case
CASES: dict[str, Case] = {
    "operator-stop": Case(
        P.ALIGN, P.ABORTED, seen(operator_request=OperatorRequest.CUT_MOTORS), 0.1, O.EMERGENCY,
        EmergencyStop
    ),
    "hung-but-locked": Case(
        P.COMPLETE, P.PERCHED, at(CONTACT_Z_M, thrust=0.0, supervisor=READY | LOCKED), 0.1,
        O.PERCHED, state={
            "motor_stop_commanded_at_s": BEGIN_S,
            "vehicle_world_z_at_last_contact_m": CONTACT_Z_M,
        },
        z_m=CONTACT_Z_M,
    ),
    "locked": Case(P.ALIGN, P.ABORTED, at(supervisor=AIRBORNE | LOCKED), 0.1, O.SAFETY,
                   StopMotors),
    "tumbled": Case(P.ALIGN, P.ABORTED, at(supervisor=AIRBORNE | TUMBLED), 0.1, O.SAFETY,
                    StopMotors),
    "crashed": Case(P.ALIGN, P.ABORTED, at(supervisor=AIRBORNE | CRASHED), 0.1, O.SAFETY,
                    StopMotors),
    "tilted": Case(P.ALIGN, P.ABORTED, at(roll_rad=1.5), 0.5, O.SAFETY, EmergencyStop),
    "operator-land": Case(P.ALIGN, P.LANDING, seen(operator_request=OperatorRequest.LAND), 0.1,
        O.ENDED_BY_OPERATOR),
    "link-lost": Case(P.ALIGN, P.LANDING, seen(link_problem="gone"), 0.1, O.SAFETY),
    "telemetry-stale": Case(P.ALIGN, P.LANDING, old(seen(), BEGIN_S), 1.5, O.SAFETY),
    "heading-lost": Case(
        P.ALIGN, P.LANDING, seen(has_estimated_position_jumped=True, heading_jump_rad=1.5), 0.1,
        O.SAFETY, PositionSetpoint
    ),
    "position-astray": Case(
        P.APPROACH, P.LANDING, aside(0.2, 0.01), 0.1, O.SAFETY, RawThrust, z_m=0.3, profile=MOCAP
    ),
    "position-lost": Case(
        P.ALIGN, P.LANDING,
        seen(external_position_age_s=0.8, external_position_problem="occluded"), 0.1, O.SAFETY
    ),
    "estimator-jump": Case(
        P.ALIGN, P.LANDING, seen(has_estimated_position_jumped=True), 0.8, O.SAFETY
    ),
    "estimate-unsure": Case(
        P.ALIGN, P.LANDING, at(velocity_variance_m2ps2=0.08), 1.2, O.SAFETY
    ),
    "battery-low": Case(P.ASCEND, P.LANDING, at(battery_v=2.8), 1.8, O.SAFETY),
    "battery-unknown": Case(P.ALIGN, P.LANDING, seen(battery_reading_age_s=99.0), 0.1, O.SAFETY),
    "latency": Case(
        P.ALIGN, P.LANDING,
        seen(camera_imu_mismatch=CameraImuMismatch(camera_latency_error_s=0.15)), 0.1, O.SAFETY,
    ),
    "mounting": Case(
        P.ALIGN, P.LANDING, seen(), 0.1, O.SAFETY,
        state={"camera_mounting_monitor": CameraMountingMonitor(
            contradicting_sighting_count=MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG
        )},
    ),
    "height-limit": Case(P.SEARCH, P.LANDING, unseen(3.4), 0.1, O.SAFETY, z_m=3.4),
    "fence": Case(P.ALIGN, P.LANDING, aside(2.5), 0.1, O.SAFETY),
    "corridor": Case(P.ALIGN, P.LANDING, aside(0.6), 0.1, O.SAFETY, profile=IN_CORRIDOR),
    "camera-gone": Case(
        P.ALIGN, P.LANDING, seen(last_good_frame_age_s=4.0, has_new_frame=False), 0.1, O.SAFETY
    ),
    "loop-late": Case(P.ALIGN, P.LANDING, seen(tick_start_delay_s=1.2), 0.1, O.SAFETY),
    "markers-disagree": Case(P.ALIGN, P.LANDING, seen(successive_marker_conflict_frames=40), 0.1,
        O.SAFETY),
    "log-lost": Case(
        P.ALIGN, P.LANDING, seen(flight_log_problem="disk full"), 0.1, O.SAFETY, profile=LAND_ON_LOG
    ),
    "time-over": Case(
        P.ALIGN, P.LANDING, seen(), 0.1, O.ATTEMPTS_USED_UP, state={"flight_started_at_s": -1000.0}
    ),
    "caught": Case(
        P.PERCH, P.COMPLETE, at(CONTACT_Z_M - 0.03, thrust=QUIET), 1.2, z_m=CONTACT_Z_M - 0.03
    ),
    "held": Case(
        P.ASCEND, P.LANDING, at(CONTACT_Z_M - 0.2, thrust=QUIET), 2.2, O.SAFETY,
        state={"entered_s": BEGIN_S, "vehicle_world_z_at_last_contact_m": CONTACT_Z_M - 0.2},
        z_m=CONTACT_Z_M - 0.2,
        row="held",
    ),
    "hangs-at-contact": Case(
        P.RECOVER, P.LANDING, unseen(CONTACT_Z_M, 0.05, thrust=QUIET), 2.2, O.SAFETY,
        state={
            "entered_s": BEGIN_S, "vehicle_world_z_at_last_contact_m": CONTACT_Z_M,
            "gear_to_target_at_last_contact": GearToTargetDistance(0.01, 0.05),
        },
        z_m=CONTACT_Z_M,
    ),
    "cannot-rise": Case(
        P.APPROACH, P.LANDING, at(0.3, thrust=FULL), 0.9, O.SAFETY,
        state={"setpoint": PositionSetpoint(0.0, 0.0, 0.5, 0.0)}, z_m=0.3,
    ),
    "blocked": Case(
        P.SEARCH, P.RECOVER, blind(at(1.0, thrust=PRESSED)), 0.9,
        state={"setpoint": PositionSetpoint(0.0, 0.0, 1.3, 0.0), "entry_m": (0.0, 0.0, 1.3)},
    ),
    "too-weak": Case(
        P.SEARCH, P.LANDING, blind(at(thrust=FULL)), 2.3, O.SAFETY,
        state={"search_step_began_at_s": BEGIN_S + 9.0},
    ),
    "approached": Case(P.APPROACH, P.SEARCH, seen(0.5), 0.4, z_m=0.5),
    "approach-timeout": Case(
        P.APPROACH, P.LANDING, seen(0.1), 0.1, O.SAFETY, state={"entered_s": -20.0}, z_m=0.1
    ),
    "found": Case(P.SEARCH, P.ESTIMATE, seen(), 0.2),
    "searched-out": Case(
        P.SEARCH, P.LANDING, unseen(), 0.1, O.TARGET_NOT_FOUND, state={"searched_position_count": 6}
    ),
    "estimate-lost": Case(P.ESTIMATE, P.SEARCH, unseen(), 1.2),
    "estimated": Case(P.ESTIMATE, P.ALIGN, seen(), 0.6),
    "align-lost": Case(P.ALIGN, P.SEARCH, unseen()),
    "align-timeout": Case(P.ALIGN, P.RECOVER, aside(0.2), state={"entered_s": -20.0}),
    "too-little-left": Case(
        P.ALIGN, P.LANDING, at(battery_v=3.24), 1.0, O.SAFETY,
        state={"battery_fit": replace(FINE_BATTERY, rest_v=3.77)},
    ),
    "hover-height": Case(
        P.ALIGN, P.LANDING, seen(), 0.6, O.SAFETY,
        profile=changed({"safety.max_height_m": 1.04}, HOVERING),
    ),
    "climb-not-permitted": Case(
        P.ALIGN, P.LANDING, seen(climb_withheld_reason="not now"), LONGEST_WAIT_S, O.SAFETY
    ),
    "climb-withheld": Case(
        P.ALIGN, P.LANDING, seen(climb_withheld_reason="not now"), LONGEST_WAIT_S, O.SAFETY
    ),
    "aligned": Case(P.ALIGN, P.ASCEND, seen(), 0.6),
    "ascend-lost": Case(P.ASCEND, P.RECOVER, unseen(), 0.6),
    "outside-cone": Case(P.ASCEND, P.ALIGN, aside(0.4)),
    "ascend-timeout": Case(P.ASCEND, P.RECOVER, seen(), state={"entered_s": -50.0}),
    "at-hover-place": Case(P.ASCEND, P.HOVER, seen(), 0.5, profile=HOVERING),
    "settled": Case(P.ASCEND, P.PERCH, seen(STANDOFF_Z_M), 0.5, z_m=STANDOFF_Z_M),
    "beside-the-magnet": Case(
        P.PERCH, P.RECOVER, aside(0.06, CONTACT_Z_M, thrust=PRESSED), 0.5, z_m=CONTACT_Z_M
    ),
    "contact": Case(
        P.PERCH, P.COMPLETE, at(CONTACT_Z_M, thrust=PRESSED), 0.5, z_m=CONTACT_Z_M
    ),
    "pressed-blindly": Case(
        P.PERCH, P.RECOVER, seen(external_position_age_s=1.3), 0.1, profile=BY_TARGET
    ),
    "knocked-aside": Case(
        P.PERCH, P.RECOVER, at(2.0, velocity_mps=(0.4, -0.4, 0.0)), 0.1, z_m=2.0
    ),
    "no-contact": Case(P.PERCH, P.RECOVER, seen(2.0), 3.2, z_m=2.0),
    "slipped": Case(
        P.COMPLETE, P.RECOVER,
        at(CONTACT_Z_M - 0.1, velocity_mps=(0.0, 0.0, -0.5), thrust=QUIET),
        z_m=CONTACT_Z_M,
    ),
    "not-released": Case(
        P.COMPLETE, P.RECOVER, at(CONTACT_Z_M), state={"entered_s": 0.0}, z_m=CONTACT_Z_M
    ),
    "perched": Case(
        P.COMPLETE, P.PERCHED, at(CONTACT_Z_M, **OFF), 0.3, O.PERCHED,
        state={
            "motor_stop_commanded_at_s": BEGIN_S - 3.0,
            "vehicle_world_z_at_last_contact_m": CONTACT_Z_M,
        },
        z_m=CONTACT_Z_M,
    ),
    "fell-unseen": Case(
        P.COMPLETE, P.LANDING, at(0.02, **OFF), 0.3, O.SAFETY,
        state={
            "motor_stop_commanded_at_s": BEGIN_S - 3.0,
            "vehicle_world_z_at_last_contact_m": CONTACT_Z_M,
        },
        z_m=CONTACT_Z_M,
    ),
    "not-stopped": Case(
        P.COMPLETE, P.LANDING, at(CONTACT_Z_M, thrust=1000.0, supervisor=READY), 0.1, O.SAFETY,
        state={"motor_stop_commanded_at_s": BEGIN_S - 12.0, "stop_or_land_command_count": 5,
            "vehicle_world_z_at_last_contact_m": CONTACT_Z_M},
        z_m=CONTACT_Z_M,
    ),
    "attempts-used": Case(
        P.RECOVER, P.LANDING, seen(), 0.7, O.ATTEMPTS_USED_UP,
        state={"failed_attempts": PROFILE.planner.attempts},
    ),
    "recovered": Case(P.RECOVER, P.ESTIMATE, seen(), 1.2),
    "recover-timeout": Case(
        P.RECOVER, P.LANDING, at(velocity_mps=(0.5, 0.0, 0.0)), 0.1, O.SAFETY,
        state={"entered_s": 0.0},
    ),
    "hover-lost": Case(P.HOVER, P.RECOVER, unseen(), 0.6, profile=HOVERING),
    "left-place": Case(P.HOVER, P.ALIGN, aside(0.4), profile=HOVERING),
    "hovered": Case(P.HOVER, P.LANDING, seen(), 5.1, O.HOVERED, profile=HOVERING),
    "sunk": Case(P.HOVER, P.ASCEND, seen(0.9), 0.5, profile=HOVERING),
    "hung": Case(
        P.LANDING, P.PERCHED, at(CONTACT_Z_M, **OFF), 0.3, O.ENDED_BY_OPERATOR,
        state={"outcome": O.ENDED_BY_OPERATOR, "motor_stop_commanded_at_s": BEGIN_S,
            "vehicle_world_z_at_last_contact_m": CONTACT_Z_M},
        z_m=CONTACT_Z_M,
    ),
    "landed": Case(
        P.LANDING, P.LANDED, at(0.02, **OFF), 0.3, O.ENDED_BY_OPERATOR,
        state={"outcome": O.ENDED_BY_OPERATOR, "stop_or_land_command_count": 1}, z_m=0.02,
    ),
    "held-elsewhere": Case(
        P.LANDING, P.ABORTED, at(CONTACT_Z_M - 0.2, **OFF), 0.3, O.SAFETY,
        state={"outcome": O.SAFETY, "motor_stop_commanded_at_s": BEGIN_S, "row": "held",
            "entered_s": BEGIN_S},
        z_m=CONTACT_Z_M - 0.2,
    ),
    "hangs-or-stands": Case(
        P.LANDING, P.ABORTED, unknown, 2.3, O.SAFETY,
        state={
            "outcome": O.SAFETY, "motor_stop_commanded_at_s": BEGIN_S,
            "vehicle_world_z_at_last_contact_m": CONTACT_Z_M,
            "magnet_reach_entered_at_s": BEGIN_S - 1.0,
        },
        z_m=CONTACT_Z_M, profile=BY_TARGET,
    ),
    "landing-timeout": Case(
        P.LANDING, P.ABORTED, seen(), 0.1, O.SAFETY, Idle,
        state={"entered_s": -40.0, "stop_or_land_command_count": 1,
            "last_stop_or_land_command_at_s": BEGIN_S},
    ),
}  # fmt: skip


def test_every_row_has_its_case() -> None:
    assert list(CASES) == [row.name for row in TABLE]


@pytest.mark.parametrize("name", CASES)
def test_the_row_decides(name: str) -> None:
    assert CASES[name].holds()


@pytest.mark.parametrize("name", CASES)
def test_without_the_row_a_case_fails(name: str) -> None:
    """A safety row that no test misses is no safety row."""
    without = tuple(row for row in TABLE if row.name != name)
    assert not CASES[name].holds(without)


def test_what_was_locked_while_it_landed_has_not_perched() -> None:
    """It hangs, but nobody has seen whether it hangs on the target: its outcome is that of what led
    to the landing."""
    state = remembering(
        state_in(P.LANDING, BEGIN_S, CONTACT_Z_M), motor_stop_commanded_at_s=BEGIN_S - 1.0,
        vehicle_world_z_at_last_contact_m=CONTACT_Z_M, outcome=O.ENDED_BY_OPERATOR,
    )  # fmt: skip
    locked = at(CONTACT_Z_M, thrust=0.0, supervisor=READY | LOCKED)(BEGIN_S + TICK_S)
    state, _ = planner.step_mission(state, locked, PROFILE)
    assert (state.phase, state.transition_name, state.outcome) == (
        P.PERCHED,
        "hung-but-locked",
        O.ENDED_BY_OPERATOR,
    )


def test_what_kept_a_vehicle_from_being_steady_is_named() -> None:
    """No cause is: a wind, a weak motor and a wrong gain look alike from here."""
    sample = at(velocity_mps=(0.3, 0.0, 0.0))(BEGIN_S)
    x_m, y_m, z_m = sample.telemetry.position_m
    state = remembering(
        state_in(P.RECOVER), entered_s=0.0, setpoint=PositionSetpoint(x_m + 0.31, y_m, z_m, 0.0)
    )
    context = context_at(state, sample, PROFILE)
    row = find_first_matching_transition(context, TABLE)
    assert row is not None
    text = row.reason_text(context)
    assert text.startswith("not steady 6 s after the attempt: moving at 0.30 m/s, 0.31 m")
    hangs = context_at(remembering(state, vehicle_world_z_at_last_contact_m=z_m), sample, PROFILE)
    assert row.reason_text(hangs).endswith("still at its contact")


# --- severity ------------------------------------------------------------------------------

ROGUE = Transition(
    "rogue", PRE_LANDING_PHASES | {P.LANDING}, lambda c: True, P.SEARCH, "take off again"
)


def test_no_row_undoes_a_landing() -> None:
    """Whatever a table says: from a landing nothing leads back into the flight."""
    landing = remembering(state_in(P.LANDING), severity=Severity.LAND, stop_or_land_command_count=1)
    context = context_at(landing, observation(BEGIN_S), PROFILE)
    assert find_first_matching_transition(context, (ROGUE,)) is None
    flying = context_at(state_in(P.ALIGN), observation(BEGIN_S), PROFILE)
    assert find_first_matching_transition(flying, (ROGUE,)) is ROGUE


# --- Your own rows ------------------------------------------------


MINE = Transition("mine", {P.ALIGN}, lambda c: True, P.LANDING, "enough", Severity.LAND)


def test_a_row_of_your_own_comes_after_every_safety_row() -> None:
    back = Transition("back", {P.PERCH}, bool, P.RECOVER, "", Severity.BACK_OFF)
    table = add_rows([MINE, back])
    at = table.index(next(row for row in table if row.name == "mine"))
    names = [row.name for row in table[at - 1 : at + 3]]
    assert names == ["too-weak", "mine", "back", "approached"]
    assert tuple(row for row in table if row.name not in ("mine", "back")) == TABLE
    assert table[at].outcome is Outcome.SAFETY
    stopped = replace(observation(BEGIN_S), operator_request=OperatorRequest.LAND)
    for obs, name in ((observation(BEGIN_S), "mine"), (stopped, "operator-land")):
        row = find_first_matching_transition(context_at(state_in(P.ALIGN), obs, PROFILE), table)
        assert row is not None
        assert row.name == name


def test_the_phases_of_a_row_cannot_grow_in_flight() -> None:
    phases = {P.ALIGN}
    table = add_rows([replace(MINE, phases=phases)])
    phases.add(P.COMPLETE)
    assert next(row for row in table if row.name == "mine").phases == {P.ALIGN}


def test_no_row_of_your_own_may_climb_stop_or_prove() -> None:
    assert {to for _, to, _ in TRANSITIONS_ALLOWED_FOR_USER_ROWS} == {
        P.SEARCH,
        P.ALIGN,
        P.RECOVER,
        P.LANDING,
    }
    assert all(how >= Severity.HOLD for *_, how in TRANSITIONS_ALLOWED_FOR_USER_ROWS)
    assert [at for at, to, _ in TRANSITIONS_ALLOWED_FOR_USER_ROWS if at is to] == [
        P.ALIGN
    ]  # where it waits
    assert {at for at, _, _ in TRANSITIONS_ALLOWED_FOR_USER_ROWS} == PRE_LANDING_PHASES - {
        P.COMPLETE
    }


@pytest.mark.parametrize("change", [
    {"to": P.PERCH}, {"to": P.ASCEND}, {"to": P.PERCHED}, {"to": P.ABORTED}, {"to": P.SEARCH},
    {"severity": Severity.CONTINUE}, {"severity": Severity.STOP}, {"phases": {P.COMPLETE}},
    {"phases": {P.LANDING}}, {"stop_command": StopMotors()}, {"outcome": Outcome.PERCHED},
    {"outcome": Outcome.ENDED_BY_OPERATOR}, {"phases": set()}, {"phases": iter([P.ALIGN])},
    {"reason": None},
    {"name": "fence"}, {"phases": {"ALIGN"}}, {"phases": P.ALIGN}, {"to": "LANDING"},
    {"severity": 3}, {"when": True},
])  # fmt: skip
def test_a_row_of_your_own_that_may_do_more_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InvalidValue, match=r"row '(mine|fence)'"):
        add_rows([replace(MINE, **change)])


def test_two_rows_of_your_own_have_two_names() -> None:
    for rows in ([MINE, MINE], 3, ["mine"]):
        with pytest.raises(InvalidValue, match="row"):
            add_rows(rows)  # type: ignore[arg-type]


WAIT = Transition("wait", {P.ALIGN}, lambda c: c.t_s < 50.0, P.ALIGN, "mine", Severity.HOLD)


def test_a_row_of_your_own_waits_in_the_alignment() -> None:
    """It stays aligned and does not go on, the wait does not count, and other rows still act."""
    table = add_rows([WAIT])
    state = waiting = remembering(state_in(P.ALIGN), condition_start_times_s={ALIGNED: 10.0})
    for t_s in range(11, 50):
        waiting, command = planner.step_mission(waiting, observation(t_s), PROFILE, table)
    assert (waiting.phase, waiting.pause_reason, waiting.hold_reason) == (P.ALIGN, "mine", "")
    assert isinstance(command, PositionSetpoint)
    assert waiting.total_wait_in_phase_s == 39.0 > PROFILE.planner.align.timeout_s
    after, _ = planner.step_mission(waiting, observation(50.0), PROFILE, table)
    assert (after.phase, after.pause_reason) == (P.ALIGN, "")  # it has yet to stay aligned
    for tick in range(1, 25):
        after, _ = planner.step_mission(after, observation(50.0 + TICK_S * tick), PROFILE, table)
    assert (after.phase, after.pause_reason, after.total_wait_in_phase_s) == (P.ASCEND, "", 0.0)
    lost = observation(11.0, target=None)
    assert planner.step_mission(state, lost, PROFILE, table)[0].phase is P.SEARCH
    stopped = observation(11.0, operator_request=OperatorRequest.LAND)
    assert planner.step_mission(state, stopped, PROFILE, table)[0].phase is P.LANDING


def test_a_profile_names_rows_or_a_function_that_makes_them_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module: Any = ModuleType("my_rows")
    called: list[int] = []
    module.ROWS, module.make, module.fails = [MINE], lambda: [MINE], lambda: 1 / 0
    module.other = partial(called.append, 1)  # as a log's profile might name anything
    monkeypatch.setitem(sys.modules, "my_rows", module)
    for name in ("ROWS", "make"):
        assert [row.name for row in load_table(f"my_rows:{name}") if row.name == "mine"] == ["mine"]
    for name, words in (("fails", "ZeroDivisionError"), ("other", "must be"), ("none", "no none")):
        with pytest.raises(PerchError, match=words):
            load_table(f"my_rows:{name}")
    assert called == []


@pytest.mark.parametrize("change", [
    {"when": lambda c: 1 / 0}, {"when": lambda c: True, "reason": lambda c: 1 / 0},
])  # fmt: skip
def test_an_error_of_a_row_of_your_own_names_the_row(change: dict[str, Any]) -> None:
    table = add_rows([replace(MINE, **change)])
    with pytest.raises(InvalidValue, match="your own row 'mine' raised ZeroDivisionError"):
        planner.step_mission(state_in(P.ALIGN), observation(BEGIN_S), PROFILE, table)


@pytest.mark.parametrize("distance_below_m", [0.1, 0.0])
def test_a_press_off_the_target_is_given_up_before_its_time(distance_below_m: float) -> None:
    """No contact can be proven there; at the target's height one is."""
    z_m = CONTACT_Z_M - distance_below_m
    press = {"setpoint": PositionSetpoint(0.0, 0.0, z_m + 0.15, 0.0)}
    case = Case(P.PERCH, P.RECOVER, at(z_m, thrust=PRESSED), 1.5, state=press, z_m=z_m)
    assert case.holds() is (distance_below_m > 0.0)
