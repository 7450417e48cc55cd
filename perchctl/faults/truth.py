"""The true vehicle, sampled for the oracle while simulated time passes."""

from __future__ import annotations

import math
from collections.abc import Callable

from perchctl.faults.oracle import Sample
from perchctl.geometry import GRAVITY_MPS2
from perchctl.profile import TargetConfig
from perchctl.sim import (
    CONTROL_PERIOD_S,
    REST_HEIGHT_M,
    CaptureSettings,
    Scenario,
    SimulatedVehicle,
)
from perchctl.vehicle import LOCKED
from perchctl.vision import CameraModel

SAMPLE_S = 0.01
FULL_THRUST = 60000.0
"""The largest raw order, of 65,535 (docs/firmware.md, "Raw thrust"): it lifts whatever can fly."""
PRESSING_RATIO = 1.02
"""Rotors that lift more than this part of the weight press where something is in the way."""


class WatchedVehicle(SimulatedVehicle):
    """Calls `each` once every `SAMPLE_S`, whoever lets its time pass."""

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
    """What is true now of the vehicle; the rest of a sample is what it is held to."""
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
