"""A recorded flight of a real or a simulated Crazyflie, and what the record tells of the vehicle.

A `Recording` has one row every 10 ms. Axes are perchctl's: x forward, y left, z up, roll to the
right, pitch nose down; all angles are in radians. Every estimator takes a `Recording` alone, so
that the same function measures the record and its replay in the simulator. An estimator returns
NaN if the record cannot answer it.

docs/real-flights.md has the equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt

from perchctl.geometry import (
    GRAVITY_MPS2,
    Array,
    rotation_from_quaternion,
    rpy_from_rotation,
)
from perchctl.sim.powertrain import FULL_COMMAND, MOTOR_CURRENT_A, MOTOR_FORCE_N, thrust_n
from perchctl.sim.world import ARM_M, INERTIA_REFERENCE_KG, INERTIA_REFERENCE_KGM2

ROW_S = 0.01
MARGIN_S, MARGIN_SHARE = 3.0, 0.3
"""Cut from both ends of a flight to get its cruise; of a short flight the share."""
LONG_S = 5.0
"""Least cruise for what is regressed at low frequencies."""
LIFTED_M = 0.02
CRASHED_RAD = math.radians(60.0)
NAN = math.nan

POSITION = ("px", "py", "pz")
ATTITUDE = ("roll", "pitch", "yaw")
ESTIMATED = tuple(f"att_stateEstimate_{angle}" for angle in ATTITUDE)
SETPOINT = tuple(f"sp_ctrltarget_{name}" for name in ("x", "y", "z", "yaw"))
GYRO = tuple(f"imu_gyro_{axis}" for axis in "xyz")
ACCELEROMETER = tuple(f"imu_acc_{axis}" for axis in "xyz")
MOTORS = tuple(f"motor_motor_m{i}" for i in (1, 2, 3, 4))
BATTERY, TIME, PID_THRUST = "pwr_pm_vbat", "t", "pid_controller_cmd_thrust"
COLUMNS = (
    TIME, *POSITION, *ATTITUDE, *GYRO, *ACCELEROMETER, *MOTORS, *ESTIMATED, *SETPOINT,
    PID_THRUST, BATTERY,
)  # fmt: skip
"""The columns of a NanoBench file that are read."""


class UnreadableRecord(ValueError):
    """The file is not a flight in NanoBench's layout."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One flight; n rows, `ROW_S` apart.

    Attributes:
        position_m, rpy_rad: (n, 3), by motion capture.
        estimated_rpy_rad: (n, 3), the vehicle's own estimate.
        setpoint: (n, 4), x, y, z in m and yaw in rad; zeros while there is none.
        gyro_radps, acc_g: (n, 3), body axes.
        duty: (n, 4), duty cycles of M1..M4, 0..1.
        battery_v: (n,), under load.
        by_pid: the PID controller flew it.
        has_setpoints: the setpoints are the recorded ones, not made up from the path.
    """

    name: str
    position_m: Array
    rpy_rad: Array
    estimated_rpy_rad: Array
    setpoint: Array
    gyro_radps: Array
    acc_g: Array
    duty: Array
    battery_v: Array
    by_pid: bool = True
    has_setpoints: bool = True
    begin: int = field(init=False)
    end: int = field(init=False)

    def __post_init__(self) -> None:
        running = np.flatnonzero(self.duty.max(axis=1) > 0.0)
        first, last = (int(running[0]), int(running[-1]) + 1) if len(running) else (0, 0)
        object.__setattr__(self, "begin", first)
        object.__setattr__(self, "end", last)

    @property
    def cruise(self) -> slice:
        """The rows between take-off and landing; may be empty."""
        margin = min(round(MARGIN_S / ROW_S), round(MARGIN_SHARE * (self.end - self.begin)))
        return slice(self.begin + margin, self.end - margin)

    @property
    def is_long(self) -> bool:
        """The cruise is long enough for regressions at low frequencies."""
        return bool(self.cruise.stop - self.cruise.start >= round(LONG_S / ROW_S))

    @property
    def lift_off(self) -> int | None:
        """The first row above the floor by `LIFTED_M`; None if the vehicle never rose."""
        rise_m = self.position_m[self.begin : self.end, 2] - self.position_m[self.begin, 2]
        risen = np.flatnonzero(rise_m > LIFTED_M)
        return self.begin + int(risen[0]) if len(risen) else None

    @property
    def rest_v(self) -> float:
        """The battery's voltage before the motors start."""
        return float(np.median(self.battery_v[: max(1, self.begin - 20)]))

    def thrusts_n(self) -> Array:
        """(n, 4): each motor's steady thrust at its duty cycle, by perchctl's curve."""
        volts = self.duty * self.battery_v[:, None]
        grid = np.linspace(0.0, 5.0, 2001)
        return np.interp(volts, grid, [thrust_n(float(v)) for v in grid])

    def mass_kg(self) -> float:
        """The mass that perchctl's thrust curve lifts in this flight: sum(T) / (g a_z)."""
        c = self.cruise
        pull_mps2 = GRAVITY_MPS2 * float(self.acc_g[c, 2].mean())
        return float(self.thrusts_n()[c].sum(axis=1).mean()) / pull_mps2

    def unusable(self) -> str | None:
        """Say why the flight cannot be compared with the simulator's; None if it can."""
        c = self.cruise
        if self.end == 0:
            return "the motors never ran"
        if not self.by_pid:
            return "not flown by the PID controller"
        if self.lift_off is None or c.stop - c.start < round(1.0 / ROW_S):
            return "too short"
        if self.end >= len(self.duty) or np.abs(self.rpy_rad[: self.end, :2]).max() > CRASHED_RAD:
            return "crashed"
        if np.median(self.position_m[c, 2]) - self.position_m[0, 2] < 0.3:
            return "did not climb"
        return None


