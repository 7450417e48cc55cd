"""LANDING: fly the descent (`perchctl.mission.descent`) until the vehicle rests with motors off."""

from __future__ import annotations

from perchctl.mission.belief.contact import MOTORS_OFF_AS_COMMANDED, MOTORS_OFF_DWELL_S
from perchctl.mission.belief.reckoning import correct_acceleration_bias_for_wrong_positions
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.descent import DESCENT_MANEUVER, act_in_landing, enter_descent
from perchctl.mission.phase import Outcome, Phase, VehicleDiagnosis
from perchctl.mission.rest import RestState, find_rest_state
from perchctl.mission.state import PlannerState
from perchctl.mission.transition import Predicate, Transition, abort_during_landing_row
from perchctl.values import replace
from perchctl.vehicle import FLYING, FRESH_S

REST_STATE_TIMEOUT_AFTER_MOTORS_OFF_S = 2.0
"""Time after the motors stop during which a picture may still show that the target is far above the
vehicle, s."""


def enter_landing(state: PlannerState, previous_context: Context) -> PlannerState:
    """Return the state with which the landing begins. `previous_context` is the context before the
    transition, in the same tick. `state.entry.diagnosis` holds what the transition asserts about
    the vehicle:

    - The external positions are wrong: the descent does not use positions.
    - The camera's mounting is wrong: the setpoint is deleted, since it may lead the vehicle in the
      wrong direction. If, in a flight by motion capture, the target moved with the vehicle, the
      axes of the positions may be wrong instead, so the descent does not use positions either.
    - The vehicle is hanging at its last touch: the recorded distance between gear and target at
      that touch is kept. Otherwise, it is deleted if the previous phase was RECOVER.
    """
    diagnosis, b = state.entry.diagnosis, state.belief
    # The mounting may be right and the axes of the motion capture wrong. Position control would
    # then accelerate the landing until the vehicle tips over.
    capture = (
        b.profile.positioning.source.is_mocap and b.camera_mounting_monitor.is_camera_mounting_wrong
    )
    if VehicleDiagnosis.EXTERNAL_POSITIONS_WRONG in diagnosis or (
        VehicleDiagnosis.CAMERA_MOUNTING_WRONG in diagnosis and capture
    ):
        dead_reckoning = (
            b.dead_reckoning
            if b.is_position_diverged
            else correct_acceleration_bias_for_wrong_positions(b.dead_reckoning)
        )
        b = replace(b, is_position_diverged=True, dead_reckoning=dead_reckoning)
    if (
        previous_context.state.phase is Phase.RECOVER
        and VehicleDiagnosis.HANGING_AT_LAST_TOUCH not in diagnosis
    ):
        # no evidence of a support at that position
        b = replace(b, gear_to_target_at_last_contact=None)
    # With a wrong mounting, the setpoint leads the vehicle in the wrong direction.
    setpoint = None if VehicleDiagnosis.CAMERA_MOUNTING_WRONG in diagnosis else state.setpoint
    return enter_descent(replace(state, belief=b, setpoint=setpoint), previous_context.state)


def make_rest_state_predicate(rest_state: RestState) -> Predicate:
    """Return a predicate that is true once the motors have been off for `MOTORS_OFF_DWELL_S` and
    the vehicle is in the rest state `rest_state`."""
    return lambda c: (
        c.true_for_s(MOTORS_OFF_AS_COMMANDED) >= MOTORS_OFF_DWELL_S
        and find_rest_state(c) is rest_state
    )


def unconfirmed_landing_reason(c: Context) -> str:
    """Return a message that says that the landing was not confirmed in time, and why: the telemetry
    is too old, still shows the vehicle flying, or does not yet show it at rest. It is the reason to
    end the flight once `landing.timeout_s` has passed."""
    age_s, proof_age_s = c.belief.attitude_age_s, c.safety.proof_age_s
    if age_s > FRESH_S:
        cause = f"the newest telemetry is {age_s:.1f} s old"
    elif c.telemetry.has_bit(FLYING) or c.telemetry.thrust >= 1:
        cause = "telemetry still shows the vehicle flying"
    elif age_s > proof_age_s:
        cause = (
            f"the newest telemetry is {age_s:.2f} s old, too old to confirm a landing (at most "
            f"{proof_age_s:g} s)"
        )
    else:
        cause = "telemetry does not yet show the vehicle at rest"
    return f"the landing was not confirmed in time: {cause}"


def _outcome_if_landing_ends_hanging(previous_outcome: Outcome | None) -> Outcome | None:
    """Return the outcome of a flight whose landing ends with the vehicle hanging on the magnet.
    TARGET_NOT_FOUND becomes ATTEMPTS_USED_UP, since the vehicle is hanging on a target; HOVERED
    becomes SAFETY, since a hover must not end on the magnet; any other outcome, or None, is
    kept."""
    if previous_outcome is Outcome.HOVERED:
        return Outcome.SAFETY
    return (
        Outcome.ATTEMPTS_USED_UP
        if previous_outcome is Outcome.TARGET_NOT_FOUND
        else previous_outcome
    )


LANDING = PhaseDefinition(
    phase=Phase.LANDING,
    maneuver=DESCENT_MANEUVER,
    enter=enter_landing,
    act=act_in_landing,
    exits=(
        Transition(
            "hung",
            {Phase.LANDING},
            make_rest_state_predicate(RestState.HANGS),
            Phase.PERCHED,
            "hanging with the motors off",
            outcome=_outcome_if_landing_ends_hanging,
        ),
        Transition(
            "landed",
            {Phase.LANDING},
            make_rest_state_predicate(RestState.STANDS),
            Phase.LANDED,
            lambda c: (
                "motors off"
                + (
                    ""
                    if c.belief.dead_reckoning_began_at_s is None
                    else "; the height was dead-reckoned during the descent"
                )
            ),
        ),
        abort_during_landing_row(
            "held-elsewhere",
            make_rest_state_predicate(RestState.HELD),
            "motors off; something holds the vehicle in place, away from the target: look before "
            "you touch it",
        ),
        abort_during_landing_row(
            "hangs-or-stands",
            lambda c: (
                c.true_for_s(MOTORS_OFF_AS_COMMANDED) >= REST_STATE_TIMEOUT_AFTER_MOTORS_OFF_S
            ),
            "motors off; no telemetry arrived for so long that a fall may have gone unnoticed, so "
            "it is unknown whether the vehicle is hanging or on the floor: look before you touch "
            "it",
        ),
        abort_during_landing_row(
            "landing-timeout",
            lambda c: c.time_in_phase_s > c.planner.landing.timeout_s,
            unconfirmed_landing_reason,
            diagnosis=VehicleDiagnosis.LANDING_UNCONFIRMED,
        ),
    ),
)
