"""The log variables and parameters that a Crazyflie announces, and how they are read and set.

The names are those of the real firmware. The tables cover the variables that perchctl reads, and
the parameters that a profile may set, most of which have no effect here. Each table is filled up to
the measured size (docs/firmware.md, "Link": 385 log variables, 257 parameters).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from perchctl.sim.firmware.outside import POSITION_STATE, VELOCITY_STATE

LOG_COUNT = 385
PARAMETER_COUNT = 257
IDLE_THRUST = 1000
"""Largest thrust command at which the motors stand still, 0..65535."""
GYRO_NOISE_S = 0.02
"""Time over which the attitude integrates a sample of the gyroscope's noise, s. Larger: a hanging
vehicle seems to move. Smaller: a rounded reading may repeat."""


@dataclass(frozen=True)
class Parameter:
    """One parameter: its C type, value at boot, and whether it is read-only or storable."""

    ctype: str
    default: float
    readonly: bool = False
    persistent: bool = False


# group -> "ctype: name=default ..."; "*" persistent, "!" read-only.
_PARAMETER_GROUPS: dict[str, str] = {
    "stabilizer": "uint8_t: estimator=2 controller=1 stop=0",
    "system": "uint8_t: selftestPassed=1!",
    "led": "uint8_t: bitmask=0",
    "commander": "uint8_t: enHighLevel=1",
    "hlCommander": "float: vtoff=0.5* vland=0.5*",
    "supervisor": "uint8_t: infdmp=0 tmblChckEn=1; uint16_t: prefltTimeout=30000"
    " landedTimeout=3000",
    "kalman": "uint8_t: resetEstimation=0 robustTdoa=0 robustTwr=0; float: initialX=0 initialY=0"
    " initialZ=0 initialYaw=0 pNAcc_xy=0.5 pNAcc_z=1 pNVel=0 pNPos=0 pNAtt=0 mNBaro=2"
    " mNGyro_rollpitch=0.1 mNGyro_yaw=0.1 attitudeReversion=0.001 maxPos=100 maxVel=10",
    "posCtlPid": "float: xKp=2* xKi=0* xKd=0* yKp=2* yKi=0* yKd=0* zKp=2* zKi=0.5* zKd=0*"
    " rLimit=20* pLimit=20* xVelMax=1* yVelMax=1* zVelMax=1*;"
    " uint16_t: thrustBase=36000* thrustMin=20000*",
    "velCtlPid": "float: vxKp=25* vxKi=1* vxKd=0* vyKp=25* vyKi=1* vyKd=0* vzKp=25* vzKi=15*"
    " vzKd=0*",
    "pid_attitude": "float: roll_kp=6* roll_ki=3* roll_kd=0* pitch_kp=6* pitch_ki=3* pitch_kd=0*"
    " yaw_kp=6* yaw_ki=1* yaw_kd=0.35* yawMaxDelta=0*",
    "pid_rate": "float: roll_kp=250* roll_ki=500* roll_kd=2.5* pitch_kp=250* pitch_ki=500*"
    " pitch_kd=2.5* yaw_kp=120* yaw_ki=16.7* yaw_kd=0*",
    "pm": "float: lowVoltage=3.2* criticalLowVoltage=3*",
    "deck": "uint8_t: bcFlow2=1! bcFlow=0! bcLighthouse4=0! bcLoco=0! bcDWM1000=0! bcAI=0!",
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
    """One log variable: its C type, and the function that reads it from a `Firmware`."""

    ctype: str
    read: Callable[[Any], float] = lambda firmware: 0.0


def _field(path: str, scale: float = 1.0, ctype: str = "float") -> LogVariable:
    read = attrgetter(path)
    return LogVariable(ctype, lambda firmware: scale * float(read(firmware)))


def _item(path: str, place: int, ctype: str = "float") -> LogVariable:
    """A variable that reads one element of a sequence."""
    read = attrgetter(path)
    return LogVariable(ctype, lambda firmware: float(read(firmware)[place]))


def _angle(name: str, gyro_axis: str) -> LogVariable:
    """An angle of the estimate, in degrees.

    Dry friction holds a hanging vehicle perfectly still, and the estimator's true attitude with it.
    A real estimate integrates the noise of the gyroscope (some 0.001 deg), so no two
    successive readings are the same, and perchctl treats readings that repeat as frozen. While the
    vehicle hangs with its motors idle, the reading therefore contains that noise.
    """
    read = attrgetter(f"estimator.now.{name}_deg")
    gyro = attrgetter(f"estimator.now.gyro_{gyro_axis}_dps")

    def reading(firmware: Any) -> float:
        still = firmware.world.magnet_engaged and firmware.controller.thrust <= IDLE_THRUST
        return float(read(firmware)) + (GYRO_NOISE_S * gyro(firmware) if still else 0.0)

    return LogVariable("float", reading)


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
        f"kalman.var{_axis.upper()}": _variance(POSITION_STATE + _i),
        f"kalman.varP{_axis.upper()}": _variance(VELOCITY_STATE + _i),
        f"acc.{_axis}": _item("estimator.acc_g", _i),
        f"gyro.{_axis}": _field(f"estimator.now.gyro_{_axis}_dps"),
    }
for _name, _axis in (("roll", "x"), ("pitch", "y"), ("yaw", "z")):
    LOG_VARIABLES[f"stateEstimate.{_name}"] = _angle(_name, _axis)
LOG_VARIABLES |= {
    f"debugCtr.c{_i}": LogVariable("uint32_t") for _i in range(LOG_COUNT - len(LOG_VARIABLES))
}
