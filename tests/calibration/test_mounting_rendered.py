"""One vehicle in a hand, through renderer, camera and pipeline, and what a mirrored picture is."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perchctl.calibration import (
    MountingPart,
    PoseReader,
    profile_camera,
    solve_carry,
    solve_pivot,
)
from perchctl.vision import Frame
from tests.helpers.hand import Hand, T_target_cam_at, draw_hand, pictures, record_hand
from tests.helpers.mounting import profile

SEED = 4
RATE_HZ: dict[MountingPart, float] = {"carry": 7.3, "pivot": 8.2}


def _few_pictures(part: MountingPart, seconds: float) -> Hand:
    drawn = draw_hand(profile(), part, SEED, seconds)
    scenario = replace(
        drawn.scenario, camera_rate_hz=RATE_HZ[part], camera_drop_rate=0.0, camera_burst=None
    )
    return replace(drawn, scenario=scenario)


@pytest.mark.long
def test_a_mounting_is_measured_from_pictures() -> None:
    camera = profile_camera(profile().camera)
    carry, pivot = _few_pictures("carry", 21.5), _few_pictures("pivot", 13.0)
    np.testing.assert_array_equal(carry.T_body_cam, pivot.T_body_cam)
    carried = solve_carry(record_hand(carry, profile(), camera))
    turned = Rotation.from_matrix(carried.R_body_cam @ carry.T_body_cam[:3, :3].T)
    assert np.degrees(turned.magnitude()) < 0.15
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
        found = reader.look(Frame(frame.index, frame.t_arrival_s, image, frame.t_arrival_s))
        poses += found
        for pose in found:
            T_target_cam = T_target_cam_at(held, frame.t_exposure_s)
            R_off = pose.rotation_cam_target @ T_target_cam[:3, :3]
            assert Rotation.from_matrix(R_off).magnitude() < 0.02
            place_m = -T_target_cam[:3, :3].T @ T_target_cam[:3, 3]
            np.testing.assert_allclose(pose.position_cam_target_m, place_m, atol=4e-3)
            assert pose.covariance is not None
    assert (reader.mirrored, len(poses)) == ((4, 0) if flipped else (0, 4))
    assert bool(reader.outlines) is not flipped
    again = Frame(frame.index + 1, frame.t_arrival_s + 0.03, image, frame.t_arrival_s + 0.03)
    live = PoseReader(profile(), camera, live=True)
    assert len(live.look(again)) == len(found)
    assert live.look(replace(again, index=99)) == [], "a receiver's repetition is no picture"
