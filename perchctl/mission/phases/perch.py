"""Phase 6, PERCH: press the gear against the target until a contact is proven.

ASCEND ends with the vehicle settled at the stand-off; PERCH has no entry action of its own. The
setpoint rises through the target, or raw thrust presses (`planner.perch` in the profile,
`PerchConfig`). Position, acceleration and thrust together prove a contact (`TARGET_CONTACT` in
`belief/contact.py`). A contact within the magnet's radius leads to COMPLETE. A contact outside it
leads to RECOVER. A push from the side, a press without contact and, with the target as the only
position source, a press that lasts too long without a new position also lead to RECOVER. Each of
these four cases is a failed attempt. The rows in `safety.py` come first, including those for a
magnet that catches early and for an obstacle. No hold applies in this phase because a hold would
leave the vehicle pressed (`hold_reason`).
"""

from __future__ import annotations

from perchctl.mission.belief.contact import TARGET_CONTACT, current_gear_to_target
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.belief.quality import LATERAL_SPEED_EXCEEDS_DRAUGHT, position_loss_text
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Phase
from perchctl.mission.setpoints import (
    Action,
    fly_to,
    make_setpoint_at_vehicle,
    make_setpoint_under_target,
    step_setpoint_towards,
)
from perchctl.mission.transition import Transition, back_off_row
from perchctl.vehicle import RawThrust

KNOCKED_ASIDE_DWELL_S = 0.04
"""Time for which the vehicle must move laterally faster than any draught can move it before the
attempt ends, s: more than one telemetry sample."""
MAX_PRESS_DURATION_WITHOUT_SIGHTING_S = 1.25
"""Longest press after the last sighting, s. The vehicle flies the last centimetres without the
target in view; with the target as the only position source, it flies them by dead reckoning.
Larger: the vehicle presses outside the magnet's radius. Smaller: a covered marker ends attempts
that would succeed."""


def act_in_perch(c: Context) -> Action:
    """Raise the setpoint to `perch.press_m` above the height at which the gear touches the target,
    while x, y and heading keep following the target.

    The integral of the lateral error is frozen, and the height is not corrected
    (`corrects_height=False`), because both would wind up against the ceiling. If the profile
    presses by raw thrust, command that thrust instead of a setpoint.
    """
    perch, target = c.planner.perch, c.belief.target
    if perch.mode == "raw":
        return c.state, RawThrust(perch.thrust)
    old = c.state.setpoint or make_setpoint_at_vehicle(c)
    if target.world_position_m is None:
        return fly_to(c, old, corrects_height=False)
    goal = make_setpoint_under_target(c, target.vehicle_world_z_when_touching_m + perch.press_m)
    setpoint = step_setpoint_towards(c, old, goal, max_up_mps=perch.climb_mps, max_down_mps=0.0)
    return fly_to(c, setpoint, corrects_height=False)


def is_contact_proven(c: Context) -> bool:
    """True if the evidence has shown for `perch.contact_dwell_s` without interruption that the gear
    is in contact with the target (condition `TARGET_CONTACT`)."""
    return c.true_for_s(TARGET_CONTACT) >= c.planner.perch.contact_dwell_s


def contact_evidence_text(c: Context) -> str:
    """Return a message for the moment at which the contact is proven (`is_contact_proven`, which is
    not checked again). It names the evidence (acceleration and thrust, and the position if that is
    valid) and the horizontal distance of the gear from the target's axis."""
    by = "position, acceleration and thrust"
    if not c.belief.is_position_valid:
        by = f"acceleration and thrust ({position_loss_text(c.belief)})"
    return f"contact proven by {by}; {current_gear_to_target(c.belief).text}"


PERCH = PhaseDefinition(
    phase=Phase.PERCH,
    maneuver=Maneuver(presses_against_target=True),
    act=act_in_perch,
    exits=(
        back_off_row(
            "beside-the-magnet",
            {Phase.PERCH},
            lambda c: (
                is_contact_proven(c)
                and not current_gear_to_target(c.belief).is_certainly_within(
                    c.planner.perch.contact_xy_m
                )
            ),
            lambda c: f"contact {current_gear_to_target(c.belief).text}",
        ),
        Transition(
            "contact", {Phase.PERCH}, is_contact_proven, Phase.COMPLETE, contact_evidence_text
        ),
        back_off_row(
            "pressed-blindly",
            {Phase.PERCH},
            lambda c: (
                c.belief.is_target_position_source
                and c.belief.position_correction_age_s > MAX_PRESS_DURATION_WITHOUT_SIGHTING_S
            ),
            lambda c: (
                f"no contact {c.belief.position_correction_age_s:.1f} s "
                "after the last sighting of the target"
            ),
        ),
        back_off_row(
            "knocked-aside",
            {Phase.PERCH},
            lambda c: c.true_for_s(LATERAL_SPEED_EXCEEDS_DRAUGHT) >= KNOCKED_ASIDE_DWELL_S,
            "pushed sideways under the target",
        ),
        back_off_row(
            # The delay of this tick counts towards the timeout because the next tick may be just as
            # late.
            "no-contact",
            {Phase.PERCH},
            lambda c: c.time_in_phase_s + c.obs.tick_start_delay_s > c.planner.perch.timeout_s,
            "contact not proven in time",
        ),
    ),
)
