"""The conditions of one simulated flight, how they are drawn from a profile's ranges with a seed,
and when its radio is silent."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perchctl.geometry import GRAVITY_MPS2, Array, make_T, rotation_from_rpy
from perchctl.profile import Profile, SimulationConfig
from perchctl.sim.airframe import CRAZYFLIE_21, Airframe

CONTROL_PERIOD_S = 0.002
"""Time step of the physics and of the firmware model, s (500 Hz)."""


@dataclass(frozen=True)
class Neighbour:
    """Another vehicle's target on the same ceiling.

    Attributes:
        xy_m: its centre in the axes of the vehicle's own target.
        yaw_rad: its heading minus that of the vehicle's own target.
        large_id, small_id: its markers' ids, in the dictionaries of the vehicle's own target; None:
            the same ids.
    """

    xy_m: tuple[float, float]
    yaw_rad: float = 0.0
    large_id: int | None = None
    small_id: int | None = None


@dataclass(frozen=True)
class Scenario:
    """Everything that can differ between two simulated flights, in SI units and the world frame.

    The world's origin is on the floor under the vehicle's start; its x axis points along the
    vehicle's heading there.

    The defaults are those of the trials in docs/firmware.md, in which the vehicle had four equal
    motors and less drag than a real one. A field with the same name as a key of
    `perchctl.profile.SimulationConfig` is the value drawn from that key's range.

    Attributes:
        target_xy_m, target_yaw_rad: centre and heading of the target.
        gear_body_m: true position of the magnet gear's tip in body axes.
        T_body_cam_true: rows of the camera's true pose, mounting error included.
        camera_mirrored: the camera flips its images left to right.
        drift_mps: drift of the state estimate, world axes.
        draught_mps: the wind with its smooth gusts (`perchctl.sim.world.Wind`).
        first_contact_force_n: pull at the first contact; None: `magnet_force_n`.
        camera_freeze_at_s: time after which the camera only repeats its last image; None: never.
        parameters: firmware parameters that differ from the release's at boot.
        gyro_bias_radps, acc_bias_mps2: biases in body axes, of the gyroscope after and of the
            accelerometer before the firmware's calibration on the ground; only for a vehicle
            without a deck (`perchctl.sim.firmware.outside`).
        target_above_ceiling_m: height of the target's plane above the surface that the gear meets.
        target_tilt_rad: the target's rotations about the world's x and y axes, after its heading.
        capture_holes_s: start and duration of each period in which motion capture does not see the
            vehicle.
        neighbours: other vehicles' targets on the same ceiling.
        motor_strength: thrust of M1..M4 at the same duty, as shares of the data sheet's. In steady
            flight, the strongest and the weakest motor of a recorded vehicle differ by 17 % of the
            mean (7 to 40).
        motors_brake: the motors slow down as fast as they speed up at any duty but 0, as recorded
            take-offs show (30 to 50 ms both ways); otherwise they coast whenever they slow down, as
            in the trials.
        centre_of_mass_m: x and y of the centre of mass, body axes; recorded vehicles flew as if
            their centre of mass were up to 2.4 mm off.
        authority: angular acceleration for a given torque, as a share of the data sheet's: the
            inertia is divided by it. Recorded flights show 0.54 (0.41 to 0.69) at 1 to 6 Hz.
            `thrust_noise` explains most of the reduction; the remainder is an assumption.
        drag_nspm: horizontal drag, N per m/s. In 104 recorded flights, it was 0.38 (0.36 to
            0.41) times the mass per second, which is 0.016 at 42 g.
        airspeed_moment_nmspm: moment that lifts the nose in forward flight, and the left side in
            flight to the left, N.m per m/s. In the same flights, the motors counteract 0.8e-3
            forward and 0.7e-3 sideways.
        ground_effect: share of thrust that the vehicle gains on the floor. Recorded take-offs of
            three vehicles needed 0.91 of the thrust with 0 to 3 cm of clearance, and 0.965 with 3
            to 7 cm.
        thrust_noise: standard deviation of each motor's thrust, as a share, with a correlation time
            of 20 ms. With 0.02 the body's rotation rates above 20 Hz are as large as in 49 recorded
            flights (0.43 deg/s in roll and pitch, 0.31 to 0.66), and a regression finds the same
            delay.
        acc_vibration_g: vibration that the running motors add to each axis of the accelerometer
            before its filter: 2.5 times the vibration above 8 Hz in a log, which was 0.003 and
            0.010 to 0.028 g.
        airframe: the kind of vehicle; current and resistance of its cell are those of a Crazyflie
            2.1, scaled per N of thrust.
    """

    seed: int = 0
    mass_kg: float = 0.042
    battery_rest_v: float = 4.15
    ceiling_z_m: float = 2.2
    target_xy_m: tuple[float, float] = (0.0, 0.0)
    target_yaw_rad: float = 0.0
    large_side_m: float = 0.150
    small_side_m: float = 0.025
    gear_body_m: tuple[float, float, float] = (0.0, 0.0, 0.03)
    T_body_cam_true: tuple[tuple[float, ...], ...] = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.01),
        (0.0, 0.0, 0.0, 1.0),
    )
    camera_rate_hz: float = 30.0
    camera_latency_s: float = 0.06
    camera_jitter_s: float = 0.008
    camera_drop_rate: float = 0.0
    camera_burst: tuple[float, int] | None = None  # (start s, number of lost frames)
    camera_noise_sigma: float = 5.0
    camera_exposure_s: float = 0.008
    camera_defocus_px: float = 0.6
    camera_fields: str = "progressive"
    camera_readout_s: float = 0.0
    camera_flicker: float = 0.0
    camera_pumping: float = 0.0
    camera_receiver_hz: float | None = None
    camera_mirrored: bool = False
    estimate_noise_m: float = 0.002
    estimate_tilt_bias_rad: tuple[float, float] = (0.0, 0.0)
    drift_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    draught_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    magnet_force_n: float = 1.2
    first_contact_force_n: float | None = None
    cell_resistance_ohm: float | None = None
    cell_slow_ohm: float = 0.0
    cell_charge: float = 1.0
    cell_knee: float = 0.1
    parameters: dict[str, float] = field(default_factory=dict)
    no_target: bool = False
    camera_freeze_at_s: float | None = None
    target_above_ceiling_m: float = 0.0
    neighbours: tuple[Neighbour, ...] = ()
    ceiling_suction: float = 0.10
    target_tilt_rad: tuple[float, float] = (0.0, 0.0)
    radio_loss: float = 0.0
    radio_burst_s: float = 0.1
    capture_holes_s: tuple[tuple[float, float], ...] = ()
    gyro_bias_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    acc_bias_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extra: dict[str, float] = field(default_factory=dict)
    motor_strength: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    motors_brake: bool = False
    centre_of_mass_m: tuple[float, float] = (0.0, 0.0)
    authority: float = 1.0
    drag_nspm: float = 0.009
    airspeed_moment_nmspm: float = 0.0
    ground_effect: float = 0.0
    thrust_noise: float = 0.0
    acc_vibration_g: float = 0.04
    airframe: Airframe = CRAZYFLIE_21

    def radio_bursts(self) -> RadioBursts | None:
        """Return the times at which the flight's radio is silent; None without losses."""
        return (
            RadioBursts(self.seed, self.radio_loss, self.radio_burst_s) if self.radio_loss else None
        )


