"""The physics of one simulated flight: a rigid body, four motors, a room and a magnet.

Axes are those of `perchctl.geometry`: world x forward at the start, y left, z up,
origin on the floor under the start. One `World.step` is one `CONTROL_PERIOD_S`.

Assumptions of the model, each with its source:

- Motors, their battery, and the curve between a motor's voltage and its thrust:
  `perchctl.sim.powertrain`.
- Drag is linear in the airspeed, as 104 recorded flights confirm (R^2 = 0.98); horizontally it is
  `Scenario.drag_nspm`, vertically 0.008 N/(m/s) for four rotors that lift 42 g (identified by
  Foerster, ETH Zurich, 2015) and 0.001 for camera, board and gear.
- Airspeed tilts the vehicle away from its direction of flight, nose up in forward flight, by
  `Scenario.airspeed_moment_nmspm`.
- Near the floor the rotors lift more, by `Scenario.ground_effect`.
- A draught has a steady part and smooth gusts, which together reach its nominal speed when the
  gusts are at two standard deviations (`Wind`).
- The downwash of other vehicles in a fleet is `downwash_mps` (`perchctl.sim.downwash`).
- Near the ceiling, suction pulls the rotors towards it: at the ceiling itself, the force is their
  thrust times `Scenario.ceiling_suction`; 0.1 was measured on test benches with rotors of this size
  (Hsiao and Chirarattananon, arXiv 1905.04632).
- The magnet: `Magnet`. The gear's tip is a flat disc, so a vehicle held by the magnet hangs level,
  and friction keeps the tip in its place: dry friction, without creep under a steady push (MuJoCo's
  `noslip`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from perchctl.errors import no_simulator
from perchctl.geometry import GRAVITY_MPS2, Array, rotation_from_rpy
from perchctl.sim.powertrain import Powertrain
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

# MuJoCo is not used for drawing; its window library would start a process at each import.
os.environ.setdefault("MUJOCO_GL", "disable")

try:
    import mujoco
except ModuleNotFoundError as error:
    raise no_simulator(error.name) from None

ARM_M = 0.046  # hub to motor axis, X configuration
YAW_TORQUE_M = 0.006  # N.m of reaction per N of thrust
DRAG_VERTICAL_NSPM = 0.009
SUCTION_LENGTH_M = 0.02
GROUND_LENGTH_M = 0.035
"""Clearance over which the ground effect decreases by a factor of e, m."""
_SQRT_HALF = math.sqrt(0.5)
_WIND_EVERY = 10  # the wind is evaluated every 20 ms


Vector = tuple[float, float, float]


class World:
    """One vehicle in one room. Deterministic for a scenario.

    The attributes `x_m ... fz_mps2` are the state: position and velocity in world axes, rotation
    rates in body axes, `quaternion` (w, x, y, z) from body to world, and `fx_mps2 ... fz_mps2`, the
    readings of an ideal accelerometer in body axes (+g along z at rest).
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._model = build_model(scenario)
        self._data = mujoco.MjData(self._model)
        self._qpos, self._qvel = self._data.qpos, self._data.qvel
        self._floor, self._ceiling = (self._model.geom(n).id for n in ("floor", "ceiling"))
        self._suction = scenario.ceiling_suction
        self._air = scenario.airspeed_moment_nmspm, scenario.drag_nspm
        self._steps = 0
        self.powertrain = Powertrain(scenario)
        self._wind_mps = (0.0, 0.0, 0.0)
        self._wind = Wind(scenario)
        self.downwash_mps = 0.0  # downward wind from other vehicles
        self._hand: Callable[[World], None] | None = None
        self.magnet = Magnet(scenario)
        self.external_force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
        mujoco.mj_forward(self._model, self._data)
        self._read()
        self.set_acceleration(0.0, 0.0, 0.0)

    @property
    def t_s(self) -> float:
        return self._steps * CONTROL_PERIOD_S

    @property
    def height_m(self) -> float:
        """Height of the vehicle relative to its position when it is standing on the floor."""
        return float(self.z_m - REST_HEIGHT_M)

    @property
    def magnet_engaged(self) -> bool:
        """True if the magnet is holding the gear's tip."""
        return self.magnet.engaged

    @property
    def battery_v(self) -> float:
        """The battery's voltage under the present load."""
        return self.powertrain.cell.battery_v

    @property
    def battery_rest_v(self) -> float:
        return self.powertrain.cell.rest_v

    @battery_rest_v.setter
    def battery_rest_v(self, rest_v: float) -> None:
        self.powertrain.cell.set_rest_v(rest_v)

    def step(self, pwm: tuple[float, float, float, float]) -> None:
        """Advance by `CONTROL_PERIOD_S` with the duty cycles 0..65535 of M1..M4."""
        self._steps += 1
        f1, f2, f3, f4 = self.powertrain.step(pwm)
        if self._hand is not None:
            self._hand(self)
            return
        if self._steps % _WIND_EVERY == 1:
            self._wind_mps = self._wind.at(self.t_s)
            if self.downwash_mps:
                x_mps, y_mps, z_mps = self._wind_mps
                self._wind_mps = x_mps, y_mps, z_mps - self.downwash_mps
        thrust_n = f1 + f2 + f3 + f4
        height_m = self._scenario.ceiling_z_m - self.z_m
        if height_m < 0.2:
            thrust_n *= 1.0 + self._suction * math.exp(-max(height_m, 0.0) / SUCTION_LENGTH_M)
        if (clearance_m := self.height_m) < 0.2:
            lifts = self._scenario.ground_effect
            thrust_n *= 1.0 + lifts * math.exp(-max(clearance_m, 0.0) / GROUND_LENGTH_M)
        # M1 front right, M2 back right, M3 back left, M4 front left; M1 and M3 turn
        # counter-clockwise, so their reaction is clockwise.
        arm = ARM_M * _SQRT_HALF
        torque_x = arm * (f3 + f4 - f1 - f2)
        torque_y = arm * (f2 + f3 - f1 - f4)
        torque_z = YAW_TORQUE_M * (f2 + f4 - f1 - f3)
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = self._R
        wind = self._wind_mps
        air_x_mps, air_y_mps = self.vx_mps - wind[0], self.vy_mps - wind[1]
        moment_nmspm, drag_nspm = self._air
        torque_x += moment_nmspm * (r01 * air_x_mps + r11 * air_y_mps)
        torque_y -= moment_nmspm * (r00 * air_x_mps + r10 * air_y_mps)
        push = self.external_force_n
        force_x = thrust_n * r02 - drag_nspm * air_x_mps + push[0]
        force_y = thrust_n * r12 - drag_nspm * air_y_mps + push[1]
        force_z = thrust_n * r22 - DRAG_VERTICAL_NSPM * (self.vz_mps - wind[2]) + push[2]
        pull_n = self.magnet.pull_n(self.gear_tip_m(), upright=r22 > 0.0)
        if pull_n > 0.0:
            force_z += pull_n
            gx, gy, gz = self._scenario.gear_body_m
            torque_x += pull_n * (gy * r22 - gz * r21)
            torque_y += pull_n * (gz * r20 - gx * r22)
            torque_z += pull_n * (gx * r21 - gy * r20)
        self._data.qfrc_applied = (force_x, force_y, force_z, torque_x, torque_y, torque_z)
        vx, vy, vz = self.vx_mps, self.vy_mps, self.vz_mps
        mujoco.mj_step(self._model, self._data)
        self._read()
        rate = 1.0 / CONTROL_PERIOD_S
        self.set_acceleration(
            (self.vx_mps - vx) * rate, (self.vy_mps - vy) * rate, (self.vz_mps - vz) * rate
        )

    def gear_tip_m(self) -> tuple[float, float, float]:
        """The gear's tip (x, y, z) in world axes."""
        gx, gy, gz = self._scenario.gear_body_m
        rows = zip((self.x_m, self.y_m, self.z_m), self._R, strict=True)
        x, y, z = (place + a * gx + b * gy + c * gz for place, (a, b, c) in rows)
        return x, y, z

    def gear_miss_m(self) -> float:
        """The horizontal distance of the gear's tip from the target's centre."""
        tip = self.gear_tip_m()
        target = self.magnet.target_xy_m
        return math.hypot(tip[0] - target[0], tip[1] - target[1])

    def set_pose(
        self,
        position_m: tuple[float, float, float],
        rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0),
        hold: bool = False,
    ) -> None:
        """Put the vehicle into a pose with zero rotation rates; `hold` keeps it there until
        `let_go`.

        The gyroscope does not sense the change of pose.
        """
        self._hand = World._stay if hold else None
        self.set_state(position_m, rotation_from_rpy(*rpy_rad), velocity_mps, (0.0, 0.0, 0.0))

    def move_by_hand(self, hand: Callable[[World], None]) -> None:
        """Call `hand` every period to set the state of the held vehicle, until `let_go`."""
        self._hand = hand

    def let_go(self) -> None:
        """Release the vehicle from `set_pose(..., hold=True)` or `move_by_hand`."""
        self._hand = None

    def _stay(self) -> None:
        self.set_acceleration(0.0, 0.0, 0.0)

    def set_state(
        self,
        position_m: Sequence[float] | Array,
        R: Array,
        velocity_mps: Sequence[float] | Array,
        rates_radps: Sequence[float] | Array,
    ) -> None:
        """Set position and velocity, world axes, R_world_body (3, 3), and rates, body axes."""
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, R.ravel())
        self._data.qpos[:3] = position_m
        self._data.qpos[3:] = quaternion
        self._data.qvel[:3] = velocity_mps
        self._data.qvel[3:] = rates_radps
        mujoco.mj_forward(self._model, self._data)
        self._read()

    def _read(self) -> None:
        self.x_m, self.y_m, self.z_m, w, x, y, z = self._qpos.tolist()
        (self.vx_mps, self.vy_mps, self.vz_mps, self.p_radps, self.q_radps, self.r_radps) = (
            self._qvel.tolist()
        )
        self.quaternion = (w, x, y, z)
        self._R = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )

    def set_acceleration(self, ax: float, ay: float, az: float) -> None:
        """Set the accelerometer's reading from an acceleration in world axes, m/s^2."""
        az += GRAVITY_MPS2
        self.fx_mps2, self.fy_mps2, self.fz_mps2 = (
            a * ax + b * ay + c * az for a, b, c in zip(*self._R, strict=True)
        )

    def push_n_and_on_floor(self) -> tuple[float, bool]:
        """Return the contact force at the ceiling, N, and whether the vehicle touches the floor."""
        ceiling_n, floor = 0.0, False
        wrench = np.zeros(6)
        for i, pair in enumerate(self._data.contact.geom.tolist()):
            floor = floor or self._floor in pair
            if self._ceiling in pair:
                mujoco.mj_contactForce(self._model, self._data, i, wrench)
                ceiling_n += float(wrench[0])
        return ceiling_n, floor