def read_recordings(path: Path) -> list[Recording]:
    """The flights in a file of either layout; none if it is another table.

    Raises UnreadableRecord if the rows are missing or hold anything but numbers."""
    try:
        with path.open(encoding="utf-8") as file:
            names = file.readline().strip().lstrip("# ").split(",")
    except (OSError, UnicodeDecodeError) as error:
        raise UnreadableRecord(str(error)) from error
    if set(COLUMNS) <= set(names):
        return [_nanobench(path, names)]
    if set(SWARM_COLUMNS) <= set(names) and path.parent.name == SWARM_FOLDER:
        return _neural_swarm(path, names)
    return []


def _columns(path: Path, names: list[str], wanted: tuple[str, ...]) -> dict[str, Array]:
    try:
        table = np.loadtxt(
            path, delimiter=",", skiprows=1, ndmin=2, usecols=[names.index(n) for n in wanted]
        )
    except ValueError as error:
        raise UnreadableRecord(str(error)) from error
    if len(table) < 100 or not np.isfinite(table).all():
        raise UnreadableRecord("less than 1 s of numbers")
    return dict(zip(wanted, table.T, strict=True))


def _nanobench(path: Path, names: list[str]) -> Recording:
    table = _columns(path, names, COLUMNS)

    def stacked(wanted: tuple[str, ...]) -> Array:
        return np.stack([table[name] for name in wanted], axis=1)

    setpoint = stacked(SETPOINT)
    setpoint[:, 3] = np.radians(setpoint[:, 3])
    return Recording(
        path.stem,
        stacked(POSITION),
        stacked(ATTITUDE),
        np.radians(stacked(ESTIMATED)) * (1.0, -1.0, 1.0),  # its pitch is nose up
        setpoint,
        stacked(GYRO),
        stacked(ACCELEROMETER),
        stacked(MOTORS) / FULL_COMMAND,
        table[BATTERY],
        bool(table[PID_THRUST].any()),
    )


