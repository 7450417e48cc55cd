"""Each detector has laws of its own: of bias, sample rate, heading, and of more evidence."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import ImuMotion
from perchctl.mission.belief.motion import (
    FALL_DETECTOR_GAINED_CLIMB_RATE_UPPER_CLAMP_MPS,
    MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS,
    MAX_CLIMB_RATE_GAINED_TO_DETECT_FALL_MPS,
    MAX_LATERAL_VELOCITY_DEVIATION_TO_COUNT_AS_STEADY_MPS,
    MEAN_LATERAL_VELOCITY_TIME_CONSTANT_S,
    MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G,
    MIN_LOW_G_DURATION_TO_DETECT_FALL_S,
    UP_ACCELERATION_OFFSET_TIME_CONSTANT_S,
    FallDetector,
    FreezeDetector,
    Impact,
    ImpactDetector,
    LateralPushDetector,
    SteadySpeedDetector,
)
from perchctl.vehicle import Telemetry
from tests.helpers.mission import telemetry

RATES_HZ = st.sampled_from([50.0, 100.0, 200.0])
"""Of the telemetry, in its range."""
BIAS_MPS2 = st.floats(-0.3, 0.3)
"""Of the vertical acceleration: 0.03 g, as turning motors and a tilt of 14 degrees make it."""


# --- Falls ---------------------------------------------------------------------------------------


def watched(
    up_acceleration_mps2: list[tuple[float, float]], rate_hz: float, bias_mps2: float = 0.0
) -> FallDetector:
    """After accelerations for so long each: (m/s2, s). It reads what it feels."""
    fall, t_s, dt_s = FallDetector(), 0.0, 1.0 / rate_hz
    for mps2, lasts_s in up_acceleration_mps2:
        for _ in range(round(lasts_s * rate_hz)):
            t_s += dt_s
            reads_g = 1.0 + (mps2 + bias_mps2) / GRAVITY_MPS2
            fall = fall.update_fall(t_s, mps2 + bias_mps2, reads_g, dt_s)
    return fall


LEARNED_S = 4.0 * UP_ACCELERATION_OFFSET_TIME_CONSTANT_S


@given(RATES_HZ, BIAS_MPS2)
def test_a_constant_bias_is_no_fall_and_hides_none(rate_hz: float, bias_mps2: float) -> None:
    hovers = [(0.0, LEARNED_S)]
    assert watched(hovers, rate_hz, bias_mps2).last_fall_at_s < 0.5 * LEARNED_S
    falls = [*hovers, (-0.9 * GRAVITY_MPS2, 0.15)]
    assert watched(falls, rate_hz, bias_mps2).last_fall_at_s > LEARNED_S


@given(RATES_HZ, st.floats(0.0, 0.9), st.floats(0.0, 0.5))
def test_a_deeper_or_longer_fall_is_one_too(rate_hz: float, part: float, more_s: float) -> None:
    """By as much as gravity gives: what falls for a moment falls for longer as well."""
    begins = [(0.0, 1.0)]
    short = watched([*begins, (-part * GRAVITY_MPS2, 0.2)], rate_hz)
    assume(short.last_fall_at_s > 1.0)
    deep = watched([*begins, (-GRAVITY_MPS2, 0.2)], rate_hz)
    long = watched([*begins, (-part * GRAVITY_MPS2, 0.2 + more_s)], rate_hz)
    assert min(deep.last_fall_at_s, long.last_fall_at_s) > 1.0


@given(st.floats(0.3, 1.0))
def test_a_fall_is_noticed_after_the_same_time_at_each_rate(part: float) -> None:
    found = []
    for rate_hz in (50.0, 100.0, 200.0):
        for ms in range(20, 400, 20):
            fallen = watched([(0.0, 1.0), (-part * GRAVITY_MPS2, ms / 1e3)], rate_hz)
            if fallen.last_fall_at_s > 1.0:
                found.append(ms / 1e3)
                break
    assert len(found) == 3
    assert max(found) - min(found) <= 0.02 + 1e-9  # one sample at the lowest rate
    assert max(found) <= MIN_LOW_G_DURATION_TO_DETECT_FALL_S + 0.04


@given(RATES_HZ, st.floats(1.0, 6.0))
def test_the_rebound_of_an_impact_is_no_fall(rate_hz: float, speed_mps: float) -> None:
    """Against the ceiling the accelerometer reads several g down for some hundredths of a
    second."""
    lasts_s = max(0.02, 1.0 / rate_hz)
    blow = [(0.0, 1.0), (-0.1 * speed_mps / lasts_s, lasts_s), (0.0, 1.0)]
    assert watched(blow, rate_hz).last_fall_at_s < 1.0


@given(RATES_HZ, st.floats(0.1, 0.65), st.floats(1.0, 3.0), st.floats(1.0, 3.0))
def test_a_climb_that_is_braked_is_no_fall(
    rate_hz: float, speed_mps: float, gains_mps2: float, brakes_mps2: float
) -> None:
    climbs = [(0.0, 1.0), (gains_mps2, speed_mps / gains_mps2)]
    stops = [(-brakes_mps2, speed_mps / brakes_mps2), (0.0, 1.0)]
    assert watched([*climbs, *stops], rate_hz).last_fall_at_s < 1.0


@given(RATES_HZ, st.floats(0.1, 3.0), st.floats(0.1, 0.3))
def test_a_climb_of_any_speed_delays_the_detection_of_a_fall_only_by_a_little(
    rate_hz: float, speed_mps: float, part: float
) -> None:
    falls_mps2 = part * GRAVITY_MPS2
    # The offset that the detector learns meanwhile, and what it forgets, take a fifth at most.
    late_s = (
        FALL_DETECTOR_GAINED_CLIMB_RATE_UPPER_CLAMP_MPS - MAX_CLIMB_RATE_GAINED_TO_DETECT_FALL_MPS
    ) / (0.8 * falls_mps2)
    flight = [(0.0, 1.0), (5.0, speed_mps / 5.0), (-falls_mps2, late_s + 0.05)]
    assert watched(flight, rate_hz).last_fall_at_s > 1.0


@given(RATES_HZ, st.floats(-1.0, 0.55), st.floats(0.0, 5.0))
def test_what_reads_light_for_longer_than_a_rebound_falls_whatever_the_attitude_says(
    rate_hz: float, reads_g: float, up_acceleration_mps2: float
) -> None:
    """With a wrong attitude the vertical acceleration may show none of it."""
    fall, t_s, dt_s = FallDetector(), 1.0, 1.0 / rate_hz
    for _ in range(round(rate_hz)):
        t_s += dt_s
        fall = fall.update_fall(t_s, up_acceleration_mps2, reads_g, dt_s)
        if fall.last_fall_at_s > 0.0:
            break
    assert (
        MIN_LOW_G_DURATION_TO_DETECT_FALL_S
        <= t_s - 1.0
        <= MIN_LOW_G_DURATION_TO_DETECT_FALL_S + 2.1 * dt_s
    )


# --- Impacts -------------------------------------------------------------------------------------


def struck(gained_mps: float, rate_hz: float, sinks_mps: float = -0.7) -> ImpactDetector:
    """After a blow from below that has taken 20 ms, and a moment of rest."""
    impact, t_s, dt_s, v_mps = ImpactDetector(), 0.0, 1.0 / rate_hz, sinks_mps
    blows = max(1, round(0.02 * rate_hz))
    for k in range(round(rate_hz)):
        up_acceleration_mps2 = (
            gained_mps / (blows * dt_s) if 0 <= k - round(0.5 * rate_hz) < blows else 0.0
        )
        t_s, v_mps = t_s + dt_s, v_mps + up_acceleration_mps2 * dt_s
        now = Impact(t_s, v_mps, v_mps, 1.0 + up_acceleration_mps2 / GRAVITY_MPS2, 0.0)
        impact = impact.update_impact(now, 0.0, up_acceleration_mps2, dt_s)
    return impact


@given(RATES_HZ, st.floats(0.3, 3.0), st.floats(0.0, 1.0))
def test_a_harder_blow_is_a_blow_and_never_softer(
    rate_hz: float, gained_mps: float, more_mps: float
) -> None:
    soft, hard = struck(gained_mps, rate_hz), struck(gained_mps + more_mps, rate_hz)
    assert soft.newest_impact.t_s > 0.4
    assert hard.newest_impact.t_s > 0.4
    assert (
        hard.newest_impact.peak_specific_force_body_z_g
        >= soft.newest_impact.peak_specific_force_body_z_g - 1e-9
    )


@given(RATES_HZ, st.floats(-1.5, -0.3), st.floats(0.3, 1.5))
def test_the_speed_of_a_touchdown_is_the_one_before_it(
    rate_hz: float, sinks_mps: float, gained_mps: float
) -> None:
    blow = struck(gained_mps, rate_hz, sinks_mps).newest_impact
    assert blow.estimated_climb_rate_before_impact_mps == pytest.approx(sinks_mps, abs=1e-9)


@given(RATES_HZ)
def test_full_thrust_is_no_blow(rate_hz: float) -> None:
    """A Crazyflie's gives 0.2 g more than its weight on a fresh battery."""
    impact, t_s, dt_s = ImpactDetector(), 0.0, 1.0 / rate_hz
    for _ in range(round(2.0 * rate_hz)):
        t_s += dt_s
        now = Impact(t_s, 0.0, 0.0, 1.2)
        impact = impact.update_impact(now, 1.0, 0.2 * GRAVITY_MPS2, dt_s)
    assert impact.last_impact_or_bounce_at_s == -math.inf


