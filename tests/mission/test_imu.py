"""What accelerometer and attitude tell of the motion, through silences and readings that stand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import ImuMotion
from perchctl.mission.imu import (
    FROZEN_S,
    GAP_S,
    UNCORRECTED_S,
    Reckoning,
    advance_reckoning,
)
from perchctl.vehicle import Telemetry
from tests.helpers.mission import telemetry


def flown(samples: list[Telemetry], motion: ImuMotion | None = None) -> ImuMotion:
    motion = motion or ImuMotion()
    for last, new in zip([None, *samples], samples, strict=False):
        motion = motion.with_sample(last, new)
    return motion


def test_an_accelerometer_that_stands_still_is_a_silence() -> None:
    """A reading of 0.9 g for ever is neither a fall nor a way down."""
    frozen = [telemetry(0.01 * i, acc_x_g=0.0, acc_z_g=0.9) for i in range(300)]
    motion = flown(frozen)
    assert motion.frozen_s == pytest.approx(2.99)
    assert motion.silent_s == pytest.approx(2.99)
    assert motion.fell_s < 0.0
    assert abs(motion.velocity_mps[2]) < 1.1 * 0.1 * 9.81 * FROZEN_S
    alive = flown([telemetry(0.01 * i, acc_z_g=0.9) for i in range(300)])
    assert alive.frozen_s == 0.0
    assert alive.fell_s > 0.0


def since_heard(after: Telemetry, before: Telemetry | None = None) -> ImuMotion:
    """What a silence leaves, of a vehicle that hung at 1.9 m before it."""
    hung = [telemetry(0.01 * i, 1.9) for i in range(100)]
    return flown(hung).with_sample(before or hung[-1], after)


@given(silent_s=st.floats(GAP_S + 0.01, 4.0), drift_mps=st.floats(-0.1, 0.1))
def test_a_silence_over_which_the_estimate_shows_no_fall_hides_none(
    silent_s: float, drift_mps: float
) -> None:
    """On board the accelerometer is felt all the time: what fell has gained speed, or where the
    floor took that, has gone down."""
    t_s = 0.99 + silent_s
    hangs = since_heard(telemetry(t_s, 1.9 + 0.05, velocity_mps=(0.0, 0.0, drift_mps)))
    assert (hangs.silent_s, hangs.gap_s) == (t_s, -math.inf)
    for z_m, climb_mps, changes in (
        (1.9, drift_mps - 1.0, {}),  # the floor's blow was more than the accelerometer reads
        (0.0, drift_mps, {}),
        (1.9, drift_mps, {"behind_s": silent_s}),  # the position is from before
        (1.9, drift_mps, {"start": 1}),  # and this estimate is another one
    ):
        after = telemetry(t_s, z_m, velocity_mps=(0.0, 0.0, climb_mps), **changes)
        assert since_heard(after).gap_s == t_s
    still = telemetry(0.99, 1.9)
    assert since_heard(replace(still, t_s=t_s), still).gap_s == t_s


def test_after_a_silence_the_estimate_s_own_change_counts() -> None:
    """On board the accelerometer was felt all the time, and no position corrected anything. What
    the estimate was wrong by before it is still wrong by."""
    before = telemetry(1.0, velocity_mps=(0.1, 0.0, 0.15))
    after = telemetry(1.7, velocity_mps=(0.1, 0.2, -0.5))
    imu = flown([before])
    old = Reckoning(imu, velocity_mps=(0.0, 0.0, 0.05), estimated_mps=before.velocity_mps)
    heard = imu.with_sample(before, after)
    new = advance_reckoning(old, heard, after, believed=False)
    assert new.velocity_mps == pytest.approx((0.0, 0.2, -0.6))
    assert advance_reckoning(old, heard, after, believed=True).velocity_mps == after.velocity_mps
    assert advance_reckoning(old, heard, after, believed=False, astray=True).velocity_mps == (
        old.velocity_mps
    )


# --- Whether the estimate is corrected -----------------------------------------------------------


def uncorrected_s(*growths: tuple[float, float]) -> float:
    """The age of the last correction, after each a second by how much the variance of the vertical
    speed grows in it and how long it lasts; its packets come each 0.1 s."""
    variance, motion, last = 1e-4, ImuMotion(), None
    t_s = 0.0
    for per_s, lasts_s in growths:
        for _ in range(round(lasts_s / 0.01)):
            t_s += 0.01
            if round(100 * t_s) % 10 == 0:
                variance += 0.1 * per_s
            new = telemetry(t_s, climb_variance_m2ps2=variance)
            motion, last = motion.with_sample(last, new), new
    return motion.corrections.age_s(t_s)


def test_a_variance_that_grows_on_and_on_is_corrected_no_more() -> None:
    """After 0.5 s it is certain, and then the age counts from the last correction."""
    assert uncorrected_s((0.0, 1.0), (1e-3, UNCORRECTED_S)) == 0.0
    assert uncorrected_s((0.0, 1.0), (1e-3, 0.6)) == pytest.approx(0.6, abs=0.11)
    assert uncorrected_s((0.0, 1.0), (1e-3, 5.0)) == pytest.approx(5.0, abs=0.11)


@pytest.mark.parametrize("growths", [
    ((2e-4, 5.0),),  # a laser's reading that is worse with each centimetre of height
    ((1e-3, 0.4), (-1e-3, 0.1)) * 8,  # positions with holes
    ((1e-3, 3.0), (-1e-2, 0.2)),  # they come again
    ((1e-3, 0.4), (0.0, 3.0)),  # the variance's packets come no more
    ((math.nan, 3.0),),
])  # fmt: skip
def test_what_is_corrected_or_not_known_is_not_called_uncorrected(
    growths: tuple[tuple[float, float], ...],
) -> None:
    assert uncorrected_s((0.0, 1.0), *growths) == 0.0


def test_no_silence_and_no_frozen_accelerometer_hides_that_nothing_corrects_it() -> None:
    silent = [telemetry(0.3 * i, climb_variance_m2ps2=1e-4 + 3e-4 * i) for i in range(10)]
    assert flown(silent).corrections.age_s(2.7) == pytest.approx(2.7)