# --- The rigid bodies as a MuJoCo model: floor, ceiling, and the vehicle with its gear ---


REST_HEIGHT_M = 0.012
# Crazyflie 2.1 at 27 g; scaled by mass.
INERTIA_REFERENCE_KG = 0.027
INERTIA_REFERENCE_KGM2 = (1.66e-5, 1.67e-5, 2.93e-5)

_MODEL = """
<mujoco>
  <option timestep="{dt}" gravity="0 0 -{g}" cone="elliptic" impratio="10" iterations="30"
    noslip_iterations="3"/>
  <default><geom solref="0.006 1" solimp="0.95 0.99 0.0005" friction="1 0.003 0.0005"
    condim="4"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="30 30 1"/>
    <geom name="ceiling" type="plane" size="30 30 1" pos="0 0 {room.ceiling_z_m}" quat="0 1 0 0"/>
    <body name="vehicle" pos="0 0 {rest}">
      <freejoint/>
      <inertial pos="{centre}" mass="{room.mass_kg}" diaginertia="{inertia}"/>
      <geom name="frame" type="box" size="0.035 0.035 {rest}"/>
      <geom name="gear" type="cylinder" size="0.006 0.002"
        pos="{room.gear_body_m[0]} {room.gear_body_m[1]} {gear_z}"/>
    </body>
  </worldbody>
</mujoco>
"""


