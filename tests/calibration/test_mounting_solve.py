"""The mounting's solvers on true poses with known errors: exact without them, honest with them,
and a sentence where a recording will not do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perchctl.calibration import (
    AttitudeSample,
    MountingRecording,
    solve_carry,
    solve_pivot,
)
from perchctl.calibration.mounting.carry import CarrySolution
from perchctl.calibration.mounting.recording import SeenPose, missing_motion
from perchctl.errors import InvalidValue
from perchctl.geometry import Array, make_T, rotation_from_rpy
from tests.helpers.hand import Hand
from tests.helpers.mounting import hand, seen

ANGLE = st.floats(-np.pi, np.pi)


def turn_error_deg(found: CarrySolution, held: Hand) -> float:
    off = Rotation.from_matrix(found.R_body_cam @ held.T_body_cam[:3, :3].T)
    return float(np.degrees(off.magnitude()))


def mounted(held: Hand, R_body_cam: Array) -> Hand:
    T = make_T(R_body_cam, held.T_body_cam[:3, 3])
    scenario = replace(held.scenario, T_body_cam_true=tuple(map(tuple, T.tolist())))
    return replace(held, scenario=scenario)


# --- the carry ---------------------------------------------------------------------------


@settings(max_examples=4, deadline=None)
@given(ANGLE, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.0, 0.3))
def test_any_mounting_and_latency_is_found_from_nothing(
    yaw: float, roll: float, pitch: float, latency_s: float
) -> None:
    held = mounted(hand("carry", 3, latency_s=latency_s), rotation_from_rpy(roll, pitch, yaw))
    found = solve_carry(seen(held, errors=False))
    assert turn_error_deg(found, held) < 0.005
    assert found.latency_s == pytest.approx(latency_s, abs=2e-5)


def test_a_positive_latency_is_a_late_picture() -> None:
    held = hand("carry", 3, latency_s=0.0)
    recording = seen(held, errors=False)
    late = tuple(replace(pose, t_s=pose.t_s + 0.08) for pose in recording.poses)
    found = solve_carry(replace(recording, poses=late))
    assert found.latency_s == pytest.approx(0.08, abs=2e-5)


def test_intervals_hold_the_truth_and_errors_are_small() -> None:
    off, turns_deg, latencies_s = [], [], []
    for seed in range(20, 25):
        held = hand("carry", seed)
        found = solve_carry(seen(held))
        turned = (np.array(found.rpy_deg) - held.rpy_deg + 180.0) % 360.0 - 180.0
        off += (turned / found.rpy_sigma_deg).tolist()
        off.append((found.latency_s - held.latency_s) / found.latency_sigma_s)
        turns_deg.append(turn_error_deg(found, held))
        latencies_s.append(abs(found.latency_s - held.latency_s))
    assert 0.85 <= np.mean(np.abs(off) < 1.96) <= 1.0
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.median(turns_deg) < 0.1
    assert max(turns_deg) < 0.25
    assert max(latencies_s) < 3e-3


def test_an_attitude_that_is_off_does_not_move_the_camera() -> None:
    """Half a degree in the body's axes looks like a camera that is tilted by as much."""
    held = hand("carry", 5)
    recording = seen(held)
    tilted = tuple(
        replace(a, roll_rad=a.roll_rad + 0.02, pitch_rad=a.pitch_rad - 0.02)
        for a in recording.attitudes
    )
    found = solve_carry(replace(recording, attitudes=tilted))
    assert turn_error_deg(found, held) < 0.1
    added = found.attitude_bias_rad - held.attitude_bias_rad
    np.testing.assert_allclose(added[:2], (0.02, -0.02), atol=0.008)


def test_wrong_poses_and_wrong_claims_do_not_hurt() -> None:
    held = hand("carry", 6)
    for recording in (seen(held, wrong=0.15), seen(held, claimed=20.0)):
        found = solve_carry(recording)
        assert turn_error_deg(found, held) < 0.15
        assert abs(found.latency_s - held.latency_s) < 3e-3
    bare = tuple(replace(p, covariance=None) for p in seen(held).poses)
    assert turn_error_deg(solve_carry(replace(seen(held), poses=bare)), held) < 0.15


# --- the pivot ---------------------------------------------------------------------------


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000))
def test_the_tip_is_found(seed: int) -> None:
    held = replace(hand("pivot", seed, 14.0))
    still = replace(held, sway=replace(held.sway, amplitude=0.0 * held.sway.amplitude))
    found = solve_pivot(seen(still, errors=False))
    np.testing.assert_allclose(found.gear_cam_m, held.gear_cam_m, atol=1e-6)
    np.testing.assert_allclose(found.point_target_m, held.point_target_m, atol=1e-6)


def test_the_tips_interval_holds_the_truth() -> None:
    off, size_mm = [], []
    rng = np.random.default_rng(8)
    for seed in range(20, 34):
        held = replace(hand("pivot", seed, 14.0), size_error=0.005 * rng.normal())
        found = solve_pivot(seen(held, wrong=0.03), size_sigma=0.005)
        error_m = np.array(found.gear_cam_m) - held.gear_cam_m
        off += (error_m / found.gear_cam_sigma_m).tolist()
        size_mm.append(1e3 * np.linalg.norm(error_m))
    assert 0.85 <= np.mean(np.abs(off) < 1.96) <= 1.0
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
    assert np.median(size_mm) < 0.4