SWARM_FOLDER = "takeoff_s"
"""Flights of single vehicles with stock rotors."""
SWARM_TIME, SWARM_BATTERY = "time[ms]", "Vbat[V]"
SWARM_POSITION = ("x[m]", "y[m]", "z[m]")
SWARM_FORCE = ("ax[m/s^2]", "ay[m/s^2]", "az[m/s^2]")
SWARM_QUATERNION = ("qw", "qx", "qy", "qz")
SWARM_DUTY = tuple(f"u{i}[PWM]" for i in (1, 2, 3, 4))
SWARM_GYRO = ("wx[rad/s]", "wy[rad/s]", "wz[rad/s]")
SWARM_COLUMNS = (
    SWARM_TIME, *SWARM_POSITION, *SWARM_FORCE, *SWARM_QUATERNION, *SWARM_DUTY, SWARM_BATTERY,
    *SWARM_GYRO,
)  # fmt: skip
STANDING_ROWS = 100
LEAD_S = 0.3
"""The made-up setpoint is the recorded path so much later: about the position loop's delay."""


def _neural_swarm(path: Path, names: list[str]) -> list[Recording]:
    """Cut a file into its flights, and put 1 s of standing still before each."""
    table = _columns(path, names, SWARM_COLUMNS)
    t_s = 1e-6 * table[SWARM_TIME]  # microseconds, whatever the header says
    rows_s = np.arange(t_s[0], t_s[-1], ROW_S)
    table = {name: np.interp(rows_s, t_s, column) for name, column in table.items()}

    def stacked(wanted: tuple[str, ...]) -> Array:
        return np.stack([table[name] for name in wanted], axis=1)

    duty = stacked(SWARM_DUTY)
    spinning = np.concatenate(([False], duty.max(axis=1) > 0.0, [False]))
    switches = np.flatnonzero(np.diff(spinning.astype(int)))
    columns = (
        stacked(SWARM_POSITION),
        np.array([_rpy(q) for q in stacked(SWARM_QUATERNION)]),
        stacked(SWARM_GYRO),
        stacked(SWARM_FORCE) / GRAVITY_MPS2,
        duty,
        table[SWARM_BATTERY],
    )
    flights = []
    for number, (first, last) in enumerate(switches.reshape(-1, 2).tolist(), 1):
        before, after = max(0, first - 1), min(len(duty), last + 5)
        position, rpy, gyro, acc, turning, volts = (
            np.concatenate([np.repeat(c[before : before + 1], STANDING_ROWS, axis=0),
                            c[before:after]])
            for c in columns
        )  # fmt: skip
        turning[:STANDING_ROWS] = 0.0
        lead = round(LEAD_S / ROW_S)
        path_m = np.concatenate([position[lead:], np.repeat(position[-1:], lead, axis=0)])
        flights.append(
            Recording(
                f"{path.stem}#{number}",
                position,
                rpy,
                np.full_like(rpy, NAN),
                np.column_stack([low_pass(path_m, 2.0), np.full(len(rpy), rpy[0, 2])]),
                gyro,
                acc,
                turning,
                volts,
                has_setpoints=False,
            )
        )
    return flights


def _rpy(quaternion: Array) -> tuple[float, float, float]:
    w, x, y, z = quaternion.tolist()
    return rpy_from_rotation(rotation_from_quaternion((w, x, y, z)))


# --- Filters: without phase, along the rows ---


def low_pass(x: Array, hz: float) -> Array:
    """Second-order Butterworth, forwards and backwards."""
    sos = butter(2, hz, fs=1.0 / ROW_S, output="sos")
    return np.asarray(sosfiltfilt(sos, x, axis=0))


def high_pass(x: Array, hz: float) -> Array:
    """Fourth-order Butterworth, forwards and backwards."""
    sos = butter(4, hz, btype="highpass", fs=1.0 / ROW_S, output="sos")
    return np.asarray(sosfiltfilt(sos, x, axis=0))


