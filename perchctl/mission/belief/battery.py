"""Estimate the battery's charge from its voltage readings.

A Crazyflie does not measure its battery current. The model therefore assumes a cell's resting
voltage as a function of its charge (`DISCHARGE_CURVE_REST_VOLTAGES_V`) and the current at full
thrust (`PowerTrain`). Two parameters are fitted by least squares with exponential forgetting: the
voltage sag at full thrust, and `true_to_coulomb_counted_discharge_ratio`, the discharge rate of
this battery divided by the rate calculated from the assumed current:

    reading = rest voltage(charge) - sag * load
    d charge / dt = -true_to_coulomb_counted_discharge_ratio * load * current / capacity
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import NamedTuple

from perchctl.values import replace
from perchctl.vehicle import AUTO_ARM, FULL_THRUST, Telemetry, is_battery_reading

DISCHARGE_CURVE_CHARGE_FRACTIONS = (
    0.0,
    0.02,
    0.05,
    0.1,
    0.2,
    0.3,
    0.4,
    0.5,
    0.6,
    0.7,
    0.8,
    0.9,
    1.0,
)
"""Charges (0..1) at which `DISCHARGE_CURVE_REST_VOLTAGES_V` gives the resting voltage."""
DISCHARGE_CURVE_REST_VOLTAGES_V = (
    3.0,
    3.4,
    3.64,
    3.76,
    3.82,
    3.86,
    3.885,
    3.915,
    3.955,
    3.995,
    4.04,
    4.1,
    4.2,
)
"""Resting voltage of a cell, V, at each charge in `DISCHARGE_CURVE_CHARGE_FRACTIONS` (0..1); the
values are slightly below those in the firmware's table."""
TYPICAL_FULL_THRUST_SAG_V = 0.63
"""Voltage sag of a typical battery at full thrust, V. Larger: perchctl refuses attempts that the
battery could finish."""
FULL_THRUST_SAG_PRIOR_SIGMA_V = 0.3
"""Standard deviation of the sag between batteries, V. Smaller: the fit takes longer to recognize a
worn battery."""
MIN_FITTED_FULL_THRUST_SAG_V = 0.2
"""Lower bound of the fitted sag, V; no battery sags less."""
TYPICAL_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO = 1.1
"""Discharge rate of a typical battery, divided by the rate calculated from the assumed current."""
TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO_PRIOR_SIGMA = 0.3
"""Standard deviation of the ratio of true to calculated discharge between batteries."""
MIN_FITTED_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO = 1.0
"""Lower bound of the fitted ratio of true to calculated discharge."""
MAX_FITTED_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO = 3.0
"""Upper bound of the fitted ratio of true to calculated discharge."""
ONE_SECOND_MEAN_VOLTAGE_READING_SIGMA_V = 0.02
"""Standard deviation of the mean of the voltage readings over one second, V."""
BATTERY_FIT_FORGETTING_TIME_CONSTANT_S = 40.0
"""Time constant with which the fit forgets old readings, s. Larger: the fit adapts too slowly to a
change in temperature."""
REST_VOLTAGE_FILTER_TIME_CONSTANT_S = 1.0
"""Time constant of the low-pass filter on the resting voltage, s."""
THRUST_TO_VOLTAGE_LAG_TIME_CONSTANT_S = 0.3
"""Time constant with which the voltage reading follows a change in thrust, s."""
MAX_RECENT_THRUST_CHANGE_FRACTION_TO_USE_VOLTAGE = 0.06
"""Largest difference between the present load and the filtered load, as a fraction of full thrust.
With a larger difference, the voltage reading still reflects an earlier thrust and is not used."""
MIN_CHARGE_FRACTION_TO_USE_COULOMB_COUNTING = 0.05
"""Fraction of the full charge below which the discharge calculated from the assumed current is not
used: the voltage curve is so steep there that the readings alone determine the charge."""
MIN_THRUST_FRACTION_TO_FIT_BATTERY_MODEL = 0.2
"""Smallest load, as a fraction of full thrust, at which a reading contributes to the fitted sag."""
MIN_TIME_UNDER_LOAD_TO_FIT_BATTERY_MODEL_S = 1.0
"""Total time of readings under load that an estimate requires, s."""
FIRMWARE_LOW_POWER_REPORT_DELAY_S = 5.0
"""Time below the low-power voltage after which the firmware reports low power, s (from the power
management in the firmware source). Larger: perchctl starts attempts that the battery cannot
finish."""
MAX_BATTERY_READING_AGE_TO_UPDATE_FIT_S = 1.0
"""Age beyond which a voltage reading is no longer used, s."""


