"""How much the battery has left, and whether it is enough for an attempt and a landing.

No current is measured on a Crazyflie. Assumed are a cell's resting voltage by its charge (`VOLTS`)
and the current at full thrust (`Drive`). Fitted are the sag under full thrust and `hunger`: how
much faster this battery empties than assumed, by least squares, with old readings fading.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

from perchctl.mission.conditions import max_press_thrust
from perchctl.mission.context import Context
from perchctl.mission.state import BatteryOutlook, EnergyState, Phase
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import AUTO_ARM, FULL_THRUST, Telemetry, is_battery_reading

SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
VOLTS = (3.0, 3.4, 3.64, 3.76, 3.82, 3.86, 3.885, 3.915, 3.955, 3.995, 4.04, 4.1, 4.2)
"""Of the charge, and of the resting cell with it: a little below the firmware's own table."""
USUAL_SAG_V, SAG_WITHIN_V, LEAST_SAG_V = 0.63, 0.3, 0.2
USUAL_HUNGER, HUNGER_WITHIN, LEAST_HUNGER, MOST_HUNGER = 1.1, 0.3, 1.0, 3.0
READING_V, FADES_S = 0.02, 40.0  # error of a second of readings, and how long it counts
SMOOTH_S, LAG_S = 1.0, 0.3  # of the resting voltage; of a reading behind its thrust
STEADY_LOAD = 0.06  # a changed thrust does not belong to the reading
COUNTED_SHARE = 0.05  # below this charge the voltage alone tells what is spent
LEAST_LOAD, LEAST_LOADED_S = 0.2, 1.0  # what an estimate needs
FRESH_S = 1.0  # an older reading counts as none
UNKNOWN_S = 5.0  # without a reading for longer it is unknown
SETTLING_S, TOUCHING_S, LANDING_S = 3.0, 1.0, 3.0  # as measured in simulated flights
PRESS_DIP_V = 0.3  # below `safety.min_load_v`, for a press shorter than the debounce
BACK_OFF_S = 3.0  # until it is steady and sees the target again


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


def read_battery(c: Context) -> EnergyState:
    """The battery's state after this tick's reading; a stale reading counts as no reading."""
    tel = c.telemetry
    reading_v = tel.battery_v if c.obs.battery_age_s <= FRESH_S else math.nan
    dt_s = max(0.0, c.t_s - c.state.t_s)
    mah, drive = c.profile.vehicle.battery_mah, drive_of(tel)
    return update_energy(c.state.energy, dt_s, reading_v, tel.thrust, mah, drive)


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
        used_share=state.used_share + load * _per_s(battery_mah, drive) * dt_s,
        load=_towards(state.load, load, dt_s / LAG_S),
    )
    if load >= LEAST_LOAD:
        known = dt_s / 3.0 if state.mean_load else 1.0
        state = replace(state, mean_load=_towards(state.mean_load, load, known))
    if not is_battery_reading(battery_v):  # the last estimate, less what the thrust takes
        state = replace(state, unknown_s=state.unknown_s + dt_s)
        if state.rest_v is None:
            return state
        spent = fit_sag_model(state)[1] * state.load * _per_s(battery_mah, drive) * dt_s
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
    weight, keep = dt_s / READING_V**2, math.exp(-dt_s / FADES_S)
    a, b, c, p, q = (keep * each for each in state.fit_sums)
    return (
        a + weight * state.load * state.load,
        b + weight * state.load * spent_v,
        c + weight * spent_v * spent_v,
        p + weight * state.load * off_v,
        q + weight * spent_v * off_v,
    )


def _per_s(battery_mah: float, drive: Drive) -> float:
    """Share of the charge that a second of full thrust takes."""
    return drive.full_a / (3.6 * battery_mah)


def _towards(value: float, goal: float, part: float) -> float:
    return value + min(1.0, part) * (goal - value)


# --- What that is enough for ---