@pytest.mark.parametrize("at_s", [4.0, 9.0, 12.0])
def test_a_tip_that_slipped_is_named(at_s: float) -> None:
    held = replace(hand("pivot", 2, 14.0), slips_m=(0.0012, -0.0016, 0.0), slips_at_s=at_s)
    with pytest.raises(InvalidValue, match=r"the tip slipped by (1\.[89]|2\.[012]) mm"):
        solve_pivot(seen(held, wrong=0.03))


def test_a_print_that_may_be_of_another_size_widens_the_interval() -> None:
    recording = seen(hand("pivot", 2, 14.0))
    sure, unsure = solve_pivot(recording, 0.0), solve_pivot(recording, 0.02)
    grown = np.square(unsure.gear_cam_sigma_m) - np.square(sure.gear_cam_sigma_m)
    np.testing.assert_allclose(grown, np.square(0.02 * np.array(sure.gear_cam_m)), rtol=1e-6)


# --- what will not do --------------------------------------------------------------------


def without(recording: MountingRecording, *axes: int) -> MountingRecording:
    """As if the vehicle had not been turned about these axes of its own."""
    kept = [a for a in range(3) if a not in axes]
    samples = []
    for a in recording.attitudes:
        rpy = np.array([a.roll_rad, a.pitch_rad, a.yaw_rad])
        gyro = a.gyro_radps.copy()
        rpy[list(axes)] = gyro[list(axes)] = 0.0
        samples.append(AttitudeSample(a.t_s, *rpy.tolist(), gyro))
    assert kept
    return replace(recording, attitudes=tuple(samples))


@pytest.mark.parametrize(("axis", "name"), [(0, "roll"), (1, "pitch"), (2, "yaw")])
def test_the_missing_turn_is_named(axis: int, name: str) -> None:
    recording = seen(hand("carry", 3), errors=False)
    assert missing_motion(recording) == ()
    lacking = missing_motion(without(recording, axis))
    assert [words.split(":")[0] for words in lacking] == [name]
    with pytest.raises(InvalidValue, match=f"the carry lacks motion: {name}"):
        solve_carry(without(recording, axis))


def slower(recording: MountingRecording, factor: float) -> MountingRecording:
    return replace(
        recording,
        attitudes=tuple(
            replace(a, t_s=factor * a.t_s, gyro_radps=a.gyro_radps / factor)
            for a in recording.attitudes
        ),
        poses=tuple(replace(p, t_s=factor * p.t_s) for p in recording.poses),
    )


def test_too_short_too_slow_too_few() -> None:
    recording = seen(hand("carry", 3), errors=False)
    assert any("faster" in w for w in missing_motion(slower(recording, 6.0)))
    short = replace(recording, poses=tuple(p for p in recording.poses if p.t_s < 16.0))
    assert [w.split(":")[0] for w in missing_motion(short)] == ["longer"]
    few = replace(recording, poses=recording.poses[::3])
    assert [w.split(":")[0] for w in missing_motion(few)] == ["more pictures"]
    assert missing_motion(replace(recording, poses=())) == ("bring the target into view",)
    assert missing_motion(MountingRecording("carry", (), ())) == ("wait for the vehicle",)


def test_a_pivot_that_is_not_tilted_enough() -> None:
    held = hand("pivot", 2, 14.0)
    for still, words in (((0, 1), "tilt: around"), ((1,), "tilt: also at right angles")):
        amplitude = held.turns.amplitude.copy()
        amplitude[list(still)] = 0.0
        straight = replace(held, turns=replace(held.turns, amplitude=amplitude))
        if still == (1,):  # heading turns would tilt it the other way, too
            amplitude[2] = 0.0
        assert any(w.startswith(words) for w in missing_motion(seen(straight)))
        with pytest.raises(InvalidValue, match=words):
            solve_pivot(seen(straight))


def test_a_mirrored_picture_is_recognised() -> None:
    recording = replace(seen(hand("carry", 3)), poses=(), mirrored_pictures=200)
    with pytest.raises(InvalidValue, match="the picture is mirrored"):
        solve_carry(recording)


def test_a_target_that_was_carried_about_is_refused() -> None:
    recording = seen(hand("carry", 3), errors=False)
    rng = np.random.default_rng(4)
    steps = 0.1 * rng.normal(size=(len(recording.poses), 3))
    way = Rotation.from_rotvec(steps.cumsum(axis=0)).as_matrix()
    moved = tuple(
        SeenPose(p.t_s, p.rotation_cam_target @ R, p.position_cam_target_m)
        for p, R in zip(recording.poses, way, strict=True)
    )
    with pytest.raises(InvalidValue, match="must not move"):
        solve_carry(replace(recording, poses=moved))


def test_clocks_that_do_not_agree_are_refused() -> None:
    recording = seen(hand("carry", 3, latency_s=0.02), errors=False)
    early = tuple(replace(p, t_s=p.t_s - 0.1) for p in recording.poses)
    with pytest.raises(InvalidValue, match="stamped 80 ms before"):
        solve_carry(replace(recording, poses=early))
    other_day = tuple(replace(p, t_s=p.t_s + 1000.0) for p in recording.poses)
    with pytest.raises(InvalidValue, match="clock"):
        solve_carry(replace(recording, poses=other_day))


def test_the_wrong_part_is_refused() -> None:
    with pytest.raises(InvalidValue, match="a recording of the pivot, not of the carry"):
        solve_carry(seen(hand("pivot", 2, 14.0)))
