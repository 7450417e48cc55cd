"""What several rows of the mission's table ask, each with a name."""

from __future__ import annotations

import math

from perchctl.mission import budget
from perchctl.mission.conditions import (
    SATURATED,
    contact_aside_m,
    contact_within_m,
    is_at_target,
    press_thrust,
    touched_aside_m,
)
from perchctl.mission.context import HANGING_S, Context
from perchctl.mission.imu import PUSHED_S
from perchctl.mission.mounting import explained
from perchctl.mission.state import Condition, Phase
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint

CATCHABLE_M = 1.0
"""Hanging lower, a slip from still motors reaches the floor (docs/firmware.md, "Catching a
slip": up to 0.8 m at 42 g)."""
FALLING_MPS = -0.05
LIFTED_M, SIDEWAYS_M = 0.05, 0.12
LOW_M, ASTRAY_LOW_M, ASTRAY_LANDING_M, ASTRAY_M = 0.3, 0.22, 0.4, 0.8
"""As long as nothing but a climb was ordered, a vehicle stays within a few centimetres of its
place (7 cm in simulated flights); later a setpoint is walked ahead of it, and a blow may carry it
half a metre, as does a gust. A landing goes straight down."""
ABOVE_START_M = 0.1
OTHERWISE_S = 0.1
ONLY_UP = frozenset({Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE})
WALKED = frozenset({Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND})
SWINGS_MPS = 0.5
"""Nothing sinks so fast where it hovers or walks up by itself: position control swings it."""
BELOW_S = 0.3
WEAK_S = 2.0
BLIND_PRESS_S = 1.25
UNSTOPPED_S = 10.0
HELD_S = 2.0
"""By then a hold at the magnet has been told from any other."""


def left_jump_hold(c: Context) -> bool:
    jump = c.state.jump_s
    return jump is not None and c.obs.t_s - jump >= c.profile.safety.jump_hold_s


def fence_broken(c: Context) -> bool:
    if c.state.ground_m is None:
        return False
    x, y, _ = c.obs.telemetry.position_m
    dx, dy = x - c.state.ground_m[0], y - c.state.ground_m[1]
    return math.hypot(dx, dy) > c.profile.safety.fence_radius_m


def searched_out(c: Context) -> bool:
    return c.state.searches >= c.profile.planner.search.attempts


def attempts_used(c: Context) -> bool:
    return c.state.attempts >= c.profile.planner.attempts


def is_aligned(c: Context) -> bool:
    return c.held(Condition.ALIGNED) >= c.profile.planner.align.dwell_s


def has_recovered(c: Context) -> bool:
    dwell_s = c.profile.planner.recover.dwell_s
    steady = c.held(Condition.STEADY) >= dwell_s and c.in_phase_s >= dwell_s
    return steady and c.state.contact_z_m is None


def too_little_left(c: Context) -> bool:
    """An attempt would begin, or begin anew, and the battery has not enough for it."""
    begins = is_aligned(c) if c.state.phase is Phase.ALIGN else has_recovered(c)
    return begins and not attempts_used(c) and budget.short_of_charge(c)


def presses_too_long(c: Context) -> bool:
    """No contact is proven in time, or would be by the next turn of a loop as late as this one."""
    return c.in_phase_s + c.obs.loop_late_s > c.profile.planner.perch.timeout_s


def is_blocked(c: Context) -> bool:
    return c.held(Condition.BLOCKED) >= c.profile.safety.blocked_s


def is_blocked_off_target(c: Context) -> bool:
    """Pressed, and in the press so far from the target's height that no contact can be proven."""
    pressing = c.state.phase is Phase.PERCH
    return is_blocked(c) and not (pressing and abs(c.error_z_m) <= contact_within_m(c))


def too_weak(c: Context) -> bool:
    """No thrust is left to press with: seen at full thrust, or known before the press. What is
    backing off from a press has it from that."""
    if c.state.pressed:
        return False
    if c.held(Condition.SATURATED) >= WEAK_S:
        return True
    near = c.state.phase is Phase.ASCEND and c.held(Condition.NEAR_STANDOFF) >= 0.0
    return near and c.state.hover_thrust > SATURATED * press_thrust(c.profile)


