"""The lateral offset from the target, by pictures and lean."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.mission.belief.lateral_offset import (
    MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S,
    MAX_VELOCITY_SIGMA_TO_USE_FILTER_MPS,
    LateralMotionSample,
    LateralOffsetAndVelocity,
    LateralOffsetFilter,
    LateralVector,
)

AGAIN = settings(max_examples=20)
SAMPLE_S, PICTURE_S = 0.02, 1.0 / 30.0
Motion = Callable[[float], tuple[LateralVector, LateralVector, LateralVector]]
"""Offset (gear to target), velocity and acceleration of the vehicle at a time."""

phases = st.floats(-math.pi, math.pi)


def swaying(amplitude_m: float, period_s: float, phase_rad: float) -> Motion:
    """A vehicle that swings below the target, in x and in y with different phases."""
    w = 2.0 * math.pi / period_s

    def at(t_s: float) -> tuple[LateralVector, LateralVector, LateralVector]:
        a, b = w * t_s + phase_rad, w * t_s
        offset = (-amplitude_m * math.sin(a), -amplitude_m * math.sin(b))
        velocity = (amplitude_m * w * math.cos(a), amplitude_m * w * math.cos(b))
        return offset, velocity, (w * w * offset[0], w * w * offset[1])

    return at


def watch(
    motion: Motion,
    until_s: float,
    *,
    latency_s: float = 0.08,
    sigma_m: float = 0.0,
    seed: int = 0,
    acceleration_bias_mps2: float = 0.0,
    velocity_error_mps: float = 0.0,
    last_picture_s: float = math.inf,
) -> LateralOffsetFilter:
    """The filter at `until_s` after pictures and samples of the motion, in the order in which they
    arrive."""
    rng = np.random.default_rng(seed)
    filtered = LateralOffsetFilter()
    pictures = [k * PICTURE_S for k in range(int(until_s / PICTURE_S) + 1)]
    for k in range(int(until_s / SAMPLE_S) + 1):
        t_s = k * SAMPLE_S
        _, (v_x, v_y), (a_x, a_y) = motion(t_s)
        bias = acceleration_bias_mps2
        acceleration_mps2 = (a_x + bias, a_y + bias)
        velocity_mps = (v_x + velocity_error_mps, v_y + velocity_error_mps)
        filtered = filtered.with_sample(LateralMotionSample(t_s, acceleration_mps2, velocity_mps))
        while pictures and pictures[0] + latency_s <= t_s:
            exposure_s = pictures.pop(0)
            if exposure_s <= last_picture_s:
                x_m, y_m = motion(exposure_s)[0]
                n_x, n_y = rng.normal(0.0, sigma_m, 2) if sigma_m else (0.0, 0.0)
                filtered = filtered.with_picture_measurement(
                    exposure_s, (x_m + n_x, y_m + n_y), sigma_m
                )
    return filtered


def known(filtered: LateralOffsetFilter, t_s: float) -> LateralOffsetAndVelocity:
    found = filtered.predict(t_s)
    assert found is not None
    return found


@AGAIN
@given(amplitude_m=st.floats(0.002, 0.02), period_s=st.floats(0.8, 3.0), phase_rad=phases)
def test_the_offset_between_late_pictures_follows_the_lean(
    amplitude_m: float, period_s: float, phase_rad: float
) -> None:
    """The vehicle moves by up to 3 cm in the tenth of a second until a picture is here; what is
    left is the error of an acceleration that is held for a sample's 20 ms."""
    motion = swaying(amplitude_m, period_s, phase_rad)
    now = known(watch(motion, 2.0), 2.0)
    (ex, ey), (vx, vy), _ = motion(2.0)
    fastest_mps = 2.0 * math.pi * amplitude_m / period_s
    assert now.gear_to_target_world_xy_m == pytest.approx((ex, ey), abs=0.03 * amplitude_m)
    assert now.vehicle_velocity_world_xy_mps == pytest.approx((vx, vy), abs=0.15 * fastest_mps)
    held = math.hypot(*(a - b for a, b in zip(motion(1.92)[0], (ex, ey), strict=True)))
    assert math.dist(now.gear_to_target_world_xy_m, (ex, ey)) <= max(0.3 * held, 0.03 * amplitude_m)


