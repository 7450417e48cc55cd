"""From a profile's ranges and a seed to one flight's `Scenario`.

What harder worlds draw beyond that of `sim` comes in groups, each from a random stream of its
own, so that no other value of a seed moves.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from perchctl.geometry import GRAVITY_MPS2, Array, make_T, rotation_from_rpy
from perchctl.profile import Profile, SimulationConfig
from perchctl.sim.capture import CaptureFault, CaptureSettings
from perchctl.sim.scenario import Neighbour, Scenario

_STREAM, _GROUPS_STREAM, _IMU_STREAM = 1, 21, 22  # the scenario's own random streams
_AIR, _CELL, _TILT, _RADIO, _CAPTURE = 0, 1, 2, 6, 7
_LONGEST_S = 240.0
"""No simulated flight lasts longer."""
_LEAST_GAP_S = 1.0


def draw_scenario(profile: Profile, seed: int) -> Scenario:
    """The scenario of that seed. Every value is drawn in a fixed order, so adding a
    range at the end leaves the earlier ones of a seed as they were; the groups of harder
    worlds come from other streams."""
    sim = profile.simulation
    rng = np.random.default_rng([seed, _STREAM])

    def between(key: str) -> float:
        return float(rng.uniform(*getattr(sim, key)))

    def direction() -> Array:
        vector = rng.normal(size=3)
        return np.asarray(vector / np.linalg.norm(vector))

    offset = rng.uniform(-sim.start_offset_m, sim.start_offset_m, size=2)
    target_xy_m = (float(offset[0]), float(offset[1]))
    yaw_rad = math.radians(between("target_yaw_deg"))
    ceiling_z_m = between("ceiling_z_m")
    mass_kg = between("mass_kg")
    battery_v = between("battery_rest_v")
    latency_s = between("camera_latency_s")
    noise_sigma = between("camera_noise_sigma")
    burst = _burst(sim, rng, between("camera_burst_start_s"))
    T_body_cam = profile.camera.mount.T_body_cam @ _mounting_error(profile, rng)
    drift_x, drift_y, drift_z = (direction() * sim.drift_mps).tolist()
    wind_angle = float(rng.uniform(-math.pi, math.pi))
    wind_mps = between("draught_mps")
    tilt_bias_rad = math.radians(sim.estimate_tilt_bias_deg)
    bias_x, bias_y = (rng.uniform(-1, 1, size=2) * tilt_bias_rad).tolist()
    fails = rng.uniform() < sim.first_contact_fails
    weak_part = between("first_contact_share")
    return Scenario(
        seed=seed,
        mass_kg=mass_kg,
        battery_rest_v=battery_v,
        ceiling_z_m=ceiling_z_m,
        target_xy_m=target_xy_m,
        target_yaw_rad=yaw_rad,
        large_side_m=profile.target.large.side_m,
        small_side_m=profile.target.small.side_m,
        gear_body_m=profile.vehicle.gear_body_m,
        T_body_cam_true=tuple(tuple(float(v) for v in row) for row in T_body_cam),
        camera_latency_s=latency_s,
        camera_burst=burst,
        camera_noise_sigma=noise_sigma,
        camera_mirrored=profile.camera.mirrored,
        estimate_noise_m=sim.estimate_noise_m,
        magnet_force_n=sim.magnet_force_n,
        no_target=sim.no_target,
        camera_rate_hz=sim.camera_rate_hz,
        camera_jitter_s=sim.camera_jitter_s,
        camera_drop_rate=sim.camera_drop_rate,
        camera_exposure_s=sim.camera_exposure_s,
        camera_defocus_px=sim.camera_defocus_px,
        camera_fields=sim.camera_fields,
        camera_blended=sim.camera_blended,
        camera_readout_s=sim.camera_readout_s,
        camera_flicker=sim.camera_flicker,
        camera_pumping=sim.camera_pumping,
        camera_receiver_hz=sim.camera_receiver_hz,
        camera_receiver_noise=sim.camera_receiver_noise,
        camera_blank_rate=sim.camera_blank_rate,
        estimate_tilt_bias_rad=(bias_x, bias_y),
        drift_mps=(drift_x, drift_y, drift_z),
        draught_mps=(wind_mps * math.cos(wind_angle), wind_mps * math.sin(wind_angle), 0.0),
        first_contact_force_n=weak_part * mass_kg * 9.81 if fails else None,
        **_imu_errors(sim, seed),
        extra=_extra(profile),
        neighbours=_neighbours(sim),
        **_groups(sim, seed),
    )


def _burst(
    sim: SimulationConfig, rng: np.random.Generator, start_s: float
) -> tuple[float, int] | None:
    """Start and number of the frames that are lost in one go."""
    low, high = sim.camera_burst_frames or (0, 0)
    if low == high:
        rng.integers(2)  # numpy draws none of one number, and what comes later must stay
    frames = int(rng.integers(low, high + 1))
    return None if sim.camera_burst_frames is None else (start_s, frames)


def _neighbours(sim: SimulationConfig) -> tuple[Neighbour, ...]:
    large_id, small_id = sim.neighbour_ids or (None, None)
    return tuple(
        Neighbour((x_m, y_m), math.radians(yaw_deg), large_id, small_id)
        for x_m, y_m, yaw_deg in sim.neighbours
    )


def _imu_errors(sim: SimulationConfig, seed: int) -> dict[str, Any]:
    """Biases of gyroscope and accelerometer; the latter has none along z, where the firmware's
    scale would take it out."""
    rng = np.random.default_rng([seed, _IMU_STREAM])
    p, q, r = (math.radians(sim.gyro_bias_dps) * rng.uniform(-1.0, 1.0, size=3)).tolist()
    x, y = (GRAVITY_MPS2 * sim.acc_bias_g * rng.uniform(-1.0, 1.0, size=2)).tolist()
    return {"gyro_bias_radps": (p, q, r), "acc_bias_mps2": (x, y, 0.0)}


def draw_capture(profile: Profile, seed: int) -> CaptureSettings | None:
    """The motion capture of that seed's flight; None where the vehicle's decks do it."""
    config, sim = profile.positioning, profile.simulation
    if config.by != "mocap":
        return None
    roll, pitch, yaw = (math.radians(angle) for angle in config.body_rpy_deg)
    holes = draw_scenario(profile, seed).capture_holes_s
    hidden = CaptureFault(occluded=True)
    return CaptureSettings(
        body=config.body,
        body_rpy_rad=(roll, pitch, yaw),
        body_position_m=config.body_position_m,
        delay_s=sim.capture_delay_s,
        position_noise_m=sim.capture_noise_m,
        faults=tuple((begin_s, begin_s + length_s, hidden) for begin_s, length_s in holes),
        seed=seed,
    )


def _extra(profile: Profile) -> dict[str, float]:
    extra = {}
    if profile.simulation.camera_analogue:
        extra["analogue"] = profile.simulation.camera_analogue
    if profile.positioning.by != "deck":
        extra["external_position"] = 1.0  # and no deck
    return extra


def _mounting_error(profile: Profile, rng: np.random.Generator) -> Array:
    """A turn and a shift that the profile lacks: up to `mount_error_deg` and `mount_error_m`."""
    sim = profile.simulation
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turn = axis * math.radians(rng.uniform(0, sim.mount_error_deg))
    way = rng.normal(size=3)
    way *= rng.uniform(0, sim.mount_error_m) / np.linalg.norm(way)
    return make_T(rotation_from_rpy(*(float(a) for a in turn)), way)


# --- What harder worlds draw beyond that ---------------------------------------------------------


def _groups(sim: SimulationConfig, seed: int) -> dict[str, Any]:
    """Fields of the scenario. Where the ranges are those of `sim`, its defaults."""
    air, cell, tilt, radio, capture = (
        _Draws(seed, group) for group in (_AIR, _CELL, _TILT, _RADIO, _CAPTURE)
    )
    ohm = sim.cell_resistance_ohm
    return {
        "ceiling_suction": air.between(sim.ceiling_suction),
        "cell_resistance_ohm": None if ohm is None else cell.between(ohm),
        "cell_slow_ohm": cell.between(sim.cell_slow_ohm),
        "cell_charge": cell.between(sim.cell_charge),
        "cell_knee": cell.between(sim.cell_knee),
        "target_tilt_rad": _tilt(sim, tilt),
        "radio_loss": radio.between(sim.radio_loss),
        "radio_burst_s": radio.between(sim.radio_burst_s),
        "capture_holes_s": _capture_holes(sim, capture),
    }


class _Draws:
    """One group's random numbers."""

    def __init__(self, seed: int, group: int) -> None:
        self.rng = np.random.default_rng([seed, _GROUPS_STREAM, group])

    def between(self, bounds: tuple[float, float]) -> float:
        return float(self.rng.uniform(*bounds))

    def angle_rad(self, bounds_deg: tuple[float, float] = (-180.0, 180.0)) -> float:
        return math.radians(self.between(bounds_deg))


def _tilt(sim: SimulationConfig, draws: _Draws) -> tuple[float, float]:
    """The target's turns about the world's x and y."""
    tilt_rad = draws.angle_rad(sim.target_tilt_deg)
    towards_rad = draws.angle_rad()
    if not tilt_rad:
        return (0.0, 0.0)
    # Lifted on the side of +x is a turn about -y, on that of +y one about x.
    return (tilt_rad * math.sin(towards_rad), -tilt_rad * math.cos(towards_rad))


def _capture_holes(sim: SimulationConfig, draws: _Draws) -> tuple[tuple[float, float], ...]:
    """Begin and length of each."""
    if not sim.capture_hole_s[1]:
        return ()
    holes, t_s = [], 0.0
    while (t_s := t_s + float(draws.rng.exponential(sim.capture_hole_every_s))) < _LONGEST_S:
        length_s = draws.between(sim.capture_hole_s)
        holes.append((t_s, length_s))
        t_s += length_s + _LEAST_GAP_S
    return tuple(holes)
