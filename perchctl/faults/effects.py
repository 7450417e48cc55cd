"""The effects of faults: each is a function that acts on the parts of a flight (`FaultRig`) when
the fault begins, at `t_s`.

Durations are measured from the beginning of the fault.
"""

from __future__ import annotations

import math
import random
from dataclasses import replace
from functools import partial
from typing import Any

from perchctl.faults.edges import CameraFault, FaultRig, PlantedError
from perchctl.geometry import GRAVITY_MPS2
from perchctl.link import MockLink
from perchctl.mission import Phase, Tick
from perchctl.profile import Profile
from perchctl.sim import CaptureFault, Scenario

Effect = partial[Any]
Axes = tuple[float, float, float]
"""World axes."""
FOR_EVER = 1e6
SAMPLE_S = 0.01
"""Time between two calls of `Injector.begin_due` and of `FaultRig.call_due`, s."""
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


# --- The radio ---


def radio_loss(
    rig: FaultRig,
    t_s: float,
    for_s: float,
    up: bool = False,
    down: str = "",
    delay_s: float = math.inf,
) -> None:
    """For `for_s`, lose all commands if `up` is True, and all packets of the log block `down`
    ("all": of every block). A finite `delay_s` delays the log packets instead."""
    rig.radio.lose(t_s + for_s, up, down, delay_s)


def packet_lost(rig: FaultRig, t_s: float, order: str, count: int) -> None:
    """Lose the next `count` packets of the kind `order` (`perchctl.faults.edges.packet_kind`)."""
    rig.radio.lost[order] = count


def packet_twice(rig: FaultRig, t_s: float, order: str) -> None:
    """Deliver the next packet of the kind `order` twice."""
    rig.radio.twice.add(order)


def reboots(rig: FaultRig, t_s: float, boots_s: float) -> None:
    """Reboot the vehicle after a voltage drop: its motors stop, it receives nothing for `boots_s`,
    and its log blocks are missing until the link restarts them."""
    rig.vehicle.firmware.reboot()
    rig.radio.lose(t_s + boots_s, uplink=True, block="all")
    rig.radio.lose(t_s + (boots_s + MockLink.BLOCKS_BACK_AFTER_S), uplink=False, block="all")


# --- The camera and the positions ---


def camera_fault(rig: FaultRig, t_s: float, kind: str, for_s: float, late_s: float = 0.0) -> None:
    """Begin the `CameraFault` with these values, which corrupts the images for `for_s`."""
    rig.camera.begin_fault(CameraFault(kind, for_s, late_s), t_s)


def external_positions(
    rig: FaultRig,
    t_s: float,
    how: str,
    for_s: float,
    late_s: float = 0.0,
    swapped_with: str | None = None,
) -> None:
    """For a vehicle without a deck, make the motion-capture system fail for `for_s` as in
    `CAPTURE_FAULTS[how]`, or delay its frames by `late_s`. `swapped_with`: the body that swaps
    names with the vehicle's; None: the first of the other bodies."""
    assert rig.vehicle.capture is not None
    fault = replace(CAPTURE_FAULTS[how], late_s=late_s, swapped_with=swapped_with)
    rig.vehicle.capture.begin_fault(fault, for_s)


def deck_silent(rig: FaultRig, t_s: float, for_s: float, acc_z_mps2: float) -> None:
    """Stop the deck's absolute positions for `for_s`. Throughout the flight, the accelerometer
    has an error of `acc_z_mps2` along z because the motors shake it; the positions correct the
    resulting error of the estimate until they stop."""
    rig.set_until(t_s + for_s, rig, "deck_silent", True, False)


# --- The vehicle ---


def estimate_error(
    rig: FaultRig,
    t_s: float,
    step_m: Axes = (0.0, 0.0, 0.0),
    turn_deg: float = 0.0,
    drift_mps: Axes = (0.0, 0.0, 0.0),
    for_s: float = FOR_EVER,
) -> None:
    """Add a step, a change of heading, and a drift, in world axes, to the state estimate."""

    def spoil(now: Any) -> None:
        after_s = rig.vehicle.t_s - t_s
        x, y, z = step_m
        vx, vy, vz = drift_mps
        now.x_m += x + vx * after_s
        now.y_m += y + vy * after_s
        now.z_m += z + vz * after_s
        now.vx_mps += vx
        now.vy_mps += vy
        now.vz_mps += vz
        now.yaw_deg = math.remainder(now.yaw_deg + turn_deg, 360.0)

    rig.set_until(t_s + for_s, rig.vehicle.firmware.estimator, "spoil", spoil, None)


