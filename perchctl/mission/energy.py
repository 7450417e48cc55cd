"""How much the battery has left: fitted in flight, and what an attempt and a landing take.

No current is measured on a Crazyflie. What is known: the resting voltage on the ground,
the voltage under load, and the thrust that the load follows. The estimate rests on three
things, of which two are assumed:

- a lithium polymer cell's resting voltage by its charge (`CURVE`): assumed;
- the charge that a thrust takes in a time (`FULL_A` at full thrust): assumed, for a battery
  of `vehicle.battery_mah`;
- from the voltages, `sag_v`, by how much it falls under full thrust, and `hunger`, how much
  faster this battery empties than assumed: both by least squares around what is usual, over
  all readings, the old ones fading. In a few seconds of flight the voltage tells the first
  well and the second hardly; it counts the more, the longer it flies.

The voltage under load that is now, and the curve from there on, tell for how long hovering
keeps it above where the battery would end the flight.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

from perchctl.values import replace
from perchctl.vehicle import FULL_THRUST, is_battery_reading

CURVE: tuple[tuple[float, float], ...] = (
    (0.0, 3.0), (0.02, 3.4), (0.05, 3.64), (0.1, 3.76), (0.2, 3.82), (0.3, 3.86), (0.4, 3.885),
    (0.5, 3.915), (0.6, 3.955), (0.7, 3.995), (0.8, 4.04), (0.9, 4.1), (1.0, 4.2),
)  # fmt: skip
"""Share of the charge, and the resting voltage at it: flat in the middle, steep at the end. A
little below the tenths of the firmware's own table, for what a table does not know."""
FULL_A = 4.4
"""At full thrust, four motors together; proportional to the thrust below."""
LOW_POWER_V = 3.2
"""Where the firmware reports low power after 5 s, unless `pm.lowVoltage` says otherwise."""
USUAL_SAG_V, SAG_WITHIN_V = 0.63, 0.3
USUAL_HUNGER, HUNGER_WITHIN = 1.1, 0.3
LEAST_HUNGER, MOST_HUNGER, LEAST_SAG_V = 1.0, 3.0, 0.2
READING_V, FADES_S = 0.02, 40.0
"""What a second of readings is off, and for how long it counts."""
SMOOTH_S, LAG_S = 1.0, 0.3
"""Of the present resting voltage; and by how much a reading comes after its thrust."""
STEADY_LOAD = 0.06
"""A thrust that is not farther from where it was belongs to the reading of the moment."""
COUNTED_SHARE = 0.05
"""Down to so much of the charge the count tells what is spent; below, the voltage alone."""
LEAST_LOAD, LEAST_LOADED_S = 0.2, 1.0
"""From so much of the full thrust on, and after so many seconds of it, there is an estimate."""

_SHARES, _VOLTS = zip(*CURVE, strict=True)


@dataclass(frozen=True)
class EnergyState:
    """What is remembered from tick to tick. Shares are of the full charge, loads of full thrust.

    Attributes:
        ground_v: at rest on the ground; from the first reading where that was under load.
        used: by the count of the thrust, for a battery as assumed.
        load: as the reading follows it; `mean_load` over the last seconds in the air.
        rest_v: estimated resting voltage now; None until one can be.
        loaded_s: how long there were readings under load.
        unknown_s: since the last reading.
        fit: sums of least squares: sag^2, sag * hunger, hunger^2, and the two right sides.
    """

    ground_v: float | None = None
    used: float = 0.0
    load: float = 0.0
    mean_load: float = 0.0
    rest_v: float | None = None
    loaded_s: float = 0.0
    unknown_s: float = 0.0
    fit: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BatteryFit:
    """`sag_v` under full thrust; `hunger`: how much faster it empties than assumed."""

    sag_v: float
    hunger: float


@dataclass(frozen=True)
class Floor:
    """Where the battery ends a flight: under a long load, and under the one of a press, which
    takes `press_load` of the full thrust."""

    hover_v: float
    press_v: float
    press_load: float = 1.0


def update_energy(
    state: EnergyState, dt_s: float, battery_v: float, thrust: float, battery_mah: float
) -> EnergyState:
    """The state after `dt_s` under a commanded thrust 0..65535.

    A `battery_v` that no cell can have, or none (NaN), is no reading."""
    load = max(0.0, min(1.0, thrust / FULL_THRUST))
    state = replace(
        state,
        used=state.used + load * _per_s(battery_mah) * dt_s,
        load=_towards(state.load, load, dt_s / LAG_S),
    )
    if load >= LEAST_LOAD:
        known = dt_s / 3.0 if state.mean_load else 1.0
        state = replace(state, mean_load=_towards(state.mean_load, load, known))
    if not is_battery_reading(battery_v):
        return _counted(state, dt_s, battery_mah)
    state = replace(state, unknown_s=0.0)
    if load == 0.0 and not state.loaded_s:
        return replace(state, ground_v=battery_v, rest_v=battery_v)
    if abs(load - state.load) > STEADY_LOAD:
        return state  # a reading that comes after its thrust belongs to another one
    if state.ground_v is None:
        state = replace(state, ground_v=battery_v + USUAL_SAG_V * state.load)
    if state.load >= LEAST_LOAD:
        state = replace(
            state,
            fit=_summed(state, dt_s, battery_v),
            loaded_s=state.loaded_s + dt_s,
        )
    now_v = battery_v + fit_battery(state).sag_v * state.load
    rest_v = now_v if state.rest_v is None else _towards(state.rest_v, now_v, dt_s / SMOOTH_S)
    return replace(state, rest_v=rest_v)