# --- From a profile's ranges and a seed to a scenario ---


# Numbers of the random streams that are used only to draw a scenario.
_SCENARIO_STREAM = 1
_GROUPS_STREAM = 21
_IMU_BIAS_STREAM = 22
_VEHICLE_STREAM = 23
_DRAWN = ("ceiling_z_m", "mass_kg", "battery_rest_v", "camera_latency_s", "camera_noise_sigma")
"""Keys that each seed draws from their range, in this order."""
_AS_GIVEN = (
    "camera_rate_hz",
    "camera_jitter_s",
    "camera_drop_rate",
    "camera_exposure_s",
    "camera_defocus_px",
    "camera_fields",
    "camera_readout_s",
    "camera_flicker",
    "camera_pumping",
    "camera_receiver_hz",
    "estimate_noise_m",
    "magnet_force_n",
    "no_target",
)
"""Profile keys that have the same value for every seed."""
_LEAST_STRENGTH = 0.8
"""Smallest strength of a motor with which the vehicle still flies, as a share of the others'
strength."""
_LONGEST_S = 240.0
"""Upper limit for the duration of a simulated flight, s."""
_LEAST_GAP_S = 1.0


def draw_scenario(profile: Profile, seed: int) -> Scenario:
    """Return the seed's scenario. Values are drawn in a fixed order, so a new range at the end
    leaves a seed's earlier values unchanged. `_imu_errors`, `_groups` and `_vehicle` draw from
    separate random streams."""
    sim = profile.simulation
    rng = np.random.default_rng([seed, _SCENARIO_STREAM])

    def between(key: str) -> float:
        return float(rng.uniform(*getattr(sim, key)))

    x_m, y_m = rng.uniform(-sim.start_offset_m, sim.start_offset_m, size=2).tolist()
    yaw_rad = math.radians(between("target_yaw_deg"))
    drawn: dict[str, Any] = {key: between(key) for key in _DRAWN}
    burst_s, frames = between("camera_burst_start_s"), sim.camera_burst_frames or (0, 0)
    if frames[0] == frames[1]:
        # numpy draws nothing for a range with a single value, but later draws must not change
        rng.integers(2)
    burst = burst_s, int(rng.integers(frames[0], frames[1] + 1))
    T_body_cam = profile.camera.mount.T_body_cam @ _mounting_error(sim, rng)
    direction = rng.normal(size=3)
    drift_x, drift_y, drift_z = (direction / np.linalg.norm(direction) * sim.drift_mps).tolist()
    wind_angle = float(rng.uniform(-math.pi, math.pi))
    wind_mps = between("draught_mps")
    tilt_bias_rad = math.radians(sim.estimate_tilt_bias_deg)
    bias_x, bias_y = (rng.uniform(-1, 1, size=2) * tilt_bias_rad).tolist()
    fails = rng.uniform() < sim.first_contact_fails
    weak_part = between("first_contact_share")
    extra = {"analogue": sim.camera_analogue} if sim.camera_analogue else {}
    if not profile.positioning.source.is_deck:
        extra["external_position"] = 1.0  # such a vehicle has no deck
    return Scenario(
        seed=seed,
        target_xy_m=(x_m, y_m),
        target_yaw_rad=yaw_rad,
        large_side_m=profile.target.large.side_m,
        small_side_m=profile.target.small.side_m,
        gear_body_m=profile.vehicle.gear_body_m,
        T_body_cam_true=tuple(tuple(float(v) for v in row) for row in T_body_cam),
        camera_burst=None if sim.camera_burst_frames is None else burst,
        camera_mirrored=profile.camera.mirrored,
        estimate_tilt_bias_rad=(bias_x, bias_y),
        drift_mps=(drift_x, drift_y, drift_z),
        draught_mps=(wind_mps * math.cos(wind_angle), wind_mps * math.sin(wind_angle), 0.0),
        first_contact_force_n=weak_part * drawn["mass_kg"] * 9.81 if fails else None,
        **_imu_errors(sim, seed),
        **drawn,
        **{name: getattr(sim, name) for name in _AS_GIVEN},
        extra=extra,
        neighbours=tuple(
            Neighbour((x_m, y_m), math.radians(yaw_deg), *(sim.neighbour_ids or ()))
            for x_m, y_m, yaw_deg in sim.neighbours
        ),
        **_groups(sim, seed),
        **_vehicle(sim, seed),
    )


