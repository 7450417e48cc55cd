"""The simulated motion capture: what its cameras see, when it arrives, and what can go wrong.
tests/flight/test_positions.py reads its server with the library that reads a lab's."""

from __future__ import annotations

import itertools
import math
import statistics
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import quaternion_from_rotation, rotation_from_rpy
from perchctl.positioning import CaptureFrame, VehiclePose
from perchctl.profile import PositioningConfig
from perchctl.sim import CaptureFault, CaptureSettings
from perchctl.sim.capture import SimCapture

STEP_S = 0.002
EXACT = CaptureSettings(position_noise_m=0.0, attitude_noise_rad=0.0, jitter_s=0.0)
AT = (0.3, -0.2, 0.5)


@dataclass
class Room:
    """A vehicle that is wherever a test puts it."""

    t_s: float = 0.0
    x_m: float = AT[0]
    y_m: float = AT[1]
    z_m: float = AT[2]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


def watched(
    capture: SimCapture, seconds: float, room: Room, climb_mps: float = 0.0
) -> list[CaptureFrame]:
    frames = []
    for _ in range(round(seconds / STEP_S)):
        room.t_s += STEP_S
        room.z_m += climb_mps * STEP_S
        capture.advance(room)
        frames += capture.take()
    return frames


def test_frames_come_at_the_cameras_rate_and_late() -> None:
    frames = watched(SimCapture(EXACT), 2.0, Room(z_m=0.0), climb_mps=1.0)  # tells when
    assert len(frames) == pytest.approx(240, abs=3)
    gaps = [b.t_s - a.t_s for a, b in itertools.pairwise(frames)]
    assert statistics.fmean(gaps) == pytest.approx(1 / 120, rel=1e-3)
    for frame in frames:
        assert frame.t_s - frame.bodies["crazyflie"].position_m[2] == pytest.approx(0.01, abs=1e-9)


def test_noise_is_what_the_settings_say_and_the_seed_s() -> None:
    settings = CaptureSettings(seed=4)
    frames = watched(SimCapture(settings), 5.0, Room())
    x = [frame.bodies["crazyflie"].position_m[0] for frame in frames]
    assert statistics.fmean(x) == pytest.approx(AT[0], abs=2e-4)
    assert statistics.stdev(x) == pytest.approx(0.001, rel=0.15)
    again = watched(SimCapture(settings), 1.0, Room())
    assert again == [frame for frame in frames if frame.t_s <= 1.0]
    other = watched(SimCapture(replace(settings, seed=5)), 1.0, Room())
    assert other[0].bodies != frames[0].bodies


def test_a_body_s_own_axes_are_undone_by_the_profile_s() -> None:
    """The same turn and offset in capture and profile: the vehicle's place comes out."""
    rpy_deg, offset_m = (10.0, -20.0, 75.0), (0.01, -0.02, 0.03)
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    settings = replace(EXACT, body_rpy_rad=(roll, pitch, yaw), body_position_m=offset_m)
    R = rotation_from_rpy(0.1, -0.2, 1.3)
    seen = watched(SimCapture(settings), 0.5, Room(quaternion=quaternion_from_rotation(R)))[-1]
    config = PositioningConfig(by="mocap", body_rpy_deg=rpy_deg, body_position_m=offset_m)
    placed = VehiclePose.of(seen.bodies["crazyflie"], config)
    assert placed.position_m == pytest.approx(AT)
    assert np.allclose(placed.R, R, atol=1e-6)


@pytest.mark.parametrize(
    ("fault", "at_m"), [({}, (1.2, 0.3, 0.5)), ({"mirrored": True}, (1.2, -0.3, 0.5))]
)
def test_a_body_is_where_the_capture_s_world_and_the_fault_put_it(
    fault: dict[str, Any], at_m: tuple[float, ...]
) -> None:
    faults = ((0.0, math.inf, CaptureFault(**fault)),)
    wrong = replace(EXACT, heading_rad=math.pi / 2, origin_m=(1.0, 0.0, 0.0), faults=faults)
    frames = watched(SimCapture(wrong), 0.5, Room())
    assert frames[-1].bodies["crazyflie"].position_m == pytest.approx(at_m)


def test_an_occluded_body_is_missing_for_its_time_only() -> None:
    """All other frames are as without the fault."""
    fault = (0.5, 0.8, CaptureFault(occluded=True))
    noisy = replace(EXACT, position_noise_m=0.001, faults=(fault,))
    frames, free = (
        watched(SimCapture(each), 1.0, Room()) for each in (noisy, replace(noisy, faults=()))
    )
    hidden = [frame for frame in frames if "crazyflie" not in frame.bodies]
    assert len(hidden) == pytest.approx(36, abs=1)
    assert all("wand" in frame.bodies for frame in hidden)
    assert frames[-10:] == free[-10:]


def test_frozen_bodies_stay_to_the_last_digit_until_they_are_healed() -> None:
    room, capture = Room(), SimCapture(replace(EXACT, position_noise_m=0.001))
    watched(capture, 0.3, room)
    capture.begin_fault(CaptureFault(frozen=True))
    room.x_m = 1.0
    frozen = watched(capture, 0.3, room)[5:]
    assert len({frame.bodies["crazyflie"].position_m for frame in frozen}) == 1
    capture.end_faults()
    assert watched(capture, 0.3, room)[-1].bodies["crazyflie"].position_m[0] > 0.9