def fit_battery(state: EnergyState) -> BatteryFit:
    """What the readings say, around what is usual, within what can be."""
    a, b, c, p, q = state.fit
    a += SAG_WITHIN_V**-2
    c += HUNGER_WITHIN**-2
    det = a * c - b * b
    sag_v = USUAL_SAG_V + (c * p - b * q) / det
    hunger = USUAL_HUNGER + (a * q - b * p) / det
    return BatteryFit(max(LEAST_SAG_V, sag_v), min(MOST_HUNGER, max(LEAST_HUNGER, hunger)))


def left_s(
    state: EnergyState, floor: Floor, battery_mah: float, hover_load: float | None = None
) -> float | None:
    """For how long hovering keeps the voltage above the floor; None where nothing tells it.

    `hover_load`: of the full thrust; by default that of the last seconds."""
    load = hover_load or state.mean_load
    if state.rest_v is None or state.loaded_s < LEAST_LOADED_S or not load > 0.0:
        return None
    fit = fit_battery(state)
    press_load = max(load, floor.press_load)
    end_v = max(floor.hover_v + fit.sag_v * load, floor.press_v + fit.sag_v * press_load)
    share = charge_at(state.rest_v) - charge_at(end_v)
    return max(0.0, share) / (fit.hunger * load * _per_s(battery_mah))


def loaded_v(state: EnergyState, load: float) -> float | None:
    """The voltage under a share of the full thrust, now; None where nothing tells it."""
    if state.rest_v is None:
        return None
    return state.rest_v - fit_battery(state).sag_v * load


def used_mah(state: EnergyState, battery_mah: float) -> float:
    """By the count of the thrust: what a battery as assumed has given."""
    return state.used * battery_mah


def charge_at(rest_v: float) -> float:
    """The share of its charge that a cell with that resting voltage has, 0..1."""
    i = min(max(bisect_right(_VOLTS, rest_v), 1), len(_VOLTS) - 1)
    (x0, v0), (x1, v1) = CURVE[i - 1], CURVE[i]
    return min(1.0, max(0.0, x0 + (rest_v - v0) * (x1 - x0) / (v1 - v0)))


def resting_v(share: float) -> float:
    """The resting voltage at a share of the charge."""
    i = min(max(bisect_right(_SHARES, share), 1), len(_SHARES) - 1)
    (x0, v0), (x1, v1) = CURVE[i - 1], CURVE[i]
    return v0 + (share - x0) * (v1 - v0) / (x1 - x0)


def _counted(state: EnergyState, dt_s: float, battery_mah: float) -> EnergyState:
    """Without a reading: what was there, less what the thrust takes."""
    state = replace(state, unknown_s=state.unknown_s + dt_s)
    if state.rest_v is None:
        return state
    share = (
        charge_at(state.rest_v)
        - fit_battery(state).hunger * state.load * _per_s(battery_mah) * dt_s
    )
    return replace(state, rest_v=resting_v(share))


def _summed(
    state: EnergyState, dt_s: float, battery_v: float
) -> tuple[float, float, float, float, float]:
    """With one reading more, as deviations from what is usual."""
    assert state.ground_v is not None
    # A larger battery than assumed goes on where the count has come to the curve's steep end:
    # counted on, a sag would be made up for it. A voltage above the curve is nothing spent.
    begun = charge_at(state.ground_v)
    counted = max(min(begun, COUNTED_SHARE), begun - state.used)
    spent_v = resting_v(begun) - resting_v(counted)
    off_v = state.ground_v - battery_v - USUAL_SAG_V * state.load - USUAL_HUNGER * spent_v
    weight, keep = dt_s / READING_V**2, math.exp(-dt_s / FADES_S)
    a, b, c, p, q = (keep * each for each in state.fit)
    return (
        a + weight * state.load * state.load,
        b + weight * state.load * spent_v,
        c + weight * spent_v * spent_v,
        p + weight * state.load * off_v,
        q + weight * spent_v * off_v,
    )


def _per_s(battery_mah: float) -> float:
    """Share of the charge that a second of full thrust takes."""
    return FULL_A / (3.6 * battery_mah)


def _towards(value: float, goal: float, part: float) -> float:
    return value + min(1.0, part) * (goal - value)
