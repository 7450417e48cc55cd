"""The hover thrust's filter: laws that hold whatever it measures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.hover import (
    HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_DESCENT,
    MAX_HOVER_THRUST_CORRECTION_IN_DESCENT_SIGMAS,
    MIN_HOVER_THRUST_SIGMA_FRACTION_AT_DESCENT_START,
    estimate_hover_thrust,
    learn_hover_thrust_in_descent,
    learn_hover_thrust_in_quiet_flight,
)
from perchctl.mission.belief.maneuver import CommandHistory, Maneuver
from perchctl.mission.belief.thrust import (
    HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_QUIET_FLIGHT,
    INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER,
    ONE_SECOND_HOVER_THRUST_MEASUREMENT_SIGMA_FRACTION,
    HoverThrustEstimate,
)
from perchctl.mission.phase import Phase
from perchctl.values import replace
from tests.helpers.mission import (
    context_at,
    observation,
    observing,
    remembering,
    state_in,
    telemetry,
)

thrusts = st.floats(30_000.0, 62_000.0)
drifts = st.sampled_from(
    [
        HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_QUIET_FLIGHT,
        HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_DESCENT,
    ]
)
DESCENDS = CommandHistory(maneuver=Maneuver(descends_to_floor=True), commanded_raw_thrust=48_000)


def believing(phase: Phase, thrust: float, acc_z_g: float = 1.0) -> Belief:
    """A belief, in the air, with a hover thrust of 50000 learned and one more sample."""
    sample = replace(telemetry(10.0, 1.0), thrust=thrust, acc_z_g=acc_z_g)
    state = remembering(state_in(phase), hover_thrust=50_000.0)
    return context_at(state, observation(10.0, telemetry=sample)).belief


def measured(
    start: HoverThrustEstimate, values: Iterable[float], dt_s: float, drift: float
) -> HoverThrustEstimate:
    for value in values:
        start = start.propagate(dt_s, drift).with_measurement(value, dt_s)
    return start


@given(first=thrusts, true=thrusts, drift=drifts)
def test_it_converges_to_what_is_measured(first: float, true: float, drift: float) -> None:
    settled_s = (
        12.0 * ONE_SECOND_HOVER_THRUST_MEASUREMENT_SIGMA_FRACTION / drift
    )  # the filter's own time, twelve times
    steps = int(settled_s / 0.02)
    found = measured(
        HoverThrustEstimate(first, INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER),
        [true] * steps,
        0.02,
        drift,
    )
    assert found.raw_thrust == pytest.approx(true, rel=1e-3)


@given(sigma=st.floats(1e-3, 0.2), drift=drifts)
def test_its_spread_settles_where_drift_and_noise_balance(sigma: float, drift: float) -> None:
    """P = r d for a scalar Kalman filter, within the step of a tick."""
    found = measured(HoverThrustEstimate(50_000.0, sigma), [50_000.0] * 3000, 0.02, drift)
    assert found.sigma_fraction == pytest.approx(
        math.sqrt(ONE_SECOND_HOVER_THRUST_MEASUREMENT_SIGMA_FRACTION * drift), rel=0.05
    )


@given(first=thrusts, true=thrusts, drift=drifts)
def test_the_rate_of_the_loop_changes_nothing(first: float, true: float, drift: float) -> None:
    """Half as many measurements that stand for twice the time; 2 % of the step that is measured."""
    start = HoverThrustEstimate(first, INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER)
    slow = measured(start, [true] * 25, 0.02, drift)
    fast = measured(start, [true] * 50, 0.01, drift)
    assert slow.raw_thrust == pytest.approx(fast.raw_thrust, abs=0.02 * abs(true - first) + 1e-6)
    assert slow.sigma_fraction == pytest.approx(fast.sigma_fraction, rel=0.05)


@given(old=thrusts, one=thrusts, other=thrusts, sigma=st.floats(1e-3, 0.2))
def test_more_measured_is_more_believed(old: float, one: float, other: float, sigma: float) -> None:
    start = HoverThrustEstimate(old, sigma)
    low, high = (start.with_measurement(each, 0.02).raw_thrust for each in sorted((one, other)))
    assert low <= high
    assert (
        min(old, one) - 1e-6 <= start.with_measurement(one, 0.02).raw_thrust <= max(old, one) + 1e-6
    )
    assert start.with_measurement(one, 0.0) == start  # no time, no evidence


@pytest.mark.parametrize(("thrust", "learns"), [(52_000.0, True), (62_000.0, False)])
def test_a_hand_that_holds_the_vehicle_teaches_nothing(thrust: float, learns: bool) -> None:
    found = learn_hover_thrust_in_quiet_flight(believing(Phase.ALIGN, thrust), 0.02)
    assert (found.raw_thrust > 50_000.0) is learns


@given(thrust=thrusts, acc_z_g=st.floats(0.7, 1.3))
def test_a_descent_stays_within_the_spread_that_it_began_with(
    thrust: float, acc_z_g: float
) -> None:
    b = believing(Phase.LANDING, thrust, acc_z_g)
    for _ in range(200):
        b = replace(b, hover_thrust_estimate=learn_hover_thrust_in_descent(b, 0.02))
    assert (
        abs(b.hover_thrust / 50_000.0 - 1.0)
        <= MAX_HOVER_THRUST_CORRECTION_IN_DESCENT_SIGMAS
        * MIN_HOVER_THRUST_SIGMA_FRACTION_AT_DESCENT_START
        + 1e-9
    )
    assert (b.hover_thrust > 50_000.0) is (thrust / acc_z_g > 50_000.0)


@pytest.mark.parametrize(
    "hides",
    [
        {"command_history": replace(DESCENDS, floor_detected_at_s=9.9)},
        {"vehicle_world_z_at_last_contact_m": 1.0},  # a magnet may hold it
        {"magnet_reach_entered_at_s": 9.0},
    ],
    ids=["floor", "contact", "reach"],
)
def test_what_may_carry_it_teaches_a_descent_nothing(hides: dict[str, Any]) -> None:
    b = believing(Phase.LANDING, 30_000.0)
    assert (
        learn_hover_thrust_in_descent(replace(b, command_history=DESCENDS), 0.02).raw_thrust
        < 50_000.0
    )
    assert learn_hover_thrust_in_descent(replace(b, **hides), 0.02).raw_thrust == 50_000.0


def test_what_was_never_learned_is_felt_and_rough() -> None:
    b = replace(believing(Phase.LANDING, 45_000.0), hover_thrust_estimate=HoverThrustEstimate())
    assert estimate_hover_thrust(b).raw_thrust == pytest.approx(45_000.0)
    assert estimate_hover_thrust(b).is_imprecise
    assert not learn_hover_thrust_in_quiet_flight(b, 0.02).is_imprecise


def test_a_sample_is_measured_once_however_often_the_loop_sees_it() -> None:
    """One late packet teaches no more in a second than in a tick."""
    start = remembering(
        state_in(Phase.LANDING),
        commanded_raw_thrust=45_000,
        hover_thrust_estimate=HoverThrustEstimate(50_000.0, 0.12),
    )
    sample = replace(telemetry(10.02, 1.0), thrust=45_000.0)
    once = observing(start, observation(10.02, telemetry=sample))
    again = observing(once, observation(10.04, telemetry=sample))
    assert once.belief.hover_thrust < 50_000.0
    assert again.belief.hover_thrust == once.belief.hover_thrust


@pytest.mark.parametrize("step", [0.6, 1.3])
def test_a_step_of_the_thrust_is_no_other_hover_thrust(step: float) -> None:
    """The rotors follow an order with their lag, and the accelerometer with them: until they have,
    the thrust that is read divided by the specific force is not what hovering takes."""
    state = remembering(
        state_in(Phase.LANDING), hover_thrust_estimate=HoverThrustEstimate(50_000.0, 0.12)
    )
    force_g = 1.0
    for i in range(100):
        t_s, read = 10.0 + 0.01 * i, 50_000.0 if i < 50 else step * 50_000.0
        force_g += (1.0 - math.exp(-0.01 / 0.06)) * (read / 50_000.0 - force_g)
        sample = replace(telemetry(t_s, 1.0), thrust=read, acc_z_g=force_g)
        state = observing(
            replace(state, commanded_raw_thrust=int(read)), observation(t_s, telemetry=sample)
        )
        assert state.belief.hover_thrust == pytest.approx(50_000.0, rel=0.005)


@given(sigma=st.floats(1e-3, 0.2), dt_s=st.floats(0.0, 600.0))
def test_what_is_not_measured_grows_unsure_up_to_what_is_felt(sigma: float, dt_s: float) -> None:
    later = HoverThrustEstimate(50_000.0, sigma).propagate_with_bounded_sigma(dt_s)
    assert (
        sigma
        <= later.sigma_fraction
        <= max(sigma, INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER)
    )


def test_an_unknown_thrust_is_the_first_one_that_is_measured() -> None:
    found = HoverThrustEstimate().with_measurement(48_000.0, 0.02)
    assert found.raw_thrust == 48_000.0
    assert math.isfinite(found.sigma_fraction)


def test_a_tick_without_a_measurement_makes_it_less_sure() -> None:
    """In a press nothing measures the hover thrust."""
    start = remembering(state_in(Phase.PERCH), hover_thrust=50_000.0)
    later = observing(start, observation(10.5))
    assert later.belief.hover_thrust == 50_000.0
    assert (
        later.belief.hover_thrust_estimate.sigma_fraction
        > start.belief.hover_thrust_estimate.sigma_fraction
    )