def log_reads(
    rig: FaultRig, t_s: float, names: tuple[str, ...], value: float | None, for_s: float
) -> None:
    """Make the log variables `names` report `value` for `for_s`; if `value` is None, freeze them at
    their current values."""
    firmware = rig.vehicle.firmware
    for name in names:
        firmware.log_overrides[name] = firmware.log_value(name) if value is None else value
    rig.call_at(t_s + for_s, firmware.log_overrides.clear)


def battery_sags(rig: FaultRig, t_s: float, rate_vps: float, by_v: float) -> None:
    """Make the battery's resting voltage drop by `by_v` at the rate `rate_vps`."""
    world, left_v = rig.vehicle.world, by_v

    def sag(_now_s: float) -> None:
        nonlocal left_v
        step_v = min(rate_vps * SAMPLE_S, left_v)
        world.battery_rest_v -= step_v
        left_v -= step_v

    rig.on_sample.append(sag)


def thrust_changed(rig: FaultRig, t_s: float, to: tuple[float, float, float, float]) -> None:
    """Multiply each motor's thrust by its factor in `to`, as if it had a different propeller."""
    powertrain = rig.vehicle.world.powertrain
    s1, s2, s3, s4 = (s * part for s, part in zip(powertrain.strength, to, strict=True))
    powertrain.strength = (s1, s2, s3, s4)


def push(rig: FaultRig, t_s: float, force_n: Axes, for_s: float) -> None:
    """Push the vehicle with a force, in world axes, for `for_s`."""
    still_n = (0.0, 0.0, 0.0)
    rig.set_until(t_s + for_s, rig.vehicle.world, "external_force_n", force_n, still_n)


def magnet_lets_go(rig: FaultRig, t_s: float, after_s: float) -> None:
    """Disable the magnet permanently, `after_s` after the gear has touched it."""
    world, contact_s = rig.vehicle.world, math.inf

    def watch(now_s: float) -> None:
        nonlocal contact_s
        if world.magnet_engaged:
            contact_s = min(contact_s, now_s)
        if now_s >= contact_s + after_s:
            world.magnet.let_go = True

    rig.on_sample.append(watch)


def target_moves(rig: FaultRig, t_s: float, by_m: tuple[float, float]) -> None:
    """Move the target and its magnet by (x, y), in world axes."""
    x, y = rig.vehicle.world.magnet.target_xy_m
    rig.vehicle.move_target((x + by_m[0], y + by_m[1]))


# --- The operator and the program ---


def operator(
    rig: FaultRig, t_s: float, presses_s: tuple[float, ...], hang_up: bool = False
) -> None:
    """Press Ctrl-C at each of the times `presses_s` after `t_s`, or close the terminal if `hang_up`
    is True."""
    for press_s in presses_s:
        rig.call_at(t_s + press_s, rig.hang_up if hang_up else rig.press)


def parent_gone(rig: FaultRig, t_s: float, noticed_s: float, for_s: float) -> None:
    """Take away the fleet's parent process for `for_s`, which must be permanent; the vehicle's
    process notices it after `noticed_s` and lands (`perchctl.fleet.parent_watch`)."""
    rig.call_at(t_s + noticed_s, rig.hang_up)


def killed(rig: FaultRig, t_s: float) -> None:
    """Kill the program the next time its loop waits."""
    rig.clock.pending = rig.clock.kill


def suspended(rig: FaultRig, t_s: float, for_s: float) -> None:
    """Suspend all threads of the program for `for_s`."""
    rig.clock.pending = partial(rig.clock.suspend, for_s)


def hung(rig: FaultRig, t_s: float, for_s: float) -> None:
    """Block the loop's thread for `for_s`; the program's other threads keep running."""
    rig.clock.pending = partial(rig.clock.hang, for_s)


def slow(rig: FaultRig, t_s: float, tick_s: float, for_s: float) -> None:
    """Make each tick of the loop take at least `tick_s`, for `for_s`."""
    rig.clock.tick_s, rig.clock.slow_until_s = tick_s, t_s + for_s


def raises(rig: FaultRig, t_s: float) -> None:
    """Raise an unforeseen exception in the loop's thread."""

    def fail() -> None:
        raise PlantedError("an exception that the fault raised")

    rig.clock.pending = fail


def disk_full(rig: FaultRig, t_s: float, for_s: float) -> None:
    """Make the log's disk full for `for_s`."""
    rig.set_until(t_s + for_s, rig.disk, "problem", "No space left on device", None)


# --- Effects that apply from the start of the flight ---


