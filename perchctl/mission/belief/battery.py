"""Estimate the battery's charge from its voltage readings.

A Crazyflie does not measure its battery current. The model therefore assumes a cell's resting
voltage as a function of its charge (`VOLTS`) and the current at full thrust (`Drive`). It fits two
parameters by least squares with exponential forgetting: the voltage sag at full thrust, and
`hunger`, the factor by which this battery discharges faster than the assumed current predicts:

    reading = rest voltage(charge) - sag * load,   d charge = -hunger * load * current / capacity dt
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

from perchctl.values import replace
from perchctl.vehicle import AUTO_ARM, FULL_THRUST, Telemetry, is_battery_reading

SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Charges (0..1) at which `VOLTS` gives the resting voltage."""
VOLTS = (3.0, 3.4, 3.64, 3.76, 3.82, 3.86, 3.885, 3.915, 3.955, 3.995, 4.04, 4.1, 4.2)
"""Resting voltage of a cell, V, at each charge in `SHARES` (0..1); slightly below the table in the
firmware."""
USUAL_SAG_V = 0.63
"""Voltage sag of a typical battery at full thrust, V. Larger: perchctl refuses attempts that the
battery could finish."""
SAG_WITHIN_V = 0.3
"""Standard deviation of the sag between batteries, V. Smaller: the fit recognizes a worn battery
late."""
LEAST_SAG_V = 0.2
"""Lower bound of the fitted sag, V; no battery sags less."""
USUAL_HUNGER = 1.1
"""Factor by which a typical battery discharges faster than the assumed current predicts."""
HUNGER_WITHIN = 0.3
"""Standard deviation of that factor between batteries."""
LEAST_HUNGER = 1.0
"""Lower bound of the fitted discharge factor."""
MOST_HUNGER = 3.0
"""Upper bound of the fitted discharge factor."""
READING_SIGMA_V = 0.02
"""Standard deviation of one second of averaged voltage readings, V."""
FADES_S = 40.0
"""Time constant with which the fit forgets old readings, s. Larger: the fit follows a change of
temperature late."""
SMOOTH_S = 1.0
"""Time constant of the low-pass filter on the resting voltage, s."""
LAG_S = 0.3
"""Time constant with which the voltage reading follows a change of thrust, s."""
STEADY_LOAD = 0.06
"""Largest difference between the current load and the filtered load, as a share of full thrust. A
reading with a larger difference belongs to an earlier thrust and is not used."""
COUNTED_SHARE = 0.05
"""Charge below which the count of the consumed charge is not used: the voltage curve is so steep
there that the readings alone determine the consumed charge."""
LEAST_LOAD = 0.2
"""Smallest load, as a share of full thrust, at which a reading contributes to the fitted sag."""
LEAST_LOADED_S = 1.0
"""Time of readings under load that an estimate requires, s."""
BATTERY_FRESH_S = 1.0
"""Age at which a voltage reading is no longer used, s."""


@dataclass(frozen=True)
class EnergyState:
    """State of the battery fit after the newest reading.

    Charges are shares of the full charge; loads are shares of full thrust. `fit_sums` holds the
    normal equations of the least-squares fit: the sums of sag^2, sag * hunger and hunger^2, then
    the two right-hand sides.
    """

    # resting voltage before take-off, estimated if the first reading was under load
    ground_v: float | None = None
    used_share: float = 0.0  # charge consumed by the assumed current alone
    load: float = 0.0  # load, low-pass filtered with `LAG_S` as the reading is
    mean_load: float = 0.0  # mean over the last seconds in the air
    rest_v: float | None = None  # estimated resting voltage now
    loaded_s: float = 0.0  # total time of readings under load
    unknown_s: float = 0.0  # time since the last reading
    fit_sums: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


# --- Brushed and brushless motors ---


@dataclass(frozen=True)
class Drive:
    """Motor type and its power supply.

    Attributes:
        full_a: current of the four motors at full thrust, A; at lower thrust, the current is
            assumed proportional to the thrust.
        low_power_v: voltage below which the firmware reports low power, V, unless `pm.lowVoltage`
            is set.
    """

    full_a: float
    low_power_v: float


BRUSHED = Drive(full_a=4.4, low_power_v=3.2)
"""Drive of the vehicles with brushed motors, which arm themselves."""
BRUSHLESS = Drive(full_a=7.3, low_power_v=3.35)
"""The current of the brushless motors is not published. The value assumes the same current per
newton as the brushed motors (0.80 N at full thrust, 0.48 N brushed). It is an upper bound because
brushless motors are designed to be more efficient."""


def drive_of(telemetry: Telemetry) -> Drive:
    """Return the vehicle's drive: motors that start only after an arming request are brushless."""
    return BRUSHED if telemetry.has_bit(AUTO_ARM) else BRUSHLESS


# --- The battery's state, fitted reading by reading ---


