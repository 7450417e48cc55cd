"""What is true in a flight: samples of the vehicle for the oracle, and the facts that expected
outcomes rest on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.faults.effects import SAMPLE_S, Effect, reboots
from perchctl.faults.oracle import Sample
from perchctl.geometry import GRAVITY_MPS2
from perchctl.profile import Profile, TargetConfig
from perchctl.sim import (
    CONTROL_PERIOD_S,
    MOTOR_FORCE_N,
    REST_HEIGHT_M,
    CaptureSettings,
    Scenario,
    SimulatedVehicle,
    most_thrust_n,
)
from perchctl.vehicle import LOCKED
from perchctl.vision import CameraModel

FULL_THRUST = 60000.0
"""The largest raw thrust order (docs/firmware.md, "Raw thrust"): it lifts every vehicle that can
fly."""
PRESSING_RATIO = 1.02
"""Rotors that lift more than this part of the weight press against whatever is in the way."""


class WatchedVehicle(SimulatedVehicle):
    """A simulated vehicle that calls `each` every `SAMPLE_S` of its time."""

    def __init__(
        self,
        scenario: Scenario,
        camera: CameraModel,
        target: TargetConfig,
        capture: CaptureSettings | None = None,
    ) -> None:
        super().__init__(scenario, camera, target, capture)
        self.each: Callable[[float], None] = lambda t_s: None
        self._next_s = SAMPLE_S

    def advance_to(self, t_s: float) -> None:
        while self.t_s < t_s - CONTROL_PERIOD_S / 2:
            super().advance_to(min(t_s, self._next_s))
            if self.t_s >= self._next_s - CONTROL_PERIOD_S / 2:
                self._next_s += SAMPLE_S
                self.each(self.t_s)


def sample_of(vehicle: SimulatedVehicle) -> Sample:
    """Return the true state of the vehicle now; the fields that depend on the fault stay at
    their defaults."""
    world, firmware = vehicle.world, vehicle.firmware
    weight_n = vehicle.scenario.mass_kg * GRAVITY_MPS2
    _, qx, qy, _ = world.quaternion
    up_z = 1.0 - 2.0 * (qx * qx + qy * qy)
    target_z_m = vehicle.scenario.ceiling_z_m + vehicle.scenario.target_above_ceiling_m
    ceiling_n, floor = world.contacts()
    motors_on = max(firmware.motors) > 0.0
    lift_n = sum(world.powertrain.forces_n)
    pushing = motors_on and (
        firmware.controller.thrust >= FULL_THRUST or lift_n >= PRESSING_RATIO * weight_n
    )
    supervisor = firmware.supervisor
    fx, fy, fz = world.fx_mps2, world.fy_mps2, world.fz_mps2
    return Sample(
        vehicle.t_s,
        world.x_m,
        world.y_m,
        world.z_m - REST_HEIGHT_M,
        world.vz_mps,
        up_z,
        math.sqrt(fx * fx + fy * fy + fz * fz) / GRAVITY_MPS2,
        motors_on,
        pushing and (ceiling_n > 0.0 or (floor and up_z < 0.5)),
        floor,
        world.magnet_engaged,
        world.magnet.hold_n / weight_n,
        bool(firmware.supervisor_info & LOCKED),
        supervisor.crashed or supervisor.tumbled,
        math.hypot(world.vx_mps, world.vy_mps),
        miss_m=world.gear_miss_m(),
        below_m=target_z_m - world.gear_tip_m()[2],
    )


# --- The facts ---------------------------------------------------------------------------------


LEAST_LIFT = 1.02
"""The lift over the weight that keeps a vehicle in the air."""
CUT_S = 1.9
"""A longer silence ends in the firmware's cut (2.0 s after the last setpoint)."""
LOCKS_S = 0.1
"""The lock shows this long after the cut; what arrives meanwhile prevents nothing."""
TOPPLES_S, TOPPLED_UP_Z = 0.3, 0.5
"""Motors that stood still take longer than this to regain control."""
WATCH_WITHIN_S = 0.1
"""The telemetry shows a hanging vehicle up to this late."""


