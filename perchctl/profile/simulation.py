"""The profile's keys of the simulation: what a seed's flight is drawn from."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from perchctl.profile.base import Range, Section

MarkerId = Annotated[int, Field(ge=0)]


class SimulationConfig(Section):
    """Ranges from which a seed draws one flight's conditions (`perchctl.sim.draw`)."""

    start_offset_m: float = Field(
        0.5, ge=0, le=5, description="start under the target, at most so far aside in x and in y"
    )
    target_yaw_deg: Range = Field((-180.0, 180.0), description="the target's heading")
    ceiling_z_m: Range = Field((1.8, 2.6), description="over the floor")
    mass_kg: Range = Field((0.038, 0.042), description="all-up")
    battery_rest_v: Range = Field((3.85, 4.2), description="at the start")
    camera_latency_s: Range = Field((0.03, 0.12), description="the true one")
    camera_jitter_s: float = Field(0.008, ge=0, le=0.2, description="of the latency, one sigma")
    camera_rate_hz: float = Field(30.0, gt=0, le=200, description="frames")
    camera_drop_rate: float = Field(0.1, ge=0, lt=1, description="share of frames lost")
    camera_burst_frames: tuple[int, int] | None = Field(
        (8, 20), description="frames lost in one go, once a flight"
    )
    camera_noise_sigma: Range = Field((4.0, 8.0), description="of 255")
    camera_exposure_s: float = Field(0.008, ge=0, le=0.05, description="motion blur")
    camera_defocus_px: float = Field(0.6, ge=0, le=10, description="sigma of the lens's blur")
    camera_fields: Literal["progressive", "top", "bottom"] = Field(
        "progressive", description="interlaced: which row's field comes first"
    )
    camera_blended: bool = Field(
        False, description="the two fields averaged, as some converters do"
    )
    camera_readout_s: float = Field(
        0.0, ge=0, le=0.05, description="rolling shutter: from the first row to the last"
    )
    camera_flicker: float = Field(
        0.0, ge=0, le=1, description="share of the light that comes and goes 100 times a second"
    )
    camera_pumping: float = Field(
        0.0, ge=0, le=0.9, description="share by which an exposure control that hunts is off"
    )
    camera_analogue: float = Field(
        0.0, ge=0, le=1, description="trembling, torn and lost lines; 1 is about to be lost"
    )
    camera_receiver_hz: float | None = Field(
        None,
        gt=0,
        le=200,
        description="the receiver's own rate, at which it gives out its newest picture again; "
        "none: each once, as it comes",
    )
    camera_receiver_noise: float = Field(
        0.0, ge=0, le=50, description="that the receiver adds each time; of 255, one sigma"
    )
    camera_blank_rate: float = Field(
        0.0, ge=0, lt=1, description="share of pictures in whose place the screen is blue"
    )
    mount_error_deg: float = Field(
        1.0, ge=0, le=20, description="what the profile's mount is wrong by, at most"
    )
    mount_error_m: float = Field(
        0.001, ge=0, le=0.05, description="what the profile's mount is wrong by, at most"
    )
    estimate_noise_m: float = Field(0.002, ge=0, le=0.2, description="of the state estimate")
    estimate_tilt_bias_deg: float = Field(
        0.3, ge=0, le=10, description="of the state estimate, at most"
    )
    drift_mps: float = Field(0.01, ge=0, le=0.2, description="of the state estimate")
    draught_mps: Range = Field((0.0, 0.3), description="wind, with gusts")
    magnet_force_n: float = Field(1.2, ge=0, le=20, description="that the magnet holds")
    first_contact_fails: float = Field(
        0.1, ge=0, le=1, description="share of flights in which the first contact does not hold"
    )
    no_target: bool = Field(False, description="a bare ceiling")
    capture_delay_s: float = Field(
        0.01, ge=0, le=1, description="motion capture: from exposure to arrival"
    )
    capture_noise_m: float = Field(
        0.001, gt=0, le=0.1, description="motion capture: of a position, one sigma"
    )
    neighbours: tuple[tuple[float, float, float], ...] = Field(
        (),
        max_length=8,
        description="other targets beside the own one: x and y (m) in its axes, heading (deg)",
    )
    neighbour_ids: tuple[MarkerId, MarkerId] | None = Field(
        None, description="of their large and small markers; none: the own target's"
    )