@AGAIN
@given(turn_rad=phases, phase_rad=phases)
def test_the_axes_may_point_anywhere(turn_rad: float, phase_rad: float) -> None:
    """A motion in rotated axes is estimated in rotated axes."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)

    def rotate(v: LateralVector) -> LateralVector:
        return cos * v[0] - sin * v[1], sin * v[0] + cos * v[1]

    motion = swaying(0.01, 1.5, phase_rad)

    def rotated(t_s: float) -> tuple[LateralVector, LateralVector, LateralVector]:
        offset, velocity, acceleration = motion(t_s)
        return rotate(offset), rotate(velocity), rotate(acceleration)

    here, there = known(watch(motion, 1.5), 1.5), known(watch(rotated, 1.5), 1.5)
    assert there.gear_to_target_world_xy_m == pytest.approx(
        rotate(here.gear_to_target_world_xy_m), abs=1e-9
    )
    assert there.vehicle_velocity_world_xy_mps == pytest.approx(
        rotate(here.vehicle_velocity_world_xy_mps), abs=1e-9
    )


@AGAIN
@given(latency_s=st.floats(0.0, 0.25), phase_rad=phases)
def test_a_late_picture_corrects_the_moment_that_it_shows(
    latency_s: float, phase_rad: float
) -> None:
    """Once they have arrived, pictures leave the same estimate, prompt or late."""
    motion = swaying(0.01, 1.5, phase_rad)
    prompt = watch(motion, 2.0, latency_s=0.0, last_picture_s=1.5)
    late = watch(motion, 2.0, latency_s=latency_s, last_picture_s=1.5)
    assert known(late, 1.9).gear_to_target_world_xy_m == pytest.approx(
        known(prompt, 1.9).gear_to_target_world_xy_m, abs=1e-12
    )


def test_the_spread_is_what_the_estimate_errs_by() -> None:
    """Mean squared error over variance; 1 is honest. The filter also allows for gusts, which this
    motion lacks, so it claims more than it errs by; it must not claim less."""
    squares, sigma_m = [], 0.0008
    for seed in range(60):
        motion = swaying(0.005, 1.7, 0.1 * seed)
        now = known(watch(motion, 1.5, sigma_m=sigma_m, seed=seed), 1.5)
        error_m = np.subtract(now.gear_to_target_world_xy_m, motion(1.5)[0])
        squares += list((error_m / now.gear_to_target_sigma_m) ** 2)
    assert 0.05 < np.mean(squares) < 1.2


def test_the_spread_grows_until_the_estimate_is_unknown() -> None:
    filtered = watch(swaying(0.005, 1.7, 0.0), 2.0, last_picture_s=1.5)
    spreads = [
        known(filtered, 1.5 + t_s).gear_to_target_sigma_m for t_s in np.linspace(0.0, 0.48, 10)
    ]
    assert spreads == sorted(spreads)
    assert spreads[-1] > 2.0 * spreads[0]
    assert filtered.predict(1.5 + MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S + PICTURE_S) is None
    assert filtered.predict(0.5) is None


def test_nothing_is_known_before_the_pictures_show_a_velocity() -> None:
    assert LateralOffsetFilter().predict(0.0) is None
    one = LateralOffsetFilter().with_picture_measurement(1.0, (0.0, 0.0), 0.001)
    assert one.predict(1.0) is None
    with_more = watch(swaying(0.005, 1.7, 0.0), 0.5)
    assert known(with_more, 0.5).velocity_sigma_mps < 2.0 * MAX_VELOCITY_SIGMA_TO_USE_FILTER_MPS


def test_a_step_of_the_pose_is_no_velocity() -> None:
    """A pose that jumps by 5 cm, and stays there: the velocity starts again from rest."""
    filtered = watch(swaying(0.002, 2.0, 0.0), 1.0)
    t_s = filtered.t_s + PICTURE_S
    jumped = filtered.with_picture_measurement(t_s, (0.05, 0.0), 0.001)
    assert jumped.gear_to_target_world_xy_m == (0.05, 0.0)
    assert jumped.vehicle_velocity_world_xy_mps == (0.0, 0.0)
    assert jumped.predict(t_s) is None


def test_a_picture_or_sample_from_the_past_changes_nothing() -> None:
    filtered = watch(swaying(0.005, 1.7, 0.0), 1.0)
    assert filtered.with_picture_measurement(filtered.t_s, (1.0, 1.0), 0.001) is filtered
    assert filtered.with_sample(LateralMotionSample(1.0, (9.0, 9.0), (9.0, 9.0))) is filtered


@AGAIN
@given(bias_mps2=st.floats(-0.06, 0.06))
def test_a_wrong_lean_moves_the_estimate_by_little(bias_mps2: float) -> None:
    """An attitude that is wrong by a third of a degree moves the offset by half a millimetre, since
    the next picture corrects it."""
    motion = swaying(0.005, 1.7, 0.0)
    now = known(watch(motion, 2.0, acceleration_bias_mps2=bias_mps2), 2.0)
    assert now.gear_to_target_world_xy_m == pytest.approx(motion(2.0)[0], abs=0.0012)
