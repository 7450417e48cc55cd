"""A camera that mirrors, as the profile says: it is simulated so, and flown as any other."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from numpy.typing import NDArray

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, mirrored_note, open_camera
from perchctl.faults.catalogue import BY_NAME, draw_case
from perchctl.faults.effects import FOR_EVER, CameraFault
from perchctl.faults.flight import FaultyFlight
from perchctl.flight import lockstep_source
from perchctl.link import MockLink
from perchctl.mission import Phase
from perchctl.profile import CameraConfig, Profile
from perchctl.sim import SimulatedVehicle, draw_hand, draw_scenario, record_hand
from perchctl.sim.hand import pictures
from perchctl.sim.host import VehicleHost
from perchctl.sim.process import HostSetup
from perchctl.vision import Frame
from tests.helpers.flights import SEED, fly_short, short_profile

Picture = NDArray[np.uint8]
PLAIN = short_profile()
MIRRORED = short_profile({"camera.mirrored": True})
LOOKED_S = 0.3


def polled(source: FrameSource, link: MockLink) -> list[Frame]:
    frames = []
    while link.now_s < LOOKED_S:
        link.advance_to(link.now_s + 0.02)
        frames.append(source.poll(link.now_s))
    return [frame for frame in frames if frame is not None]


def same(some: list[Frame], others: list[Frame]) -> bool:
    pairs = zip(some, others, strict=True)
    return all((a.image == b.image).all() and a.t_s == b.t_s for a, b in pairs)


def flipped(frames: list[Frame]) -> list[Frame]:
    return [Frame(f.index, f.t_s, f.image[:, ::-1], f.t_arrival_s) for f in frames]


def vehicle_of(profile: Profile) -> SimulatedVehicle:
    return SimulatedVehicle(
        draw_scenario(profile, SEED), profile_camera(profile.camera), profile.target
    )


def test_the_lockstep_camera_mirrors_and_the_flight_sees_it_turned_right() -> None:
    def seen(by: Profile, camera: Profile) -> list[Frame]:
        vehicle = vehicle_of(camera)
        return polled(lockstep_source(vehicle, by), MockLink(vehicle))

    plain = seen(PLAIN, PLAIN)
    assert len(plain) > 3
    assert same(seen(MIRRORED, MIRRORED), plain)
    assert same(seen(PLAIN, MIRRORED), flipped(plain)), "the camera itself does mirror"
    assert same(seen(MIRRORED, PLAIN), flipped(plain))


def published(profile: Profile) -> list[Picture]:
    """By the simulated vehicle's process, on its way to the stream."""
    setup = HostSetup(
        scenario=draw_scenario(profile, SEED), camera=profile_camera(profile.camera),
        target=profile.target,
    )  # fmt: skip
    out: list[Picture] = []
    with contextlib.closing(VehicleHost(setup)) as host:
        assert host.stream is not None
        host.stream.publish = out.append  # type: ignore[method-assign]
        host.advance(LOOKED_S)
    return out


def test_the_stream_of_the_simulated_vehicle_s_process_is_mirrored() -> None:
    plain, mirrored = published(PLAIN), published(MIRRORED)
    assert len(plain) > 3
    for one, other in zip(plain, mirrored, strict=True):
        np.testing.assert_array_equal(one[:, ::-1], other)


def test_each_source_that_is_opened_by_a_profile_is_turned_right(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    cv2.imwrite(f"{tmp_path}/a.png", image)
    for mirrored in (False, True):
        config = CameraConfig(mirrored=mirrored)
        source = open_camera(f"images:{tmp_path}", lambda: 0.0, config)
        frame = source.poll(0.0)
        assert frame is not None
        np.testing.assert_array_equal(frame.image, image[:, ::-1] if mirrored else image)


@pytest.mark.long
def test_a_flight_with_a_camera_that_mirrors_perches() -> None:
    flown = fly_short({"camera.mirrored": True})
    assert flown.report.phase is Phase.PERCHED
    assert flown.flight.miss_m < 0.005


def test_the_fault_mirrors_against_what_the_profile_says() -> None:
    def seen(profile: Profile, is_faulty: bool) -> list[Frame]:
        scenario = draw_scenario(profile, SEED)
        case = draw_case(SEED, scenario, [BY_NAME["camera-mirrored"]])
        flight = FaultyFlight(profile, case, scenario)
        source = flight._parts.source
        if is_faulty:
            source.begin(CameraFault("mirrored", FOR_EVER), 0.0)  # type: ignore[attr-defined]
        return polled(source, flight._link)

    plain = seen(PLAIN, False)
    assert len(plain) > 3
    assert same(seen(MIRRORED, False), plain)
    for profile in (PLAIN, MIRRORED):
        assert same(seen(profile, True), flipped(plain))


def test_a_camera_in_a_hand_mirrors_too() -> None:
    def shown(mirrored: bool) -> Iterator[Picture]:
        profile = MIRRORED if mirrored else PLAIN
        for frame in pictures(hands[mirrored], profile, profile_camera(profile.camera)):
            yield frame.image

    hands = [draw_hand(p, "carry", SEED, seconds=0.3) for p in (PLAIN, MIRRORED)]
    for one, other in zip(shown(False), shown(True), strict=True):
        np.testing.assert_array_equal(one[:, ::-1], other)
    found = [
        record_hand(hand, profile, profile_camera(profile.camera))
        for hand, profile in zip(hands, (PLAIN, MIRRORED), strict=True)
    ]
    assert found[0].poses
    assert found[1].mirrored_pictures == 0
    for a, b in zip(found[0].poses, found[1].poses, strict=True):
        np.testing.assert_array_equal(a.position_cam_target_m, b.position_cam_target_m)


def test_the_advice_is_the_opposite_of_what_is_set() -> None:
    notes = [mirrored_note(CameraConfig(mirrored=is_set)) for is_set in (False, True)]
    assert ["set camera.mirrored" in note for note in notes] == [True, False]
    assert ["take camera.mirrored out" in note for note in notes] == [False, True]
