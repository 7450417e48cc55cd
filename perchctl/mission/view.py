"""One tick seen by the planner: state, observation and profile, and what follows from them.

`View` answers the questions that the transition table and the actions ask. The
named conditions are debounced by `PlannerState.since`: `held(name)` says for how
long a condition has been true without a break.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from perchctl.geometry import Array, rot_z, rotation_from_rpy, wrap_rad
from perchctl.mission.state import Observation, Phase, PlannerState
from perchctl.mission.types import FLYING, HL_ACTIVE, HL_FINISHED
from perchctl.profile import Profile

HANGING_S = 1.0
"""For how long a thrust below the weight must be enough before it proves the magnet."""
LOW_POWER = 3  # pm.state
NO_BATTERY_READING_V = 1.0
"""Below this nothing is measured: the battery is unknown, not empty (fault 7)."""


@dataclass(frozen=True, eq=False)
class View:
    state: PlannerState
    obs: Observation
    profile: Profile

    @property
    def in_phase_s(self) -> float:
        return self.obs.t_s - self.state.entered_s

    def held(self, condition: str) -> float:
        """Seconds for which the condition has been true; -1 when it is not."""
        since = self.state.since.get(condition)
        return -1.0 if since is None else self.obs.t_s - since

    # --- the vehicle -----------------------------------------------------

    @cached_property
    def position_m(self) -> Array:
        return np.array(self.obs.telemetry.position_m)

    @cached_property
    def speed_mps(self) -> float:
        return math.sqrt(sum(v * v for v in self.obs.telemetry.velocity_mps))

    @cached_property
    def gear_world_m(self) -> Array:
        tel = self.obs.telemetry
        R = rotation_from_rpy(tel.roll_rad, tel.pitch_rad, tel.yaw_rad)
        return self.position_m + R @ np.array(self.profile.vehicle.gear_body_m)

    @property
    def height_m(self) -> float:
        """Above the ground the flight started from, in the estimate's world."""
        ground = self.state.ground_m
        return self.obs.telemetry.position_m[2] - (ground[2] if ground else 0.0)

    @property
    def telemetry_age_s(self) -> float:
        return self.obs.t_s - self.obs.telemetry.t_s

    @property
    def flying(self) -> bool:
        return self.obs.telemetry.has(FLYING)

    @property
    def high_level_active(self) -> bool:
        return self.obs.telemetry.has(HL_ACTIVE)

    @property
    def high_level_finished(self) -> bool:
        return self.obs.telemetry.has(HL_FINISHED)

    @property
    def tilt_rad(self) -> float:
        tel = self.obs.telemetry
        return math.acos(max(-1.0, min(1.0, math.cos(tel.roll_rad) * math.cos(tel.pitch_rad))))

    @property
    def battery_is_low(self) -> bool:
        tel = self.obs.telemetry
        known = tel.battery_v >= NO_BATTERY_READING_V
        return tel.battery_state == LOW_POWER or (
            known and tel.battery_v < self.profile.safety.min_load_v
        )

    # --- the target ------------------------------------------------------

    @cached_property
    def target_world_m(self) -> Array | None:
        anchor = self.state.anchor
        return None if anchor is None else anchor.at(self.obs.t_s)

    @cached_property
    def error_m(self) -> Array | None:
        """(e_x, e_y, e_z) now: target relative to the gear, level frame, (3,)."""
        if self.target_world_m is None:
            return None
        R_world_level = rot_z(self.obs.telemetry.yaw_rad)
        return R_world_level.T @ (self.target_world_m - self.gear_world_m)

    @cached_property
    def error_xy_m(self) -> float:
        e = self.error_m
        return math.inf if e is None else math.hypot(e[0], e[1])

    @cached_property
    def error_z_m(self) -> float:
        e = self.error_m
        return math.inf if e is None else float(e[2])

    @cached_property
    def error_yaw_rad(self) -> float:
        anchor = self.state.anchor
        if anchor is None:
            return math.inf
        return wrap_rad(anchor.yaw_rad - self.obs.telemetry.yaw_rad)

    @property
    def target_age_s(self) -> float:
        """Since the exposure of the last frame in which the target was measured."""
        anchor = self.state.anchor
        return math.inf if anchor is None else self.obs.t_s - anchor.t_s

    @property
    def tracked(self) -> bool:
        """Seen, or coasting within the filter's n_max frames."""
        return self.obs.target is not None

    @property
    def fresh(self) -> bool:
        return self.tracked and self.target_age_s <= self._fresh_limit_s

    @property
    def small_is_fresh(self) -> bool:
        return self.obs.t_s - self.state.small_seen_s <= self._fresh_limit_s

    @property
    def _fresh_limit_s(self) -> float:
        # A frame is as old as the camera's latency when it arrives.
        return self.profile.planner.ascend.fresh_s + self.profile.camera.latency_s

    @property
    def contact_goal_z_m(self) -> float:
        """Height of the body at which the gear touches the target."""
        target = self.target_world_m
        if target is None:
            return math.inf
        return float(target[2]) - self.profile.vehicle.gear_body_m[2]

    @property
    def cone_m(self) -> float:
        ascend = self.profile.planner.ascend
        return ascend.cone_base_m + ascend.cone_slope * max(0.0, self.error_z_m)


def _aligned(v: View) -> bool:
    align = v.profile.planner.align
    return (
        v.fresh
        and v.error_xy_m <= align.xy_m
        and abs(v.error_yaw_rad) <= math.radians(align.yaw_deg)
    )