def _mounting_error(sim: SimulationConfig, rng: np.random.Generator) -> Array:
    """Return a rotation and shift of the camera that the profile does not contain, up to
    `mount_error_deg` and `mount_error_m`."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turn = axis * math.radians(rng.uniform(0, sim.mount_error_deg))
    way = rng.normal(size=3)
    way *= rng.uniform(0, sim.mount_error_m) / np.linalg.norm(way)
    return make_T(rotation_from_rpy(*(float(a) for a in turn)), way)


def _imu_errors(sim: SimulationConfig, seed: int) -> dict[str, Any]:
    """Return the biases of gyroscope and accelerometer; none along the accelerometer's z, which the
    firmware's scale corrects."""
    rng = np.random.default_rng([seed, _IMU_BIAS_STREAM])
    p, q, r = (math.radians(sim.gyro_bias_dps) * rng.uniform(-1.0, 1.0, size=3)).tolist()
    x, y = (GRAVITY_MPS2 * sim.acc_bias_g * rng.uniform(-1.0, 1.0, size=2)).tolist()
    return {"gyro_bias_radps": (p, q, r), "acc_bias_mps2": (x, y, 0.0)}


def _groups(sim: SimulationConfig, seed: int) -> dict[str, Any]:
    air, cell, tilt, radio, capture = (
        np.random.default_rng([seed, _GROUPS_STREAM, group]) for group in (0, 1, 2, 6, 7)
    )
    ohm = sim.cell_resistance_ohm
    return {
        "ceiling_suction": float(air.uniform(*sim.ceiling_suction)),
        "cell_resistance_ohm": None if ohm is None else float(cell.uniform(*ohm)),
        "cell_slow_ohm": float(cell.uniform(*sim.cell_slow_ohm)),
        "cell_charge": float(cell.uniform(*sim.cell_charge)),
        "cell_knee": float(cell.uniform(*sim.cell_knee)),
        "target_tilt_rad": _tilt(sim, tilt),
        "radio_loss": float(radio.uniform(*sim.radio_loss)),
        "radio_burst_s": float(radio.uniform(*sim.radio_burst_s)),
        "capture_holes_s": _capture_holes(sim, capture),
    }


