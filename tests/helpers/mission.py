"""Building blocks for planner tests: telemetry, targets and a flight told by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from perchctl.mission import Event, EventKind, ImuMotion, Observation, Phase, PlannerState
from perchctl.mission.belief.battery import BatteryFitState
from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.thrust import HoverThrustEstimate
from perchctl.mission.context import Context
from perchctl.mission.observe import update_state_with_observation
from perchctl.mission.phase import Severity
from perchctl.mission.state import DescentState, HoverErrorAccumulator
from perchctl.mission.table import PHASE_TIMED_CONDITIONS, PHASES
from perchctl.profile import Profile
from perchctl.vehicle import ARMED, AUTO_ARM, CAN_FLY, FLYING, PositionSetpoint, Telemetry
from perchctl.vision import TargetEstimate
from perchctl.vision.types import VisibleMarkers

READY = AUTO_ARM | CAN_FLY | ARMED
AIRBORNE = READY | FLYING
HOVER_THRUST = 56000.0
CEILING_M = 2.2
FINE_BATTERY = BatteryFitState(
    takeoff_rest_v=4.1,
    rest_v=4.08,
    lagged_thrust_fraction=HOVER_THRUST / 65535,
    mean_airborne_thrust_fraction=HOVER_THRUST / 65535,
    time_under_load_s=5.0,
)
"""After some seconds of flight: enough for every attempt."""
PROFILE = Profile()
PROFILES = {by: Profile.model_validate({"positioning": by}) for by in ("deck", "mocap", "target")}
IN_CORRIDOR = PROFILE.with_(
    {
        "safety.corridor": {
            "home_m": (0.0, 0.0),
            "target_m": (0.0, 0.0),
            "radius_m": 0.4,
            "way_top_m": 1.6,
            "target_top_m": 3.0,
        }
    }
)
"""A vehicle of a fleet, right below its target."""
HOVERING = PROFILE.with_(
    {"planner.hover": {"below_m": 1.2 - PROFILE.vehicle.gear_body_m[2], "duration_s": 5.0}}
)
"""A mission that hovers with its body 1 m above the ground."""
MOCAP, BY_TARGET = PROFILES["mocap"], PROFILES["target"]
HANG_Z_M = CEILING_M - PROFILE.vehicle.gear_body_m[2]
"""Height of the body that hangs with its gear at the target."""


def telemetry(t_s: float, z_m: float = 1.0, **changes: object) -> Telemetry:
    sample = Telemetry(
        t_s=t_s,
        position_m=(0.0, 0.0, z_m),
        velocity_mps=(1e-9 * (round(t_s * 1000) % 7), 0.0, 0.0),  # alive
        roll_rad=1e-9 * (round(t_s * 1000) % 7),
        pitch_rad=0.0,
        yaw_rad=0.0,
        acc_x_g=1e-6 * (round(t_s * 1000) % 7),  # alive
        acc_z_g=1.0,
        thrust=HOVER_THRUST,
        battery_v=3.9 + 0.001 * (round(t_s * 100) % 7),
        supervisor=AIRBORNE,
        position_variance_m2=2e-5,
        height_variance_m2=1e-5,
        velocity_variance_m2ps2=1e-4,
        climb_variance_m2ps2=1e-4,
        motor_duty=(50_000, 49_500, 50_200, 50_300),
    )
    return replace(sample, **changes)  # type: ignore[arg-type]


def target_at(
    t_s: float,
    world_m: tuple[float, float, float] = (0.0, 0.0, CEILING_M),
    body_m: tuple[float, float, float] = (0.0, 0.0, 1.0),
    **changes: object,
) -> TargetEstimate:
    """The target as the pipeline estimates it from a level vehicle that looks along x."""
    gear_m = np.array(body_m) + PROFILE.vehicle.gear_body_m
    pose = TargetEstimate(
        t_s=t_s,
        last_measured_at_s=t_s,
        small_marker_last_measured_at_s=t_s,
        stage=VisibleMarkers.BOTH,
        is_measured_in_newest_frame=True,
        tracked=True,
        unseen_frames=0,
        e_m=np.array(world_m) - gear_m,
        e_yaw_rad=0.0,
        velocity_mps=np.zeros(3),
        sigma_m=np.full(3, 1e-3),
        sigma_yaw_rad=1e-3,
        world_m=np.array(world_m),
        world_yaw_rad=0.0,
        world_velocity_mps=np.zeros(3),
        measured_gear_to_target_world_m=np.array(world_m) - gear_m,
        measured_gear_to_target_sigma_m=1e-3,
    )
    return replace(pose, **changes)  # type: ignore[arg-type]


def observation(t_s: float, z_m: float = 1.0, **changes: object) -> Observation:
    tel = changes.pop("telemetry", None) or telemetry(t_s, z_m)
    obs = Observation(
        t_s=t_s,
        telemetry=tel,
        target=target_at(t_s, body_m=tel.position_m),
        has_new_frame=True,  # type: ignore[arg-type]
    )
    return replace(obs, **changes)  # type: ignore[arg-type]


def changed(changes: Mapping[str, Any], profile: Profile = PROFILE) -> Profile:
    """The profile with some keys changed, each named by its dotted path, without a check."""
    for dotted, value in changes.items():
        *sections, key = dotted.split(".")
        models: list[Any] = [profile]
        for name in sections:
            models.append(getattr(models[-1], name))
        new = models.pop().model_copy(update={key: value})
        for model, name in zip(reversed(models), reversed(sections), strict=True):
            new = model.model_copy(update={name: new})
        profile = new
    return profile


class Felt:
    """Adds to each observation what the accelerometer has told by then, as the loop does."""

    def __init__(self) -> None:
        self._motion = ImuMotion()
        self._last: Telemetry | None = None

    def __call__(self, obs: Observation) -> Observation:
        sample = obs.telemetry
        if self._last is None or sample.t_s > self._last.t_s:
            self._motion = self._motion.with_sample(self._last, sample)
            self._last = sample
        return replace(obs, imu=self._motion)

    def at_rest(self, until_s: float, acc_z_g: float = 1.0) -> Felt:
        """Has stood on the ground for two seconds before."""
        for i in range(200):
            t_s = until_s - 0.01 * (200 - i)
            rests = telemetry(t_s, 0.0, thrust=0.0, supervisor=READY, acc_z_g=acc_z_g)
            self(Observation(t_s, rests))
        return self


def entered(t_s: float, phase: Phase, reason: str) -> Event:
    return Event(t_s, EventKind.PHASE, reason, phase)


def held(t_s: float, reason: str) -> Event:
    return Event(t_s, EventKind.HOLD, reason, Phase.ALIGN, severity=Severity.HOLD)


def note(t_s: float, text: str) -> Event:
    return Event(t_s, EventKind.NOTE, text)


LEARNED_SIGMA = 0.005
"""Spread, as a share, of a hover thrust that quiet flight has taught."""
_BELIEF = {each.name for each in fields(Belief)} - {"t_s"}
_DESCENT = {each.name for each in fields(DescentState)}
_ENTRY = {
    "entered_s": "t_s",
    "entry_m": "vehicle_world_position_m",
    "entry_yaw_rad": "vehicle_world_yaw_rad",
    "row": "transition_name",
    "reason": "reason",
    "diagnosis": "diagnosis",
}
"""What a test calls it, and the field of the `PhaseEntry`."""


def remembering(state: PlannerState, **changes: Any) -> PlannerState:
    """The state with changes of its own fields, of its belief's and of its descent's, each by the
    field's name. Conditions, as `since`, go where they are counted."""
    condition_start_times_s = changes.pop("condition_start_times_s", None)
    if condition_start_times_s is not None:
        changes["condition_start_times_s"] = {
            each: s for each, s in condition_start_times_s.items() if each in PHASE_TIMED_CONDITIONS
        }
        held = {
            each: s
            for each, s in condition_start_times_s.items()
            if each not in PHASE_TIMED_CONDITIONS
        }
        state = replace(state, belief=replace(state.belief, condition_start_times_s=held))
    if "hover_thrust" in changes:
        thrust = changes.pop("hover_thrust")
        changes["hover_thrust_estimate"] = (
            HoverThrustEstimate(thrust, LEARNED_SIGMA) if thrust else HoverThrustEstimate()
        )
    belief = {
        name: value
        for name, value in changes.items()
        if name in _BELIEF - {"condition_start_times_s"}
    }
    descent = {name: value for name, value in changes.items() if name in _DESCENT}
    entry = {_ENTRY[name]: value for name, value in changes.items() if name in _ENTRY}
    rest = {
        name: value
        for name, value in changes.items()
        if name not in belief and name not in descent and name not in _ENTRY
    }
    if "t_s" in rest:
        belief["t_s"] = rest["t_s"]
    return replace(
        state,
        belief=replace(state.belief, **belief),
        descent=replace(state.descent, **descent),
        entry=replace(state.entry, **entry),
        **rest,
    )


