"""The physics of one simulated flight: a rigid body, four motors, a room and a magnet.

Axes are those of `perchctl.geometry`: world x forward at the start, y left, z up,
origin on the floor under the start. One `World.step` is one `CONTROL_PERIOD_S`.

Assumptions of the model, each with its source:

- 0.12 N a motor at full command with a fresh battery, thrust proportional to the
  command, because the firmware compensates for the battery (firmware facts, "Thrust
  budget"). What compensation cannot give back is the loss of `THRUST_LOSS_PER_V`:
  100 % at 4.2 V at rest, 95 % at 3.7 V.
- Drag is linear in the airspeed; a draught is a wind of the scenario's mean with
  smooth gusts of the same order.
- Near the ceiling the rotors pull themselves towards it (a few per cent of thrust).
- The magnet pulls the gear tip towards the ceiling within 25 mm of the target's
  centre. Its pull falls to zero over `MAGNET_RANGE_M`; the gear's tip is a flat disc,
  so a held vehicle hangs level and friction keeps the tip in its place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from perchctl.geometry import GRAVITY_MPS2, Array, rotation_from_rpy
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.wind import Wind

FULL_COMMAND = 65535.0
MOTOR_FORCE_N = 0.12
MOTOR_LAG_S = 0.05
ARM_M = 0.046  # hub to motor axis, X configuration
YAW_TORQUE_M = 0.006  # N.m of reaction per N of thrust
FRESH_BATTERY_V = 4.2
THRUST_LOSS_PER_V = 0.10
DRAG_LEVEL_NSPM = 0.025
DRAG_VERTICAL_NSPM = 0.012
FRAME_HALF_M = (0.035, 0.035, 0.012)
REST_HEIGHT_M = FRAME_HALF_M[2]
GEAR_RADIUS_M = 0.006
MAGNET_RADIUS_M = 0.025
MAGNET_RANGE_M = 0.003
MAGNET_TOUCH_M = 0.001
SUCTION_GAIN = 0.10
SUCTION_LENGTH_M = 0.02
# Crazyflie 2.1 at 27 g; scaled by mass.
INERTIA_REFERENCE_KG = 0.027
INERTIA_REFERENCE_KGM2 = (1.66e-5, 1.67e-5, 2.93e-5)
# A 250 mAh cell: about 4.4 A at full thrust, and what that does to its voltage.
MOTOR_CURRENT_A = 1.1
CELL_RESISTANCE_OHM = 0.11
CELL_CHARGE_C = 900.0
CELL_SLOPE_V = 0.8  # resting voltage lost over the whole charge
_SQRT_HALF = math.sqrt(0.5)
_WIND_EVERY = 10  # the wind is evaluated every 20 ms

_MODEL = """
<mujoco>
  <option timestep="{dt}" gravity="0 0 -{g}" cone="elliptic" impratio="10" iterations="30"/>
  <default><geom solref="0.006 1" solimp="0.95 0.99 0.0005" friction="1 0.003 0.0005"
    condim="4"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="30 30 1"/>
    <geom name="ceiling" type="plane" size="30 30 1" pos="0 0 {ceiling}" quat="0 1 0 0"/>
    <body name="vehicle" pos="0 0 {rest}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia}"/>
      <geom name="frame" type="box" size="{frame}"/>
      <geom name="gear" type="cylinder" size="{radius} 0.002" pos="{gear}"/>
    </body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class TrueState:
    """What is true now, SI.

    `position_m`, `velocity_mps` (3,) world; `R_world_body` (3, 3); `rates_radps` (3,)
    body; `specific_force_mps2` (3,) body, what an ideal accelerometer reads (+g along
    z at rest); `ceiling_force_n` the push between vehicle and ceiling, >= 0.
    """

    t_s: float
    position_m: Array
    velocity_mps: Array
    R_world_body: Array
    rates_radps: Array
    specific_force_mps2: Array
    ceiling_force_n: float
    floor_contact: bool
    magnet_engaged: bool


