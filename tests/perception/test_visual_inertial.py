"""Pictures that are late, or of a camera that is turned, against the motion that is felt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2, Array, rot_z, rotation_from_rpy
from perchctl.mission import CameraImuMismatch
from perchctl.perception.visual_inertial import (
    BEYOND_S,
    LEAST_LATER_S,
    MEASURED_LATER_S,
    STEP_S,
    MeasuredLatency,
    VisualInertialWindow,
    estimate_motion,
)
from perchctl.vehicle import Telemetry

LEAST_S, MOST_S = -0.08, 0.1  # of a latency that the flight measures
TARGET_M = np.array([0.3, -0.2, 1.9])
RATE_HZ, FLOWN_S = 30.0, 1.5
BRIEFLY = settings(max_examples=15)  # each watches for seconds
LATENCY_S = 0.2  # so much newer is the telemetry than the exposure is taken to be


@dataclass(frozen=True)
class Swing:
    """A level vehicle that swings about a place 1 m below the target, as its tilt leads it."""

    size_m: float = 0.05
    rate_radps: float = 4.5  # a pendulum of 1 m, 3.1, would keep the target in the line of sight
    heading_rad: float = 0.4
    heave_m: float = 0.0
    jump_mps: float = 0.0  # a blow that the accelerometer misses, at 1 s

    def position_m(self, t_s: float) -> Array:
        a = self.rate_radps * t_s
        x_m = self.size_m * math.sin(a) + self.jump_mps * max(0.0, t_s - 1.0)
        z_m = 0.9 + self.heave_m * math.sin(a)
        return np.array([x_m, 0.5 * self.size_m * math.sin(1.3 * a), z_m])

    def velocity_mps(self, t_s: float) -> Array:
        return (self.position_m(t_s + 1e-4) - self.position_m(t_s - 1e-4)) / 2e-4

    def sample(self, t_s: float, offset_g: float) -> Telemetry:
        w = self.rate_radps
        a_x = -(w**2) * self.size_m * math.sin(w * t_s)
        a_y = -((1.3 * w) ** 2) * 0.5 * self.size_m * math.sin(1.3 * w * t_s)
        a_z = -(w**2) * self.heave_m * math.sin(w * t_s)
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        ahead, left = c * a_x + s * a_y, c * a_y - s * a_x
        pitch_rad, roll_rad = ahead / GRAVITY_MPS2, -left / GRAVITY_MPS2
        R = rotation_from_rpy(roll_rad, pitch_rad, self.heading_rad)
        force = R.T @ np.array([a_x, a_y, GRAVITY_MPS2 + a_z]) / GRAVITY_MPS2
        x_m, y_m, z_m = self.position_m(t_s).tolist()
        return Telemetry(
            t_s=t_s, position_m=(x_m, y_m, z_m), velocity_mps=(0.0, 0.0, 0.0),
            roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=self.heading_rad,
            acc_x_g=float(force[0]) + offset_g, acc_y_g=float(force[1]), acc_z_g=float(force[2]),
            thrust=30000.0, battery_v=3.9, supervisor=0,
        )  # fmt: skip

    def way_m(self, t_s: float, turned_rad: float) -> tuple[float, float, float]:
        """From the body to the target, as a camera sees it that is turned by so much."""
        sample = self.sample(t_s, 0.0)
        R = rotation_from_rpy(sample.roll_rad, sample.pitch_rad, sample.yaw_rad)
        x, y, z = (rot_z(-turned_rad) @ R.T @ (TARGET_M - self.position_m(t_s))).tolist()
        return x, y, z


def watched(
    swing: Swing,
    *,
    later_s: float = 0.0,
    turned_rad: float = 0.0,
    offset_g: float = 0.0,
    rate_hz: float = RATE_HZ,
    measured: MeasuredLatency | None = None,
    noise_m: float = 1e-3,
) -> VisualInertialWindow:
    rng = np.random.default_rng(0)
    watch = VisualInertialWindow()
    flown = [swing.sample(0.01 * k, offset_g) for k in range(int((FLOWN_S + 2.2) * 100) + 1)]
    for i in range(int(FLOWN_S * rate_hz)):
        t_s = 2.0 + i / rate_hz
        newest = int((t_s + LATENCY_S) * 100.0)
        samples = tuple(flown[newest - 200 : newest + 1])
        x, y, z = swing.way_m(t_s - later_s, turned_rad)
        x, y = x + float(rng.normal(0.0, noise_m)), y + float(rng.normal(0.0, noise_m))
        watch = estimate_motion(watch, t_s, (x, y, z), samples, (0.0, 0.0, 0.0), measured)
    return watch


@BRIEFLY
@given(
    later_s=st.floats(LEAST_LATER_S + STEP_S, 0.4) | st.floats(-0.15, -LEAST_LATER_S - STEP_S),
    size_m=st.floats(0.02, 0.06),
    offset_g=st.floats(-0.02, 0.02),
    heading_rad=st.floats(-3.0, 3.0),
)
def test_a_delay_is_found_and_the_speed_with_it(
    later_s: float, size_m: float, offset_g: float, heading_rad: float
) -> None:
    swing = Swing(size_m, heading_rad=heading_rad, heave_m=0.05)
    watch = watched(swing, later_s=later_s, offset_g=offset_g)
    mismatch, motion = watch.mismatch, watch.motion
    assert mismatch is not None
    assert motion is not None
    assert mismatch.camera_yaw_error_rad == 0.0
    assert mismatch.camera_latency_error_s == pytest.approx(later_s, abs=1.5 * STEP_S)
    *true_mps, true_climb_mps = swing.velocity_mps(motion.t_s)
    # Between two delays of the grid the speed is off by 0.06 m/s at the most.
    assert motion.velocity_world_xy_mps == pytest.approx(true_mps, abs=0.07)
    assert motion.climb_mps == pytest.approx(true_climb_mps, abs=0.07)


@BRIEFLY
@given(
    later_s=st.floats(LEAST_S, MOST_S),
    in_use_s=st.floats(LEAST_S, MOST_S),
    rate_hz=st.sampled_from([10.0, 30.0]),
    size_m=st.floats(0.03, 0.06),
    heading_rad=st.floats(-3.0, 3.0),
)
def test_an_error_of_a_measured_latency_is_found_and_ends_when_it_is_corrected(
    later_s: float, in_use_s: float, rate_hz: float, size_m: float, heading_rad: float
) -> None:
    """To 10 ms, which is half of the grid, also at ten pictures a second."""
    swing = Swing(size_m, heading_rad=heading_rad)
    measured = MeasuredLatency(in_use_s, LEAST_S, MOST_S)
    watch = watched(swing, later_s=later_s, rate_hz=rate_hz, measured=measured)
    off_s = abs(later_s - in_use_s)
    assert watch.mismatch is None
    if off_s > MEASURED_LATER_S + 2.0 * STEP_S:
        assert watch.correction_s == pytest.approx(later_s, abs=0.01)
    elif off_s < MEASURED_LATER_S - STEP_S / 2.0:
        assert watch.correction_s is None


@BRIEFLY
@given(later_s=st.floats(MOST_S + BEYOND_S + STEP_S, 0.4), in_use_s=st.floats(-0.08, 0.1))
def test_a_latency_that_cannot_be_measured_is_the_planner_s_matter(
    later_s: float, in_use_s: float
) -> None:
    """And so is a camera that is turned."""
    measured = MeasuredLatency(in_use_s, LEAST_S, MOST_S)
    watch = watched(Swing(0.05), later_s=later_s, measured=measured)
    assert watch.correction_s is None
    assert watch.mismatch is not None
    assert watch.mismatch.camera_latency_error_s == pytest.approx(later_s - in_use_s, abs=0.02)
    turned = watched(Swing(0.05), later_s=in_use_s, turned_rad=math.pi, measured=measured)
    assert turned.correction_s is None
    assert turned.mismatch == CameraImuMismatch(0.0, math.pi)


@BRIEFLY
@given(
    beyond_s=st.floats(BEYOND_S + STEP_S, 0.08),
    noise_m=st.floats(0.003, 0.0035),
    heading_rad=st.floats(-3.0, 3.0),
)
def test_the_nearest_usable_latency_does_not_hide_one_just_beyond(
    beyond_s: float, noise_m: float, heading_rad: float
) -> None:
    """Although it explains noisy sightings about as well."""
    measured, later_s = MeasuredLatency(-0.04, LEAST_S, MOST_S), MOST_S + beyond_s
    swing = Swing(0.05, heading_rad=heading_rad)
    watch = watched(swing, later_s=later_s, measured=measured, noise_m=noise_m)
    assert watch.correction_s is None
    assert watch.mismatch is not None
    assert watch.mismatch.camera_latency_error_s == pytest.approx(later_s + 0.04, abs=0.03)


@pytest.mark.parametrize("quarters", [1, 2, -1])
def test_a_turned_camera_is_found(quarters: int) -> None:
    turned_rad = 0.5 * math.pi * quarters
    swing = Swing()
    watch = watched(swing, turned_rad=turned_rad)
    mismatch, motion = watch.mismatch, watch.motion
    assert mismatch is not None
    assert motion is not None
    assert mismatch.camera_latency_error_s == 0.0
    assert mismatch.camera_yaw_error_rad == pytest.approx(turned_rad)
    assert motion.velocity_world_xy_mps == pytest.approx(
        swing.velocity_mps(motion.t_s)[:2], abs=0.03
    )


@BRIEFLY
@given(
    size_m=st.floats(0.0, 0.06),
    later_s=st.floats(-0.04, 0.04),
    jump_mps=st.floats(-1.0, 1.0),
    offset_g=st.floats(-0.02, 0.02),
)
def test_a_camera_as_the_profile_has_it_fits(
    size_m: float, later_s: float, jump_mps: float, offset_g: float
) -> None:
    """Also through a blow that no sample of the accelerometer shows."""
    swing = Swing(size_m, jump_mps=jump_mps)
    assert watched(swing, later_s=later_s, offset_g=offset_g).mismatch is None


def test_at_rest_nothing_is_known() -> None:
    assert watched(Swing(0.0), later_s=0.3).mismatch is None
    assert watched(Swing(0.0), turned_rad=math.pi).mismatch is None
