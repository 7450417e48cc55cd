"""One simulated flight's conditions, drawn from ranges by a seed."""

from __future__ import annotations

from dataclasses import dataclass, field

CONTROL_PERIOD_S = 0.002
"""Step of the physics and of the firmware model (500 Hz)."""


@dataclass(frozen=True)
class Neighbour:
    """Another vehicle's target on the same ceiling.

    Attributes:
        xy_m: its centre in the own target's axes.
        yaw_rad: its heading less the own target's.
        large_id, small_id: its markers', in the own ones' dictionaries; None: the same.
    """

    xy_m: tuple[float, float]
    yaw_rad: float = 0.0
    large_id: int | None = None
    small_id: int | None = None


@dataclass(frozen=True)
class Scenario:
    """Everything that differs between two simulated flights; SI, world frame.

    World origin: the floor under the place where the vehicle starts; its state
    estimate starts there with heading zero *in the estimate's frame*, so
    `start_yaw_rad` turns the target instead: target_* are given in that frame.

    Attributes:
        mass_kg: all-up mass.
        battery_rest_v: resting voltage at the start.
        ceiling_z_m: height of the ceiling's underside over the floor.
        target_xy_m, target_yaw_rad: centre and heading of the target.
        gear_body_m: tip of the magnet gear in body axes (its truth).
        T_body_cam_true: rows of the camera's true pose, mounting error included.
        camera_*: what the camera and its radio do to the frames.
        camera_fields: "progressive", or interlaced with the field of the "top" or the
            "bottom" row first, half a period before the other; camera_blended: averaged
            by a converter.
        camera_readout_s: from a picture's (or field's) first row to its last.
        camera_flicker, camera_pumping: share by which lamps (100 Hz) and an exposure control
            that hunts change the brightness.
        camera_receiver_hz: of the receiver's output, where it gives out its newest picture
            again and again, with `camera_receiver_noise` on it each time; None: it does not.
        camera_blank_rate: share of pictures that are a blue screen.
        camera_mirrored: it gives its pictures flipped left to right.
        drift_mps: drift of the state estimate, world axes.
        draught_mps: the wind with its smooth gusts (`perchctl.sim.world.Wind`).
        ceiling_suction: share of thrust gained with the rotors' plane at the ceiling.
        magnet_force_n: pull the magnet can hold.
        first_contact_force_n: pull at the first contact; None means the same.
        no_target: the ceiling is bare.
        camera_freeze_at_s, camera_gone_at_s: faults; None means never.
        motor_strength: what is left of each motor's thrust, M1..M4.
        cell_resistance_ohm: of the battery; None means a good one.
        cell_slow_ohm: more of it, that an old or cold cell shows within seconds.
        cell_charge: what an old cell still holds, as a share of a new one's.
        cell_knee: the share of its charge below which its voltage falls steeply.
        rssi_dbm: of the radio, at the vehicle.
        parameters: the firmware's, where they differ from its release at boot.
        gyro_bias_radps, acc_bias_mps2: what the gyroscope, after the firmware has taken out what it
            found on the ground, and the accelerometer, before the firmware scales it to 1 g, read
            too much; body axes, of a vehicle without a deck (`perchctl.sim.firmware.outside`).
        target_above_ceiling_m: the target's plane lies so far above what the gear meets.
        target_tilt_rad: the target's turns about the world's x and y, after its heading.
        radio_loss, radio_burst_s: share of the time in which no packet passes, and how long
            such a time lasts on average (`perchctl.sim.bursts`).
        capture_holes_s: begin and length of the times in which a motion capture does not see
            the vehicle.
        neighbours: other vehicles' targets. What these vehicles do to the air is in the draught.
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
    camera_blended: bool = False
    camera_readout_s: float = 0.0
    camera_flicker: float = 0.0
    camera_pumping: float = 0.0
    camera_receiver_hz: float | None = None
    camera_receiver_noise: float = 0.0
    camera_blank_rate: float = 0.0
    camera_mirrored: bool = False
    estimate_noise_m: float = 0.002
    estimate_tilt_bias_rad: tuple[float, float] = (0.0, 0.0)
    drift_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    draught_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    magnet_force_n: float = 1.2
    first_contact_force_n: float | None = None
    motor_strength: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    cell_resistance_ohm: float | None = None
    cell_slow_ohm: float = 0.0
    cell_charge: float = 1.0
    cell_knee: float = 0.1
    rssi_dbm: float = -40.0
    parameters: dict[str, float] = field(default_factory=dict)
    no_target: bool = False
    camera_freeze_at_s: float | None = None
    camera_gone_at_s: float | None = None
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
