"""A camera that mirrors, as the profile says: it is simulated so, and flown as any other."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from numpy.typing import NDArray

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, mirrored_note, open_camera
from perchctl.flight import lockstep_source
from perchctl.link import MockLink
from perchctl.mission import Phase
from perchctl.profile import CameraConfig, Profile
from perchctl.sim import SimulatedVehicle, draw_scenario
from tests.helpers.flights import SEED, fly_short, short_profile

Pictures = list[NDArray[np.uint8]]
PLAIN = short_profile()
MIRRORED = short_profile({"camera.mirrored": True})
LOOKED_S = 0.3


def polled(source: FrameSource, link: MockLink) -> Pictures:
    frames = []
    while link.now_s < LOOKED_S:
        link.advance_to(link.now_s + 0.02)
        frames.append(source.poll(link.now_s))
    return [frame.image for frame in frames if frame is not None]


def lockstep(by: Profile, camera: Profile) -> Pictures:
    """A flight by one profile of a vehicle whose camera is as another says."""
    vehicle = SimulatedVehicle(
        draw_scenario(camera, SEED), profile_camera(camera.camera), camera.target
    )
    return polled(lockstep_source(vehicle, by), MockLink(vehicle))


def test_each_simulated_camera_mirrors_and_the_flight_sees_it_turned_right() -> None:
    plain = lockstep(PLAIN, PLAIN)
    assert len(plain) > 3
    flipped = [image[:, ::-1] for image in plain]
    assert np.array_equal(lockstep(MIRRORED, MIRRORED), plain)
    assert np.array_equal(lockstep(PLAIN, MIRRORED), flipped), "the camera itself does mirror"
    assert np.array_equal(lockstep(MIRRORED, PLAIN), flipped)


@pytest.mark.parametrize("mirrored", [False, True])
def test_each_source_that_is_opened_by_a_profile_is_turned_right(
    mirrored: bool, tmp_path: Path
) -> None:
    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    cv2.imwrite(f"{tmp_path}/a.png", image)
    config = CameraConfig(mirrored=mirrored)
    frame = open_camera(f"images:{tmp_path}", lambda: 0.0, config).poll(0.0)
    assert frame is not None
    np.testing.assert_array_equal(frame.image, image[:, ::-1] if mirrored else image)
    advice = "take camera.mirrored out" if mirrored else "set camera.mirrored"
    assert advice in mirrored_note(config)


@pytest.mark.long
def test_a_flight_with_a_camera_that_mirrors_perches() -> None:
    flown = fly_short({"camera.mirrored": True})
    assert flown.report.phase is Phase.PERCHED
    assert flown.flight.miss_m < 0.005