def _swings(c: Context) -> bool:
    """Up and down, by a motion capture that is late: soon sideways, too, with a wrong attitude."""
    by_capture = c.profile.positioning.by == "mocap"
    return by_capture and c.state.phase in WALKED and c.climb_mps < -SWINGS_MPS


def is_astray(c: Context) -> bool:
    """Position control leads away from its setpoint: at take-off sideways, where only a climb was
    ordered, and later farther off than any draught carries it. On a way down that began for another
    reason it is looked for too: there it would speed up until it tilts over.

    Positions from outside in other axes than the vehicle's do that: those that a vehicle at rest
    does not tell from true ones (fault 11)."""
    setpoint = c.state.setpoint
    if c.profile.positioning.by == "deck" or not c.placed:
        return False
    if c.held(Condition.OTHERWISE) >= OTHERWISE_S or _swings(c):
        return True
    if setpoint is None:
        return False
    touched = c.state.contact_z_m is not None or c.state.stopped_s is not None
    if c.state.phase is Phase.LANDING and touched:
        return False
    x_m, y_m, _ = c.obs.telemetry.position_m
    away_m = math.hypot(x_m - setpoint.x_m, y_m - setpoint.y_m)
    if c.state.phase is Phase.APPROACH and c.height_m < LIFTED_M:
        return away_m > SIDEWAYS_M
    if c.state.phase is Phase.LANDING:
        return away_m > ASTRAY_LANDING_M
    stays = c.height_m < LOW_M or (_only_climbs(c) and not _is_pushed(c))
    return away_m > (ASTRAY_LOW_M if stays else ASTRAY_M)


def _is_pushed(c: Context) -> bool:
    """By moving air, which leads a vehicle as far off as wrong positions do, and is felt."""
    return c.obs.imu.t_s - c.obs.imu.pushed_s <= PUSHED_S


def _only_climbs(c: Context) -> bool:
    """Its setpoint is still above the place of its take-off, and is not walked."""
    setpoint, ground = c.state.setpoint, c.state.ground_m
    if setpoint is None or ground is None or c.state.phase not in ONLY_UP:
        return False
    return math.hypot(setpoint.x_m - ground[0], setpoint.y_m - ground[1]) < ABOVE_START_M


def stopped_for_s(c: Context) -> float:
    return -1.0 if c.state.stopped_s is None else c.obs.t_s - c.state.stopped_s


def is_watched(c: Context) -> bool:
    """The motors have been off for as long as a perched vehicle is watched."""
    watched = stopped_for_s(c) >= c.profile.planner.complete.watch_s
    return watched and c.held(Condition.DOWN) >= 0.1


def still_turns(c: Context) -> bool:
    """The motors were stopped, and are not seen to have, for longer than a supervisor's word that
    stands still is waited for."""
    return stopped_for_s(c) > c.profile.planner.complete.watch_s + UNSTOPPED_S


def settling_too_long(c: Context) -> bool:
    ascend = c.profile.planner.ascend
    return c.held(Condition.NEAR_STANDOFF) > ascend.settle_timeout_s


def has_slipped(c: Context) -> bool:
    """Debounced; in free fall at once, since each 10 ms cost what full thrust takes 80 ms to
    give back."""
    tel, complete = c.obs.telemetry, c.profile.planner.complete
    falls = c.state.released_s is not None and tel.acc_z_g < complete.slip_acc_g
    if falls and c.imu_proves and c.climb_mps < FALLING_MPS:
        return True
    return c.held(Condition.SLIPPING) >= complete.slip_dwell_s


def unsure(c: Context) -> str:
    limit_m2 = c.profile.safety.flight_variance_m2
    return f"the position's variance is {c.variance_m2:.2g} m^2, at most {limit_m2:g} allowed"


