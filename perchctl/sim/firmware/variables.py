"""The log variables and parameters that a Crazyflie announces, and what they read and set.

Groups and names follow the real firmware's, as far as a vehicle that perches has a use for them.
Each table is filled up to the measured size (docs/firmware.md, "Link": 385 log variables, 257
parameters).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from perchctl.sim.firmware.outside import ATTITUDE, POSITION, VELOCITY

LOG_COUNT = 385
PARAMETER_COUNT = 257

# group -> "ctype: names", several types separated by ";".
_LOG_GROUPS: dict[str, str] = {
    "stateEstimate": "float: x y z vx vy vz roll pitch yaw qx qy qz qw",
    "stabilizer": "float: roll pitch yaw thrust",
    "acc": "float: x y z",
    "gyro": "float: x y z",
    "pm": "float: vbat; uint16_t: vbatMV; int8_t: state; uint8_t: batteryLevel",
    "supervisor": "uint16_t: info",
    "kalman": "float: varX varY varZ varPX varPY varPZ varD0 varD1 varD2 q0 q1 q2 q3",
    "motor": "uint16_t: m1 m2 m3 m4; int32_t: m1req m2req m3req m4req",
    "radio": "uint8_t: rssi isConnected",
    "stateEstimateZ": "int16_t: x y z vx vy vz",
    "range": "uint16_t: zrange",
    "locSrvZ": "uint16_t: tick",
}

# group -> "ctype: name=default ..."; "*" persistent, "!" read-only.
_PARAMETER_GROUPS: dict[str, str] = {
    "stabilizer": "uint8_t: estimator=2 controller=1 stop=0",
    "commander": "uint8_t: enHighLevel=1",
    "hlCommander": "float: vtoff=0.5* vland=0.5*",
    "supervisor": "uint8_t: infdmp=0 tmblChckEn=1; uint16_t: prefltTimeout=30000"
    " landedTimeout=3000",
    "kalman": "uint8_t: resetEstimation=0 quadIsFlying=0 robustTdoa=0 robustTwr=0; float:"
    " pNAcc_xy=0.5 pNAcc_z=1.0 pNVel=0 pNPos=0 pNAtt=0 mNBaro=2.0 mNGyro_rollpitch=0.1"
    " mNGyro_yaw=0.1 initialX=0 initialY=0 initialZ=0 initialYaw=0 attitudeReversion=0.001"
    " maxPos=100 maxVel=10",
    "posCtlPid": "float: xKp=2.0* xKi=0* xKd=0* xKff=0* yKp=2.0* yKi=0* yKd=0* yKff=0* zKp=2.0*"
    " zKi=0.5* zKd=0* zKff=0* rLimit=20* pLimit=20* xVelMax=1* yVelMax=1* zVelMax=1*;"
    " uint16_t: thrustBase=36000* thrustMin=20000*",
    "velCtlPid": "float: vxKp=25* vxKi=1* vxKd=0* vxKFF=0* vyKp=25* vyKi=1* vyKd=0* vyKFF=0*"
    " vzKp=25* vzKi=15* vzKd=0* vzKFF=0*",
    "pid_attitude": "float: roll_kp=6* roll_ki=3* roll_kd=0* roll_kff=0* pitch_kp=6* pitch_ki=3*"
    " pitch_kd=0* pitch_kff=0* yaw_kp=6* yaw_ki=1* yaw_kd=0.35* yaw_kff=0* yawMaxDelta=0*;"
    " int8_t: attFiltEn=0*; float: attFiltCut=15*",
    "pid_rate": "float: roll_kp=250* roll_ki=500* roll_kd=2.5* roll_kff=0* pitch_kp=250*"
    " pitch_ki=500* pitch_kd=2.5* pitch_kff=0* yaw_kp=120* yaw_ki=16.7* yaw_kd=0* yaw_kff=0*;"
    " int8_t: rateFiltEn=0*; float: omxFiltCut=30* omyFiltCut=30* omzFiltCut=30*",
    "pm": "float: lowVoltage=3.2* criticalLowVoltage=3.0*",
    "system": "uint8_t: selftestPassed=1!",
    "deck": "uint8_t: bcFlow2=1! bcFlow=0! bcLighthouse4=0! bcLoco=0! bcDWM1000=0! bcAI=0!",
    "locSrv": "uint8_t: enRangeStreamFP32=0 enLhAngleStream=0; float: extPosStdDev=0.01"
    " extQuatStdDev=0.0045",
    "ctrlMel": "float: mass=0.029",
}


@dataclass(frozen=True)
class Parameter:
    """One parameter: its C type, value at boot, and whether it can be written or kept."""

    ctype: str
    default: float
    readonly: bool = False
    persistent: bool = False


def _typed(text: str) -> list[tuple[str, str]]:
    """Return each item of a group with its type before it."""
    parts = (part.split(":", 1) for part in text.split(";"))
    return [(ctype.strip(), item) for ctype, items in parts for item in items.split()]


LOG_VARIABLES: dict[str, str] = {
    f"{group}.{name}": ctype for group, text in _LOG_GROUPS.items() for ctype, name in _typed(text)
}
LOG_VARIABLES |= {f"debugCtr.c{_i}": "uint32_t" for _i in range(LOG_COUNT - len(LOG_VARIABLES))}
PARAMETERS: dict[str, Parameter] = {
    f"{group}.{item.split('=')[0]}": Parameter(
        ctype, float(item.split("=")[1].rstrip("*!")), item.endswith("!"), item.endswith("*")
    )
    for group, text in _PARAMETER_GROUPS.items()
    for ctype, item in _typed(text)
}
PARAMETERS |= {
    f"debugCtr.p{_i}": Parameter("uint32_t", 0.0) for _i in range(PARAMETER_COUNT - len(PARAMETERS))
}


# --- Where each log variable comes from; the fillers read 0 -----------


Getter = Callable[[Any], float]
"""Reads the value off a `Firmware`."""


def _field(path: str, scale: float = 1.0) -> Getter:
    read = attrgetter(path)
    return lambda firmware: scale * float(read(firmware))


def _item(path: str, place: int) -> Getter:
    """Return a getter of one element of a sequence."""
    read = attrgetter(path)
    return lambda firmware: float(read(firmware)[place])


def _duty_cycle(path: str, motor: int) -> Getter:
    read = attrgetter(path)
    return lambda firmware: float(int(read(firmware)[motor]))


def _variance(state: int) -> Getter:
    return lambda firmware: firmware.estimator.variance(firmware.t_s, state)


def _range_mm(firmware: Any) -> float:
    """Return what a deck measures of the height."""
    return 1000.0 * max(0.0, firmware.world.z_m) if firmware.estimator.outside is None else 0.0


LIVE: dict[str, Getter] = {
    "pm.vbat": _field("power.battery_v"),
    "pm.vbatMV": _field("power.battery_v", 1000.0),
    "pm.state": _field("power.state"),
    "pm.batteryLevel": _field("power.level_percent"),
    "supervisor.info": _field("supervisor_info"),
    "stabilizer.thrust": _field("controller.thrust"),
    "radio.rssi": _field("scenario.rssi_dbm", -1.0),
    "radio.isConnected": lambda firmware: 1.0,
    "range.zrange": _range_mm,
    "locSrvZ.tick": _field("external_tick_ms"),
}
for _i, _axis in enumerate("xyz"):
    _place, _speed = f"estimator.now.{_axis}_m", f"estimator.now.v{_axis}_mps"
    LIVE |= {
        f"stateEstimate.{_axis}": _field(_place),
        f"stateEstimate.v{_axis}": _field(_speed),
        f"stateEstimateZ.{_axis}": _field(_place, 1000.0),
        f"stateEstimateZ.v{_axis}": _field(_speed, 1000.0),
        f"kalman.var{_axis.upper()}": _variance(POSITION + _i),
        f"kalman.varP{_axis.upper()}": _variance(VELOCITY + _i),
        f"kalman.varD{_i}": _variance(ATTITUDE + _i),
        f"acc.{_axis}": _item("estimator.acc_g", _i),
        f"gyro.{_axis}": _field(f"estimator.now.gyro_{_axis}_dps"),
    }
for _angle in ("roll", "pitch", "yaw"):
    LIVE[f"stateEstimate.{_angle}"] = _field(f"estimator.now.{_angle}_deg")
    LIVE[f"stabilizer.{_angle}"] = _field(f"estimator.now.{_angle}_deg")
for _i, _part in enumerate("wxyz"):
    LIVE[f"stateEstimate.q{_part}"] = LIVE[f"kalman.q{_i}"] = _item("world.quaternion", _i)
    LIVE[f"motor.m{_i + 1}"] = _duty_cycle("motors", _i)
    LIVE[f"motor.m{_i + 1}req"] = _duty_cycle("driver.requested", _i)