def state_with(**changes: Any) -> PlannerState:
    """A planner's state with nothing but these fields of it and of its belief."""
    return remembering(PlannerState.initial_on_ground(observation(0.0, 0.0), PROFILE), **changes)


def context_at(state: PlannerState, obs: Observation, profile: Profile = PROFILE) -> Context:
    """The tick in which this state meets this observation, before it has taken it in."""
    history = state.command_history(PHASES[state.phase].maneuver)
    return Context(
        replace(
            state,
            belief=replace(state.belief.with_observation(obs, profile), command_history=history),
        )
    )


def observing(state: PlannerState, obs: Observation, profile: Profile = PROFILE) -> PlannerState:
    """The state with the observation taken in, and nothing decided."""
    return update_state_with_observation(state, obs, profile, PHASES[state.phase].maneuver)


def state_in(phase: Phase, t_s: float = 10.0, z_m: float = 1.0) -> PlannerState:
    """A planner that has just come into `phase` in an undisturbed flight."""
    return state_with(
        phase=phase,
        entered_s=t_s,
        t_s=t_s,
        search_step_began_at_s=t_s,
        setpoint=PositionSetpoint(0.0, 0.0, z_m, 0.0),
        entry_m=(0.0, 0.0, z_m),
        last_target_position_world_m=np.array([0.0, 0.0, CEILING_M]),
        hover_thrust=HOVER_THRUST,
        battery_fit=FINE_BATTERY,
        vehicle_world_z_at_last_contact_m=CEILING_M - 0.03 if phase is Phase.COMPLETE else None,
        hover_errors=HoverErrorAccumulator(t_s, t_s),
    )
