"""The keys that one tick of the loop writes to the flight log, with their units and meanings.

The record is flat, and each key ends with its unit. Values are in SI units and radians, in the
frames of `perchctl.geometry`. A missing value is None: it is left out of the file, and is None
again when the file is read. `FIELDS` is copied into the header of each log, so that a log explains
itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from perchctl.mission import Event, ExternalPositionStatus, Tick
from perchctl.vehicle import (
    Arm,
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    Telemetry,
)
from perchctl.vision import MARKERS, PipelineOutput, TargetEstimate

FORMAT = "perchctl-flight-log"
SCHEMA_VERSION = 5
READABLE_VERSIONS = (1, 2, 3, 4, SCHEMA_VERSION)
"""Version 1 had no `tracked`, and no events with several fields; its missing values read as None.
Version 2 had no turns. Version 3 did not contain the reason for a turn's decision, nor the commands
sent in the loop's place. Up to version 4, the velocity variance was stored under the name of
the position variance, and the position variance was not recorded."""

_POSE_SOURCES = {"l": "large", "s": "small", "j": "joint"}


def _axes(name: str, meaning: str) -> dict[str, str]:
    return {name.format(axis): meaning for axis in "xyz"}


DUTY_FIELDS = tuple(f"duty_m{motor}" for motor in (1, 2, 3, 4))
_DUTIES = (
    "duty cycles of the motors front right (M1), back right, back left and front left, 0..65535, "
    "sampled together with the battery voltage"
)
FIELDS: dict[str, str] = {
    "t_s": "time on the loop's clock",
    # the planner
    "phase": "phase of the mission",
    "stage": "markers seen in the newest frame: none, large, both or small",
    "reason": "why the phase was entered",
    "hold": "why the mission pauses; empty if it does not pause",
    "attempts": "failed perching attempts so far",
    # the vehicle's own state estimate, world axes
    **_axes("{}_m", "position of the body in the world frame of the state estimate, z up"),
    **_axes("v{}_mps", "velocity, world axes"),
    "roll_rad": "roll, right-handed about body x",
    "pitch_rad": "pitch, right-handed about body y: positive is nose down",
    "yaw_rad": "heading, right-handed about world z",
    "acc_z_g": "specific force along body z, +1 at rest",
    "thrust": "thrust command of the vehicle's controller, 0..65535",
    **dict.fromkeys(DUTY_FIELDS, _DUTIES),
    "battery_v": "battery voltage under load",
    "battery_state": "pm.state; 3 is low power",
    "battery_rest_v": "resting voltage according to the energy model",
    "battery_used_mah": "charge used, according to the summed thrust and the assumed battery",
    "battery_left_s": "hover time left until row `battery-low` lands the vehicle, according to the "
    "model",
    "battery_attempts": "further attempts that the battery allows, with enough left for a landing",
    "supervisor": "supervisor bits",
    "vel_var_m2ps2": "largest of the estimator's velocity variances",
    "pos_var_m2": "largest of the estimator's position variances; with a Flow deck always 100",
    "height_var_m2": "the estimator's variance of the height",
    "tel_age_s": "age of the telemetry sample",
    # external positions, as sent to the vehicle; None if its decks measure the position
    "pos_age_s": "age of the last external position sent, measured from its exposure",
    "pos_note": "why no external position is being sent",
    **_axes("pos_{}_m", "last external position sent, in the world frame of the state estimate"),
    # the camera frame; None in a tick without a new frame
    "frame": "number of the frame that this tick processed",
    "frame_t_s": "the frame's time of exposure on the loop's clock",
    "large_px": "corners of the large marker, x y of TL TR BR BL",
    "small_px": "corners of the small marker, x y of TL TR BR BL",
    **{
        key: f"{name}: {text}"
        for short, name in _POSE_SOURCES.items()
        for key, text in (
            (f"{short}x_m", "unfiltered position of the target relative to the gear, level frame"),
            (f"{short}y_m", f"as {short}x_m"),
            (f"{short}z_m", f"as {short}x_m"),
            (f"{short}yaw_rad", "unfiltered heading of the target in the level frame"),
            (f"{short}_rms_px", "RMS reprojection error"),
        )
    },
    "lock_note": "why the frame's pose was rejected, or accepted at an unexpected position",
    "cam_age_s": "time since the last good frame",
    "delay_s": "measured latency minus the profile's camera.latency_s",
    "delay_used_s": "correction applied to the frames' times, with `camera.latency_s: measured`",
    # the estimate of the target at t_s, by which the planner steers: the paper's error vector
    **_axes("e{}_m", "position of the target relative to the gear, level frame"),
    "eyaw_rad": "heading of the target in the level frame",
    **_axes("ev{}_mps", "target velocity from the filter, level axes"),
    **_axes("es{}_m", "standard deviation of the target's position"),
    "esyaw_rad": "standard deviation of eyaw_rad",
    "measured": "true if the newest frame showed the target, false while the filter coasts",
    "tracked": "true if the target is visible or the filter still predicts it, "
    "false if its position is only remembered",
    "target_age_s": "time since the exposure of the last frame that showed the target",
    "unseen": "frames since the target was last detected",
    **_axes("t{}_m", "position of the target in the world frame of the state estimate"),
    "tyaw_rad": "heading of the target in the world frame of the state estimate",
    # the command that was sent
    "cmd": "idle, position, thrust, stop, land or emergency",
    **_axes("cmd_{}_m", "position setpoint; z is also the target height of a landing"),
    "cmd_yaw_rad": "heading setpoint",
    "cmd_thrust": "raw thrust 0..65535",
    "cmd_roll_rad": "roll sent with cmd_thrust, positive to the right",
    "cmd_pitch_rad": "pitch sent with cmd_thrust, positive nose down",
    "cmd_duration_s": "duration of a landing",
    "late_s": "how late this tick started",
    # simulation only
    **_axes("true_{}_m", "true position of the body, simulation only"),
    "true_miss_m": "true horizontal distance of the gear from the target's centre, simulation only",
}


def event_record(event: Event) -> dict[str, Any]:
    """An event as a flat log record. Severities are continue, hold, back off, land and stop."""
    return {
        "t_s": event.t_s,
        "event": event.kind.value,
        "phase": event.phase.value if event.phase else None,
        "row": event.transition_name or None,
        "severity": event.severity.name.lower().replace("_", " "),
        "reason": event.reason,
        "simulated": event.simulated_fault or None,
        "rest": None if event.rest_state is None else event.rest_state.name.lower(),
    }


def tick_record(
    tick: Tick,
    true_position_m: tuple[float, float, float] | None = None,
    true_miss_m: float | None = None,
) -> dict[str, Any]:
    """Return a tick as a flat record with all `FIELDS`, in order. The ground truth is known only in
    simulation."""
    seen, battery = tick.output or tick.target, tick.state.battery
    values: dict[str, Any] = {
        "t_s": tick.t_s,
        "phase": tick.state.phase.value,
        "stage": None if seen is None else seen.stage.value,
        "reason": tick.state.transition_reason,
        "hold": tick.state.pause_reason or None,
        "attempts": tick.state.failed_attempts,
        "tel_age_s": tick.telemetry_age_s,
        "cam_age_s": tick.last_good_frame_age_s,
        "late_s": tick.tick_start_delay_s,
        "delay_s": None
        if tick.camera_errors is None
        else tick.camera_errors.latency_above_profile_s,
        "delay_used_s": tick.camera_latency_above_profile_s or None,
        "true_miss_m": true_miss_m,
        **_xyz("true_", true_position_m),
        **_external_values(tick.external_positions),
        **_battery_values(battery),
        **_telemetry_values(tick.telemetry),
        **_output_values(tick.output),
        **_target_values(tick.target),
        **command_values(tick.command),
    }
    return {key: values.get(key) for key in FIELDS}


def _battery_values(battery: Any) -> dict[str, Any]:
    return {
        "battery_left_s": battery.hover_time_left_s,
        "battery_attempts": battery.affordable_attempts,
        "battery_used_mah": battery.consumed_charge_mah,
        "battery_rest_v": battery.rest_v,
    }


def _external_values(external: ExternalPositionStatus | None) -> dict[str, Any]:
    if external is None:
        return {}
    return {
        "pos_age_s": external.newest_position_age_s
        if math.isfinite(external.newest_position_age_s)
        else None,
        "pos_note": external.problem,
        **_xyz("pos_", external.newest_position and external.newest_position.position_m),
    }


def _xyz(prefix: str, vector: Any, unit: str = "m") -> dict[str, Any]:
    if vector is None:
        return {}
    return {f"{prefix}{axis}_{unit}": v for axis, v in zip("xyz", vector, strict=True)}


def _telemetry_values(tel: Telemetry) -> dict[str, Any]:
    same = "roll_rad pitch_rad yaw_rad acc_z_g thrust battery_v battery_state supervisor"
    return {
        **_xyz("", tel.position_m),
        **_xyz("v", tel.velocity_mps, "mps"),
        **{name: getattr(tel, name) for name in same.split()},
        **dict(zip(DUTY_FIELDS, tel.motor_duty or (), strict=False)),
        "vel_var_m2ps2": tel.velocity_variance_m2ps2,
        "pos_var_m2": tel.position_variance_m2,
        "height_var_m2": tel.height_variance_m2,
    }


def _output_values(output: PipelineOutput | None) -> dict[str, Any]:
    if output is None:
        return {}
    values: dict[str, Any] = {
        "frame": output.detections.frame_index,
        "frame_t_s": output.detections.t_s,
        "lock_note": output.target_lock_message or None,
    }
    for marker in MARKERS:
        detection = output.detections.get(marker)
        if detection is not None:
            corners = detection.corners_px.reshape(-1)
            values[f"{marker}_px"] = [round(float(c), 3) for c in corners]
    for short, name in _POSE_SOURCES.items():
        pose = output.poses.get(name)
        if pose is not None:
            values |= _xyz(short, pose.e_m)
            values[f"{short}yaw_rad"] = pose.e_yaw_rad
            values[f"{short}_rms_px"] = pose.rms_reprojection_px
    return values


def _target_values(target: TargetEstimate | None) -> dict[str, Any]:
    if target is None:
        return {}
    return {
        **_xyz("e", target.e_m),
        "eyaw_rad": target.e_yaw_rad,
        **_xyz("ev", target.velocity_mps, "mps"),
        **_xyz("es", target.sigma_m),
        "esyaw_rad": target.sigma_yaw_rad,
        "measured": target.is_measured_in_newest_frame,
        "tracked": target.tracked,
        "target_age_s": target.t_s - target.last_measured_at_s,
        "unseen": target.unseen_frames,
        **_xyz("t", target.world_m),
        "tyaw_rad": target.world_yaw_rad,
    }


def command_values(command: Command) -> Mapping[str, Any]:
    """Return a command as values of the tick's fields: ``cmd`` and the command's numbers."""
    match command:
        case PositionSetpoint(x_m, y_m, z_m, yaw_rad):
            return {"cmd": "position", **_xyz("cmd_", (x_m, y_m, z_m)), "cmd_yaw_rad": yaw_rad}
        case RawThrust(thrust, roll_rad, pitch_rad):
            tilt = {"cmd_roll_rad": roll_rad, "cmd_pitch_rad": pitch_rad}
            return {"cmd": "thrust", "cmd_thrust": thrust, **tilt}
        case Land(height_m, duration_s):
            return {"cmd": "land", "cmd_z_m": height_m, "cmd_duration_s": duration_s}
        case Arm(armed):
            return {"cmd": "arm" if armed else "disarm"}
    return {"cmd": {Idle: "idle", StopMotors: "stop", EmergencyStop: "emergency"}[type(command)]}