def build_model(scenario: Scenario) -> Any:
    """A `mujoco.MjModel` with the geoms "floor", "ceiling", "frame" and "gear".

    The inertia is the Crazyflie 2.1's, scaled by mass and divided by the scenario's `authority`;
    the gear's cylinder ends at its tip.
    """
    scale = scenario.mass_kg / INERTIA_REFERENCE_KG / scenario.authority
    return mujoco.MjModel.from_xml_string(
        _MODEL.format(
            room=scenario,
            dt=CONTROL_PERIOD_S,
            g=GRAVITY_MPS2,
            rest=REST_HEIGHT_M,
            centre="{} {} 0".format(*scenario.centre_of_mass_m),
            inertia=" ".join(repr(i * scale) for i in INERTIA_REFERENCE_KGM2),
            gear_z=scenario.gear_body_m[2] - 0.002,
        )
    )


# --- The magnet: how it pulls the gear's tip towards the ceiling, and when it holds ---
# The magnet acts on an upright vehicle within `MAGNET_RADIUS_M` of the target's centre. Its force
# is full at contact and falls to zero over a gap of `MAGNET_RANGE_M`. The first contact may be
# weaker than the later ones (`Scenario.first_contact_force_n`); the first contact is over when the
# tip has engaged and come off again.


MAGNET_RADIUS_M = 0.025
MAGNET_RANGE_M = 0.003
MAGNET_TOUCH_M = 0.001


