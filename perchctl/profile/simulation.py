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
        0.5, "maximum offset of the start from the target, in x and in y", ge=0, le=5
    )
    target_yaw_deg: Range = key((-180.0, 180.0), "heading of the target")
    ceiling_z_m: Range = key((1.8, 2.6), "height of the ceiling above the floor")
    mass_kg: Range = key((0.038, 0.042), "all-up mass")
    battery_rest_v: Range = key((4.12, 4.2), "resting battery voltage at the start")
    camera_latency_s: Range = key((0.03, 0.12), "true camera latency")
    camera_jitter_s: float = key(0.008, "jitter of the latency, one sigma", ge=0, le=0.2)
    camera_rate_hz: float = key(30.0, "frame rate", gt=0, le=200)
    camera_drop_rate: float = key(0.1, "share of lost frames", ge=0, lt=1)
    camera_burst_frames: tuple[int, int] | None = key(
        (8, 20), "number of frames lost in a gap, once per flight"
    )
    camera_noise_sigma: Range = key((4.0, 8.0), "pixel noise, on a scale of 0 to 255")
    camera_exposure_s: float = key(0.008, "exposure time, which causes motion blur", ge=0, le=0.05)
    camera_defocus_px: float = key(0.6, "sigma of the lens blur", ge=0, le=10)
    camera_fields: Literal["progressive", "top", "bottom"] = key(
        "progressive", "scan type; `top` and `bottom`: interlaced, with this field first"
    )
    camera_readout_s: float = key(
        0.0, "rolling shutter: time from the first to the last row", ge=0, le=0.05
    )
    camera_flicker: float = key(0.0, "share of the light that flickers at 100 Hz", ge=0, le=1)
    camera_pumping: float = key(
        0.0, "maximum relative error of an automatic exposure that hunts", ge=0, le=0.9
    )
    camera_analogue: float = key(
        0.0,
        "amount of jittering, torn and lost lines in analogue video; at 1, the video is nearly "
        "lost",
        ge=0,
        le=1,
    )
    camera_receiver_hz: float | None = key(
        None,
        "rate at which the receiver repeats its newest image; none: it sends each image once",
        gt=0,
        le=200,
    )
    mount_error_deg: float = key(
        1.0, "maximum rotation error of the camera mount in the profile", ge=0, le=20
    )
    mount_error_m: float = key(
        0.001, "maximum position error of the camera mount in the profile", ge=0, le=0.05
    )
    estimate_noise_m: ClassVar[float] = 0.002
    """Noise of the state estimate."""
    estimate_tilt_bias_deg: float = key(0.3, "maximum tilt bias of the state estimate", ge=0, le=10)
    drift_mps: float = key(0.01, "drift of the state estimate", ge=0, le=0.2)
    gyro_bias_dps: float = key(
        0.0, "maximum gyroscope bias on each axis, if there is no deck", ge=0, le=5
    )
    acc_bias_g: float = key(
        0.0, "maximum accelerometer bias on each horizontal axis, if there is no deck", ge=0, le=0.2
    )
    draught_mps: Range = key((0.0, 0.3), "wind, with gusts")
    magnet_force_n: ClassVar[float] = 1.2  # holding force as a multiple of the weight
    first_contact_fails: float = key(
        0.1, "share of flights in which the magnet does not hold at the first contact", ge=0, le=1
    )
    no_target: bool = key(False, "simulate a bare ceiling")
    capture_delay_s: ClassVar[float] = 0.01
    """Time from a motion-capture exposure to the arrival of the frame, s."""
    capture_noise_m: ClassVar[float] = 0.001
    """Standard deviation of a motion-capture position, m."""
    neighbours: tuple[tuple[float, float, float], ...] = key(
        (),
        "other targets: x and y (m) in the axes of the vehicle's target, and heading (deg)",
        max_length=8,
    )
    neighbour_ids: tuple[MarkerId, MarkerId] | None = key(
        None, "ids of the neighbours' large and small markers; none: those of the vehicle's target"
    )
    camera_burst_start_s: ClassVar[tuple[float, float]] = (4.0, 22.0)
    """Range of the time at which the burst of lost frames begins, s."""
    first_contact_share: ClassVar[tuple[float, float]] = (0.0, 0.6)
    """Range of the magnet's holding force at a first contact that fails, as a share of the
    weight."""
    ceiling_suction: Shares = key(
        (0.1, 0.1), "relative increase in thrust with the rotors at the ceiling"
    )
    cell_resistance_ohm: Ohms | None = key(
        (0.11, 0.23), "internal resistance of the battery; none: 0.143, a good cell"
    )
    cell_slow_ohm: Ohms = key(
        (0.0, 0.0),
        "additional resistance of an old or cold cell, with a time constant of 15 s",
    )
    cell_charge: Charges = key((0.6, 1.0), "battery charge, as a fraction of a new cell's capacity")
    cell_knee: Knees = key(
        (0.1, 0.1), "remaining share of charge below which the voltage falls steeply"
    )
    motor_spread: float = key(
        0.07, "relative standard deviation of the motors' strengths", ge=0, le=0.2
    )
    centre_of_mass_m: float = key(
        0.002, "maximum offset of the centre of mass from the middle, in x and in y", ge=0, le=0.01
    )
    thrust_scale: Range = key((0.95, 1.1), "thrust of all motors, relative to the data sheet")
    authority: Range = key(
        (0.55, 1.0), "angular acceleration that a given torque produces, relative to the data sheet"
    )
    drag_nspm: Range = key((0.015, 0.0175), "horizontal drag, in N per m/s of airspeed")
    airspeed_moment_nmspm: Range = key(
        (0.6e-3, 0.85e-3), "nose-up pitching moment in flight, in N.m per m/s of airspeed"
    )
    ground_effect: Shares = key(
        (0.1, 0.18), "relative increase in thrust with the vehicle on the floor"
    )
    thrust_noise: Shares = key(
        (0.011, 0.022),
        "relative fluctuation of each motor's thrust, with a correlation time of 20 ms",
    )
    acc_vibration_g: Range = key((0.005, 0.08), "vibration in the accelerometer readings")
    target_tilt_deg: Tilts = key((0.0, 0.0), "tilt of the target from the horizontal")
    radio_loss: Losses = key((0.0, 0.0), "share of time during which no packet gets through")
    radio_burst_s: Bursts = key((0.1, 0.1), "mean duration of a radio gap")
    capture_hole_s: Amounts = key((0.0, 0.0), "duration of a motion-capture gap")
    capture_hole_every_s: float = key(15.0, "mean time between motion-capture gaps", gt=0, le=1000)