def is_beside_magnet(c: Context) -> bool:
    """Contact, but farther aside than the magnet reaches, or so far that nobody knows."""
    if c.held(Condition.CONTACT) < c.profile.planner.perch.contact_dwell_s:
        return False
    aside_m, sigma_m = contact_aside_m(c)
    return not aside_m + sigma_m <= c.profile.planner.perch.contact_xy_m


def is_caught(c: Context) -> bool:
    """The target's magnet holds it already: it hangs at the target, or where it met the target's
    height, as far as its place there was known to within the magnet's radius."""
    if c.held(Condition.HANGING) < HANGING_S:
        return False
    touched = touched_aside_m(c)
    radius_m = c.profile.planner.perch.contact_xy_m
    return is_at_target(c) or (touched is not None and max(touched) <= radius_m)


def is_held(c: Context) -> bool:
    """Something holds it: the magnet, a hand, a net, another ceiling."""
    return c.held(Condition.HANGING) >= HELD_S


def is_held_elsewhere(c: Context) -> bool:
    """Something else than the target's magnet holds it: it hangs at another height than the
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


def why_beside_magnet(c: Context) -> str:
    aside_m, sigma_m = contact_aside_m(c)
    if not math.isfinite(sigma_m):
        return "contact, but how far aside of the target is not known"
    return f"contact {1e3 * aside_m:.0f} +- {1e3 * sigma_m:.0f} mm aside of the target"


def pressed_blindly(c: Context) -> bool:
    """The last centimetres are flown without a sight of the target; where it is the positioning
    system, by dead reckoning, and no longer than that may lead aside by millimetres."""
    return c.by_sight and c.position_age_s > BLIND_PRESS_S


def mounted_wrong(c: Context) -> bool:
    """The target moves with the vehicle, or seems to lie below it."""
    return (
        c.state.mount.wrong or _felt_turn_rad(c) != 0.0 or c.held(Condition.TARGET_BELOW) >= BELOW_S
    )


def _felt_turn_rad(c: Context) -> float:
    return 0.0 if c.obs.mismatch is None else c.obs.mismatch.turn_rad


def latency_changed(c: Context) -> bool:
    """The pictures show the vehicle's motion, but later or earlier than they are taken to."""
    return c.obs.mismatch is not None and c.obs.mismatch.later_s != 0.0


def why_latency(c: Context) -> str:
    taken_s = c.profile.camera.start_latency_s + c.obs.delay_s
    found_s = taken_s + (0.0 if c.obs.mismatch is None else c.obs.mismatch.later_s)
    return (
        f"the pictures are {1e3 * found_s:.0f} ms old, not {1e3 * taken_s:.0f} as "
        f"camera.latency_s has it: find what delays them"
    )


def why_contact(c: Context) -> str:
    aside_m, sigma_m = contact_aside_m(c)
    by = "position, acceleration and thrust"
    if not c.placed:
        by = f"acceleration and thrust, {unplaced_text(c)}"
    text = f"contact proven by {by}; {1e3 * aside_m:.1f} +- {1e3 * sigma_m:.1f} mm off centre"
    if c.height_m >= CATCHABLE_M:
        return text
    return f"{text}; at {c.height_m:.1f} m, too low for a slip to be caught"


def why_mounted_wrong(c: Context) -> str:
    if turn_rad := _felt_turn_rad(c):
        return explained(turn_rad)
    if c.state.mount.wrong and c.profile.positioning.by == "mocap":
        return f"{explained(c.state.mount.turn_rad)}; or swapped axes in the motion capture"
    if c.state.mount.wrong:
        return explained(c.state.mount.turn_rad)
    return (
        f"the target seems to lie {-c.error_z_m:.1f} m below the vehicle: camera.mount does not "
        f"look up"
    )


def why_pressed_blindly(c: Context) -> str:
    return f"no contact {c.position_age_s:.1f} s after the last sight of the target"


def why_unplaced(c: Context) -> str:
    return f"{unplaced_text(c)}; down level, by thrust alone"