def band_pass(x: Array, low_hz: float, high_hz: float) -> Array:
    """Second-order Butterworth, forwards and backwards."""
    sos = butter(2, (low_hz, high_hz), btype="bandpass", fs=1.0 / ROW_S, output="sos")
    return np.asarray(sosfiltfilt(sos, x, axis=0))


def body_velocity(r: Recording, hz: float = 2.0) -> Array:
    """(n, 2): velocity along the heading and to its left, m/s, below `hz`."""
    v = low_pass(np.gradient(r.position_m[:, :2], ROW_S, axis=0), hz)
    cos, sin = np.cos(r.rpy_rad[:, 2]), np.sin(r.rpy_rad[:, 2])
    return np.stack([v[:, 0] * cos + v[:, 1] * sin, v[:, 1] * cos - v[:, 0] * sin], axis=1)


def torques_nm(r: Recording) -> Array:
    """(n, 2): the torque about x and y that the duty cycles ask for, by perchctl's curve."""
    f1, f2, f3, f4 = r.thrusts_n().T
    arm_m = ARM_M * math.sqrt(0.5)
    return np.stack([arm_m * (f3 + f4 - f1 - f2), arm_m * (f2 + f3 - f1 - f4)], axis=1)


def slope(x: Array, y: Array) -> float:
    """Least squares of y = a + b x: b."""
    x = x - x.mean()
    return float(x @ (y - y.mean()) / (x @ x)) if (x @ x) > 0.0 else NAN


# --- Estimators ---

MOST_DELAY_S = 1.2
LEAST_PATH_M = 0.2  # standard deviation of the setpoint: below it, no delay can be measured


def tracking_delay_ms(r: Recording) -> float:
    """The shift of the setpoint that fits the level position best."""
    c = r.cruise
    if not r.has_setpoints or r.setpoint[c, :2].std(axis=0).max() < LEAST_PATH_M:
        return NAN
    p = r.position_m[c, :2]
    errors = []
    for shift in range(round(MOST_DELAY_S / ROW_S)):
        wanted = r.setpoint[c.start - shift : c.stop - shift, :2]
        errors.append(float(((p - wanted) ** 2).sum(axis=1).mean()))
    return 1e3 * ROW_S * minimum_of(errors)


def minimum_of(values: list[float]) -> float:
    """The place of the least value, by a parabola through its neighbours; NaN at an end."""
    i = int(np.argmin(values))
    if not 0 < i < len(values) - 1:
        return NAN
    before, least, after = values[i - 1 : i + 2]
    bend = before - 2.0 * least + after
    return i + 0.5 * (before - after) / bend if bend > 0.0 else float(i)


def tracking_rms_m(r: Recording) -> float:
    """RMS level distance from the setpoint of the same row."""
    c = r.cruise
    if not r.has_setpoints:
        return NAN
    return float(np.sqrt(((r.position_m[c, :2] - r.setpoint[c, :2]) ** 2).sum(axis=1).mean()))


RUN_S = 1.5


def _ascent(r: Recording) -> slice:
    first = r.begin if r.lift_off is None else r.lift_off
    return slice(first, min(r.end, first + round(RUN_S / ROW_S)))


def take_off_run_mm(r: Recording) -> float:
    """The largest level distance from the start within `RUN_S` of lift-off."""
    if not r.has_setpoints:
        return NAN
    run_m = r.position_m[_ascent(r), :2] - r.position_m[: r.begin + 1, :2].mean(axis=0)
    return 1e3 * float(np.hypot(*run_m.T).max())


def take_off_turn_deg(r: Recording) -> float:
    """The largest change of heading within `RUN_S` of lift-off."""
    if not r.has_setpoints:
        return NAN
    turn = np.unwrap(r.rpy_rad[:, 2])
    return math.degrees(float(np.abs(turn[_ascent(r)] - turn[: r.begin + 1].mean()).max()))