class World:
    """One vehicle in one room. Deterministic for a scenario.

    The plain-float attributes `x_m ... fz_mps2` are the state in the form the firmware
    model reads 500 times a second; `state()` is the same as arrays.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        mass = scenario.mass_kg
        scale = mass / INERTIA_REFERENCE_KG
        gear = scenario.gear_body_m
        self._model = mujoco.MjModel.from_xml_string(
            _MODEL.format(
                dt=CONTROL_PERIOD_S,
                g=GRAVITY_MPS2,
                ceiling=scenario.ceiling_z_m,
                rest=REST_HEIGHT_M,
                mass=mass,
                inertia=" ".join(repr(i * scale) for i in INERTIA_REFERENCE_KGM2),
                frame=" ".join(map(repr, FRAME_HALF_M)),
                radius=GEAR_RADIUS_M,
                gear=f"{gear[0]!r} {gear[1]!r} {gear[2] - 0.002!r}",
            )
        )
        self._data = mujoco.MjData(self._model)
        self._floor, self._ceiling = (self._model.geom(n).id for n in ("floor", "ceiling"))
        # Farther than this below the ceiling the gear cannot touch it.
        self._reach_m = math.dist(gear, (0.0, 0.0, 0.0)) + MAGNET_RANGE_M
        self._steps = 0
        self._forces_n = [0.0, 0.0, 0.0, 0.0]
        self._lag = 1.0 - math.exp(-CONTROL_PERIOD_S / MOTOR_LAG_S)
        self._wind_mps = (0.0, 0.0, 0.0)
        self._wind = Wind(scenario)
        self._held = False
        self._magnet_broken = False
        self.external_force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self.magnet_engaged = False
        self.battery_rest_v = scenario.battery_rest_v
        self.battery_v = scenario.battery_rest_v
        mujoco.mj_forward(self._model, self._data)
        self._read()
        self._set_specific_force(0.0, 0.0, 0.0)

    @property
    def t_s(self) -> float:
        return self._steps * CONTROL_PERIOD_S

    def step(self, motors: tuple[float, float, float, float]) -> None:
        """Advance by `CONTROL_PERIOD_S` under four motor commands 0..65535."""
        self._steps += 1
        self._drive(motors)
        if self._held:
            self._set_specific_force(0.0, 0.0, 0.0)
            return
        if self._steps % _WIND_EVERY == 1:
            self._wind_mps = self._wind.at(self.t_s)
        f1, f2, f3, f4 = self._forces_n
        thrust_n = f1 + f2 + f3 + f4
        height_m = self._scenario.ceiling_z_m - self.z_m
        if height_m < 0.2:
            thrust_n *= 1.0 + SUCTION_GAIN * math.exp(-max(height_m, 0.0) / SUCTION_LENGTH_M)
        # M1 front right, M2 back right, M3 back left, M4 front left; M1 and M3 turn
        # counter-clockwise, so their reaction is clockwise.
        arm = ARM_M * _SQRT_HALF
        torque_x = arm * (f3 + f4 - f1 - f2)
        torque_y = arm * (f2 + f3 - f1 - f4)
        torque_z = YAW_TORQUE_M * (f2 + f4 - f1 - f3)
        r02, r12, r22 = self._up
        r20, r21 = self._down_row
        wind = self._wind_mps
        push = self.external_force_n
        force_x = thrust_n * r02 - DRAG_LEVEL_NSPM * (self.vx_mps - wind[0]) + push[0]
        force_y = thrust_n * r12 - DRAG_LEVEL_NSPM * (self.vy_mps - wind[1]) + push[1]
        force_z = thrust_n * r22 - DRAG_VERTICAL_NSPM * (self.vz_mps - wind[2]) + push[2]
        pull_n = self._magnet_pull() if height_m < self._reach_m else self._far_from_magnet()
        if pull_n > 0.0:
            force_z += pull_n
            gx, gy, gz = self._scenario.gear_body_m
            torque_x += pull_n * (gy * r22 - gz * r21)
            torque_y += pull_n * (gz * r20 - gx * r22)
            torque_z += pull_n * (gx * r21 - gy * r20)
        self._data.qfrc_applied[:] = (force_x, force_y, force_z, torque_x, torque_y, torque_z)
        vx, vy, vz = self.vx_mps, self.vy_mps, self.vz_mps
        mujoco.mj_step(self._model, self._data)
        self._read()
        rate = 1.0 / CONTROL_PERIOD_S
        self._set_specific_force(
            (self.vx_mps - vx) * rate, (self.vy_mps - vy) * rate, (self.vz_mps - vz) * rate
        )

    def state(self) -> TrueState:
        """The true state as arrays."""
        ceiling_n, floor = self._contacts() if self._data.ncon else (0.0, False)
        vectors = np.array(
            (
                (self.x_m, self.y_m, self.z_m),
                (self.vx_mps, self.vy_mps, self.vz_mps),
                (self.p_radps, self.q_radps, self.r_radps),
                (self.fx_mps2, self.fy_mps2, self.fz_mps2),
            )
        )
        position, velocity, rates, force = vectors
        return TrueState(
            self.t_s,
            position,
            velocity,
            _rotation(self.quaternion),
            rates,
            force,
            ceiling_n,
            floor,
            self.magnet_engaged,
        )

    def gear_tip_m(self) -> tuple[float, float, float]:
        """The gear's tip in world axes."""
        w, x, y, z = self.quaternion
        gx, gy, gz = self._scenario.gear_body_m
        r02, r12, r22 = self._up
        r20, r21 = self._down_row
        return (
            self.x_m + (1 - 2 * (y * y + z * z)) * gx + 2 * (x * y - w * z) * gy + r02 * gz,
            self.y_m + 2 * (x * y + w * z) * gx + (1 - 2 * (x * x + z * z)) * gy + r12 * gz,
            self.z_m + r20 * gx + r21 * gy + r22 * gz,
        )

    def gear_miss_m(self) -> float:
        """Horizontal distance of the gear's tip from the target's centre."""
        tip = self.gear_tip_m()
        target = self._scenario.target_xy_m
        return math.hypot(tip[0] - target[0], tip[1] - target[1])

    def set_pose(
        self,
        position_m: tuple[float, float, float],
        rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0),
        hold: bool = False,
    ) -> None:
        """Put the vehicle somewhere, not turning; `hold` pins it there until `let_go`."""
        R = rotation_from_rpy(*rpy_rad)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, R.ravel())
        self._data.qpos[:3] = position_m
        self._data.qpos[3:] = quaternion
        self._data.qvel[:3] = velocity_mps
        self._data.qvel[3:] = 0.0
        self._held = hold
        mujoco.mj_forward(self._model, self._data)
        self._read()

    def let_go(self) -> None:
        """End what `set_pose(..., hold=True)` began."""
        self._held = False

    def _read(self) -> None:
        self.x_m, self.y_m, self.z_m, w, x, y, z = self._data.qpos.tolist()
        (self.vx_mps, self.vy_mps, self.vz_mps, self.p_radps, self.q_radps, self.r_radps) = (
            self._data.qvel.tolist()
        )
        self.quaternion = (w, x, y, z)
        self._up = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
        self._down_row = (2 * (x * z - w * y), 2 * (y * z + w * x))

    def _set_specific_force(self, ax: float, ay: float, az: float) -> None:
        w, x, y, z = self.quaternion
        az += GRAVITY_MPS2
        r20, r21 = self._down_row
        r02, r12, r22 = self._up
        self.fx_mps2 = (1 - 2 * (y * y + z * z)) * ax + 2 * (x * y + w * z) * ay + r20 * az
        self.fy_mps2 = 2 * (x * y - w * z) * ax + (1 - 2 * (x * x + z * z)) * ay + r21 * az
        self.fz_mps2 = r02 * ax + r12 * ay + r22 * az

    def _drive(self, motors: tuple[float, float, float, float]) -> None:
        loss = THRUST_LOSS_PER_V * (FRESH_BATTERY_V - self.battery_rest_v)
        unit_n = MOTOR_FORCE_N * (1.0 - loss) / FULL_COMMAND
        forces, lag = self._forces_n, self._lag
        current_a = 0.0
        for i in range(4):
            force = forces[i] + lag * (unit_n * motors[i] - forces[i])
            forces[i] = force
            share = force / MOTOR_FORCE_N
            current_a += share * math.sqrt(share) if share > 0.0 else 0.0
        current_a *= MOTOR_CURRENT_A
        spent = current_a * CONTROL_PERIOD_S / CELL_CHARGE_C
        self.battery_rest_v -= spent * CELL_SLOPE_V
        self.battery_v = self.battery_rest_v - CELL_RESISTANCE_OHM * current_a

    def _far_from_magnet(self) -> float:
        self._note_touch(MAGNET_RANGE_M)
        return 0.0

    def _magnet_pull(self) -> float:
        scenario = self._scenario
        if scenario.no_target:
            return 0.0
        tip = self.gear_tip_m()
        gap_m = max(0.0, scenario.ceiling_z_m - tip[2])
        miss = math.hypot(tip[0] - scenario.target_xy_m[0], tip[1] - scenario.target_xy_m[1])
        if gap_m >= MAGNET_RANGE_M or miss > MAGNET_RADIUS_M or self._up[2] <= 0.0:
            return self._far_from_magnet()
        self._note_touch(gap_m)
        first_n = scenario.first_contact_force_n
        hold_n = scenario.magnet_force_n
        if first_n is not None and not self._magnet_broken:
            hold_n = first_n
        return hold_n * (1.0 - gap_m / MAGNET_RANGE_M) ** 2

    def _note_touch(self, gap_m: float) -> None:
        if gap_m < MAGNET_TOUCH_M:
            self.magnet_engaged = True
        elif self.magnet_engaged and gap_m > 2 * MAGNET_TOUCH_M:
            self.magnet_engaged = False
            self._magnet_broken = True

    def _contacts(self) -> tuple[float, bool]:
        ceiling_n, floor = 0.0, False
        wrench = np.zeros(6)
        for i, pair in enumerate(self._data.contact.geom.tolist()):
            floor = floor or self._floor in pair
            if self._ceiling in pair:
                mujoco.mj_contactForce(self._model, self._data, i, wrench)
                ceiling_n += float(wrench[0])
        return ceiling_n, floor


def _rotation(quaternion: tuple[float, float, float, float]) -> Array:
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