def battery_outlook(c: Context) -> BatteryOutlook:
    """Return how long the battery still lasts, and for how many attempts. An unknown charge counts
    for at most the time that a vehicle without a reading may fly (fault 7)."""
    energy = c.state.energy
    used_mah = energy.used_share * c.profile.vehicle.battery_mah
    load = (c.state.hover_thrust or FULL_THRUST * energy.mean_load) / FULL_THRUST
    counted_s = hover_left_s(energy, c.profile, load, drive_of(c.telemetry))
    seconds = None if energy.unknown_s > UNKNOWN_S else counted_s
    if c.target_m is None:
        return BatteryOutlook(seconds, None, used_mah, energy.rest_v)
    enough_s, (attempt_s, again_s, landing_s) = seconds, attempt_retry_landing_s(c)
    if enough_s is None:
        enough_s = _grace_s(c) if counted_s is None else min(counted_s, _grace_s(c))
    spare_s = enough_s - c.safety.energy_reserve_s - landing_s - attempt_s
    left = c.planner.attempts - c.state.attempts
    attempts = 0  # also where the figures are no numbers
    if spare_s >= 0.0:
        attempts = 1 + math.floor(min(spare_s / again_s, max(0, left)))
    return BatteryOutlook(seconds, max(0, min(attempts, left)), used_mah, energy.rest_v)


def hover_left_s(state: EnergyState, profile: Profile, load: float, drive: Drive) -> float | None:
    """Seconds of hovering with `load`, a share of full thrust, until `battery-low` fires; None if
    unknown."""
    if state.rest_v is None or state.loaded_s < LEAST_LOADED_S or not load > 0.0:
        return None
    safety, perch = profile.safety, profile.planner.perch
    hover_v = max(
        float(profile.link.parameters.get("pm.lowVoltage", drive.low_power_v)), safety.min_load_v
    )
    lasts = TOUCHING_S + perch.contact_dwell_s > safety.battery_debounce_s
    press_v = safety.min_load_v - (0.0 if lasts else PRESS_DIP_V)
    press_load = max(load, max_press_thrust(profile) / FULL_THRUST)
    sag_v, hunger = fit_sag_model(state)
    end_v = max(hover_v + sag_v * load, press_v + sag_v * press_load)
    share = charge_from_rest_v(state.rest_v) - charge_from_rest_v(end_v)
    return max(0.0, share) / (hunger * load * _per_s(profile.vehicle.battery_mah, drive))


def attempt_retry_landing_s(c: Context) -> tuple[float, float, float]:
    """The seconds that this attempt, each retry and the landing take, in this order, by the
    height of the known target."""
    planner = c.planner
    up_m = max(0.0, c.contact_goal_z_m - c.telemetry.position_m[2])
    touch_s = SETTLING_S + planner.ascend.settle_dwell_s + TOUCHING_S
    touch_s += planner.ascend.standoff_m / planner.perch.climb_mps + planner.perch.contact_dwell_s
    aligned_s = 0.0
    if c.state.phase not in (Phase.ALIGN, Phase.ASCEND, Phase.PERCH):
        aligned_s = BACK_OFF_S if c.state.phase is Phase.RECOVER else 2.0 * BACK_OFF_S
    again_m = planner.recover.descend_m + planner.ascend.standoff_m
    attempt_s = aligned_s + _climb_s(c.profile, up_m) + touch_s
    again_s = 2.0 * BACK_OFF_S + _climb_s(c.profile, again_m) + touch_s
    return attempt_s, again_s, max(0.0, c.height_m + up_m) / planner.landing.speed_mps + LANDING_S


def is_short_of_charge(c: Context) -> bool:
    """True if the charge is not enough for an attempt at a known target."""
    gated = c.safety.energy_gate and c.target_m is not None
    return gated and not c.state.battery.attempts


def battery_shortfall(c: Context) -> str:
    """Text: the seconds left, and those that an attempt, the landing and the reserve take."""
    seconds, (attempt_s, _, landing_s) = c.state.battery.left_s, attempt_retry_landing_s(c)
    has = "what the battery has left is not known"
    if seconds is not None:
        has = f"the battery has {seconds:.0f} s left"
    return (
        f"{has}; an attempt takes {attempt_s:.0f} s, the landing {landing_s:.0f} s, "
        f"the reserve is {c.safety.energy_reserve_s:g} s"
    )


def _grace_s(c: Context) -> float:
    """Seconds that `battery-unknown` leaves to a vehicle whose reading is unknown."""
    return c.safety.battery_stale_s - max(c.state.energy.unknown_s, c.obs.battery_age_s)


def _climb_s(profile: Profile, up_m: float) -> float:
    ascend = profile.planner.ascend
    near_m = min(up_m, ascend.near_m)
    return (up_m - near_m) / ascend.speed_mps + near_m / ascend.near_speed_mps