@dataclass
class Facts:
    """What was true in the flight. Times None: never.

    Attributes:
        effects: what the fault did.
        begin_s: when it began.
        cut_s: when the firmware locked the vehicle since nothing of the program had reached it.
        own_landing: the vehicle's own landing ran as a silence of that length began.
        killed_s: when the program was killed.
        rebooted_s: when the vehicle started again on turning motors, off the floor.
        stop_s: second Ctrl-C.
        let_go_s: when the magnet let go for good; `watched`: by then the whole weight had hung on
            it, motors off, for as long as the program is to watch it.
        slipped_s: when it first came off the magnet with its motors still; `slipped_m`: how high;
            `toppled`: within `TOPPLES_S` from there it had turned over.
        weak_s: when battery and motors could first not lift the weight any more.
        low_s, low_m: when the battery was first low under load, and how high the vehicle was.
    """

    effects: tuple[Effect, ...] = ()
    begin_s: float | None = None
    cut_s: float | None = None
    own_landing: bool = False
    killed_s: float | None = None
    rebooted_s: float | None = None
    stop_s: float | None = None
    let_go_s: float | None = None
    watched: bool = False
    slipped_s: float | None = None
    slipped_m: float = 0.0
    toppled: bool = False
    weak_s: float | None = None
    low_s: float | None = None
    low_m: float = 0.0

    def does(self, act: Callable[..., None]) -> bool:
        """Return True if that is one of the effects."""
        return any(effect.func is act for effect in self.effects)


class FactsRecorder:
    """Follows the true vehicle sample by sample, and notes in `facts` when things happened."""

    def __init__(
        self, vehicle: SimulatedVehicle, profile: Profile, effects: tuple[Effect, ...] = ()
    ) -> None:
        complete = profile.planner.complete
        self.facts = Facts(effects)
        self._watch_s = complete.hang_s + complete.watch_s - WATCH_WITHIN_S
        self._min_load_v = profile.safety.min_load_v
        self._vehicle = vehicle
        self._silent_s: float | None = None  # since when nothing has arrived
        self._heard_s = -math.inf  # when the newest silence ended that was long enough for a cut
        self._landed_alone = self._locked_before = self._begun = False
        self._hangs_s: float | None = None  # since when the whole weight has hung
        self._before: Sample | None = None

    def see(self, s: Sample) -> None:
        """Note the next sample; `facts.begin_s` is set by then if the fault has begun."""
        facts, before = self.facts, self._before
        self._note_silence(s)
        self._note_hanging(s)
        if facts.begin_s is not None:
            flew = before is not None and before.motors_on and not before.floor
            if not self._begun and flew and facts.does(reboots):
                facts.rebooted_s = facts.begin_s
            self._begun = True
            self._note_power(s)
        self._before = s

    def _note_silence(self, s: Sample) -> None:
        facts = self.facts
        long = self._silent_s is not None and s.t_s - self._silent_s >= CUT_S
        facts.own_landing = facts.own_landing or (long and self._landed_alone)
        locks = s.locked and not self._locked_before
        ordered = self._vehicle.firmware.supervisor.emergency  # by a packet, not by silence
        late = s.t_s - self._heard_s <= LOCKS_S and not ordered
        if locks and (long or late) and facts.cut_s is None:
            facts.cut_s = s.t_s
        self._locked_before = s.locked
        if s.uplink:
            self._heard_s = s.t_s if long else self._heard_s
            self._silent_s = None
        elif self._silent_s is None:
            self._silent_s = s.t_s
            self._landed_alone = self._vehicle.firmware.planner.active

    def _note_hanging(self, s: Sample) -> None:
        facts, before = self.facts, self._before
        if facts.let_go_s is None and self._vehicle.world.magnet.let_go:
            facts.let_go_s = s.t_s
            facts.watched = self._hangs_s is not None and s.t_s - self._hangs_s >= self._watch_s
        came_off = before is not None and before.hanging and not s.hanging and not s.motors_on
        if came_off and facts.slipped_s is None:
            facts.slipped_s, facts.slipped_m = s.t_s, s.height_m
        if facts.slipped_s is not None and s.t_s - facts.slipped_s <= TOPPLES_S:
            facts.toppled = facts.toppled or s.up_z < TOPPLED_UP_Z
        if s.motors_on or not s.hanging:
            self._hangs_s = None
        elif self._hangs_s is None:
            self._hangs_s = s.t_s

    def _note_power(self, s: Sample) -> None:
        """Note when the vehicle can no longer lift its weight: at most four times what the
        weakest motor gives."""
        vehicle, world = self._vehicle, self._vehicle.world
        weakest = min(world.powertrain.strength or (1.0,))
        lift_n = min(4.0 * MOTOR_FORCE_N, weakest * most_thrust_n(world.battery_rest_v))
        weight_n = vehicle.scenario.mass_kg * GRAVITY_MPS2
        if self.facts.weak_s is None and lift_n < LEAST_LIFT * weight_n:
            self.facts.weak_s = s.t_s
        if self.facts.low_s is None and world.battery_v < self._min_load_v:
            self.facts.low_s, self.facts.low_m = s.t_s, s.height_m
