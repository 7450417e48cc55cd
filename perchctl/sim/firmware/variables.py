"""The log variables and parameters that a Crazyflie announces, and what they read and set.

Groups and names follow the real firmware's; of the log variables only those that a vehicle which
perches has a use for. Each table is filled up to the measured size (docs/firmware.md, "Link": 385
log variables, 257 parameters).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from perchctl.sim.firmware.controller import Controller
from perchctl.sim.firmware.outside import ATTITUDE, POSITION, VELOCITY

LOG_COUNT = 385
PARAMETER_COUNT = 257

# group -> "ctype: names", several types separated by ";".
_LOG_GROUPS: dict[str, str] = {
    "stateEstimate": "float: x y z vx vy vz ax ay az roll pitch yaw qx qy qz qw",
    "stabilizer": "float: roll pitch yaw thrust rtStab; uint32_t: intToOut",
    "acc": "float: x y z",
    "gyro": "float: x y z xVariance yVariance zVariance; int16_t: xRaw yRaw zRaw",
    "pm": "float: vbat extVbat extCurr; uint16_t: vbatMV extVbatMV extCurrMV;"
    " float: chargeCurrent; int8_t: state; uint8_t: batteryLevel",
    "supervisor": "uint16_t: info",
    "sys": "uint8_t: canfly isFlying isTumbled; int8_t: testLogParam",
    "kalman": "uint8_t: inFlight; float: stateX stateY stateZ statePX statePY statePZ"
    " stateD0 stateD1 stateD2 varX varY varZ varPX varPY varPZ varD0 varD1 varD2"
    " q0 q1 q2 q3 rtUpdate rtPred rtFinal rtApnd rtRej",
    "motor": "uint16_t: m1 m2 m3 m4; int32_t: m1req m2req m3req m4req",
    "ctrltarget": "float: x y z vx vy vz ax ay az roll pitch yaw",
    "controller": "float: cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw accelz"
    " actuatorThrust roll pitch yaw rollRate pitchRate yawRate; int16_t: ctr_yaw",
    "radio": "uint8_t: rssi isConnected; uint16_t: numRxBc numRxUc",
    "stateEstimateZ": "int16_t: x y z vx vy vz ax ay az; uint32_t: quat;"
    " int16_t: rateRoll ratePitch rateYaw",
    "range": "uint16_t: front back up left right zrange",
    "locSrv": "float: x y z qx qy qz qw; uint16_t: tick",
    "locSrvZ": "uint16_t: tick",
    "health": "float: motorVarXM1 motorVarYM1 motorVarXM2 motorVarYM2 motorVarXM3 motorVarYM3"
    " motorVarXM4 motorVarYM4; uint8_t: motorPass batteryPass; float: batterySag;"
    " uint16_t: motorTestCount",
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
    "flightmode": "uint8_t: althold=0 poshold=0 posSet=0 yawMode=2 yawRst=0 stabModeRoll=1"
    " stabModePitch=1 stabModeYaw=0",
    "motorPowerSet": "uint8_t: enable=0; uint16_t: m1=0 m2=0 m3=0 m4=0",
    "powerDist": "uint32_t: idleThrust=0*",
    "pm": "float: lowVoltage=3.2* criticalLowVoltage=3.0*",
    "sound": "uint8_t: effect=0; uint32_t: neffect=16!; uint16_t: freq=4000",
    "led": "uint8_t: bitmask=0",
    "ring": "uint8_t: effect=6* solidRed=20 solidGreen=20 solidBlue=20 headlightEnable=0;"
    " uint32_t: neffect=18!; float: glowstep=0.05 emptyCharge=3.1 fullCharge=4.2 fadeTime=0.5;"
    " uint32_t: fadeColor=0",
    "imu_sensors": "uint8_t: BMP388=1! imuPhi=0 HMC5883L=0!",
    "imu_tests": "uint8_t: MPU6500=1! HMC5883L=0! MS5611=0!",
    "imu_align": "float: phi=0* theta=0* psi=0*",
    "cpu": "uint16_t: flash=1024!; uint32_t: id0=3407926! id1=842224912! id2=540685367!",
    "firmware": "uint32_t: revision0=643039581!; uint16_t: revision1=13366!; uint8_t: modified=0!",
    "system": "uint8_t: highlightMotion=0 selftestPassed=1! doAssert=0 forceArm=0 arm=0;"
    " int8_t: testLogParam=0 storageStats=0 storageReformat=0; uint16_t: taskDump=0",
    "syslink": "uint8_t: probe=0",
    "deck": "uint8_t: bcFlow2=1! bcZRanger2=0! bcMultiranger=0! bcLedRing=0! bcBuzzer=0!"
    " bcDWM1000=0! bcLighthouse4=0! bcUSD=0! bcAI=0! bcActiveMarker=0! bcLoco=0! bcFlow=0!"
    " bcZRanger=0! bcGTGPS=0! bcBigQuad=0! bcOA=0! bcServo=0! bcColorLedTop=0!"
    " bcColorLedBot=0! bcCPPM=0!",
    "health": "uint8_t: startPropTest=0 startBatTest=0; float: propTestThreshold=0*;"
    " uint16_t: propTestPWMRatio=0* batTestPWMRatio=0*",
    "locSrv": "uint8_t: enRangeStreamFP32=0 enLhAngleStream=0; float: extPosStdDev=0.01"
    " extQuatStdDev=0.0045",
    "loco": "uint8_t: mode=0",
    "tdoa2": "float: stddev=0.15",
    "tdoa3": "float: stddev=0.15",
    "lighthouse": "uint8_t: method=1 systemType=2*; uint16_t: bsCalibReset=0 bsAvailable=0;"
    " float: sweepStd=0.0004 sweepStd2=0.001",
    "motion": "uint8_t: disable=0 adaptive=0; float: flowStdFixed=2.0",
    "multiranger": "uint16_t: filterMask=0*",
    "usd": "uint8_t: canLog=0 logging=0 sendRate=0",
    "colAv": "uint8_t: enable=0; float: ellipsoidX=0.3 ellipsoidY=0.3 ellipsoidZ=0.9 bboxMinX=-100"
    " bboxMinY=-100 bboxMinZ=-100 bboxMaxX=100 bboxMaxY=100 bboxMaxZ=100 horizon=1.0 maxSpeed=0.5"
    " sidestepThrsh=0.25; int32_t: maxPeerLocAge=5000; float: vorTol=0.01; int32_t: vorIters=100",
    "ctrlMel": "float: kp_xy=0.4 kd_xy=0.2 ki_xy=0.05 i_range_xy=2 kp_z=1.25 kd_z=0.4 ki_z=0.05"
    " i_range_z=0.4 mass=0.029 massThrust=132000 kR_xy=70000 kR_z=60000 kw_xy=20000 kw_z=12000"
    " ki_m_xy=0 ki_m_z=500 kd_omega_rp=200 i_range_m_xy=1 i_range_m_z=1500",
    "ctrlINDI": "float: thrust_threshold=300 bound_ctrl_input=32000 g1_p=0.0066146 g1_q=0.0052125"
    " g1_r=-0.001497 g2=0.000043475 ref_err_p=24 ref_err_q=24 ref_err_r=24 ref_rate_p=14"
    " ref_rate_q=14 ref_rate_r=14 act_dyn_p=0.03149 act_dyn_q=0.03149 act_dyn_r=0.03149"
    " filt_cutoff=8 filt_cutoff_r=8; uint8_t: outerLoopActive=0",
    "sensfusion6": "float: kp=0.8 ki=0.002 baseZacc=1.0",
    "crtpsrv": "uint16_t: echoDelay=0",
    "amarker": "uint8_t: mode=0 power=0; uint32_t: front=1 back=3 left=4 right=2",
    "memTst": "uint8_t: resetW=0",
}


@dataclass(frozen=True)
class Parameter:
    """One parameter: its C type, value at boot, and whether it can be written or kept."""

    ctype: str
    default: float
    readonly: bool = False
    persistent: bool = False


def _log_table() -> dict[str, str]:
    table = {
        f"{group}.{name}": ctype
        for group, text in _LOG_GROUPS.items()
        for ctype, names in _typed(text)
        for name in names
    }
    return table | {f"debugCtr.c{i}": "uint32_t" for i in range(LOG_COUNT - len(table))}


def _parameter_table() -> dict[str, Parameter]:
    table = {}
    for group, text in _PARAMETER_GROUPS.items():
        for ctype, items in _typed(text):
            for item in items:
                name, value = item.rstrip("*!").split("=")
                table[f"{group}.{name}"] = Parameter(
                    ctype, float(value), item.endswith("!"), item.endswith("*")
                )
    missing = PARAMETER_COUNT - len(table)
    return table | {f"debugCtr.p{i}": Parameter("uint32_t", 0.0) for i in range(missing)}


def _typed(text: str) -> list[tuple[str, list[str]]]:
    parts = (part.split(":", 1) for part in text.split(";"))
    return [(ctype.strip(), names.split()) for ctype, names in parts]


LOG_VARIABLES: dict[str, str] = _log_table()
PARAMETERS: dict[str, Parameter] = _parameter_table()


# --- Where each live log variable comes from; all others read 0 --------------------------------


Getter = Callable[[Any], float]
"""Reads the value off a `Firmware`."""
_AXES = "xyz"
_ANGLES = ("roll", "pitch", "yaw")


def _field(path: str, scale: float = 1.0) -> Getter:
    read = attrgetter(path)
    return lambda firmware: scale * float(read(firmware))


def _item(path: str, *places: int) -> Getter:
    """An element of a sequence, or of one within it."""
    read = attrgetter(path)

    def get(firmware: Any) -> float:
        value = read(firmware)
        for place in places:
            value = value[place]
        return float(value)

    return get


def _duty_cycle(path: str, motor: int) -> Getter:
    read = _item(path, motor)
    return lambda firmware: float(int(read(firmware)))


def _variance(state: int) -> Getter:
    return lambda firmware: firmware.estimator.variance(firmware.t_s, state)


def _range_mm(firmware: Any) -> float:
    """What a deck measures of the height."""
    return 1000.0 * max(0.0, firmware.world.z_m) if firmware.estimator.outside is None else 0.0


def _live() -> dict[str, Getter]:
    getters: dict[str, Getter] = {
        "pm.vbat": _field("power.battery_v"),
        "pm.vbatMV": _field("power.battery_v", 1000.0),
        "pm.state": _field("power.state"),
        "pm.batteryLevel": _field("power.level_percent"),
        "supervisor.info": _field("supervisor_info"),
        "sys.canfly": _field("supervisor.motors_allowed"),
        "sys.isFlying": _field("supervisor.is_flying"),
        "sys.isTumbled": _field("supervisor.tumbled"),
        "stabilizer.thrust": _field("controller.thrust"),
        "controller.cmd_thrust": _field("controller.thrust"),
        "controller.actuatorThrust": _field("controller.thrust"),
        "controller.accelz": _item("estimator.acc_g", 2),
        "radio.rssi": _field("scenario.rssi_dbm", -1.0),
        "radio.isConnected": lambda firmware: 1.0,
        "kalman.inFlight": _field("supervisor.is_flying"),
        "range.zrange": _range_mm,
        "locSrvZ.tick": _field("external_tick_ms"),
        "health.motorPass": _field("health.motor_pass"),
        "health.motorTestCount": _field("health.motor_tests"),
        "health.batteryPass": _field("health.battery_pass"),
        "health.batterySag": _field("health.sag_v"),
    }
    for i, axis in enumerate(_AXES):
        place, speed = f"estimator.now.{axis}_m", f"estimator.now.v{axis}_mps"
        getters |= {
            f"stateEstimate.{axis}": _field(place),
            f"stateEstimate.v{axis}": _field(speed),
            f"kalman.state{axis.upper()}": _field(place),
            f"kalman.stateP{axis.upper()}": _field(speed),
            f"stateEstimateZ.{axis}": _field(place, 1000.0),
            f"stateEstimateZ.v{axis}": _field(speed, 1000.0),
            f"kalman.var{axis.upper()}": _variance(POSITION + i),
            f"kalman.varP{axis.upper()}": _variance(VELOCITY + i),
            f"kalman.varD{i}": _variance(ATTITUDE + i),
            f"acc.{axis}": _item("estimator.acc_g", i),
            f"gyro.{axis}": _field(f"estimator.now.gyro_{axis}_dps"),
            f"ctrltarget.{axis}": _field(f"flown_setpoint.{axis}_m"),
            f"ctrltarget.v{axis}": _field(f"flown_setpoint.v{axis}_mps"),
        }
    for i, (angle, axis, sign) in enumerate(zip(_ANGLES, _AXES, (1, -1, 1), strict=True)):
        getters |= {
            f"stateEstimate.{angle}": _field(f"estimator.now.{angle}_deg"),
            f"stabilizer.{angle}": _field(f"estimator.now.{angle}_deg"),
            f"ctrltarget.{angle}": _field(f"flown_setpoint.{angle}_deg"),
            f"controller.{angle}": _field(f"controller.desired_{angle}_deg"),
            f"controller.cmd_{angle}": _item("controller.outputs", i),
            f"controller.r_{angle}": _field(f"estimator.now.gyro_{axis}_dps", math.radians(sign)),
        }
    for i, part in enumerate("wxyz"):
        getters[f"stateEstimate.q{part}"] = _item("world.quaternion", i)
        getters[f"kalman.q{i}"] = _item("world.quaternion", i)
    for i in range(4):
        getters[f"motor.m{i + 1}"] = _duty_cycle("motors", i)
        getters[f"motor.m{i + 1}req"] = _duty_cycle("driver.requested", i)
        getters[f"health.motorVarXM{i + 1}"] = _item("health.variance", i, 0)
        getters[f"health.motorVarYM{i + 1}"] = _item("health.variance", i, 1)
    return getters


LIVE: dict[str, Getter] = _live()


# --- Parameters that reach into the controller: the gains and limits of its loops --------------


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
