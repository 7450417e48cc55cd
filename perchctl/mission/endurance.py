"""Predict how long the battery lasts, and whether it suffices for an attempt and a landing."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.mission.belief.battery import (
    FIRMWARE_LOW_POWER_REPORT_DELAY_S,
    MIN_TIME_UNDER_LOAD_TO_FIT_BATTERY_MODEL_S,
    BatteryFitState,
    PowerTrain,
    charge_fraction_from_rest_v,
    fit_battery_voltage_model,
    full_thrust_discharge_fraction_per_s,
    identify_power_train,
)
from perchctl.mission.belief.contact import max_press_thrust
from perchctl.mission.context import Context
from perchctl.mission.phase import Phase
from perchctl.mission.state import BatteryOutlook
from perchctl.profile import Profile
from perchctl.vehicle import FULL_THRUST

MAX_BATTERY_READING_AGE_TO_TRUST_CHARGE_S = 5.0
"""Time without a reading after which the charge is unknown, s."""
EXPECTED_STANDOFF_SETTLING_DURATION_S = 3.0
"""Time that settling at the stand-off takes, s, as measured in simulated flights."""
EXPECTED_TOUCH_DURATION_BEYOND_CLIMB_AND_DWELL_S = 1.0
"""Time that the touch takes, s, as measured in simulated flights."""
EXPECTED_LANDING_DURATION_BEYOND_DESCENT_S = 3.0
"""Time that a landing takes in addition to its descent, s, as measured in simulated flights."""
TOLERATED_DIP_BELOW_MIN_LOAD_VOLTAGE_IN_PRESS_V = 0.3
"""Largest voltage dip below `safety.min_load_v`, V, during a press that is shorter than the
debounce time."""
TRUSTED_FRACTION_OF_PREDICTED_HOVER_TIME = 0.7
"""Fraction of a predicted hover time on which an attempt may rely: for worn cells near the end of
their charge, the prediction is up to a third too long (tests/mission/test_energy.py). Larger: a
battery that runs low may end an attempt in its ascent, or its landing may end in a fall."""
EXPECTED_BACK_OFF_DURATION_S = 3.0
"""Time after an attempt until the vehicle is steady and sees the target again, s."""


def compute_battery_outlook(c: Context) -> BatteryOutlook:
    """Predict how long the battery lasts and for how many attempts it suffices, from the battery
    fit, the hover thrust and the predicted durations of attempts and landing. The number of
    attempts is None until the target's position is known.

    An attempt is allowed only if a landing and the reserve remain after it, and no more attempts
    are allowed than the mission has left. Without a recent battery reading, the hover time is None,
    and the time for attempts is at most the time until row `battery-unknown` lands the vehicle.
    """
    energy = c.belief.battery_fit
    consumed_charge_mah = energy.coulomb_counted_discharge_fraction * c.profile.vehicle.battery_mah
    hover_times = _predict_hover_times_now(c)
    hover_time_left_s = None
    if hover_times is not None and not _is_battery_reading_missing(c):
        hover_time_left_s = hover_times.until_battery_low_s
    if c.belief.target.world_position_m is None:
        return BatteryOutlook(hover_time_left_s, None, consumed_charge_mah, energy.rest_v)
    predicted = predict_mission_durations(c)
    time_left_s = _time_until_landing_must_begin_s(c, hover_times, predicted.landing_duration_s)
    spare_s = time_left_s - predicted.remaining_attempt_duration_s
    left = c.planner.attempts - c.state.failed_attempts
    attempts = 0  # remains 0 if `spare_s` is NaN
    if spare_s >= 0.0:
        attempts = 1 + math.floor(min(spare_s / predicted.retry_duration_s, max(0, left)))
    return BatteryOutlook(
        hover_time_left_s, max(0, min(attempts, left)), consumed_charge_mah, energy.rest_v
    )


def _predict_hover_times_now(c: Context) -> PredictedHoverTimes | None:
    fit = c.belief.battery_fit
    thrust = c.belief.hover_thrust or FULL_THRUST * fit.mean_airborne_thrust_fraction
    power_train = identify_power_train(c.telemetry)
    return predict_hover_times(fit, c.profile, thrust / FULL_THRUST, power_train)


def _is_battery_reading_missing(c: Context) -> bool:
    without_reading_s = c.belief.battery_fit.time_since_battery_reading_s
    return without_reading_s > MAX_BATTERY_READING_AGE_TO_TRUST_CHARGE_S


def _time_until_landing_must_begin_s(
    c: Context, hover_times: PredictedHoverTimes | None, landing_duration_s: float
) -> float:
    """Return the time, s, that is left for attempts before a landing must begin; negative if the
    landing is overdue. It follows from the predicted `hover_times`. Without a recent battery
    reading, it is at most the time until row `battery-unknown` lands the vehicle, minus the landing
    and the reserve. If `hover_times` is None (no prediction), this limit is the result."""
    reserve_s = c.safety.energy_reserve_s
    by_charge_s = math.inf
    if hover_times is not None:
        by_charge_s = hover_times.until_landing_must_begin_s(landing_duration_s, reserve_s)
        if not _is_battery_reading_missing(c):
            return by_charge_s
    by_grace_s = _time_until_battery_reading_stale_s(c) - landing_duration_s - reserve_s
    return min(by_charge_s, by_grace_s)


@dataclass(frozen=True)
class PredictedHoverTimes:
    """Predicted times that the vehicle can hover from now on, s: until row `battery-low` lands it,
    and until the voltage in hover falls below `safety.min_load_v`."""

    until_battery_low_s: float  # until row `battery-low` lands the vehicle
    until_min_load_voltage_s: float  # until the voltage in hover falls below `safety.min_load_v`

    def until_landing_must_begin_s(self, landing_duration_s: float, reserve_s: float) -> float:
        """Return the time, s, until a landing that takes `landing_duration_s` must begin; negative
        if it is overdue. It is the smaller of two times: until row `battery-low` lands the vehicle;
        and until the voltage in hover falls below `safety.min_load_v`, less `landing_duration_s`
        and `reserve_s`. The landing is not subtracted from the time until `battery-low`, since the
        motors keep running at low power. Only `TRUSTED_FRACTION_OF_PREDICTED_HOVER_TIME` of each
        predicted time is counted."""
        return min(
            TRUSTED_FRACTION_OF_PREDICTED_HOVER_TIME * self.until_battery_low_s,
            TRUSTED_FRACTION_OF_PREDICTED_HOVER_TIME * self.until_min_load_voltage_s
            - landing_duration_s
            - reserve_s,
        )


def predict_hover_times(
    battery_fit: BatteryFitState,
    profile: Profile,
    hover_thrust_fraction: float,
    power_train: PowerTrain,
) -> PredictedHoverTimes | None:
    """Predict the hover times at a constant `hover_thrust_fraction` (fraction of full thrust), for
    motors with the current and the low-power voltage of `power_train`. Return None if that fraction
    is not positive, or if the battery fit has no resting voltage or has not seen enough time under
    load.

    Each time is the charge that remains above a voltage limit, divided by the rate of discharge in
    hover. The resting voltage at the limit is the limit plus the voltage sag, which is proportional
    to the thrust.

    The row `battery-low` applies at the earliest of these events: the firmware reports low power,
    `FIRMWARE_LOW_POWER_REPORT_DELAY_S` after the voltage in hover has fallen to the firmware's
    limit; the voltage in hover falls below `safety.min_load_v`; or, in a mission that perches, a
    press would pull the voltage below `safety.min_load_v`. A press that is shorter than
    `safety.battery_debounce_s` may pull it lower, by
    `TOLERATED_DIP_BELOW_MIN_LOAD_VOLTAGE_IN_PRESS_V`.
    """
    if (
        battery_fit.rest_v is None
        or battery_fit.time_under_load_s < MIN_TIME_UNDER_LOAD_TO_FIT_BATTERY_MODEL_S
        or not hover_thrust_fraction > 0.0
    ):
        return None
    safety, perch = profile.safety, profile.planner.perch
    low_power_v = float(
        profile.link.parameters.get("pm.lowVoltage", power_train.low_power_warning_v)
    )
    lasts = (
        EXPECTED_TOUCH_DURATION_BEYOND_CLIMB_AND_DWELL_S + perch.contact_dwell_s
        > safety.battery_debounce_s
    )
    press_v = safety.min_load_v - (
        0.0 if lasts else TOLERATED_DIP_BELOW_MIN_LOAD_VOLTAGE_IN_PRESS_V
    )
    press_load = max(hover_thrust_fraction, max_press_thrust(profile) / FULL_THRUST)
    sag_v, discharge_ratio = fit_battery_voltage_model(battery_fit)
    charge_fraction = charge_fraction_from_rest_v(battery_fit.rest_v)
    discharge_per_s = (
        discharge_ratio
        * hover_thrust_fraction
        * full_thrust_discharge_fraction_per_s(profile.vehicle.battery_mah, power_train)
    )

    def until_s(load_v: float, load: float) -> float:
        spare = charge_fraction - charge_fraction_from_rest_v(load_v + sag_v * load)
        return max(0.0, spare) / discharge_per_s

    min_load_v_s = until_s(safety.min_load_v, hover_thrust_fraction)
    battery_low_s = min(
        min_load_v_s,
        until_s(low_power_v, hover_thrust_fraction) + FIRMWARE_LOW_POWER_REPORT_DELAY_S,
    )
    if profile.planner.hover is None:
        battery_low_s = min(battery_low_s, until_s(press_v, press_load))
    return PredictedHoverTimes(
        until_battery_low_s=battery_low_s, until_min_load_voltage_s=min_load_v_s
    )


@dataclass(frozen=True)
class PredictedMissionDurations:
    """Predicted times, s, that the rest of this attempt, each further attempt and the landing
    take."""

    remaining_attempt_duration_s: float  # the rest of this attempt
    retry_duration_s: float  # each further attempt
    landing_duration_s: float


def predict_mission_durations(c: Context) -> PredictedMissionDurations:
    """Predict the times, s, that the rest of this attempt, each retry and the landing take, from
    the target's height, the speeds in the profile, and typical times of the stages without a set
    speed. The position of the target must be known. In a mission that hovers below the target, its
    whole hover is counted, even if a part of it is over."""
    planner, hover = c.planner, c.planner.hover
    top_z_m = c.belief.target.vehicle_world_z_when_touching_m - (
        0.0 if hover is None else hover.below_m
    )
    climb_height_m = max(0.0, top_z_m - c.telemetry.position_m[2])
    touch_s = EXPECTED_STANDOFF_SETTLING_DURATION_S + planner.ascend.settle_dwell_s
    if hover is None:
        touch_s += EXPECTED_TOUCH_DURATION_BEYOND_CLIMB_AND_DWELL_S
        touch_s += (
            planner.ascend.standoff_m / planner.perch.climb_mps + planner.perch.contact_dwell_s
        )
    else:
        touch_s += hover.duration_s
    aligned_s = 0.0
    if c.state.phase not in (Phase.ALIGN, Phase.ASCEND, Phase.PERCH, Phase.HOVER):
        aligned_s = (
            EXPECTED_BACK_OFF_DURATION_S
            if c.state.phase is Phase.RECOVER
            else 2.0 * EXPECTED_BACK_OFF_DURATION_S
        )
    retry_climb_m = planner.recover.descend_m + planner.ascend.standoff_m
    descent_s = max(0.0, c.belief.height_m + climb_height_m) / planner.landing.speed_mps
    return PredictedMissionDurations(
        remaining_attempt_duration_s=aligned_s
        + _climb_duration_s(c.profile, climb_height_m)
        + touch_s,
        retry_duration_s=2.0 * EXPECTED_BACK_OFF_DURATION_S
        + _climb_duration_s(c.profile, retry_climb_m)
        + touch_s,
        landing_duration_s=descent_s + EXPECTED_LANDING_DURATION_BEYOND_DESCENT_S,
    )


def is_charge_too_low_for_any_attempt(c: Context) -> bool:
    """True if the battery outlook allows no attempt at a target whose world position is known.
    Always False if `safety.energy_gate` is off."""
    gated = c.safety.energy_gate and c.belief.target.world_position_m is not None
    return gated and not c.state.battery.affordable_attempts


def battery_shortfall_text(c: Context) -> str:
    """Return a message with the time left before a landing must begin, or that it is unknown, and
    the times that an attempt, the landing and the reserve need. It is the reason to land once the
    charge is too low for an attempt, and does not check that again. The position of the target must
    be known."""
    predicted = predict_mission_durations(c)
    has = "the remaining battery time is unknown"
    if c.state.battery.hover_time_left_s is not None:
        hover_times, landing_s = _predict_hover_times_now(c), predicted.landing_duration_s
        time_left_s = _time_until_landing_must_begin_s(c, hover_times, landing_s)
        has = f"the battery has {max(0.0, time_left_s):.0f} s left"
    return (
        f"{has} before a landing must begin; an attempt takes "
        f"{predicted.remaining_attempt_duration_s:.0f} s (landing "
        f"{predicted.landing_duration_s:.0f} s, reserve {c.safety.energy_reserve_s:g} s)"
    )


def _time_until_battery_reading_stale_s(c: Context) -> float:
    """Return the time, s, until the row `battery-unknown` lands a vehicle that gets no more battery
    readings: `safety.battery_stale_s` minus the time since the last reading."""
    return c.safety.battery_stale_s - max(
        c.belief.battery_fit.time_since_battery_reading_s, c.obs.battery_reading_age_s
    )


def _climb_duration_s(profile: Profile, climb_height_m: float) -> float:
    ascend = profile.planner.ascend
    near_m = min(climb_height_m, ascend.near_m)
    return (climb_height_m - near_m) / ascend.speed_mps + near_m / ascend.near_speed_mps
