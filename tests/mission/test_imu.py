"""What accelerometer and attitude tell of the motion, through silences and readings that stand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from perchctl.mission.imu import FROZEN_S, ImuMotion, Reckoning, moved, reckoned
from perchctl.vehicle import Telemetry
from tests.helpers.mission import telemetry


def flown(samples: list[Telemetry], motion: ImuMotion | None = None) -> ImuMotion:
    motion = motion or ImuMotion()
    for last, new in zip([None, *samples], samples, strict=False):
        motion = moved(motion, last, new)
    return motion


def test_an_accelerometer_that_stands_still_is_a_silence() -> None:
    """A reading of 0.9 g for ever is neither a fall nor a way down."""
    frozen = [telemetry(0.01 * i, acc_x_g=0.0, acc_z_g=0.9) for i in range(300)]
    motion = flown(frozen)
    assert motion.frozen_s == pytest.approx(2.99)
    assert motion.gap_s == pytest.approx(2.99)
    assert motion.fell_s < 0.0
    assert abs(motion.velocity_mps[2]) < 1.1 * 0.1 * 9.81 * FROZEN_S
    alive = flown([telemetry(0.01 * i, acc_z_g=0.9) for i in range(300)])
    assert alive.frozen_s == 0.0
    assert alive.fell_s > 0.0


def test_with_an_attitude_that_stands_still_the_estimate_s_change_counts() -> None:
    """What it leans by is not known, and whether it falls still is."""
    samples = [telemetry(0.01 * i, roll_rad=0.2, acc_z_g=1.0) for i in range(100)]
    motion = flown(samples)
    assert motion.gap_s < 0.0
    before = Reckoning(flown(samples[:99]), (0.1, 0.2, 0.3), estimated_mps=(0.0, 0.0, 0.0))
    after = replace(samples[-1], velocity_mps=(0.0, 0.1, 0.0))
    assert reckoned(before, motion, after, believed=False).velocity_mps == (
        pytest.approx((0.1, 0.3, 0.3))
    )


def test_after_a_silence_the_estimate_s_own_change_counts() -> None:
    """On board the accelerometer was felt all the time, and no position corrected anything. What
    the estimate was wrong by before it is still wrong by."""
    before = telemetry(1.0, velocity_mps=(0.1, 0.0, 0.15))
    after = telemetry(1.7, velocity_mps=(0.1, 0.2, -0.5))
    imu = flown([before])
    old = Reckoning(imu, velocity_mps=(0.0, 0.0, 0.05), estimated_mps=before.velocity_mps)
    heard = moved(imu, before, after)
    new = reckoned(old, heard, after, believed=False)
    assert new.velocity_mps == pytest.approx((0.0, 0.2, -0.6))
    assert reckoned(old, heard, after, believed=True).velocity_mps == after.velocity_mps
    assert reckoned(old, heard, after, believed=False, astray=True).velocity_mps == (
        old.velocity_mps
    )