def _vehicle(sim: SimulationConfig, seed: int) -> dict[str, Any]:
    """Return the differences between vehicles of one kind, each drawn from its own random
    stream."""
    motors, mass, authority, thrust, vibration, air = (
        np.random.default_rng([seed, _VEHICLE_STREAM, part]) for part in range(6)
    )
    scale = motors.uniform(*sim.thrust_scale)
    strength = scale * (1.0 + sim.motor_spread * motors.standard_normal(4))
    m1, m2, m3, m4 = np.maximum(strength, _LEAST_STRENGTH * scale).tolist()
    x_m, y_m = (sim.centre_of_mass_m * mass.uniform(-1.0, 1.0, size=2)).tolist()
    return {
        "motor_strength": (m1, m2, m3, m4),
        "motors_brake": True,
        "centre_of_mass_m": (x_m, y_m),
        "authority": float(authority.uniform(*sim.authority)),
        "drag_nspm": float(air.uniform(*sim.drag_nspm)),
        "airspeed_moment_nmspm": float(air.uniform(*sim.airspeed_moment_nmspm)),
        "ground_effect": float(air.uniform(*sim.ground_effect)),
        "thrust_noise": _log_uniform(thrust, sim.thrust_noise),
        "acc_vibration_g": _log_uniform(vibration, sim.acc_vibration_g),
    }


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """Draw a value whose logarithm is uniformly distributed: recorded vehicles differ by a factor
    of ten."""
    low, high = bounds
    part = float(rng.uniform())
    return low if low <= 0.0 else low * (high / low) ** part


def _tilt(sim: SimulationConfig, rng: np.random.Generator) -> tuple[float, float]:
    tilt_rad = math.radians(float(rng.uniform(*sim.target_tilt_deg)))
    towards_rad = math.radians(float(rng.uniform(-180.0, 180.0)))
    if not tilt_rad:
        return (0.0, 0.0)
    # A target that is higher on the +x side is rotated about -y; one that is higher on the +y side,
    # about x.
    return (tilt_rad * math.sin(towards_rad), -tilt_rad * math.cos(towards_rad))


def _capture_holes(
    sim: SimulationConfig, rng: np.random.Generator
) -> tuple[tuple[float, float], ...]:
    if not sim.capture_hole_s[1]:
        return ()
    holes, t_s = [], 0.0
    while (t_s := t_s + float(rng.exponential(sim.capture_hole_every_s))) < _LONGEST_S:
        length_s = float(rng.uniform(*sim.capture_hole_s))
        holes.append((t_s, length_s))
        t_s += length_s + _LEAST_GAP_S
    return tuple(holes)


# --- A radio that loses packets in bursts: all packets are lost for a while, then none ---


_BURSTS_STREAM = 14
CONNECTED_S = 4.0
"""Time before which nothing is lost, s: packets sent before take-off are repeated until they are
answered."""


class RadioBursts:
    """Gilbert's two-state channel in continuous time: the lengths of good and bad periods are
    exponentially distributed and do not depend on the packet rate. Packets in both directions are
    lost together. The times passed to `is_lost` must not decrease. The same seed gives the same
    bursts.

    Args:
        share: share of the time in which packets are lost, above 0 and below 1.
        mean_s: mean length of a burst, s.
    """

    def __init__(self, seed: int, share: float, mean_s: float) -> None:
        self._rng = np.random.default_rng([seed, _BURSTS_STREAM])
        self._bad_s = mean_s
        self._good_s = mean_s * (1.0 - share) / share
        self._bad = False
        self._until_s = CONNECTED_S + float(self._rng.exponential(self._good_s))

    def is_lost(self, t_s: float) -> bool:
        """True if a packet sent at that time is lost."""
        while t_s >= self._until_s:
            self._bad = not self._bad
            mean_s = self._bad_s if self._bad else self._good_s
            self._until_s += float(self._rng.exponential(mean_s))
        return self._bad