# --- Frozen readings -----------------------------------------------------------------------------


@given(st.integers(1, 60), RATES_HZ)
def test_a_frozen_reading_is_as_old_as_its_first(samples: int, rate_hz: float) -> None:
    last, freeze = telemetry(0.0), FreezeDetector()
    freeze = freeze.update_freeze(None, last)
    moved = replace(telemetry(0.01), acc_x_g=0.01, roll_rad=0.01, position_m=(0.1, 0.0, 1.0))
    freeze, last = freeze.update_freeze(last, moved), moved
    assert (
        freeze.acceleration_frozen_for_s,
        freeze.attitude_frozen_for_s,
        freeze.position_frozen_for_s,
    ) == (0.0, 0.0, 0.0)
    for k in range(samples):
        now = replace(last, t_s=last.t_s + 1.0 / rate_hz, acc_x_g=0.02 + 1e-6 * k)
        freeze, last = freeze.update_freeze(last, now), now
    assert freeze.acceleration_frozen_for_s == 0.0
    assert freeze.only_attitude_frozen_for_s == pytest.approx(samples / rate_hz)
    assert freeze.only_position_frozen_for_s == pytest.approx(samples / rate_hz)


# --- Steady speeds -------------------------------------------------------------------------------


@given(RATES_HZ, st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(-math.pi, math.pi))
def test_a_constant_speed_is_steady_whatever_it_is(
    rate_hz: float, climb_mps: float, aside_mps: float, heading_rad: float
) -> None:
    """A bias of the integrated speed changes nothing, nor does the heading."""
    speed, t_s, dt_s = SteadySpeedDetector(), 0.0, 1.0 / rate_hz
    velocity = (aside_mps * math.cos(heading_rad), aside_mps * math.sin(heading_rad), climb_mps)
    for _ in range(round(2.0 * rate_hz)):
        t_s += dt_s
        speed = speed.update_steady_speed(t_s, velocity, dt_s)
    assert (
        t_s - min(speed.climb_rate_became_steady_at_s, t_s) >= 1.9
        or abs(climb_mps) <= MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS
    )
    # The first deviation is from a mean that has moved for one sample.
    first_mps = abs(aside_mps) * math.exp(-dt_s / MEAN_LATERAL_VELOCITY_TIME_CONSTANT_S)
    assert (
        t_s - min(speed.lateral_velocity_became_steady_at_s, t_s) >= 1.0
        or first_mps <= MAX_LATERAL_VELOCITY_DEVIATION_TO_COUNT_AS_STEADY_MPS + 1e-9
    )
    jerked = speed.update_steady_speed(
        t_s + dt_s,
        (*velocity[:2], climb_mps + 2.0 * MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS),
        dt_s,
    )
    assert jerked.climb_rate_became_steady_at_s == t_s + dt_s


