"""The profile's keys for the simulation: the ranges from which a seed's flight is drawn."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from perchctl.profile.base import Ordered, Range, Section, key

MarkerId = Annotated[int, Field(ge=0)]
Amounts = Ordered[Annotated[float, Field(ge=0)]]
Shares = Ordered[Annotated[float, Field(ge=0, le=1)]]
Tilts = Ordered[Annotated[float, Field(ge=0, le=20)]]
Ohms = Ordered[Annotated[float, Field(ge=0, le=1)]]
Charges = Ordered[Annotated[float, Field(ge=0.05, le=1)]]
Knees = Ordered[Annotated[float, Field(ge=0.01, le=0.9)]]
Losses = Ordered[Annotated[float, Field(ge=0, le=0.5)]]
Bursts = Ordered[Annotated[float, Field(ge=0.01, le=10)]]


class SimulationConfig(Section):
    """Ranges from which a seed draws one flight's conditions (`perchctl.sim.scenario`)."""

    start_offset_m: float = key(
        0.5, "largest offset of the start from the target, in x and in y", ge=0, le=5
    )
    target_yaw_deg: Range = key((-180.0, 180.0), "the target's heading")
    ceiling_z_m: Range = key((1.8, 2.6), "the ceiling's height above the floor")
    mass_kg: Range = key((0.038, 0.042), "all-up mass")
    battery_rest_v: Range = key((4.12, 4.2), "resting voltage at the start")
    camera_latency_s: Range = key((0.03, 0.12), "true latency")
    camera_jitter_s: float = key(0.008, "scatter of the latency, one sigma", ge=0, le=0.2)
    camera_rate_hz: float = key(30.0, "frame rate", gt=0, le=200)
    camera_drop_rate: float = key(0.1, "share of frames lost", ge=0, lt=1)
    camera_burst_frames: tuple[int, int] | None = key(
        (8, 20), "frames lost in one gap, once a flight"
    )
    camera_noise_sigma: Range = key((4.0, 8.0), "pixel noise, of 255")
    camera_exposure_s: float = key(0.008, "exposure time, which blurs motion", ge=0, le=0.05)
    camera_defocus_px: float = key(0.6, "sigma of the lens's blur", ge=0, le=10)
    camera_fields: Literal["progressive", "top", "bottom"] = key(
        "progressive", "`top`, `bottom`: interlaced, with this field first"
    )
    camera_readout_s: float = key(
        0.0, "rolling shutter: time from first to last row", ge=0, le=0.05
    )
    camera_flicker: float = key(0.0, "share of the light that flickers at 100 Hz", ge=0, le=1)
    camera_pumping: float = key(
        0.0, "largest relative error of a hunting exposure control", ge=0, le=0.9
    )
    camera_analogue: float = key(
        0.0, "trembling, torn and lost lines; at 1 the video is nearly lost", ge=0, le=1
    )
    camera_receiver_hz: float | None = key(
        None,
        "rate at which the receiver repeats its newest image; none: each image once",
        gt=0,
        le=200,
    )
    mount_error_deg: float = key(1.0, "largest rotation error of the profile's mount", ge=0, le=20)
    mount_error_m: float = key(
        0.001, "farthest that the true mount lies from the profile's", ge=0, le=0.05
    )
    estimate_noise_m: ClassVar[float] = 0.002
    """Noise of the state estimate."""
    estimate_tilt_bias_deg: float = key(0.3, "largest tilt bias of the state estimate", ge=0, le=10)
    drift_mps: float = key(0.01, "drift of the state estimate", ge=0, le=0.2)
    gyro_bias_dps: float = key(
        0.0, "largest gyroscope bias of each axis, without a deck", ge=0, le=5
    )
    acc_bias_g: float = key(
        0.0, "largest accelerometer bias of each level axis, without a deck", ge=0, le=0.2
    )
    draught_mps: Range = key((0.0, 0.3), "wind, with gusts")
    magnet_force_n: ClassVar[float] = 1.2  # share of the weight that the magnet holds
    first_contact_fails: float = key(
        0.1, "share of flights in which the first contact does not hold", ge=0, le=1
    )
    no_target: bool = key(False, "a bare ceiling")
    capture_delay_s: ClassVar[float] = 0.01
    """Time from a motion capture's exposure to arrival."""
    capture_noise_m: ClassVar[float] = 0.001
    """Standard deviation of a motion capture's position."""
    neighbours: tuple[tuple[float, float, float], ...] = key(
        (), "other targets: x and y (m) in the own target's axes, heading (deg)", max_length=8
    )
    neighbour_ids: tuple[MarkerId, MarkerId] | None = key(
        None, "ids of the neighbours' large and small markers; none: the own target's"
    )
    camera_burst_start_s: ClassVar[tuple[float, float]] = (4.0, 22.0)
    """Number of frames lost in succession."""
    first_contact_share: ClassVar[tuple[float, float]] = (0.0, 0.6)
    """Share of the weight that a first contact carries if it does not hold."""
    ceiling_suction: Shares = key(
        (0.1, 0.1), "share of thrust gained with the rotors at the ceiling"
    )
    cell_resistance_ohm: Ohms | None = key(
        (0.11, 0.23), "internal resistance; none: 0.143, a good cell's"
    )
    cell_slow_ohm: Ohms = key((0.0, 0.0), "further resistance of an old or cold cell, within 15 s")
    cell_charge: Charges = key((0.6, 1.0), "charge, as a share of a new cell's")
    cell_knee: Knees = key((0.1, 0.1), "share of charge left where its voltage drops")
    motor_spread: float = key(
        0.07, "standard deviation of the motors' strengths, as a share", ge=0, le=0.2
    )
    centre_of_mass_m: float = key(
        0.002, "farthest that the centre of mass lies from the middle, in x and in y", ge=0, le=0.01
    )
    thrust_scale: Range = key((0.95, 1.1), "thrust of all motors, as a share of the data sheet's")
    authority: Range = key(
        (0.55, 1.0), "angular acceleration for a torque, as a share of the data sheet's"
    )
    drag_nspm: Range = key((0.015, 0.0175), "level drag, N for each m/s of airspeed")
    airspeed_moment_nmspm: Range = key(
        (0.6e-3, 0.85e-3), "moment that lifts the nose in flight, N.m for each m/s of airspeed"
    )
    ground_effect: Shares = key((0.1, 0.18), "share of thrust gained on the floor")
    thrust_noise: Shares = key(
        (0.011, 0.022), "fluctuation of each motor's thrust within 20 ms, as a share"
    )
    acc_vibration_g: Range = key((0.005, 0.08), "vibration that the accelerometer reads")
    target_tilt_deg: Tilts = key((0.0, 0.0), "tilt of the target from the horizontal")
    radio_loss: Losses = key((0.0, 0.0), "share of the time in which no packet passes")
    radio_burst_s: Bursts = key((0.1, 0.1), "mean length of a radio gap")
    capture_hole_s: Amounts = key((0.0, 0.0), "length of a gap in motion capture")
    capture_hole_every_s: float = key(15.0, "mean time between capture gaps", gt=0, le=1000)