class Magnet:
    """One magnet gear under one ceiling, evaluated once per control period."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._came_off = False
        self.engaged = False
        self.target_xy_m = scenario.target_xy_m
        self.let_go = False  # the magnet has failed and no longer pulls

    def pull_n(self, tip_m: tuple[float, float, float], *, upright: bool) -> float:
        """Return the pull on the gear's tip at `tip_m`, world axes; 0 unless `upright`."""
        scenario = self._scenario
        gap_m = max(0.0, scenario.ceiling_z_m - tip_m[2])
        target_x, target_y = self.target_xy_m
        miss_m = math.hypot(tip_m[0] - target_x, tip_m[1] - target_y)
        if scenario.no_target or not upright or gap_m >= MAGNET_RANGE_M or miss_m > MAGNET_RADIUS_M:
            self._note(MAGNET_RANGE_M)
            return 0.0
        self._note(gap_m)
        return 0.0 if self.let_go else self.hold_n * (1.0 - gap_m / MAGNET_RANGE_M) ** 2

    @property
    def hold_n(self) -> float:
        """Return the force that separates magnet and gear; it may be smaller at the first
        contact."""
        scenario = self._scenario
        if scenario.first_contact_force_n is not None and not self._came_off:
            return scenario.first_contact_force_n
        return scenario.magnet_force_n

    def _note(self, gap_m: float) -> None:
        if gap_m < MAGNET_TOUCH_M:
            self.engaged = True
        elif self.engaged and gap_m > 2 * MAGNET_TOUCH_M:
            self.engaged = False
            self._came_off = True


# --- The air in the room: a draught with smooth gusts ---


_TERMS = 5
_SLOWEST_HZ, _FASTEST_HZ = 0.05, 1.0
_STEADY = 0.7  # share of the draught's speed that is steady
_SHARES = (0.15, 0.15, 0.1)  # standard deviation of the gusts relative to that speed: x, y, z
_WIND_STREAM = 1


class Wind:
    """A steady wind with gusts; the gusts are a sum of sines on each axis. The wind has the speed
    `Scenario.draught_mps` when the gusts are at two standard deviations."""

    def __init__(self, scenario: Scenario) -> None:
        x, y, z = scenario.draught_mps
        self._mean = (_STEADY * x, _STEADY * y, _STEADY * z)
        speed_mps = math.hypot(x, y, z)
        self._still = speed_mps == 0.0
        rng = np.random.default_rng([scenario.seed, _WIND_STREAM])
        self._gusts = []
        for share in _SHARES:
            amplitude = share * speed_mps * math.sqrt(2.0 / _TERMS)
            hz = np.exp(rng.uniform(math.log(_SLOWEST_HZ), math.log(_FASTEST_HZ), _TERMS))
            phases = rng.uniform(0.0, 2.0 * math.pi, _TERMS).tolist()
            terms = zip((2.0 * math.pi * hz).tolist(), phases, strict=True)
            self._gusts.append([(amplitude, w, phase) for w, phase in terms])

    def at(self, t_s: float) -> Vector:
        """The wind velocity at `t_s`, m/s, world axes; exactly zero in still air."""
        if self._still:
            return (0.0, 0.0, 0.0)
        x, y, z = (
            mean + sum(a * math.sin(w * t_s + phase) for a, w, phase in terms)
            for mean, terms in zip(self._mean, self._gusts, strict=True)
        )
        return x, y, z