def take_off_tilt_deg(r: Recording) -> float:
    """The largest tilt within `RUN_S` of lift-off, less the mounting of the markers."""
    if not r.has_setpoints:
        return NAN
    tilt = r.rpy_rad[_ascent(r), :2] - r.rpy_rad[: r.begin + 1, :2].mean(axis=0)
    return math.degrees(float(np.hypot(*tilt.T).max()))


def _climb(r: Recording) -> tuple[Array, float] | None:
    """Height above the floor in the first 4 s with motors, and the setpoint's; None if the setpoint
    does not stay where it ends."""
    if not r.has_setpoints:
        return None
    rows = slice(r.begin, min(r.end, r.begin + round(4.0 / ROW_S)))
    floor_m = r.position_m[r.begin, 2]
    height_m, wanted_m = r.position_m[rows, 2] - floor_m, r.setpoint[rows, 2] - floor_m
    goal_m = float(wanted_m[-1])
    stays = np.abs(wanted_m[-round(1.0 / ROW_S) :] - goal_m).max() < 0.02
    return (height_m, goal_m) if stays and height_m.max() > goal_m > 0.1 else None


def overshoot_m(r: Recording) -> float:
    """The highest point of the climb less the setpoint."""
    climb = _climb(r)
    return NAN if climb is None else float(climb[0].max()) - climb[1]


def rise_s(r: Recording) -> float:
    """From 10 to 90 % of the climb."""
    climb = _climb(r)
    if climb is None:
        return NAN
    tenth, most = (np.flatnonzero(climb[0] > share * climb[1])[0] for share in (0.1, 0.9))
    return ROW_S * float(most - tenth)


def lift_off_s(r: Recording) -> float:
    """From the motors' start to lift-off."""
    if r.lift_off is None or not r.has_setpoints:
        return NAN
    return ROW_S * (r.lift_off - r.begin)


LEAST_SPEED_MPS = 0.15  # standard deviation: below it, drag and moment drown


def drag_per_s(r: Recording) -> float:
    """Level drag per mass and airspeed: -slope of the specific force on the velocity."""
    c = r.cruise
    v, force = body_velocity(r)[c], GRAVITY_MPS2 * low_pass(r.acc_g[:, :2], 2.0)[c]
    v, force = v - v.mean(axis=0), force - force.mean(axis=0)
    if not r.is_long or v.std(axis=0).max() < LEAST_SPEED_MPS:
        return NAN
    return -slope(v.ravel(), force.ravel())


@dataclass(frozen=True)
class Authority:
    """What a torque asked of the motors does.

    Attributes:
        ratio: angular acceleration over the one that perchctl's inertia predicts.
        lag_ms: from the command to the response: a first-order lag's time and a delay.
    """

    ratio: float
    lag_ms: float


LAGS_S = np.arange(13) * 0.01
DELAYS = range(9)  # rows


@lru_cache(maxsize=4)
def authority(r: Recording, axis: int) -> Authority:
    """Regress the angular acceleration about x (0) or y (1) on the torque, at 1 to 6 Hz.

    The torque passes a first-order lag and a delay first, those of the best correlation. Motors
    also answer disturbances, so the ratio is too small where wind and not setpoints moves them."""
    if not r.is_long:
        return Authority(NAN, NAN)
    c, inertia = r.cruise, INERTIA_REFERENCE_KGM2[axis] * r.mass_kg() / INERTIA_REFERENCE_KG
    asked = torques_nm(r)[:, axis] / inertia
    turned = band_pass(np.gradient(r.gyro_radps[:, axis], ROW_S), 1.0, 6.0)[c]
    best, ratio, lag_s = 0.0, NAN, NAN
    for tau_s in LAGS_S:
        given = band_pass(lagged(asked, float(tau_s)), 1.0, 6.0)
        for delay in DELAYS:
            cause = given[c.start - delay : c.stop - delay]
            correlation = float(np.corrcoef(cause, turned)[0, 1])
            if correlation > best:
                best, ratio = correlation, slope(cause, turned)
                lag_s = float(tau_s) + delay * ROW_S
    return Authority(ratio, 1e3 * lag_s)


