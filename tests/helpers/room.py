"""One room with two vehicles, each under a target of its own, and what each link heard."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from perchctl.flight import fly_lockstep
from perchctl.geometry import Array, invert_T, make_T, rot_z, yaw_of
from perchctl.link import Packet, Port
from perchctl.profile import Profile
from perchctl.sim import Neighbour, Scenario, draw_scenario

COMMANDS = (Port.COMMANDER, Port.COMMANDER_GENERIC, Port.HIGH_LEVEL, Port.SUPERVISOR)
_POSITION = 7  # type of a setpoint


@dataclass(frozen=True)
class Pair:
    """Both vehicles' scenarios, each in the world of its own vehicle. `T_a_b` is the second
    target in the first one's axes."""

    scenarios: tuple[Scenario, Scenario]
    T_a_b: Array

    @property
    def starts_apart_m(self) -> float:
        """Between the places of take-off."""
        a, b = (_start_m(scenario) for scenario in self.scenarios)
        return float(np.linalg.norm(a[:2] - (self.T_a_b @ b)[:2]))


def pair(profile: Profile, seed: int, apart_m: float, **ids: int) -> Pair:
    """The room of that seed: two scenarios of the profile under one ceiling. `ids` are those
    of the other's markers in the first vehicle's picture (`Neighbour`)."""
    rng = np.random.default_rng([seed, 14])
    bearing_rad, turn_rad = (float(angle) for angle in rng.uniform(-math.pi, math.pi, 2))
    there_m = apart_m * np.array([math.cos(bearing_rad), math.sin(bearing_rad), 0.0])
    T_a_b = make_T(rot_z(turn_rad), there_m)
    a, b = (draw_scenario(profile, 2 * seed + k) for k in (0, 1))
    b = replace(b, ceiling_z_m=a.ceiling_z_m)
    sees_b, sees_a = (_neighbour(T, **ids) for T in (T_a_b, invert_T(T_a_b)))
    return Pair((replace(a, neighbours=(sees_b,)), replace(b, neighbours=(sees_a,))), T_a_b)


def _neighbour(T: Array, **ids: int) -> Neighbour:
    return Neighbour((float(T[0, 3]), float(T[1, 3])), yaw_of(T[:3, :3]), **ids)


def _start_m(scenario: Scenario) -> Array:
    """The place of take-off in the target's axes, homogeneous."""
    x, y = scenario.target_xy_m
    T_world_target = make_T(rot_z(scenario.target_yaw_rad), (x, y, 0.0))
    return np.asarray(invert_T(T_world_target) @ (0.0, 0.0, 0.0, 1.0))


def knowing(profile: Profile, scenario: Scenario) -> Profile:
    """The profile of somebody who has measured where the target hangs."""
    target = profile.target.model_copy(update={"expected_xy_m": scenario.target_xy_m})
    return profile.model_copy(update={"target": target})


@dataclass(frozen=True)
class Perch:
    """How a flight ended, by the truth."""

    seed: int
    outcome: str
    hanging: bool
    miss_m: float
    attempts: int
    log: Path


def fly_one(profile: Profile, scenario: Scenario, log: Path) -> Perch:
    """In lockstep; for a process of its own."""
    cv2.setNumThreads(1)
    flight = fly_lockstep(profile, log=log, scenario=scenario)
    report = flight.report
    return Perch(
        scenario.seed, report.outcome.value, flight.hanging, flight.miss_m, report.attempts, log
    )


@dataclass(frozen=True)
class Heard:
    """What reached a vehicle: who sent commands, and its position setpoints (n, 3), m."""

    commanders: frozenset[str]
    setpoints_m: Array


def heard(file: Path) -> Heard:
    """Of a simulated vehicle's `heard_file`."""
    commanders, setpoints = set(), []
    for line in file.read_text().splitlines():
        record = json.loads(line)
        packet = Packet.decode(bytes.fromhex(record["packet"]))
        if packet is None or packet.port not in COMMANDS:
            continue
        commanders.add(record["from"])
        generic = (packet.port, packet.channel) == (Port.COMMANDER_GENERIC, 0)
        if generic and packet.data[0] == _POSITION:
            setpoints.append(struct.unpack_from("<fff", packet.data, 1))
    return Heard(frozenset(commanders), np.array(setpoints).reshape(-1, 3))


def farthest_m(points: Array, others: Array) -> Array:
    """From each point (n, 3) to the nearest of the others (m, 3)."""
    return np.array([np.abs(others - point).max(axis=1).min() for point in points])