class BatteryVoltageModel(NamedTuple):
    """The two fitted parameters of the battery model: the voltage sag at full thrust, V, and the
    true discharge rate divided by the rate calculated from the assumed current."""

    full_thrust_sag_v: float
    true_to_coulomb_counted_discharge_ratio: float


class BatteryNormalEquationSums(NamedTuple):
    """Weighted sums over the voltage readings: the normal equations of the least-squares fit.

    The error of a reading is its deviation, V, from what `TYPICAL_FULL_THRUST_SAG_V` and
    `TYPICAL_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO` predict. The fit models this error as a sum of
    two products: the thrust, as a fraction of full thrust, times the deviation of the sag from its
    typical value; and the drop of the resting voltage since take-off, V, calculated from the
    assumed current, times the deviation of the discharge ratio.
    """

    thrust_squared: float = 0.0
    thrust_times_rest_v_drop: float = 0.0
    rest_v_drop_squared: float = 0.0
    thrust_times_voltage_error: float = 0.0
    rest_v_drop_times_voltage_error: float = 0.0


ZERO_NORMAL_EQUATION_SUMS = BatteryNormalEquationSums()


@dataclass(frozen=True)
class BatteryFitState:
    """State of the battery fit after the newest reading. The fit determines two unknowns: the
    voltage sag at full thrust, V, and the true discharge rate divided by the rate calculated from
    the assumed current.

    Attributes:
        takeoff_rest_v: resting voltage (without load) before take-off, estimated if the first
            reading was under load; None while unknown.
        coulomb_counted_discharge_fraction: charge consumed so far by the assumed current, as a
            fraction of the full charge.
        lagged_thrust_fraction: thrust, as a fraction of full thrust, delayed by a low-pass filter
            like the voltage reading.
        mean_airborne_thrust_fraction: mean thrust over the last seconds in the air, as a fraction
            of full thrust.
        rest_v: estimated resting voltage now; None while unknown.
        time_under_load_s: total time covered by readings under load.
        time_since_battery_reading_s: time since the last reading.
        normal_equation_sums: sums of the least-squares fit.
    """

    # resting voltage before take-off, estimated if the first reading was under load
    takeoff_rest_v: float | None = None
    coulomb_counted_discharge_fraction: float = 0.0  # charge consumed by the assumed current alone
    # load after a low-pass filter with `THRUST_TO_VOLTAGE_LAG_TIME_CONSTANT_S`, because the voltage
    # reading lags in the same way
    lagged_thrust_fraction: float = 0.0
    mean_airborne_thrust_fraction: float = 0.0  # mean over the last seconds in the air
    rest_v: float | None = None  # estimated resting voltage now
    time_under_load_s: float = 0.0  # total time covered by readings under load
    time_since_battery_reading_s: float = 0.0  # time since the last reading
    normal_equation_sums: BatteryNormalEquationSums = ZERO_NORMAL_EQUATION_SUMS


# --- Brushed and brushless motors ---


@dataclass(frozen=True)
class PowerTrain:
    """Electrical parameters of one motor type, brushed or brushless.

    Attributes:
        full_thrust_current_a: current of the four motors at full thrust, A; at lower thrust, the
            current is assumed to be proportional to the thrust.
        low_power_warning_v: voltage below which the firmware reports low power, V, unless
            `pm.lowVoltage` is set.
    """

    full_thrust_current_a: float
    low_power_warning_v: float


BRUSHED_POWER_TRAIN = PowerTrain(full_thrust_current_a=4.4, low_power_warning_v=3.2)
"""Power train of vehicles with brushed motors, which arm themselves."""
BRUSHLESS_POWER_TRAIN = PowerTrain(full_thrust_current_a=7.3, low_power_warning_v=3.35)
"""The current of the brushless motors is not published. The value assumes the same current per
newton as for brushed motors (full thrust is 0.80 N brushless and 0.48 N brushed). It is an upper
bound because brushless motors are designed to be more efficient."""


def identify_power_train(telemetry: Telemetry) -> PowerTrain:
    """Return the vehicle's power train. Motors that start only after an arming request are
    brushless."""
    return BRUSHED_POWER_TRAIN if telemetry.has_bit(AUTO_ARM) else BRUSHLESS_POWER_TRAIN


# --- The battery's state, fitted reading by reading ---


