"""Lays effects into one simulated flight, at its edges: radio, camera, clock, world.

The planner and the loop know nothing of it. `Injector.each` is called every 10 ms of
simulated time; `Injector.tick` with every turn of the loop.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from perchctl.faults import effects as e
from perchctl.faults.edges import FaultyCamera, FaultyClock, FaultyRadio
from perchctl.faults.truth import SAMPLE_S, WatchedVehicle
from perchctl.geometry import GRAVITY_MPS2, rot_z
from perchctl.mission import Event, Phase, Tick
from perchctl.sim import CaptureFault, Neighbour, Scenario

LIGHTHOUSE = "deck.bcLighthouse4"
CAPTURE_FAULTS = {
    "frozen": CaptureFault(frozen=True),
    "silent": CaptureFault(gone=True),
    "occluded": CaptureFault(occluded=True),
    "swapped": CaptureFault(swapped=True),
    "millimetres": CaptureFault(scale=1000.0),
    "mirrored": CaptureFault(mirrored=True),
    "late": CaptureFault(),
}


def changed_scenario(scenario: Scenario, effects: tuple[e.Effect, ...]) -> Scenario:
    """Return the scenario with the effects that hold from the start."""
    weight_n = scenario.mass_kg * GRAVITY_MPS2
    for effect in effects:
        match effect:
            case e.MagnetHolds(of_weight):
                hold_n = of_weight * weight_n
                scenario = replace(scenario, magnet_force_n=hold_n, first_contact_force_n=None)
            case e.Room():
                scenario = _other_room(scenario, effect)
            case e.ExternalPositions() | e.DeckSilent():
                extra = {**scenario.extra, "external_position": 1.0}
                parameters = scenario.parameters
                if isinstance(effect, e.DeckSilent):
                    parameters = {**parameters, LIGHTHOUSE: 1.0}
                scenario = replace(scenario, extra=extra, parameters=parameters)
    return scenario


def _other_room(scenario: Scenario, room: e.Room) -> Scenario:
    turn = rot_z(math.radians(room.mount_turned_deg))
    rows = [list(row) for row in scenario.T_body_cam_true]
    for i in range(3):
        turned = [sum(rows[i][k] * turn[k, j] for k in range(3)) for j in range(3)]
        rows[i][:3] = [float(v) for v in turned]
    return replace(
        scenario,
        ceiling_z_m=room.ceiling_z_m or scenario.ceiling_z_m,
        no_target=room.no_target or scenario.no_target,
        target_above_ceiling_m=room.target_above_ceiling_m,
        neighbours=() if room.second_target_m is None else (Neighbour(room.second_target_m),),
        T_body_cam_true=tuple(tuple(row) for row in rows),
    )


@dataclass
class Edges:
    """The parts of a flight that faults act on."""

    vehicle: WatchedVehicle
    radio: FaultyRadio
    camera: FaultyCamera
    clock: FaultyClock
    press: Callable[[], None]
    hang_up: Callable[[], None]
    disk: Disk


class Disk:
    """A watcher that stands for a log whose disk can be full."""

    def __init__(self) -> None:
        self.problem: str | None = None

    def tick(self, tick: Tick) -> None:
        return None

    def event(self, event: Event) -> None:
        return None


class Injector:
    """Begins the effects `moment_s` into `phase`, or when the phase ends earlier; `begin_s` is
    None until then. It follows the phases as a watcher of the loop."""

    problem: str | None = None

    def __init__(
        self, edges: Edges, effects: tuple[e.Effect, ...], phase: Phase, moment_s: float
    ) -> None:
        self._edges = edges
        self._effects = effects
        self._phase = phase
        self._moment_s = moment_s
        self._due_s: float | None = None
        self._later: list[tuple[float, Callable[[], None]]] = []
        self._sag: tuple[e.BatterySags, float] | None = None
        self._deck: random.Random | None = None  # the noise of a deck whose positions come
        self._shakes_mps2 = 0.0
        for effect in effects:
            if isinstance(effect, e.DeckSilent):
                self._deck = random.Random(edges.vehicle.firmware.scenario.seed)
                self._shakes_mps2 = effect.acc_z_mps2
        self._lets_go: float | None = None
        self.begin_s: float | None = None
        self.flown: Phase | None = None  # the phase of the newest turn
        self.on_begin: Callable[[], None] = lambda: None

    def event(self, event: Event) -> None:
        return None

    def tick(self, tick: Tick) -> None:
        if self.flown is None and self._shakes_mps2:
            self._edges.vehicle.firmware.estimator.shift_accelerometer(self._shakes_mps2)
        self.flown = tick.state.phase
        if self.begin_s is not None:
            return
        if tick.state.phase is self._phase:
            if self._due_s is None:
                self._due_s = tick.t_s + self._moment_s
        elif self._due_s is not None:  # left before its time
            self._begin(self._edges.vehicle.t_s)

    def each(self, t_s: float) -> None:
        """Act as simulated time passes: begin what is due, and continue what lasts."""
        if self.begin_s is None and self._due_s is not None and t_s >= self._due_s:
            self._begin(t_s)
        while self._later and self._later[0][0] <= t_s:
            self._later.pop(0)[1]()
        world = self._edges.vehicle.world
        if self._deck is not None:
            self._measure(self._deck)
        if self._sag is not None:
            sag, left_v = self._sag
            step_v = min(sag.rate_vps * SAMPLE_S, left_v)
            world.battery_rest_v -= step_v
            self._sag = (sag, left_v - step_v) if left_v > step_v else None
        if self._lets_go is not None and world.magnet_engaged:
            after_s, self._lets_go = self._lets_go, None
            self._at(t_s + after_s, partial(setattr, world.magnet, "let_go", True))

    def begin_now(self) -> None:
        """Begin the effects before the flight."""
        self._begin(self._edges.vehicle.t_s)

    def _begin(self, t_s: float) -> None:
        self.begin_s = t_s
        self.on_begin()
        for effect in self._effects:
            self._lay(effect, t_s)

    def _at(self, t_s: float, act: Callable[[], None]) -> None:
        self._later.append((t_s, act))
        self._later.sort(key=lambda entry: entry[0])

    def _set(self, owner: object, name: str, value: object, after: object, end_s: float) -> None:
        """Set an attribute now, and set it to `after` at `end_s`."""
        setattr(owner, name, value)
        self._at(end_s, partial(setattr, owner, name, after))

    def _lay(self, effect: e.Effect, t_s: float) -> None:
        edges = self._edges
        vehicle = edges.vehicle
        match effect:
            case e.Reboots():
                vehicle.firmware.reboot()
                edges.radio.begin(effect, t_s)
            case e.RadioEffect():
                edges.radio.begin(effect, t_s)
            case e.CameraFault():
                edges.camera.begin(effect, t_s)
            case e.ProgramEffect():
                edges.clock.begin(effect, t_s)
            case e.Operator():
                act = edges.hang_up if effect.hang_up else edges.press
                for press_s in effect.presses_s:
                    self._at(t_s + press_s, act)
            case e.EstimateError():
                estimator, spoil = vehicle.firmware.estimator, partial(self._spoil, effect, t_s)
                self._set(estimator, "spoil", spoil, None, t_s + effect.for_s)
            case e.ExternalPositions():
                assert vehicle.capture is not None
                fault = replace(CAPTURE_FAULTS[effect.how], late_s=effect.late_s)
                vehicle.capture.lay(fault, effect.for_s)
            case e.DeckSilent(for_s):
                self._set(self, "_deck", None, self._deck, t_s + for_s)
            case e.LogReads():
                firmware = vehicle.firmware
                for name in effect.names:
                    value = firmware.log_value(name) if effect.value is None else effect.value
                    firmware.log_overrides[name] = value
                self._at(t_s + effect.for_s, firmware.log_overrides.clear)
            case e.BatterySags():
                self._sag = (effect, effect.by_v)
            case e.MotorWeak():
                s1, s2, s3, s4 = (
                    effect.strength if m == effect.motor else 1.0 for m in (1, 2, 3, 4)
                )
                vehicle.world.powertrain.strength = (s1, s2, s3, s4)
            case e.ThrustChanged(to):
                powertrain = vehicle.world.powertrain
                s1, s2, s3, s4 = powertrain.strength or (1.0,) * 4
                powertrain.strength = (s1 * to, s2 * to, s3 * to, s4 * to)
            case e.Push():
                still_n = (0.0, 0.0, 0.0)
                end_s = t_s + effect.for_s
                self._set(vehicle.world, "external_force_n", effect.force_n, still_n, end_s)
            case e.MagnetLetsGo():
                self._lets_go = effect.after_s
            case e.TargetMoves(by_m):
                x, y = vehicle.world.magnet.target_xy_m
                vehicle.move_target((x + by_m[0], y + by_m[1]))
            case e.DiskFull():
                problem = "No space left on device"
                self._set(edges.disk, "problem", problem, None, t_s + effect.for_s)
            case e.MagnetHolds() | e.Room():
                pass  # from the start: `changed_scenario`

    def _measure(self, noise: random.Random) -> None:
        """Give the estimator a position measured by the vehicle's own deck."""
        world, firmware = self._edges.vehicle.world, self._edges.vehicle.firmware
        sigma_m = firmware.scenario.estimate_noise_m
        x_m, y_m, z_m = (p + noise.gauss(0.0, sigma_m) for p in (world.x_m, world.y_m, world.z_m))
        firmware.estimator.external_position((x_m, y_m, z_m))

    def _spoil(self, error: e.EstimateError, begin_s: float, now: Any) -> None:
        t_s = self._edges.vehicle.t_s - begin_s
        x, y, z = error.step_m
        vx, vy, vz = error.drift_mps
        now.x_m += x + vx * t_s
        now.y_m += y + vy * t_s
        now.z_m += z + vz * t_s
        now.vx_mps += vx
        now.vy_mps += vy
        now.vz_mps += vz
        now.yaw_deg = math.remainder(now.yaw_deg + error.turn_deg, 360.0)