def lagged(x: Array, tau_s: float) -> Array:
    """A first-order lag along the rows."""
    keep = math.exp(-ROW_S / tau_s) if tau_s > 0.0 else 0.0
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x, axis=0))


def imbalance_percent(r: Recording) -> float:
    """Strongest less weakest motor's thrust in cruise, of their mean."""
    each_n = r.thrusts_n()[r.cruise].mean(axis=0)
    return 100.0 * float(np.ptp(each_n) / each_n.mean())


def turning_dps(r: Recording, low_hz: float, high_hz: float) -> float:
    """RMS of roll and pitch rate between two frequencies in cruise."""
    turning = np.stack([band_pass(r.gyro_radps[:, k], low_hz, high_hz) for k in (0, 1)])
    return math.degrees(float(turning[:, r.cruise].std()))


def gyro_noise_dps(r: Recording, axes: tuple[int, ...]) -> float:
    """RMS above 20 Hz in cruise."""
    return math.degrees(float(high_pass(r.gyro_radps[:, axes], 20.0)[r.cruise].std()))


def acc_noise_g(r: Recording) -> float:
    """RMS along z above 8 Hz in cruise."""
    return float(high_pass(r.acc_g[:, 2], 8.0)[r.cruise].std())


def sag_ohm(r: Recording) -> float:
    """Fall of the voltage 1 s after lift-off, over the current of perchctl's motors."""
    if r.lift_off is None:
        return NAN
    row = r.lift_off + round(1.0 / ROW_S)
    rows = slice(row - 10, row + 11)
    amperes = MOTOR_CURRENT_A / MOTOR_FORCE_N * float(r.thrusts_n()[rows].sum(axis=1).mean())
    return (r.rest_v - float(r.battery_v[rows].mean())) / amperes if amperes > 0.0 else NAN


def discharge_mv_per_s(r: Recording) -> float:
    """Fall of the voltage in cruise: the slope of a straight line."""
    c = r.cruise
    if not r.is_long:
        return NAN
    return -1e3 * slope(ROW_S * np.arange(c.stop - c.start), r.battery_v[c])


MOST_CLOCK_ROWS = 8


def tilt_error_deg(r: Recording, axis: int) -> float:
    """Standard deviation of the estimated less the true roll (0) or pitch (1).

    The motion capture's clock is shifted by up to 80 ms to fit best, for record and replay."""
    c = r.cruise
    estimated, true = r.estimated_rpy_rad[:, axis], r.rpy_rad[c, axis]
    return math.degrees(
        min(
            float((estimated[c.start + s : c.stop + s] - true).std())
            for s in range(-MOST_CLOCK_ROWS, MOST_CLOCK_ROWS + 1)
        )
    )


def moment_nm_per_mps(r: Recording, axis: int) -> float:
    """Moment of the air that tips the vehicle away from its motion, about x (0) or y (1), by speed.

    The motors hold it, so it is what they are asked for at less than 0.5 Hz: forward flight (+x)
    lifts the nose, and the motors push it down (+y)."""
    c = r.cruise
    v, torque = body_velocity(r, 0.5)[c, 1 - axis], low_pass(torques_nm(r)[:, axis], 0.5)[c]
    if not r.is_long or v.std() < LEAST_SPEED_MPS:
        return NAN
    return slope(v, torque) * (-1.0, 1.0)[axis]


ASSUMED_LAG_S = 0.04
NEAR_FLOOR_M = ((0.01, 0.03), (0.03, 0.07))
FREE_M = 0.07


