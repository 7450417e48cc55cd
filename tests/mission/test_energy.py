"""What a battery has left, against batteries whose end is known; and the gate that asks for it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.mission import Outcome, Phase, PlannerState
from perchctl.mission.belief.battery import (
    BRUSHED_POWER_TRAIN,
    BRUSHLESS_POWER_TRAIN,
    BatteryFitState,
    PowerTrain,
    fit_battery_voltage_model,
    update_battery_fit,
)
from perchctl.mission.context import Context
from perchctl.mission.endurance import compute_battery_outlook, predict_hover_times
from perchctl.profile import Profile
from perchctl.sim import CONTROL_PERIOD_S
from perchctl.sim.powertrain import Cell
from perchctl.vehicle import AUTO_ARM, FULL_THRUST
from tests.helpers.mission import (
    AIRBORNE,
    FINE_BATTERY,
    HOVER_THRUST,
    PROFILE,
    changed,
    context_at,
    observation,
    observing,
    remembering,
    state_in,
)
from tests.mission.rig import at, fly

PERIOD_S, MAH = 0.02, 250.0
BRUSHLESS_MAH = 350.0
LOW_V = 3.2  # below it, the firmware reports low power after `FIRMWARE_LOW_POWER_REPORT_DELAY_S`
FIRMWARE_LOW_POWER_REPORT_DELAY_S = 5.0
HOVER = HOVER_THRUST / FULL_THRUST
ATTEMPT_S, LANDING_S = 12.0, 10.0


@dataclass(frozen=True)
class Moment:
    t_s: float
    energy: BatteryFitState
    under_load_v: float


def hovering(
    rest_v: float,
    kind: dict[str, float],
    most_s: float = 120.0,
    hover: float = HOVER,
    drive: PowerTrain = BRUSHED_POWER_TRAIN,
    mah: float = MAH,
) -> Iterator[Moment]:
    """On the ground for 1 s, then hovering, with a press of a second every 8 s."""
    cell, energy, reading_v = Cell(rest_v, **kind), BatteryFitState(), rest_v
    for i in range(round(most_s / PERIOD_S)):
        t_s = PERIOD_S * i
        load = 0.0 if t_s < 1.0 else 1.0 if t_s % 8.0 > 7.0 else hover
        for _ in range(round(PERIOD_S / CONTROL_PERIOD_S)):
            cell.step(drive.full_thrust_current_a * load)
        reading_v += 0.1 * (cell.battery_v - reading_v)  # the firmware's, low-passed
        energy = update_battery_fit(energy, PERIOD_S, reading_v, load * FULL_THRUST, mah, drive)
        yield Moment(
            t_s, energy, cell.rest_v - (cell.rest_v - cell.battery_v) / (load or 1) * hover
        )


def time_below_s(moments: list[Moment], load_v: float) -> float:
    """When the voltage in hover falls below `load_v`, s; infinite if it does not."""
    return next((m.t_s for m in moments if m.t_s > 1.0 and m.under_load_v < load_v), math.inf)


def time_of_battery_low_s(moments: list[Moment], low_v: float = LOW_V) -> float:
    """When row `battery-low` applies: the firmware reports low power, or the least voltage."""
    low_power_s = time_below_s(moments, low_v) + FIRMWARE_LOW_POWER_REPORT_DELAY_S
    return min(low_power_s, time_below_s(moments, PROFILE.safety.min_load_v))


WEAK = {
    "low": (3.87, {}),
    "early knee": (3.9, {"knee": 0.14}),
    "high resistance": (4.1, {"ohm": 0.19, "slow_ohm": 0.02}),
    "old": (4.0, {"ohm": 0.165, "charge": 0.5, "slow_ohm": 0.02}),
}


@pytest.mark.parametrize(
    ("name", "hover"),
    [
        *((name, HOVER) for name in WEAK),
        *(
            pytest.param(name, hover, marks=pytest.mark.long)
            for name in ("low", "old")
            for hover in (0.5, 0.7)
        ),
    ],
)
def test_what_is_left_is_not_more_than_there_is(name: str, hover: float) -> None:
    """From a few seconds on, where it decides."""
    moments = list(hovering(*WEAK[name], most_s=130.0, hover=hover))
    low_s = time_of_battery_low_s(moments)
    least_v_s = time_below_s(moments, PROFILE.safety.min_load_v)
    assert 20.0 < low_s < 130.0
    for moment in moments[:: round(1.0 / PERIOD_S)]:
        if moment.t_s < 6.0 or moment.t_s >= low_s:
            continue
        times = predict_hover_times(moment.energy, PROFILE, hover, BRUSHED_POWER_TRAIN)
        assert times is not None
        reserve_s = PROFILE.safety.energy_reserve_s
        begins = times.until_landing_must_begin_s(LANDING_S, reserve_s) >= ATTEMPT_S
        if low_s - moment.t_s < ATTEMPT_S:  # the attempt would be lost in its ascent
            assert not begins
        if least_v_s - moment.t_s < ATTEMPT_S + LANDING_S:  # the landing would be a fall
            assert not begins
        if low_s - moment.t_s > 70.0:  # three times the time that it takes
            assert begins


@pytest.mark.parametrize("rest_v", [3.9, pytest.param(3.95, marks=pytest.mark.long)])
def test_a_brushless_vehicle_has_no_more_left_than_until_its_own_low_power(rest_v: float) -> None:
    """Its bits name its motors; the battery holds 350 mAh, and low power is reported sooner."""
    cell = {"ohm": 0.143 * MAH / BRUSHLESS_MAH, "charge": BRUSHLESS_MAH / MAH}
    profile, hover, low_v = changed({"vehicle.battery_mah": BRUSHLESS_MAH}), 0.55, 3.35
    moments = list(hovering(rest_v, cell, 200.0, hover, BRUSHLESS_POWER_TRAIN, BRUSHLESS_MAH))
    end_s = time_of_battery_low_s(moments, low_v)
    for moment in moments[round(20.0 / PERIOD_S) : round(end_s / PERIOD_S) : 50]:
        obs = at(thrust=hover * FULL_THRUST, supervisor=AIRBORNE & ~AUTO_ARM)(moment.t_s)
        state = remembering(state_in(Phase.ALIGN), battery_fit=moment.energy, hover_thrust=0.0)
        left_s = compute_battery_outlook(context_at(state, obs, profile)).hover_time_left_s
        assert left_s is not None
        assert left_s <= 1.1 * (end_s - moment.t_s) + 10.0


@given(st.floats(0.4, 0.8))
def test_the_firmware_reports_low_power_only_after_its_delay(hover: float) -> None:
    """A vehicle whose voltage has just fallen to the limit flies on until the report."""
    sag_v = fit_battery_voltage_model(FINE_BATTERY).full_thrust_sag_v * hover
    at_limit = replace(FINE_BATTERY, rest_v=LOW_V + sag_v)
    at_least_v = replace(FINE_BATTERY, rest_v=PROFILE.safety.min_load_v + sag_v)
    for energy, expected_s in ((at_limit, FIRMWARE_LOW_POWER_REPORT_DELAY_S), (at_least_v, 0.0)):
        hovers = changed({"planner.hover": {"below_m": 0.5, "duration_s": 1.0}})  # no press
        times = predict_hover_times(energy, hovers, hover, BRUSHED_POWER_TRAIN)
        assert times is not None
        assert times.until_battery_low_s == pytest.approx(expected_s)


@given(st.floats(0.4, 0.8), st.floats(3.3, 4.1), st.floats(0.0, 60.0), st.floats(0.0, 9.0))
def test_a_landing_that_has_begun_goes_on_after_low_power(
    hover: float, rest_v: float, landing_s: float, reserve_s: float
) -> None:
    """Low power lands the vehicle, but stops no motor: only the least voltage ends a landing."""
    times = predict_hover_times(
        replace(FINE_BATTERY, rest_v=rest_v), PROFILE, hover, BRUSHED_POWER_TRAIN
    )
    assert times is not None
    assert 0.0 <= times.until_battery_low_s <= times.until_min_load_voltage_s
    time_left_s = times.until_landing_must_begin_s(landing_s, reserve_s)
    assert time_left_s <= times.until_battery_low_s
    assert time_left_s + landing_s + reserve_s <= max(times.until_min_load_voltage_s, 0.0) + 1e-9
    no_landing_s = times.until_landing_must_begin_s(0.0, 0.0)
    assert no_landing_s - landing_s - reserve_s <= time_left_s + 1e-9


def used_up(
    energy: BatteryFitState, volts: float, thrust: float, lasts_s: float
) -> BatteryFitState:
    """The state after a time under the same reading and thrust."""
    for _ in range(round(lasts_s / PERIOD_S)):
        energy = update_battery_fit(energy, PERIOD_S, volts, thrust, MAH, BRUSHED_POWER_TRAIN)
    return energy


@pytest.mark.parametrize("reading_v", [0.0, 0.3, math.nan, math.inf, -math.inf, 4.41, 8.38])
def test_without_a_reading_nothing_is_known(reading_v: float) -> None:
    energy = used_up(used_up(BatteryFitState(), reading_v, 0.0, 1.0), reading_v, HOVER_THRUST, 9.0)
    assert predict_hover_times(energy, PROFILE, HOVER, BRUSHED_POWER_TRAIN) is None
    assert energy.time_since_battery_reading_s == pytest.approx(10.0)


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.floats(-1.0, 6.0) | st.sampled_from([math.inf, -math.inf, math.nan, 65.0, 1e6]),
            st.floats(0.0, 70000.0),
        ),
        max_size=60,
    )
)
def test_no_reading_breaks_it(readings: list[tuple[float, float]]) -> None:
    energy = FINE_BATTERY
    for volts, thrust in readings:
        energy = update_battery_fit(energy, PERIOD_S, volts, thrust, MAH, BRUSHED_POWER_TRAIN)
    times = predict_hover_times(energy, PROFILE, HOVER, BRUSHED_POWER_TRAIN)
    assert times is not None
    assert 0.0 <= times.until_battery_low_s < 1e5


# --- the gate ------------------------------------------------------------------------------


def flown(
    phase: Phase, energy: BatteryFitState, seconds: float, profile: Profile = PROFILE, **tel: Any
) -> PlannerState:
    begin = remembering(state_in(phase), battery_fit=energy)
    return fly(begin, at(**tel), seconds, profile, one_phase=True).state


NEAR_ITS_END = replace(FINE_BATTERY, takeoff_rest_v=3.79, rest_v=3.77)


@pytest.mark.parametrize("phase", [Phase.ALIGN, Phase.RECOVER])
def test_no_attempt_begins_on_a_battery_near_its_end(phase: Phase) -> None:
    state = flown(phase, NEAR_ITS_END, 2.0, battery_v=3.24)
    assert state.phase is Phase.LANDING
    assert state.transition_name == "too-little-left"
    assert state.outcome is Outcome.SAFETY
    assert " s left" in state.transition_reason
    assert flown(phase, FINE_BATTERY, 2.0).phase in (Phase.ASCEND, Phase.ESTIMATE)


OPEN = changed({"safety.energy_gate": False})
GRACE_S = PROFILE.safety.battery_stale_s


@pytest.mark.parametrize(
    ("phase", "energy", "battery_v", "profile", "gated"),
    [
        (Phase.ASCEND, NEAR_ITS_END, 3.24, PROFILE, False),  # what was begun is flown
        (Phase.PERCH, NEAR_ITS_END, 3.24, PROFILE, False),
        (Phase.ALIGN, NEAR_ITS_END, 3.24, OPEN, False),
        # Fault 7: a vehicle that tells nothing of its battery is landed after
        # `safety.battery_stale_s`, and not in the middle of an ascent.
        (Phase.ALIGN, BatteryFitState(time_since_battery_reading_s=8.0), 0.0, PROFILE, False),
        (
            Phase.ALIGN,
            BatteryFitState(time_since_battery_reading_s=GRACE_S - 10.0),
            0.0,
            PROFILE,
            True,
        ),
        # What was little is no more without a reading.
        (Phase.ALIGN, replace(NEAR_ITS_END, time_since_battery_reading_s=8.0), 0.0, PROFILE, True),
    ],
    ids=["ascends", "presses", "open", "grace", "grace is over", "little before"],
)
def test_the_gate_holds_back_only_what_has_too_little_and_has_not_begun(
    phase: Phase, energy: BatteryFitState, battery_v: float, profile: Profile, gated: bool
) -> None:
    lasts_s = 2.0 if phase is Phase.ALIGN else 1.0
    state = flown(phase, energy, lasts_s, profile, battery_v=battery_v)
    assert (state.transition_name == "too-little-left") is gated
    assert gated or phase is not Phase.ALIGN or state.transition_name == "aligned"
    if gated and energy.rest_v is None:
        assert "unknown" in state.transition_reason
        assert state.battery.hover_time_left_s is None


def test_a_reading_that_stands_still_is_none() -> None:
    state = state_in(Phase.ALIGN)
    for age_s, known in ((0.5, True), (4.0, True), (9.0, False)):
        later = observation(state.t_s + 4.0, battery_reading_age_s=age_s)
        state = replace(observing(state, later), t_s=later.t_s)
        assert (compute_battery_outlook(Context(state)).hover_time_left_s is not None) is known


def test_a_battery_at_rest_is_known_although_its_reading_stands_still() -> None:
    """Without the resting voltage, a large sag looks like a small charge."""
    for thrust, known_v in ((0.0, 4.12), (HOVER_THRUST, None)):
        obs = replace(at(battery_v=4.12, thrust=thrust)(10.02), battery_reading_age_s=20.0)
        before = remembering(state_in(Phase.APPROACH), battery_fit=BatteryFitState())
        state = observing(before, obs)
        assert state.belief.battery_fit.takeoff_rest_v == known_v


@pytest.mark.parametrize(
    "changes",
    [
        # The firmware reports low power below `pm.lowVoltage`, and the vehicle is landed for it.
        {"link.parameters": {"pm.lowVoltage": 3.4}},
        # A press counts by how long it lasts.
        {"planner.perch.contact_dwell_s": 1.0},
        {"safety.min_load_v": 3.5},
    ],
)
def test_a_flight_ends_sooner_where_battery_low_fires_sooner(changes: dict[str, Any]) -> None:
    energy = replace(FINE_BATTERY, rest_v=3.95)
    usual = predict_hover_times(energy, PROFILE, 0.5, BRUSHED_POWER_TRAIN)
    sooner = predict_hover_times(energy, changed(changes), 0.5, BRUSHED_POWER_TRAIN)
    assert usual is not None
    assert sooner is not None
    assert 0.0 < sooner.until_battery_low_s < usual.until_battery_low_s
