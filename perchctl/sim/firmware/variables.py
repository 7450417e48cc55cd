"""The log variables and parameters that a Crazyflie announces, and what they read and set.

Names that something reads are the real firmware's. Each table is filled up to the measured
size (docs/firmware.md, "Link": 385 log variables, 257 parameters).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from perchctl.sim.firmware.outside import POSITION, VELOCITY

LOG_COUNT = 385
PARAMETER_COUNT = 257


@dataclass(frozen=True)
class Parameter:
    """One parameter: its C type, value at boot, and whether it can be written or kept."""

    ctype: str
    default: float
    readonly: bool = False
    persistent: bool = False


# group -> "ctype: name=default ..."; "*" persistent, "!" read-only.
_PARAMETER_GROUPS: dict[str, str] = {
    "stabilizer": "uint8_t: estimator=2 stop=0",
    "system": "uint8_t: selftestPassed=1!",
    "kalman": "uint8_t: resetEstimation=0; float: initialX=0 initialY=0 initialZ=0 initialYaw=0",
    "posCtlPid": "float: zKp=2.0* zVelMax=1*; uint16_t: thrustBase=36000*",
    "pm": "float: lowVoltage=3.2*",
    "deck": "uint8_t: bcFlow2=1! bcLighthouse4=0!",
    "locSrv": "float: extPosStdDev=0.01 extQuatStdDev=0.0045",
    "ctrlMel": "float: mass=0.029",
}


def _parameters() -> dict[str, Parameter]:
    found = {}
    for group, text in _PARAMETER_GROUPS.items():
        for part in text.split("; "):
            ctype, _, items = part.partition(": ")
            for item in items.split():
                name, _, value = item.partition("=")
                found[f"{group}.{name}"] = Parameter(
                    ctype, float(value.rstrip("*!")), value.endswith("!"), value.endswith("*")
                )
    fillers = range(PARAMETER_COUNT - len(found))
    return found | {f"debugCtr.p{i}": Parameter("uint32_t", 0.0) for i in fillers}


PARAMETERS = _parameters()


@dataclass(frozen=True)
class LogVariable:
    """One log variable: its C type, and what reads its value off a `Firmware`."""

    ctype: str
    read: Callable[[Any], float] = lambda firmware: 0.0


def _field(path: str, scale: float = 1.0, ctype: str = "float") -> LogVariable:
    read = attrgetter(path)
    return LogVariable(ctype, lambda firmware: scale * float(read(firmware)))


def _item(path: str, place: int, ctype: str = "float") -> LogVariable:
    """Return a variable that reads one element of a sequence."""
    read = attrgetter(path)
    return LogVariable(ctype, lambda firmware: float(read(firmware)[place]))


def _variance(state: int) -> LogVariable:
    return LogVariable("float", lambda firmware: firmware.estimator.variance(firmware.t_s, state))


LOG_VARIABLES: dict[str, LogVariable] = {
    "pm.vbat": _field("supply_v"),
    "pm.vbatMV": _field("supply_v", 1000.0, "uint16_t"),
    "pm.state": _field("power_state", ctype="int8_t"),
    "supervisor.info": _field("supervisor_info", ctype="uint16_t"),
    "stabilizer.thrust": _field("controller.thrust"),
    **{f"motor.m{i + 1}": _item("motors", i, "uint16_t") for i in range(4)},
}
for _i, _axis in enumerate("xyz"):
    LOG_VARIABLES |= {
        f"stateEstimate.{_axis}": _field(f"estimator.now.{_axis}_m"),
        f"stateEstimate.v{_axis}": _field(f"estimator.now.v{_axis}_mps"),
        f"kalman.var{_axis.upper()}": _variance(POSITION + _i),
        f"kalman.varP{_axis.upper()}": _variance(VELOCITY + _i),
        f"acc.{_axis}": _item("estimator.acc_g", _i),
        f"gyro.{_axis}": _field(f"estimator.now.gyro_{_axis}_dps"),
    }
for _angle in ("roll", "pitch", "yaw"):
    LOG_VARIABLES[f"stateEstimate.{_angle}"] = _field(f"estimator.now.{_angle}_deg")
LOG_VARIABLES |= {
    f"debugCtr.c{_i}": LogVariable("uint32_t") for _i in range(LOG_COUNT - len(LOG_VARIABLES))
}
