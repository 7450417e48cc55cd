"""The battery's charge, fitted to its readings.

No current is measured on a Crazyflie. Assumed are a cell's resting voltage by its charge (`VOLTS`)
and the current at full thrust (`Drive`). Fitted are the sag under full thrust and `hunger`: how
much faster this battery empties than assumed, by least squares, with old readings fading:

    reading = rest voltage(charge) - sag * load,   d charge = -hunger * load * current / capacity dt
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

from perchctl.values import replace
from perchctl.vehicle import AUTO_ARM, FULL_THRUST, Telemetry, is_battery_reading

SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
VOLTS = (3.0, 3.4, 3.64, 3.76, 3.82, 3.86, 3.885, 3.915, 3.955, 3.995, 4.04, 4.1, 4.2)
"""Of the charge, and of the resting cell with it: a little below the firmware's own table."""
USUAL_SAG_V = 0.63
"""Sag under full thrust of a usual battery. Larger: attempts are refused that it has charge for."""
SAG_WITHIN_V = 0.3
"""Standard deviation of that between batteries. Smaller: a tired battery is noticed late."""
LEAST_SAG_V = 0.2
"""No battery sags less."""
USUAL_HUNGER = 1.1
"""Factor by which a usual battery empties faster than assumed."""
HUNGER_WITHIN = 0.3
"""Standard deviation of that between batteries."""
LEAST_HUNGER = 1.0
"""Bounds of the fitted factor."""
MOST_HUNGER = 3.0
READING_SIGMA_V = 0.02
"""Error of a second of readings."""
FADES_S = 40.0
"""Time in which a reading fades. Larger: a change with temperature is followed late."""
SMOOTH_S = 1.0
"""Time in which the resting voltage follows."""
LAG_S = 0.3
"""Time by which a reading is behind its thrust."""
STEADY_LOAD = 0.06
"""Share of full thrust: if it has changed by more, it does not belong to the reading."""
COUNTED_SHARE = 0.05
"""Charge below which the voltage alone tells what is spent."""
LEAST_LOAD = 0.2
"""Load from which on a reading shows the sag."""
LEAST_LOADED_S = 1.0
"""Time of such readings that an estimate needs."""
BATTERY_FRESH_S = 1.0
"""An older reading counts as none."""


@dataclass(frozen=True)
class EnergyState:
    """The battery as fitted so far.

    Shares are of the full charge, loads of full thrust. `fit_sums`, of least squares: sag^2, sag *
    hunger, hunger^2, and the two right sides.
    """

    ground_v: float | None = None  # resting, before take-off; estimated if read under load first
    used_share: float = 0.0  # by the count of the thrust, for a battery as assumed
    load: float = 0.0  # as the reading follows it
    mean_load: float = 0.0  # over the last seconds in the air
    rest_v: float | None = None  # estimated resting voltage now
    loaded_s: float = 0.0  # how long there were readings under load
    unknown_s: float = 0.0  # since the last reading
    fit_sums: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


# --- Brushed and brushless motors ---


@dataclass(frozen=True)
class Drive:
    """Motors with their supply.

    Attributes:
        full_a: current of four motors at full thrust, A; proportional to the thrust below.
        low_power_v: voltage below which the firmware reports low power, unless `pm.lowVoltage`
            is set.
    """

    full_a: float
    low_power_v: float


BRUSHED = Drive(full_a=4.4, low_power_v=3.2)
BRUSHLESS = Drive(full_a=7.3, low_power_v=3.35)
"""The current is not published. Taken is that of the brushed motors for each newton (0.80 N at full
thrust, 0.48 N brushed): an upper bound, since the brushless ones are built to be more efficient."""


def drive_of(telemetry: Telemetry) -> Drive:
    """The vehicle's motors: those that start by an arming request only are brushless."""
    return BRUSHED if telemetry.has_bit(AUTO_ARM) else BRUSHLESS


# --- The battery's state, fitted reading by reading ---


def read_battery(
    old: EnergyState, telemetry: Telemetry, age_s: float, dt_s: float, battery_mah: float
) -> EnergyState:
    """The state after the reading of a sample, `dt_s` after the one before; a reading that is
    `age_s` old counts as none if that is too old."""
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
    """The state `dt_s` later, under a commanded thrust 0..65535, for a battery of `battery_mah`.

    A `battery_v` that no cell can have, or NaN, counts as no reading."""
    load = max(0.0, min(1.0, thrust / FULL_THRUST))
    state = replace(
        state,
        used_share=state.used_share + load * full_thrust_share_per_s(battery_mah, drive) * dt_s,
        load=_towards(state.load, load, dt_s / LAG_S),
    )
    if load >= LEAST_LOAD:
        known = dt_s / 3.0 if state.mean_load else 1.0
        state = replace(state, mean_load=_towards(state.mean_load, load, known))
    if not is_battery_reading(battery_v):  # the last estimate, less what the thrust takes
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
    """The voltage sag under full thrust, V, and the factor (hunger) by which the charge falls
    faster than counted: a least-squares fit to the readings, regularised and bounded."""
    a, b, c, p, q = state.fit_sums
    a += SAG_WITHIN_V**-2
    c += HUNGER_WITHIN**-2
    det = a * c - b * b
    sag_v = USUAL_SAG_V + (c * p - b * q) / det
    hunger = USUAL_HUNGER + (a * q - b * p) / det
    return max(LEAST_SAG_V, sag_v), min(MOST_HUNGER, max(LEAST_HUNGER, hunger))


def charge_from_rest_v(rest_v: float) -> float:
    """The share of its charge, 0..1, that a cell of resting voltage `rest_v` has."""
    return min(1.0, max(0.0, _along(VOLTS, SHARES, rest_v)))


def rest_v_from_charge(share: float) -> float:
    """The resting voltage, V, of a cell with `share` (0..1) of its charge."""
    return _along(SHARES, VOLTS, share)


def _along(xs: tuple[float, ...], ys: tuple[float, ...], x: float) -> float:
    i = min(max(bisect_right(xs, x), 1), len(xs) - 1)
    return ys[i - 1] + (x - xs[i - 1]) * (ys[i] - ys[i - 1]) / (xs[i] - xs[i - 1])


def _summed(
    state: EnergyState, dt_s: float, battery_v: float
) -> tuple[float, float, float, float, float]:
    """`EnergyState.fit_sums` with one more reading, as deviations from the usual values."""
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
    """Share of the charge that a second of full thrust takes."""
    return drive.full_a / (3.6 * battery_mah)


def _towards(value: float, goal: float, part: float) -> float:
    return value + min(1.0, part) * (goal - value)