def read_battery(
    old: EnergyState, telemetry: Telemetry, age_s: float, dt_s: float, battery_mah: float
) -> EnergyState:
    """Return the state after the battery reading in a sample that follows the previous one by
    `dt_s`. A reading whose age `age_s` exceeds `BATTERY_FRESH_S` counts as missing."""
    reading_v = telemetry.battery_v if age_s <= BATTERY_FRESH_S else math.nan
    drive = drive_of(telemetry)
    return update_energy(old, dt_s, reading_v, telemetry.thrust, battery_mah, drive)


def update_energy(
    state: EnergyState,
    dt_s: float,
    battery_v: float,
    thrust: float,
    battery_mah: float,
    drive: Drive,
) -> EnergyState:
    """Return the state `dt_s` later, with the commanded thrust (0..65535) and a capacity of
    `battery_mah`.

    A `battery_v` that is NaN or that no cell can have counts as missing. The estimate then falls
    with the charge that the thrust consumes.
    """
    load = max(0.0, min(1.0, thrust / FULL_THRUST))
    state = replace(
        state,
        used_share=state.used_share + load * full_thrust_share_per_s(battery_mah, drive) * dt_s,
        load=_towards(state.load, load, dt_s / LAG_S),
    )
    if load >= LEAST_LOAD:
        known = dt_s / 3.0 if state.mean_load else 1.0
        state = replace(state, mean_load=_towards(state.mean_load, load, known))
    # reduce the last estimate by the charge that the thrust consumes
    if not is_battery_reading(battery_v):
        state = replace(state, unknown_s=state.unknown_s + dt_s)
        if state.rest_v is None:
            return state
        spent = (
            fit_sag_model(state)[1]
            * state.load
            * full_thrust_share_per_s(battery_mah, drive)
            * dt_s
        )
        return replace(state, rest_v=rest_v_from_charge(charge_from_rest_v(state.rest_v) - spent))
    state = replace(state, unknown_s=0.0)
    if load == 0.0 and not state.loaded_s:
        return replace(state, ground_v=battery_v, rest_v=battery_v)
    if abs(load - state.load) > STEADY_LOAD:
        return state
    if state.ground_v is None:
        state = replace(state, ground_v=battery_v + USUAL_SAG_V * state.load)
    if state.load >= LEAST_LOAD:
        fit = _summed(state, dt_s, battery_v)
        state = replace(state, fit_sums=fit, loaded_s=state.loaded_s + dt_s)
    now_v = battery_v + fit_sag_model(state)[0] * state.load
    rest_v = now_v if state.rest_v is None else _towards(state.rest_v, now_v, dt_s / SMOOTH_S)
    return replace(state, rest_v=rest_v)


def fit_sag_model(state: EnergyState) -> tuple[float, float]:
    """Return the sag at full thrust, V, and the factor (hunger) by which the charge falls faster
    than counted: a least-squares fit to the readings, regularized by the typical values and
    bounded."""
    a, b, c, p, q = state.fit_sums
    a += SAG_WITHIN_V**-2
    c += HUNGER_WITHIN**-2
    det = a * c - b * b
    sag_v = USUAL_SAG_V + (c * p - b * q) / det
    hunger = USUAL_HUNGER + (a * q - b * p) / det
    return max(LEAST_SAG_V, sag_v), min(MOST_HUNGER, max(LEAST_HUNGER, hunger))


def charge_from_rest_v(rest_v: float) -> float:
    """Return the charge (0..1) of a cell with the resting voltage `rest_v`."""
    return min(1.0, max(0.0, _along(VOLTS, SHARES, rest_v)))


def rest_v_from_charge(share: float) -> float:
    """Return the resting voltage, V, of a cell with the charge `share` (0..1)."""
    return _along(SHARES, VOLTS, share)


def _along(xs: tuple[float, ...], ys: tuple[float, ...], x: float) -> float:
    i = min(max(bisect_right(xs, x), 1), len(xs) - 1)
    return ys[i - 1] + (x - xs[i - 1]) * (ys[i] - ys[i - 1]) / (xs[i] - xs[i - 1])


def _summed(
    state: EnergyState, dt_s: float, battery_v: float
) -> tuple[float, float, float, float, float]:
    """Return `EnergyState.fit_sums` after one more reading, as deviations from the typical
    values."""
    assert state.ground_v is not None
    begun = charge_from_rest_v(state.ground_v)
    counted = max(min(begun, COUNTED_SHARE), begun - state.used_share)
    spent_v = rest_v_from_charge(begun) - rest_v_from_charge(counted)
    off_v = state.ground_v - battery_v - USUAL_SAG_V * state.load - USUAL_HUNGER * spent_v
    weight, keep = dt_s / READING_SIGMA_V**2, math.exp(-dt_s / FADES_S)
    a, b, c, p, q = (keep * each for each in state.fit_sums)
    return (
        a + weight * state.load * state.load,
        b + weight * state.load * spent_v,
        c + weight * spent_v * spent_v,
        p + weight * state.load * off_v,
        q + weight * spent_v * off_v,
    )


def full_thrust_share_per_s(battery_mah: float, drive: Drive) -> float:
    """Return the share of the full charge that one second of full thrust consumes."""
    return drive.full_a / (3.6 * battery_mah)


def _towards(value: float, goal: float, part: float) -> float:
    return value + min(1.0, part) * (goal - value)
