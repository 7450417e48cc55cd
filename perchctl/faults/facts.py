"""What was true in a flight, and when: what expected outcomes rest on."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.faults.effects import Effect, Reboots
from perchctl.faults.oracle import Sample
from perchctl.faults.truth import WatchedVehicle
from perchctl.geometry import GRAVITY_MPS2
from perchctl.profile import Profile
from perchctl.sim import MOTOR_FORCE_N, most_thrust_n

LEAST_LIFT = 1.02
"""Over the weight: with less nothing is held in the air."""
CUT_S = 1.9
"""Silence for longer ends in the firmware's cut (2.0 s after the last setpoint)."""
LOCKS_S = 0.1
"""The lock shows that much later than the cut: what arrives meanwhile prevents nothing."""
TOPPLES_S, TOPPLED_UP_Z = 0.3, 0.5
"""Motors that stand still take longer than that to turn fast enough for any control."""
WATCH_WITHIN_S = 0.1
"""The weight hangs before the program's telemetry shows it."""


@dataclass(frozen=True)
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


class FactsRecorder:
    """Looks at the true vehicle with each sample, and keeps when what happened."""

    def __init__(self, vehicle: WatchedVehicle, profile: Profile) -> None:
        complete = profile.planner.complete
        self._watch_s = complete.hang_s + complete.watch_s - WATCH_WITHIN_S
        self._min_load_v = profile.safety.min_load_v
        self._vehicle = vehicle
        self._silent_s: float | None = None  # since when nothing has arrived
        self._heard_s = -math.inf  # when the newest silence ended that was long enough for a cut
        self._landed_alone = self._locked_before = False
        self._hangs_s: float | None = None  # since when the whole weight has hung
        self._before: Sample | None = None
        self.cut_s: float | None = None
        self.own_landing = False
        self._flew: bool | None = None  # as the fault began
        self.let_go_s: float | None = None
        self.watched = False
        self.slipped_s: float | None = None
        self.slipped_m = 0.0
        self.toppled = False
        self.weak_s: float | None = None
        self.low_s: float | None = None
        self.low_m = 0.0

    def see(self, s: Sample, *, begun: bool) -> None:
        """The next sample; `begun`: the fault has."""
        self._note_silence(s)
        self._note_hanging(s)
        if begun:
            if self._flew is None:
                before = self._before
                self._flew = before is not None and before.motors_on and not before.floor
            self._note_power(s)
        self._before = s

    def _note_silence(self, s: Sample) -> None:
        long = self._silent_s is not None and s.t_s - self._silent_s >= CUT_S
        if long and self._landed_alone:
            self.own_landing = True
        locks = s.locked and not self._locked_before
        ordered = self._vehicle.firmware.supervisor.emergency  # by a packet, not by silence
        late = s.t_s - self._heard_s <= LOCKS_S and not ordered
        if locks and (long or late) and self.cut_s is None:
            self.cut_s = s.t_s
        self._locked_before = s.locked
        if s.uplink:
            self._heard_s = s.t_s if long else self._heard_s
            self._silent_s = None
        elif self._silent_s is None:
            self._silent_s = s.t_s
            self._landed_alone = self._vehicle.firmware.planner.active

    def _note_hanging(self, s: Sample) -> None:
        still = s.hanging and not s.motors_on
        if self.let_go_s is None and self._vehicle.world.magnet.let_go:
            self.let_go_s = s.t_s
            self.watched = self._hangs_s is not None and s.t_s - self._hangs_s >= self._watch_s
        before = self._before
        came_off = before is not None and before.hanging and not s.hanging and not s.motors_on
        if came_off and self.slipped_s is None:
            self.slipped_s, self.slipped_m = s.t_s, s.height_m
        if self.slipped_s is not None and s.t_s - self.slipped_s <= TOPPLES_S:
            self.toppled = self.toppled or s.up_z < TOPPLED_UP_Z
        if not still:
            self._hangs_s = None
        elif self._hangs_s is None:
            self._hangs_s = s.t_s

    def _note_power(self, s: Sample) -> None:
        """What is lifted at most: four times what the weakest motor gives."""
        vehicle, world = self._vehicle, self._vehicle.world
        weakest = min(world.powertrain.strength or (1.0,))
        lift_n = min(4.0 * MOTOR_FORCE_N, weakest * most_thrust_n(world.battery_rest_v))
        weight_n = vehicle.scenario.mass_kg * GRAVITY_MPS2
        if self.weak_s is None and lift_n < LEAST_LIFT * weight_n:
            self.weak_s = s.t_s
        if self.low_s is None and world.battery_v < self._min_load_v:
            self.low_s, self.low_m = s.t_s, s.height_m

    def facts(
        self,
        effects: tuple[Effect, ...],
        *,
        begin_s: float | None,
        killed_s: float | None,
        stop_s: float | None,
    ) -> Facts:
        """After the last sample."""
        return Facts(
            effects=effects,
            begin_s=begin_s,
            cut_s=self.cut_s,
            own_landing=self.own_landing,
            killed_s=killed_s,
            rebooted_s=begin_s if self._flew and _reboots(effects) else None,
            stop_s=stop_s,
            let_go_s=self.let_go_s,
            watched=self.watched,
            slipped_s=self.slipped_s,
            slipped_m=self.slipped_m,
            toppled=self.toppled,
            weak_s=self.weak_s,
            low_s=self.low_s,
            low_m=self.low_m,
        )


def _reboots(effects: tuple[Effect, ...]) -> bool:
    return any(isinstance(effect, Reboots) for effect in effects)