def magnet_holds(scenario: Scenario, of_weight: float) -> Scenario:
    """The scenario with a magnet whose holding force is `of_weight` times the vehicle's weight."""
    hold_n = of_weight * (scenario.mass_kg * GRAVITY_MPS2)
    return replace(scenario, magnet_force_n=hold_n, first_contact_force_n=None)


def room(scenario: Scenario, **fields: Any) -> Scenario:
    """The scenario with `fields` replaced."""
    return replace(scenario, **fields)


OF_THE_SCENARIO = (magnet_holds, room)


def apply_to_scenario(scenario: Scenario, effects: tuple[Effect, ...]) -> Scenario:
    """Return the scenario after applying those of the `effects` that act from the start of the
    flight."""
    for effect in effects:
        if effect.func in OF_THE_SCENARIO:
            scenario = effect(scenario)
        elif effect.func in (external_positions, deck_silent):
            extra = {**scenario.extra, "external_position": 1.0}
            deck = {LIGHTHOUSE: 1.0} if effect.func is deck_silent else {}
            scenario = replace(scenario, extra=extra, parameters=scenario.parameters | deck)
    return scenario


def apply_to_profile(profile: Profile, effects: tuple[Effect, ...]) -> Profile:
    """The profile, changed to the positioning method and the camera latency that the effects
    require."""
    for effect in effects:
        if effect.func in (external_positions, deck_silent):
            by = "deck" if effect.func is deck_silent else "mocap"
            positioning = profile.positioning.model_copy(update={"by": by})
            profile = profile.model_copy(update={"positioning": positioning})
        latency_s = profile.camera.start_latency_s + latency_drop_s(effect)
        if latency_s > profile.camera.start_latency_s:
            camera = profile.camera.model_copy(update={"latency_s": latency_s})
            profile = profile.model_copy(update={"camera": camera})
    return profile


def latency_drop_s(effect: Effect) -> float:
    """Time by which an effect makes images arrive sooner than the profile expects, s."""
    sooner = effect.func is camera_fault and effect.keywords["kind"] == "sooner"
    return float(effect.keywords["late_s"]) if sooner else 0.0


# --- Begin the effects at the right time ---


class Injector:
    """Begins effects `moment_s` seconds into `phase`, or at the end of the phase if that is
    earlier.

    `tick` must be called with each tick of the loop, and `begin_due` every `SAMPLE_S` of simulated
    time. `begin_s` is None until the effects begin; `flown` is the phase of the newest tick.
    """

    def __init__(
        self, rig: FaultRig, effects: tuple[Effect, ...], phase: Phase, moment_s: float
    ) -> None:
        self._edges, self._phase, self._moment_s = rig, phase, moment_s
        self._effects = [effect for effect in effects if effect.func not in OF_THE_SCENARIO]
        self._due_s: float | None = None
        self.begin_s: float | None = None
        self.flown: Phase | None = None
        self._shakes_mps2 = 0.0
        for effect in effects:
            rig.camera.late_s += latency_drop_s(effect)
            if effect.func is deck_silent:
                self._shakes_mps2 = effect.keywords["acc_z_mps2"]
                rig.on_sample.append(
                    partial(_measure, rig, random.Random(rig.vehicle.scenario.seed))
                )

    def tick(self, tick: Tick) -> None:
        """Record the phase, and determine when the effects are due."""
        if self.flown is None and self._shakes_mps2:
            self._edges.vehicle.firmware.estimator.add_accelerometer_bias(self._shakes_mps2)
        self.flown = tick.state.phase
        if self.begin_s is not None:
            return
        if self.flown is not self._phase:
            if self._due_s is not None:  # the phase ended before the effects were due
                self.begin(self._edges.vehicle.t_s)
        elif self._due_s is None:
            self._due_s = tick.t_s + self._moment_s

    def begin_due(self, t_s: float) -> None:
        if self.begin_s is None and self._due_s is not None and t_s >= self._due_s:
            self.begin(t_s)

    def begin(self, t_s: float) -> None:
        self.begin_s = t_s
        for effect in self._effects:
            effect(self._edges, t_s)


def _measure(rig: FaultRig, noise: random.Random, _now_s: float) -> None:
    """Pass a position measured by the deck to the estimator."""
    if rig.deck_silent:
        return
    world, firmware = rig.vehicle.world, rig.vehicle.firmware
    sigma_m = firmware.scenario.estimate_noise_m
    x_m, y_m, z_m = (p + noise.gauss(0.0, sigma_m) for p in (world.x_m, world.y_m, world.z_m))
    firmware.estimator.take_external((x_m, y_m, z_m))