def update_battery_fit_from_telemetry(
    old: BatteryFitState,
    telemetry: Telemetry,
    reading_age_s: float,
    dt_s: float,
    battery_capacity_mah: float,
) -> BatteryFitState:
    """Return the fit `dt_s` later, in a tick whose newest sample is `telemetry`, for a battery with
    the full charge `battery_capacity_mah`.

    `reading_age_s` is the time since the voltage last changed. After
    `MAX_BATTERY_READING_AGE_TO_UPDATE_FIT_S`, a reading counts as missing (see
    `update_battery_fit`), unless the motors have not turned yet: a battery at rest keeps its
    voltage, and without this resting voltage the fit cannot tell a large sag from a small charge.
    """
    is_resting = telemetry.thrust == 0.0 and not old.time_under_load_s
    is_current = reading_age_s <= MAX_BATTERY_READING_AGE_TO_UPDATE_FIT_S
    reading_v = telemetry.battery_v if is_current or is_resting else math.nan
    power_train = identify_power_train(telemetry)
    return update_battery_fit(
        old, dt_s, reading_v, telemetry.thrust, battery_capacity_mah, power_train
    )


def update_battery_fit(
    state: BatteryFitState,
    dt_s: float,
    battery_v: float,
    raw_thrust: float,
    battery_capacity_mah: float,
    power_train: PowerTrain,
) -> BatteryFitState:
    """Return the fit `dt_s` later, after the voltage reading `battery_v`, V, at the commanded
    thrust `raw_thrust` (0..65535), for a battery with the full charge `battery_capacity_mah`.

    Before the first load, a reading without thrust is the resting voltage. Under load, the resting
    voltage is the reading plus the fitted sag, passed through a low-pass filter, and the reading is
    added to the sums of the fit. While the thrust is changing, the reading is ignored. A
    `battery_v` that is NaN or outside the range of a cell counts as missing: the resting voltage
    then falls by the charge that the thrust is calculated to consume.
    """
    thrust_fraction = max(0.0, min(1.0, raw_thrust / FULL_THRUST))
    state = replace(
        state,
        coulomb_counted_discharge_fraction=state.coulomb_counted_discharge_fraction
        + thrust_fraction
        * full_thrust_discharge_fraction_per_s(battery_capacity_mah, power_train)
        * dt_s,
        lagged_thrust_fraction=_low_pass(
            state.lagged_thrust_fraction,
            thrust_fraction,
            dt_s / THRUST_TO_VOLTAGE_LAG_TIME_CONSTANT_S,
        ),
    )
    if thrust_fraction >= MIN_THRUST_FRACTION_TO_FIT_BATTERY_MODEL:
        known = dt_s / 3.0 if state.mean_airborne_thrust_fraction else 1.0
        state = replace(
            state,
            mean_airborne_thrust_fraction=_low_pass(
                state.mean_airborne_thrust_fraction, thrust_fraction, known
            ),
        )
    # reduce the last estimate by the charge that the thrust consumes
    if not is_battery_reading(battery_v):
        state = replace(
            state, time_since_battery_reading_s=state.time_since_battery_reading_s + dt_s
        )
        if state.rest_v is None:
            return state
        spent = (
            fit_battery_voltage_model(state).true_to_coulomb_counted_discharge_ratio
            * state.lagged_thrust_fraction
            * full_thrust_discharge_fraction_per_s(battery_capacity_mah, power_train)
            * dt_s
        )
        return replace(
            state,
            rest_v=rest_v_from_charge_fraction(charge_fraction_from_rest_v(state.rest_v) - spent),
        )
    state = replace(state, time_since_battery_reading_s=0.0)
    if thrust_fraction == 0.0 and not state.time_under_load_s:
        return replace(state, takeoff_rest_v=battery_v, rest_v=battery_v)
    if (
        abs(thrust_fraction - state.lagged_thrust_fraction)
        > MAX_RECENT_THRUST_CHANGE_FRACTION_TO_USE_VOLTAGE
    ):
        return state
    if state.takeoff_rest_v is None:
        state = replace(
            state,
            takeoff_rest_v=battery_v + TYPICAL_FULL_THRUST_SAG_V * state.lagged_thrust_fraction,
        )
    if state.lagged_thrust_fraction >= MIN_THRUST_FRACTION_TO_FIT_BATTERY_MODEL:
        fit = _add_voltage_reading_to_sums(state, dt_s, battery_v)
        state = replace(
            state, normal_equation_sums=fit, time_under_load_s=state.time_under_load_s + dt_s
        )
    now_v = (
        battery_v
        + fit_battery_voltage_model(state).full_thrust_sag_v * state.lagged_thrust_fraction
    )
    rest_v = (
        now_v
        if state.rest_v is None
        else _low_pass(state.rest_v, now_v, dt_s / REST_VOLTAGE_FILTER_TIME_CONSTANT_S)
    )
    return replace(state, rest_v=rest_v)