def why_astray(c: Context) -> str:
    x_m, y_m, _ = c.obs.telemetry.position_m
    setpoint = c.state.setpoint
    away_m = 0.0 if setpoint is None else math.hypot(x_m - setpoint.x_m, y_m - setpoint.y_m)
    if c.by_sight:
        return (
            f"the position goes {away_m:.2f} m aside at a height of {c.height_m:.2f} m: does "
            f"camera.mount have the camera turned as it is?"
        )
    if _swings(c):
        return (
            f"it swings up and down, now at {-c.climb_mps:.1f} m/s: are the positions of the "
            f"motion capture late?"
        )
    what = f"the position goes {away_m:.2f} m aside"
    if c.held(Condition.OTHERWISE) >= 0.0:
        what = "the position moves otherwise than the accelerometer feels"
    return (
        f"{what} at a height of {c.height_m:.2f} m: swapped axes "
        f"in the motion capture, or a body that is turned in it; perchctl check --lift tells"
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


# --- Why a vehicle is held in place: what is not known in this tick, and may be in the next ----


NO_PICTURE_TEXT = "no picture for"
UNCORRECTED = "the estimate's variance only grows; is the positioning system gone?"
BLIND_VARIANCE_M2 = 0.02
"""Passed about 3 s after the last sight (docs/firmware.md, "Target as position")."""
SINK_MPS, LOWEST_M = 0.2, 0.3


def hold_reason(c: Context) -> str:
    """Why the vehicle must stay where it is in this tick, or the empty string."""
    safety = c.profile.safety
    # A take-off goes on, on what is known; without a position nothing is.
    if c.state.phase in _HOLDABLE | {Phase.APPROACH} and is_unplaced(c):
        return unplaced_text(c)
    if c.state.phase not in _HOLDABLE:
        return ""
    if c.telemetry_age_s > safety.telemetry_hold_s:
        return f"telemetry is {c.telemetry_age_s:.1f} s old"
    if c.state.jump_s is not None:
        return "the state estimate jumped"
    if c.variance_m2 > safety.flight_variance_m2:
        return f"the state estimate is unsure (variance {c.variance_m2:.2g} m^2)"
    if c.obs.loop_late_s > safety.loop_late_hold_s:
        return f"the control loop is {c.obs.loop_late_s:.1f} s late"
    if c.state.phase in _CAMERA_PHASES and c.obs.camera_age_s > safety.camera_hold_s:
        return c.obs.camera_problem or f"{NO_PICTURE_TEXT} {c.obs.camera_age_s:.1f} s"
    return ""


def is_unplaced(c: Context) -> bool:
    """No position from outside is fresh (fault 10)."""
    return c.position_age_s > c.profile.positioning.hold_s


def is_lost(c: Context) -> bool:
    """No position has come for so long that none is waited for any more: by the age of the last
    one, and of the target's, whose loss leaves nothing but the gyroscope, by the estimate's own
    variance too."""
    if c.position_age_s > c.profile.positioning.land_s or c.is_blown:
        return True
    return c.by_sight and is_unplaced(c) and c.variance_m2 > BLIND_VARIANCE_M2


def sinking(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The held setpoint, a tick later: without a sight of the target it sinks, since the camera's
    cone opens upwards, and from lower down the target is soonest seen again."""
    if not (c.by_sight and is_unplaced(c)) or c.state.ground_m is None:
        return setpoint
    lowest_m = min(setpoint.z_m, c.state.ground_m[2] + LOWEST_M)
    z_m = setpoint.z_m - SINK_MPS * max(0.0, c.obs.t_s - c.state.t_s)
    return replace(setpoint, z_m=max(lowest_m, z_m))


def unplaced_text(c: Context) -> str:
    """For how long none was sent, and why."""
    if c.is_blown:
        return "pushed aside while the target was not seen"
    age_s, why = c.position_age_s, c.obs.position_problem
    if c.profile.positioning.by == "deck":
        why = why or UNCORRECTED
    text = f"no position for {age_s:.1f} s" if math.isfinite(age_s) else "no position has come"
    return f"{text}: {why}" if why else text


_CAMERA_PHASES = frozenset({Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND})
_HOLDABLE = _CAMERA_PHASES | {Phase.RECOVER}
