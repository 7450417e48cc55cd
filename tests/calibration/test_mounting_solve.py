"""The mounting's solvers on true poses with known errors: exact without them, honest with them,
and a sentence where a recording will not do; and one vehicle through renderer and pipeline."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perchctl.calibration import MountingRecording, PoseReader, profile_camera
from perchctl.calibration.mounting.carry import RotationSolution, solve_rotation
from perchctl.calibration.mounting.pivot import solve_pivot
from perchctl.calibration.mounting.recording import MountingPart, missing_motion
from perchctl.errors import InvalidValue
from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.vision import Frame
from tests.helpers.hand import Hand, T_target_cam_at, draw_hand, pictures, record_hand
from tests.helpers.mounting import hand, profile, seen

ANGLE = st.floats(-np.pi, np.pi)


def turn_error_deg(found: RotationSolution, held: Hand) -> float:
    off = Rotation.from_matrix(found.R_body_cam @ held.T_body_cam[:3, :3].T)
    return float(np.degrees(off.magnitude()))


def mounted(held: Hand, R_body_cam: Array) -> Hand:
    T = make_T(R_body_cam, held.T_body_cam[:3, 3])
    scenario = replace(held.scenario, T_body_cam_true=tuple(map(tuple, T.tolist())))
    return replace(held, scenario=scenario)


# --- the carry ---------------------------------------------------------------------------


@settings(max_examples=2, deadline=None)
@given(ANGLE, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.0, 0.3))
def test_any_mounting_and_latency_is_found_from_nothing(
    yaw: float, roll: float, pitch: float, latency_s: float
) -> None:
    held = mounted(hand("carry", 3, latency_s=latency_s), rotation_from_rpy(roll, pitch, yaw))
    found = solve_rotation(seen(held, errors=False))
    assert turn_error_deg(found, held) < 0.005
    assert found.latency_s == pytest.approx(latency_s, abs=2e-5)


def test_intervals_hold_the_truth_and_errors_are_small() -> None:
    off, turns_deg, latencies_s = [], [], []
    for seed in range(20, 25):
        held = hand("carry", seed)
        found = solve_rotation(seen(held))
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


@pytest.mark.parametrize(
    "spoilt", [{"wrong": 0.15}, pytest.param({"claimed": 20.0}, marks=pytest.mark.long)]
)
def test_wrong_poses_and_wrong_claims_do_not_hurt(spoilt: dict[str, float]) -> None:
    held = hand("carry", 6)
    found = solve_rotation(seen(held, **spoilt))  # type: ignore[arg-type]
    assert turn_error_deg(found, held) < 0.15
    assert abs(found.latency_s - held.latency_s) < 3e-3


# --- the pivot ---------------------------------------------------------------------------


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000))
def test_the_tip_is_found(seed: int) -> None:
    held = replace(hand("pivot", seed, 14.0))
    still = replace(held, sway=replace(held.sway, amplitude=0.0 * held.sway.amplitude))
    found = solve_pivot(seen(still, errors=False))
    np.testing.assert_allclose(found.gear_cam_m, held.gear_cam_m, atol=1e-6)
    np.testing.assert_allclose(found.pivot_point_target_m, held.point_target_m, atol=1e-6)


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


# --- what will not do --------------------------------------------------------------------


def turned_about(part: str, tilts: tuple[float, float], heading: float) -> MountingRecording:
    """A recording whose hand tilted and turned by these shares of what it should."""
    held = hand("carry" if part == "carry" else "pivot", 3, 21.0)
    amplitude = held.turns.amplitude * np.array([*tilts, heading])[:, None]
    return seen(replace(held, turns=replace(held.turns, amplitude=amplitude)), errors=False)


def slower(recording: MountingRecording, factor: float) -> MountingRecording:
    attitudes = [
        replace(a, t_s=factor * a.t_s, gyro_radps=a.gyro_radps / factor)
        for a in recording.attitudes
    ]
    poses = [replace(p, t_s=factor * p.t_s) for p in recording.poses]
    return replace(recording, attitudes=attitudes, poses=poses)


CARRY, PIVOT = seen(hand("carry", 3, latency_s=0.02), errors=False), seen(hand("pivot", 2, 14.0))
LACKING = {
    "tilt the vehicle": turned_about("carry", (1.0, 0.0), 0.0),
    "turn the vehicle about": turned_about("carry", (1.0, 1.0), 0.1),
    "faster": slower(CARRY, 8.0),
    "continue": replace(CARRY, poses=CARRY.poses[:150]),
    "bring the target": replace(CARRY, poses=[]),
    "wait for the vehicle": MountingRecording("carry"),
    "tilt the vehicle in every direction": turned_about("pivot", (1.0, 0.0), 0.0),
}


@pytest.mark.parametrize("named", LACKING)
def test_the_missing_motion_is_named(named: str) -> None:
    recording = LACKING[named]
    assert not missing_motion(CARRY)
    with pytest.raises(
        InvalidValue, match=f"the {recording.part} recording lacks motion:.*{named}"
    ):
        solve_rotation(recording) if recording.part == "carry" else solve_pivot(recording)


def carried_about(recording: MountingRecording) -> MountingRecording:
    """As if the target had been turned in the room at random."""
    steps = 0.1 * np.random.default_rng(4).normal(size=(len(recording.poses), 3))
    way = Rotation.from_rotvec(steps.cumsum(axis=0)).as_matrix()
    poses = [
        replace(p, rotation_cam_target=p.rotation_cam_target @ R)
        for p, R in zip(recording.poses, way, strict=True)
    ]
    return replace(recording, poses=poses)


def later(recording: MountingRecording, seconds: float) -> MountingRecording:
    return replace(recording, poses=[replace(p, t_s=p.t_s + seconds) for p in recording.poses])


@pytest.mark.parametrize(
    ("recording", "said"),
    [
        (replace(CARRY, poses=[], mirrored_pictures=200), "the picture is mirrored"),
        (carried_about(CARRY), "fix the target"),
        (later(CARRY, -0.1), "time stamps are 80 ms too early"),
        (later(CARRY, 1000.0), "clock"),
        (PIVOT, "a recording of the pivot, not of the carry"),
    ],
)
def test_a_carry_that_contradicts_itself_is_refused(
    recording: MountingRecording, said: str
) -> None:
    with pytest.raises(InvalidValue, match=said):
        solve_rotation(recording)


# --- through renderer, camera and pipeline -------------------------------------------------


def _few_pictures(part: MountingPart, seconds: float) -> Hand:
    drawn = draw_hand(profile(), part, 4, seconds)
    few = {"camera_rate_hz": 8.2, "camera_drop_rate": 0.0, "camera_burst": None}
    return replace(drawn, scenario=replace(drawn.scenario, **few))  # type: ignore[arg-type]


@pytest.mark.long
def test_a_mounting_is_measured_from_pictures() -> None:
    camera = profile_camera(profile().camera)
    carry, pivot = _few_pictures("carry", 21.5), _few_pictures("pivot", 13.0)
    carried = solve_rotation(record_hand(carry, profile(), camera))
    assert turn_error_deg(carried, carry) < 0.15
    assert abs(carried.latency_s - carry.latency_s) < 3e-3
    pivoted = solve_pivot(record_hand(pivot, profile(), camera))
    off = np.array(pivoted.gear_cam_m) - pivot.gear_cam_m
    assert (np.abs(off) < 3.0 * np.array(pivoted.gear_cam_sigma_m)).all()
    # What the print's size does apart, it is known to hundredths of a millimetre.
    assert np.linalg.norm(off + pivot.size_error * pivot.gear_cam_m) < 1.5e-4


@pytest.mark.parametrize("flipped", [False, True])
def test_a_picture_is_seen_as_it_is_and_mirrored_as_such(flipped: bool) -> None:
    held, camera = _few_pictures("carry", 3.0), profile_camera(profile().camera)
    reader, poses = PoseReader(profile(), camera, live=False), []
    for frame in islice(pictures(held, profile(), camera), 4):
        image = np.ascontiguousarray(frame.image[:, ::-1]) if flipped else frame.image
        found = reader.read_poses(Frame(frame.index, frame.t_arrival_s, image, frame.t_arrival_s))
        poses += found
        for pose in found:
            T_target_cam = T_target_cam_at(held, frame.t_exposure_s)
            R_off = pose.rotation_cam_target @ T_target_cam[:3, :3]
            assert Rotation.from_matrix(R_off).magnitude() < 0.02
            place_m = -T_target_cam[:3, :3].T @ T_target_cam[:3, 3]
            np.testing.assert_allclose(pose.position_cam_target_m, place_m, atol=4e-3)
    assert (reader.mirrored, len(poses)) == ((4, 0) if flipped else (0, 4))
    assert bool(reader.outlines) is not flipped
    again = Frame(frame.index + 1, frame.t_arrival_s + 0.03, image, frame.t_arrival_s + 0.03)
    live = PoseReader(profile(), camera, live=True)
    assert len(live.read_poses(again)) == len(found)
    assert live.read_poses(replace(again, index=99)) == [], "a receiver's repetition is no picture"
