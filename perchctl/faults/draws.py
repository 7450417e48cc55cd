"""How the parameters of the catalogue's faults are drawn."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from perchctl.faults import effects as e
from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim import Scenario

Rng = np.random.Generator
Draw = Callable[[Rng, Scenario], tuple[e.Effect, ...]]

LONGEST_S = 30.0
EVER_SHARE = 0.25


def between(rng: Rng, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 4)


def log_between(rng: Rng, low: float, high: float) -> float:
    return round(float(math.exp(rng.uniform(math.log(low), math.log(high)))), 4)


def lasting_s(rng: Rng, low: float = 0.1) -> float:
    """From `low` to 30 s, log-uniform; one in four for ever."""
    for_s = log_between(rng, low, LONGEST_S)
    return e.FOR_EVER if rng.uniform() < EVER_SHARE else for_s


def heading(rng: Rng) -> tuple[float, float]:
    angle = float(rng.uniform(-math.pi, math.pi))
    return math.cos(angle), math.sin(angle)


def sign(rng: Rng) -> float:
    return 1.0 if rng.uniform() < 0.5 else -1.0


def silence(*, up: bool, down: bool) -> Draw:
    return lambda rng, scenario: (e.Silence(lasting_s(rng), up, down),)


def lost(order: str, *presses_s: float) -> Draw:
    """The packet of an order, which the operator's presses bring about."""

    def draw(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
        count = 1 if rng.uniform() < 0.6 else 2
        operator = (e.Operator(presses_s),) if presses_s else ()
        return (e.PacketLost(order, count), *operator)

    return draw


def twice(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    order = ("setpoint", "land", "notify", "stop")[int(rng.integers(4))]
    presses = (e.Operator((0.0,)),) if order in ("land", "notify") else ()
    return (e.PacketTwice(order), *presses)


def block_dead(name: str) -> Draw:
    return lambda rng, scenario: (e.BlockDead(name, lasting_s(rng)),)


def delayed(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.TelemetryDelayed(log_between(rng, 0.05, 2.0), lasting_s(rng, 0.5)),)


def camera(kind: str) -> Draw:
    return lambda rng, scenario: (e.CameraFault(kind, lasting_s(rng)),)


def camera_late(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.CameraFault("late", lasting_s(rng, 1.0), log_between(rng, 0.05, 0.6)),)


def camera_sooner(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.CameraFault("sooner", e.FOR_EVER, between(rng, 0.1, 0.2)),)


def camera_mirrored(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.CameraFault("mirrored", e.FOR_EVER),)


def jump_xy(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    x, y = heading(rng)
    step_m = log_between(rng, 0.1, 2.0)
    return (e.EstimateError(step_m=(x * step_m, y * step_m, 0.0), for_s=lasting_s(rng)),)


def jump_z(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    step_m = sign(rng) * log_between(rng, 0.1, 1.0)
    return (e.EstimateError(step_m=(0.0, 0.0, step_m), for_s=lasting_s(rng)),)


def jump_yaw(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    turn_deg = sign(rng) * log_between(rng, 10.0, 180.0)
    return (e.EstimateError(turn_deg=turn_deg, for_s=lasting_s(rng)),)


def drift(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    x, y = heading(rng)
    speed_mps = log_between(rng, 0.03, 0.3)
    z = between(rng, -0.2, 0.2)
    drift_mps = (x * speed_mps, y * speed_mps, z * speed_mps)
    return (e.EstimateError(drift_mps=drift_mps, for_s=lasting_s(rng, 2.0)),)


STATE_NAMES = tuple(f"stateEstimate.{axis}" for axis in ("x", "y", "z", "vx", "vy", "vz"))


def not_a_number(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.LogReads(STATE_NAMES, math.nan, lasting_s(rng, 0.02)),)


def frozen(*names: str) -> Draw:
    """Log variables whose values stand still while their packets go on coming."""
    return lambda rng, scenario: (e.LogReads(names, None, lasting_s(rng)),)


def external(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    how = "frozen" if rng.uniform() < 0.5 else "silent"
    return (e.ExternalPositions(how, lasting_s(rng)),)


def external_occluded(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """For 0.3 s, as somebody walks by, or longer."""
    for_s = 0.3 if rng.uniform() < 0.5 else lasting_s(rng, 0.5)
    return (e.ExternalPositions("occluded", for_s),)


def external_wrong(how: str) -> Draw:
    return lambda rng, scenario: (e.ExternalPositions(how, lasting_s(rng)),)


def external_late(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    late_s = log_between(rng, 0.05, 0.15)
    return (e.ExternalPositions("late", lasting_s(rng, 1.0), late_s),)


def deck_silent(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """The height then runs away by 0.1 to 0.4 m/s within 5 s."""
    return (e.DeckSilent(lasting_s(rng, 0.3), sign(rng) * between(rng, 0.03, 0.08)),)


def sags(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.BatterySags(log_between(rng, 0.01, 0.1), between(rng, 0.2, 0.6)),)


def reboots(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Reboots(between(rng, 0.5, 1.5)),)


def reading_frozen(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.LogReads(("pm.vbat",), None, lasting_s(rng)),)


def reading_low(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    if rng.uniform() < 0.5:
        return (e.LogReads(("pm.vbat",), between(rng, 2.6, 3.1), lasting_s(rng)),)
    return (e.LogReads(("pm.state",), 3.0, lasting_s(rng)),)


def weak_motor(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.MotorWeak(int(rng.integers(1, 5)), 0.85),)


def thrust_changed(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """So that hovering takes 8 % more or less at most."""
    return (e.ThrustChanged(round(1.0 / between(rng, 0.92, 1.08), 4)),)


def kick(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """A blow of 40 ms that changes the speed by up to 1 m/s, mostly sideways."""
    x, y = heading(rng)
    z = between(rng, -0.5, 0.5)
    force_n = scenario.mass_kg * between(rng, 0.2, 1.0) / 0.04
    return (e.Push((x * force_n, y * force_n, z * force_n), 0.04),)


def gust(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """Half a second to one, with up to a fifth of the weight, mostly sideways."""
    x, y = heading(rng)
    z = between(rng, -0.3, 0.3)
    force_n = scenario.mass_kg * GRAVITY_MPS2 * between(rng, 0.05, 0.2)
    for_s = between(rng, 0.5, 1.0)
    return (e.Push((x * force_n, y * force_n, z * force_n), for_s),)


def no_magnet(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.MagnetHolds(0.0),)


def weak_magnet(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.MagnetHolds(between(rng, 0.2, 1.1)),)


def lets_go(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.MagnetLetsGo(log_between(rng, 1.0, 25.0)),)


def beside_its_plane(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Room(target_above_ceiling_m=sign(rng) * log_between(rng, 0.02, 0.2)),)


def unusual_ceiling(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    low = rng.uniform() < 0.5
    return (e.Room(ceiling_z_m=between(rng, *((1.1, 1.6) if low else (2.7, 3.4)))),)


def bare(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Room(no_target=True),)


def low_and_bare(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Room(ceiling_z_m=between(rng, 0.35, 1.3), no_target=True),)


def target_moves(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    x, y = heading(rng)
    return (e.TargetMoves((0.3 * x, 0.3 * y)),)


def second_target(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    x, y = heading(rng)
    away_m = between(rng, 0.35, 1.2)
    return (e.Room(second_target_m=(x * away_m, y * away_m)),)


def turned_mount(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Room(mount_turned_deg=(90.0, 180.0, -90.0)[int(rng.integers(3))]),)


def pressed_once(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Operator((0.0,)),)


def pressed_twice(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Operator((0.0, log_between(rng, 0.6, 10.0))),)


def held(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """A key that repeats every 30 ms: one press, for less than the 2 s that are a stop."""
    return (_presses_every(0.03, log_between(rng, 0.1, 1.8)),)


def hammered(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """By a hand that wants the motors stopped."""
    return (_presses_every(between(rng, 0.08, 0.25), between(rng, 2.5, 4.0)),)


def _presses_every(period_s: float, for_s: float) -> e.Operator:
    return e.Operator(tuple(round(float(t), 3) for t in np.arange(0.0, for_s, period_s)))


def hang_up(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Operator((0.0,), hang_up=True),)


def killed(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Killed(),)


def suspended(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Suspended(log_between(rng, 0.3, 5.0)),)


def hung(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Hung(lasting_s(rng, 0.3)),)


def slow(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Slow(between(rng, 0.1, 0.4), lasting_s(rng, 0.5)),)


def raises(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.Raises(),)


def hung_and_packet_lost(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    """The loop is stuck, and the first packets of what is sent in its place are lost."""
    order = ("raw", "stop", "land")[int(rng.integers(3))]
    return (*hung(rng, scenario), e.PacketLost(order, 1 if rng.uniform() < 0.6 else 2))


def together(*parts: Draw) -> Draw:
    """Faults that begin in the same moment."""
    return lambda rng, scenario: tuple(effect for part in parts for effect in part(rng, scenario))


def disk_full(rng: Rng, scenario: Scenario) -> tuple[e.Effect, ...]:
    return (e.DiskFull(lasting_s(rng)),)