# --- Pushes --------------------------------------------------------------------------------------


def pushed(
    force_g: float, heading_rad: float, rate_hz: float, offset_g: tuple[float, float] = (0.0, 0.0)
) -> LateralPushDetector:
    push, t_s, dt_s = LateralPushDetector(), 0.0, 1.0 / rate_hz
    for _ in range(round(0.5 * rate_hz)):
        t_s += dt_s
        sample: Telemetry = replace(
            telemetry(t_s),
            acc_x_g=force_g * math.cos(heading_rad) + offset_g[0],
            acc_y_g=force_g * math.sin(heading_rad) + offset_g[1],
        )
        push = push.update_lateral_push(sample, (*offset_g, 0.0), dt_s)
    return push


@given(RATES_HZ, st.floats(-math.pi, math.pi), st.floats(0.0, 0.2), st.floats(-0.1, 0.1))
def test_a_push_is_one_from_each_side_and_with_each_offset_at_rest(
    rate_hz: float, heading_rad: float, force_g: float, offset_g: float
) -> None:
    assume(abs(force_g - MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G) > 1e-3)
    found = pushed(force_g, heading_rad, rate_hz, (offset_g, -offset_g))
    assert (found.last_lateral_push_at_s > 0.0) is (
        force_g > MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G
    )


# --- All of it -----------------------------------------------------------------------------------


@given(st.floats(-math.pi, math.pi), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_the_velocity_turns_with_the_heading(
    heading_rad: float, roll_rad: float, pitch_rad: float
) -> None:
    """The same motion in another heading is the same motion, turned."""

    def flown(yaw_rad: float) -> ImuMotion:
        motion, last = ImuMotion(), None
        for k in range(40):
            now = replace(
                telemetry(0.01 * k), roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=yaw_rad,
                acc_x_g=0.02 + 1e-6 * k, acc_y_g=-0.01, acc_z_g=1.0,
            )  # fmt: skip
            motion, last = motion.with_sample(last, now), now
        return motion

    (x, y, z), (tx, ty, tz) = (
        flown(0.0).velocity_since_first_sample_world_mps,
        flown(heading_rad).velocity_since_first_sample_world_mps,
    )
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    assert (tx, ty, tz) == pytest.approx((cos * x - sin * y, sin * x + cos * y, z), abs=1e-9)