def _settled(v: View) -> bool:
    """Under the target at the stand-off, slow, and seen by the small marker (fault 33)."""
    ascend = v.profile.planner.ascend
    return (
        v.fresh
        and v.small_is_fresh
        and v.error_z_m <= ascend.standoff_m + ascend.settle_z_m
        and v.error_xy_m <= ascend.settle_xy_m
        and abs(v.error_yaw_rad) <= math.radians(ascend.settle_yaw_deg)
        and v.speed_mps <= ascend.settle_speed_mps
    )


def _near_standoff(v: View) -> bool:
    ascend = v.profile.planner.ascend
    return v.tracked and v.error_z_m <= ascend.standoff_m + ascend.settle_z_m


def _contact(v: View) -> bool:
    """Position, acceleration and thrust together (fault 40).

    The gear is where the target is and has stopped; the accelerometer reads the
    one g of a body at rest; yet the thrust is above what hovering takes, so the
    ceiling must be carrying the difference.
    """
    perch, tel = v.profile.planner.perch, v.obs.telemetry
    return (
        abs(v.error_z_m) <= perch.contact_z_m
        and abs(tel.velocity_mps[2]) <= perch.contact_speed_mps
        and abs(tel.acc_z_g - 1.0) <= perch.contact_acc_g
        and v.state.hover_thrust > 0
        and tel.thrust >= perch.contact_thrust_ratio * v.state.hover_thrust
    )


def _magnet_holds(v: View) -> bool:
    """The vehicle stays up on a thrust that could not carry it."""
    complete = v.profile.planner.complete
    return v.obs.telemetry.thrust <= complete.hold_ratio * v.state.hover_thrust and not _slipping(v)


def _slipping(v: View) -> bool:
    """Falling away from the proven contact, by position or by acceleration."""
    complete, tel = v.profile.planner.complete, v.obs.telemetry
    if v.state.contact_z_m is None:
        return False
    below = v.state.contact_z_m - tel.position_m[2] > complete.slip_m
    sinking = tel.velocity_mps[2] < -0.15
    return (below and sinking) or (sinking and tel.acc_z_g < complete.slip_acc_g)


def _hanging(v: View) -> bool:
    """Held up by the magnet, wherever the mission is: still, at the target's height, on
    a thrust that could not carry the vehicle."""
    tel, complete = v.obs.telemetry, v.profile.planner.complete
    return (
        v.state.hover_thrust > 0
        and tel.thrust <= complete.hold_ratio * v.state.hover_thrust
        and v.height_m > 0.3
        and v.state.anchor is not None
        and abs(v.error_z_m) <= 0.15
        and abs(tel.velocity_mps[2]) < 0.05
        and abs(tel.acc_z_g - 1.0) <= v.profile.planner.perch.contact_acc_g
    )


def _steady(v: View) -> bool:
    return v.speed_mps <= v.profile.planner.recover.steady_mps


def _at_takeoff_height(v: View) -> bool:
    return (
        v.height_m >= 0.8 * v.profile.planner.takeoff_height_m
        and v.speed_mps <= 0.25
        and v.state.setpoint is not None
    )


def _estimated(v: View) -> bool:
    return v.fresh and v.state.anchor_spread_m <= v.profile.planner.estimate.spread_m


def _tilted(v: View) -> bool:
    return v.tilt_rad > math.radians(v.profile.safety.max_tilt_deg)


def _down(v: View) -> bool:
    """Motors off by the telemetry, and the supervisor agrees that nothing flies."""
    return v.obs.telemetry.thrust < 1 and not v.flying


def _resting(v: View) -> bool:
    """On the floor, or hung up: not moving although a lower height is asked for."""
    tel = v.obs.telemetry
    return abs(tel.velocity_mps[2]) < 0.05 and abs(tel.acc_z_g - 1.0) < 0.1


CONDITIONS: dict[str, Callable[[View], bool]] = {
    "aligned": _aligned,
    "settled": _settled,
    "near_standoff": _near_standoff,
    "contact": _contact,
    "magnet_holds": _magnet_holds,
    "slipping": _slipping,
    "hanging": _hanging,
    "untracked": lambda v: not v.tracked,
    "steady": _steady,
    "at_takeoff_height": _at_takeoff_height,
    "estimated": _estimated,
    "tilted": _tilted,
    "down": _down,
    "resting": _resting,
    "battery_low": lambda v: v.battery_is_low,
    "high_level_idle": lambda v: not v.high_level_active,
}


def conditions_since(view: View) -> dict[str, float]:
    """`PlannerState.since` of this tick. A condition seen while the vehicle is held
    in place for a fault, or in stale telemetry, does not count."""
    old = view.state.since
    return {name: old.get(name, view.obs.t_s) for name, holds in CONDITIONS.items() if holds(view)}


def hold_reason(v: View) -> str:
    """Why the vehicle must stay where it is in this tick, or the empty string."""
    safety = v.profile.safety
    if v.state.phase not in _HOLDABLE:
        return ""
    if v.telemetry_age_s > safety.telemetry_hold_s:
        return f"telemetry is {v.telemetry_age_s:.1f} s old"
    if v.state.jump_s is not None:
        return "the state estimate jumped"
    if v.obs.loop_late_s > safety.loop_late_hold_s:
        return f"the control loop is {v.obs.loop_late_s:.1f} s late"
    if v.state.phase in _CAMERA_PHASES and v.obs.camera_age_s > safety.camera_hold_s:
        return v.obs.camera_problem or f"no picture for {v.obs.camera_age_s:.1f} s"
    return ""


_CAMERA_PHASES = frozenset({Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND})
_HOLDABLE = _CAMERA_PHASES | {Phase.RECOVER}
