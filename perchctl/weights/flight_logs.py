"""Flight logs with truth as data: the simulator's, flown in lockstep.

Such a log holds the true position of the body; the target's true place follows from the
profile and seed in its header. Each stretch of `STRETCH_S` with both markers in sight
counts as one position. The heading's truth is the vehicle's own estimate, which does not
drift in the simulator; roll and pitch are the estimate's too.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rotation_from_rpy
from perchctl.log import FlightLog, read_log
from perchctl.profile import Profile
from perchctl.sim import Scenario, draw_scenario
from perchctl.weights.types import AXES, UNITS, Measurements, wrap

STRETCH_S = 1.0
LEAST_ROWS = 5
"""A stretch with fewer frames of both markers is too little evidence."""


def read_flight_log(path: Path) -> Measurements:
    """The frames with both markers. Errors: NotFound, InvalidValue (no log, no truth)."""
    log = read_log(path)
    scenario, later_s = _truth_of(log)
    # With `camera.latency_s: measured` the flight has taken some of it off already.
    ahead_s = later_s + np.nan_to_num(log.column("delay_used_s"))
    t_s = log.column("t_s")
    frame_s = log.column("frame_t_s")
    poses = {name: _poses(log, name[0]) for name in ("large", "small", "joint")}
    both = np.isfinite(poses["large"]).all(axis=1) & np.isfinite(poses["small"]).all(axis=1)
    actual = _actual(log, scenario, t_s, frame_s + ahead_s)
    rows = np.flatnonzero(both & np.isfinite(actual).all(axis=1))
    if not len(rows) and np.isfinite(poses["joint"]).any():
        raise InvalidValue(
            f"{path}: line 1: both markers were only solved jointly in this flight; fly it with "
            f"pose.each_marker: true (or merge.method: weights) in the profile"
        )
    if not len(rows):
        raise InvalidValue(
            f"{path}: lines 2 to {len(log.records) + 1}: no tick with the truth holds both markers"
        )
    position = np.floor((frame_s[rows] - frame_s[rows][0]) / STRETCH_S).astype(np.int64)
    numbers, counts = np.unique(position, return_counts=True)
    kept = np.isin(position, numbers[counts >= LEAST_ROWS])
    rows, position = rows[kept], position[kept]
    if not len(rows):
        raise InvalidValue(
            f"{path}: line 2: no stretch of {STRETCH_S:g} s holds {LEAST_ROWS} frames with both "
            f"markers"
        )
    joint = poses["joint"][rows]
    return Measurements(
        name=str(path),
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        position=position,
        t_s=frame_s[rows],
        large=poses["large"][rows],
        small=poses["small"][rows],
        actual=actual[rows],
        joint=None if np.isnan(joint).all() else joint,
        line=rows.astype(np.int64) + 2,
        notes=(f"{path}: heading and tilt of the truth are the vehicle's own estimate",),
    )


def _truth_of(log: FlightLog) -> tuple[Scenario, float]:
    """The scenario that was flown, and how much later than logged the frames were taken."""
    if not np.isfinite(log.column("true_x_m")).any():
        raise InvalidValue(
            f"{log.path}: line 2: no truth in this log (true_x_m is missing): only logs of "
            f"lockstep flights hold it (perchctl simulate --only SEED --log-dir DIR); --collect a "
            f"session of a real vehicle"
        )
    header: dict[str, Any] = log.header
    try:
        profile = Profile.model_validate(header["profile"])
        scenario = draw_scenario(profile, int(header["seed"]))
    except (KeyError, TypeError, ValueError, ValidationError):
        raise InvalidValue(
            f"{log.path}: line 1: the profile and seed of the header do not give the scenario"
        ) from None
    return scenario, profile.camera.start_latency_s - scenario.camera_latency_s


def _poses(log: FlightLog, short: str) -> Array:
    return np.stack(
        [log.column(f"{short}{axis}_{unit}") for axis, unit in zip(AXES, UNITS, strict=True)],
        axis=1,
    )


def _actual(log: FlightLog, scenario: Scenario, t_s: Array, at_s: Array) -> Array:
    """The target relative to the gear in the level frame at the frames' times, (n, 4)."""
    known = np.isfinite(log.column("true_x_m")) & np.isfinite(log.column("roll_rad"))
    when = np.where(np.isfinite(at_s), at_s, t_s)

    def at_frame(key: str) -> Array:
        values = log.column(key)[known]
        if key == "yaw_rad":
            values = np.unwrap(values)
        return np.interp(when, t_s[known], values, left=math.nan, right=math.nan)

    body = np.stack([at_frame(f"true_{axis}_m") for axis in "xyz"], axis=1)
    roll, pitch, yaw = (at_frame(key) for key in ("roll_rad", "pitch_rad", "yaw_rad"))
    target = np.array([*scenario.target_xy_m, scenario.ceiling_z_m])
    gear = np.asarray(scenario.gear_body_m)
    actual = np.full((len(t_s), 4), math.nan)
    for row in np.flatnonzero(np.isfinite(at_s) & np.isfinite(body).all(axis=1)):
        c, s = math.cos(yaw[row]), math.sin(yaw[row])
        x, y, z = target - body[row]
        level = np.array([c * x + s * y, -s * x + c * y, z])
        tilt = rotation_from_rpy(float(roll[row]), float(pitch[row]), 0.0)
        actual[row, :3] = level - tilt @ gear
        actual[row, 3] = wrap(scenario.target_yaw_rad - yaw[row])
    return actual