def ground_effect(r: Recording, band: int) -> float:
    """Thrust needed for the specific force at a clearance of `NEAR_FLOOR_M`, as a share of that
    needed above `FREE_M`."""
    flown = slice(r.begin, r.end)
    clearance_m = (r.position_m[:, 2] - r.position_m[0, 2])[flown]
    thrust_n = lagged(r.thrusts_n().sum(axis=1), ASSUMED_LAG_S)[flown]
    force_g = low_pass(r.acc_g[:, 2], 8.0)[flown]
    low_m, high_m = NEAR_FLOOR_M[band]
    near, free = (clearance_m > low_m) & (clearance_m < high_m), clearance_m > FREE_M
    if near.sum() < 5 or not free.any():
        return NAN
    needed = [thrust_n[rows].sum() / force_g[rows].sum() for rows in (near, free)]
    return float(needed[0] / needed[1])


@dataclass(frozen=True)
class Item:
    """One line of the comparison."""

    name: str
    unit: str
    measure: Callable[[Recording], float]


ITEMS = (
    Item("apparent mass", "g", lambda r: 1e3 * r.mass_kg()),
    Item("tracking delay, level", "ms", tracking_delay_ms),
    Item("tracking error, level, RMS", "m", tracking_rms_m),
    Item("motors' start to lift-off", "s", lift_off_s),
    Item("take-off: lateral run", "mm", take_off_run_mm),
    Item("take-off: turn", "deg", take_off_turn_deg),
    Item("take-off: tilt", "deg", take_off_tilt_deg),
    Item("take-off: overshoot", "m", overshoot_m),
    Item("take-off: rise time", "s", rise_s),
    Item("thrust needed 1..3 cm up", "1", lambda r: ground_effect(r, 0)),
    Item("thrust needed 3..7 cm up", "1", lambda r: ground_effect(r, 1)),
    Item("drag per mass, level", "1/s", drag_per_s),
    Item("authority, roll", "1", lambda r: authority(r, 0).ratio),
    Item("authority, pitch", "1", lambda r: authority(r, 1).ratio),
    Item("command to response, roll", "ms", lambda r: authority(r, 0).lag_ms),
    Item("command to response, pitch", "ms", lambda r: authority(r, 1).lag_ms),
    Item("motor imbalance", "%", imbalance_percent),
    Item("gyro at 0.5..1.5 Hz", "deg/s", lambda r: turning_dps(r, 0.5, 1.5)),
    Item("gyro at 1.5..4 Hz", "deg/s", lambda r: turning_dps(r, 1.5, 4.0)),
    Item("gyro at 4..8 Hz", "deg/s", lambda r: turning_dps(r, 4.0, 8.0)),
    Item("gyro at 8..20 Hz", "deg/s", lambda r: turning_dps(r, 8.0, 20.0)),
    Item("gyro above 20 Hz, roll and pitch", "deg/s", lambda r: gyro_noise_dps(r, (0, 1))),
    Item("gyro above 20 Hz, yaw", "deg/s", lambda r: gyro_noise_dps(r, (2,))),
    Item("accelerometer above 8 Hz, z", "g", acc_noise_g),
    Item("battery sag", "ohm", sag_ohm),
    Item("battery discharge in flight", "mV/s", discharge_mv_per_s),
    Item("estimated roll, error", "deg", lambda r: tilt_error_deg(r, 0)),
    Item("estimated pitch, error", "deg", lambda r: tilt_error_deg(r, 1)),
    Item("moment by speed, roll", "mN.m/(m/s)", lambda r: 1e3 * moment_nm_per_mps(r, 0)),
    Item("moment by speed, pitch", "mN.m/(m/s)", lambda r: 1e3 * moment_nm_per_mps(r, 1)),
)


def measure(r: Recording) -> list[float]:
    """The value of each of `ITEMS`."""
    return [item.measure(r) for item in ITEMS]