def fit_battery_voltage_model(state: BatteryFitState) -> BatteryVoltageModel:
    """Return the battery voltage model that fits the readings best: least squares, regularized by
    the typical values and bounded."""
    a, b, c, p, q = state.normal_equation_sums
    a += FULL_THRUST_SAG_PRIOR_SIGMA_V**-2
    c += TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO_PRIOR_SIGMA**-2
    det = a * c - b * b
    sag_v = TYPICAL_FULL_THRUST_SAG_V + (c * p - b * q) / det
    true_to_coulomb_counted_discharge_ratio = (
        TYPICAL_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO + (a * q - b * p) / det
    )
    return BatteryVoltageModel(
        max(MIN_FITTED_FULL_THRUST_SAG_V, sag_v),
        min(
            MAX_FITTED_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO,
            max(
                MIN_FITTED_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO,
                true_to_coulomb_counted_discharge_ratio,
            ),
        ),
    )


def charge_fraction_from_rest_v(rest_v: float) -> float:
    """Return the charge (0..1) of a cell with the resting voltage `rest_v`, V, interpolated
    linearly in the discharge curve. The result is clamped to 0..1."""
    return min(
        1.0,
        max(
            0.0,
            _interpolate(DISCHARGE_CURVE_REST_VOLTAGES_V, DISCHARGE_CURVE_CHARGE_FRACTIONS, rest_v),
        ),
    )


def rest_v_from_charge_fraction(charge_fraction: float) -> float:
    """Return the resting voltage, V, of a cell with the charge `charge_fraction` (0..1),
    interpolated linearly in the discharge curve. Outside 0..1, the curve is extrapolated."""
    return _interpolate(
        DISCHARGE_CURVE_CHARGE_FRACTIONS, DISCHARGE_CURVE_REST_VOLTAGES_V, charge_fraction
    )


def _interpolate(xs: tuple[float, ...], ys: tuple[float, ...], x: float) -> float:
    i = min(max(bisect_right(xs, x), 1), len(xs) - 1)
    return ys[i - 1] + (x - xs[i - 1]) * (ys[i] - ys[i - 1]) / (xs[i] - xs[i - 1])


def _add_voltage_reading_to_sums(
    state: BatteryFitState, dt_s: float, battery_v: float
) -> BatteryNormalEquationSums:
    """Return the sums after one more reading `battery_v`, V, under load, with a weight proportional
    to `dt_s`, the time that the reading covers. Older readings lose weight with the time constant
    `BATTERY_FIT_FORGETTING_TIME_CONSTANT_S`.

    The unknowns of the fit are the deviations of the full-thrust sag, V, and of the discharge ratio
    from their typical values. `state.takeoff_rest_v` must be known.
    """
    assert state.takeoff_rest_v is not None
    begun = charge_fraction_from_rest_v(state.takeoff_rest_v)
    counted = max(
        min(begun, MIN_CHARGE_FRACTION_TO_USE_COULOMB_COUNTING),
        begun - state.coulomb_counted_discharge_fraction,
    )
    spent_v = rest_v_from_charge_fraction(begun) - rest_v_from_charge_fraction(counted)
    off_v = (
        state.takeoff_rest_v
        - battery_v
        - TYPICAL_FULL_THRUST_SAG_V * state.lagged_thrust_fraction
        - TYPICAL_TRUE_TO_COULOMB_COUNTED_DISCHARGE_RATIO * spent_v
    )
    weight, keep = (
        dt_s / ONE_SECOND_MEAN_VOLTAGE_READING_SIGMA_V**2,
        math.exp(-dt_s / BATTERY_FIT_FORGETTING_TIME_CONSTANT_S),
    )
    a, b, c, p, q = (keep * each for each in state.normal_equation_sums)
    return BatteryNormalEquationSums(
        a + weight * state.lagged_thrust_fraction * state.lagged_thrust_fraction,
        b + weight * state.lagged_thrust_fraction * spent_v,
        c + weight * spent_v * spent_v,
        p + weight * state.lagged_thrust_fraction * off_v,
        q + weight * spent_v * off_v,
    )


def full_thrust_discharge_fraction_per_s(
    battery_capacity_mah: float, power_train: PowerTrain
) -> float:
    """Return the fraction of the full charge, `battery_capacity_mah`, that one second of full
    thrust consumes, from the assumed current of the power train."""
    return power_train.full_thrust_current_a / (3.6 * battery_capacity_mah)


def _low_pass(old_value: float, new_value: float, new_value_weight: float) -> float:
    return old_value + min(1.0, new_value_weight) * (new_value - old_value)
