"""Parameters that reach into the controller: the gains and limits of its loops."""

from __future__ import annotations

from perchctl.sim.firmware.controller import Controller

_LOOPS = {
    "posCtlPid": {axis: axis for axis in ("x", "y", "z")},
    "velCtlPid": {axis: axis for axis in ("vx", "vy", "vz")},
    "pid_attitude": {f"{axis}_": axis for axis in ("roll", "pitch", "yaw")},
    "pid_rate": {f"{axis}_": f"{axis}_rate" for axis in ("roll", "pitch", "yaw")},
}
_GAINS = {
    f"{group}.{prefix}{gain if prefix.endswith('_') else gain.capitalize()}": (loop, gain)
    for group, loops in _LOOPS.items()
    for prefix, loop in loops.items()
    for gain in ("kp", "ki", "kd")
}
_LIMITS = {
    "posCtlPid.rLimit": "roll_max_deg",
    "posCtlPid.pLimit": "pitch_max_deg",
    "posCtlPid.xVelMax": "x_speed_max_mps",
    "posCtlPid.yVelMax": "y_speed_max_mps",
    "posCtlPid.zVelMax": "z_speed_max_mps",
    "posCtlPid.thrustBase": "thrust_base",
    "posCtlPid.thrustMin": "thrust_min",
}


def apply_parameter(controller: Controller, name: str, value: float) -> None:
    """Put a parameter's value where the controller uses it; others change nothing."""
    if name in _GAINS:
        loop, gain = _GAINS[name]
        setattr(getattr(controller, loop), gain, value)
    elif name in _LIMITS:
        setattr(controller, _LIMITS[name], value)
        controller.limits_changed()
