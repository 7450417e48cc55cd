"""A Crazyflie's log variables, and their one conversion into `Telemetry`.

Here, and only here, degrees become radians and the Crazyflie's nose-up pitch
becomes the right-handed nose-down one (docs/firmware.md, "Signs and units").
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from perchctl.vehicle import Telemetry

STATE_BLOCK: dict[str, str] = {
    "stateEstimate.x": "float",
    "stateEstimate.y": "float",
    "stateEstimate.z": "float",
    "stateEstimate.vx": "float",
    "stateEstimate.vy": "float",
    "stateEstimate.vz": "float",
}
"""24 of the 26 bytes that a log block holds."""

ATTITUDE_BLOCK: dict[str, str] = {
    "stateEstimate.roll": "float",
    "stateEstimate.pitch": "float",
    "stateEstimate.yaw": "float",
    "acc.x": "FP16",
    "acc.y": "FP16",
    "acc.z": "float",
    "stabilizer.thrust": "float",
    "supervisor.info": "uint16_t",
}
"""All 26 bytes: half floats resolve a force of 0.1 g to 0.1 mg."""

BATTERY_BLOCK: dict[str, str] = {"pm.vbat": "float", "pm.state": "int8_t"}
"""Without it the battery is unknown, which the flight copes with (fault 7)."""

VARIANCE_BLOCK: dict[str, str] = {
    "kalman.varPX": "float",
    "kalman.varPY": "float",
    "kalman.varPZ": "float",
}
"""Only where the Kalman estimator runs; a firmware without it is not refused."""

NEEDED = (*STATE_BLOCK, *ATTITUDE_BLOCK)


def telemetry_from(
    values: Mapping[str, float], t_s: float, behind_s: float = 0.0, start: int = 0
) -> Telemetry:
    """Telemetry from log values by name; `behind_s` and `start` as `Telemetry` has them. KeyError
    when a needed one is missing."""
    variances = [values[name] for name in VARIANCE_BLOCK if name in values]
    return Telemetry(
        t_s=t_s,
        position_m=(
            values["stateEstimate.x"],
            values["stateEstimate.y"],
            values["stateEstimate.z"],
        ),
        velocity_mps=(
            values["stateEstimate.vx"],
            values["stateEstimate.vy"],
            values["stateEstimate.vz"],
        ),
        roll_rad=math.radians(values["stateEstimate.roll"]),
        pitch_rad=-math.radians(values["stateEstimate.pitch"]),
        yaw_rad=math.radians(values["stateEstimate.yaw"]),
        acc_z_g=values["acc.z"],
        thrust=values["stabilizer.thrust"],
        battery_v=values.get("pm.vbat", 0.0),
        supervisor=int(values["supervisor.info"]),
        battery_state=int(values.get("pm.state", 0)),
        position_variance_m2=max(variances) if variances else None,
        climb_variance_m2ps2=values.get("kalman.varPZ"),
        behind_s=behind_s,
        acc_x_g=values["acc.x"],
        acc_y_g=values["acc.y"],
        start=start,
    )
