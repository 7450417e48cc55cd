"""The simulated motion capture: what its cameras see, when it arrives, and what can go wrong."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from perchctl.errors import InvalidValue
from perchctl.geometry import quaternion_from_rotation, rotation_from_rpy
from perchctl.positioning import CaptureFrame, Placed
from perchctl.profile import PositioningConfig
from perchctl.sim import MILLIMETRES_PER_M, CaptureFault, CaptureSettings
from perchctl.sim.capture import SWAPPED_XY, TRUE_AXES, Y_UP, SimCapture

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
    capture: SimCapture, seconds: float, room: Room, act: Callable[[], None] = lambda: None
) -> list[CaptureFrame]:
    frames = []
    for _ in range(round(seconds / STEP_S)):
        room.t_s += STEP_S
        act()
        capture.advance(room)
        frames += capture.take()
    return frames


def last(
    settings: CaptureSettings, *faults: CaptureFault, room: Room | None = None
) -> CaptureFrame:
    settings = replace(settings, faults=tuple((0.0, 9.0, fault) for fault in faults))
    return watched(SimCapture(settings), 0.5, room or Room())[-1]


def test_frames_come_at_the_cameras_rate_and_late() -> None:
    room, at = Room(), []
    frames = watched(SimCapture(EXACT), 2.0, room, lambda: at.append(room.t_s))
    assert len(frames) == pytest.approx(240, abs=3)
    gaps = [b.t_s - a.t_s for a, b in itertools.pairwise(frames)]
    assert statistics.fmean(gaps) == pytest.approx(1 / 120, rel=1e-3)
    moving = Room()
    capture = SimCapture(EXACT)

    def climb() -> None:
        moving.z_m = moving.t_s  # so that a frame says when it was exposed

    for frame in watched(capture, 1.0, moving, climb):
        assert frame.t_s - frame.bodies["crazyflie"].position_m[2] == pytest.approx(0.01, abs=1e-9)


def test_noise_is_what_the_settings_say_and_the_seed_s() -> None:
    settings = CaptureSettings(seed=4)
    frames = watched(SimCapture(settings), 5.0, Room())
    x = [frame.bodies["crazyflie"].position_m[0] for frame in frames]
    assert statistics.fmean(x) == pytest.approx(AT[0], abs=2e-4)
    assert statistics.stdev(x) == pytest.approx(0.001, rel=0.15)
    assert watched(SimCapture(settings), 1.0, Room()) == [
        frame for frame in frames if frame.t_s <= 1.0
    ]
    other = watched(SimCapture(replace(settings, seed=5)), 1.0, Room())
    assert other[0].bodies != frames[0].bodies


def test_a_body_s_own_axes_are_undone_by_the_profile_s() -> None:
    """The same turn and offset in capture and profile: the vehicle's place comes out."""
    rpy_deg, offset_m = (10.0, -20.0, 75.0), (0.01, -0.02, 0.03)
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    settings = replace(EXACT, body_rpy_rad=(roll, pitch, yaw), body_position_m=offset_m)
    R = rotation_from_rpy(0.1, -0.2, 1.3)
    seen = last(settings, room=Room(quaternion=quaternion_from_rotation(R)))
    config = PositioningConfig(by="mocap", body_rpy_deg=rpy_deg, body_position_m=offset_m)
    placed = Placed.of(seen.bodies["crazyflie"], config)
    assert placed.position_m == pytest.approx(AT)
    assert np.allclose(placed.R, R, atol=1e-6)


def test_axes_scale_and_world() -> None:
    def seen(*faults: CaptureFault, settings: CaptureSettings = EXACT) -> tuple[float, ...]:
        return last(settings, *faults).bodies["crazyflie"].position_m

    x, y, z = AT
    assert seen() == pytest.approx(AT)
    assert seen(CaptureFault(axes=Y_UP)) == pytest.approx((x, z, -y))
    assert seen(settings=replace(EXACT, axes=SWAPPED_XY)) == pytest.approx((y, -x, z))
    assert seen(CaptureFault(scale=MILLIMETRES_PER_M)) == pytest.approx((300.0, -200.0, 500.0))
    turned = replace(EXACT, heading_rad=math.pi / 2, origin_m=(1.0, 0.0, 0.0))
    assert seen(settings=turned) == pytest.approx((1.0 - y, x, z))
    level = last(EXACT, CaptureFault(axes=Y_UP)).bodies["crazyflie"]
    assert level.quaternion == pytest.approx((1.0, 0.0, 0.0, 0.0))


def test_an_occluded_body_is_missing_for_its_time_only() -> None:
    capture = SimCapture(CaptureSettings())
    free = SimCapture(CaptureSettings())
    room, other_room = Room(), Room()
    before = watched(capture, 0.5, room)
    capture.lay(CaptureFault(occluded=True), 0.3)
    during = watched(capture, 0.5, room)
    hidden = [frame for frame in during if "crazyflie" not in frame.bodies]
    assert len(hidden) == pytest.approx(36, abs=1)
    assert all("wand" in frame.bodies for frame in hidden)
    undisturbed = watched(free, 1.0, other_room)
    assert (before + during)[-10:] == undisturbed[-10:]  # the others are as they were


def test_frozen_to_the_last_digit_swapped_gone_late_and_slow() -> None:
    room = Room()
    capture = SimCapture(replace(EXACT, position_noise_m=0.001))
    watched(capture, 0.3, room)
    capture.lay(CaptureFault(frozen=True))
    room.x_m = 1.0
    frozen = watched(capture, 0.3, room)[5:]
    assert len({frame.bodies["crazyflie"].position_m for frame in frozen}) == 1
    capture.heal()
    assert watched(capture, 0.3, room)[-1].bodies["crazyflie"].position_m[0] > 0.9

    swapped = last(EXACT, CaptureFault(swapped=True)).bodies
    assert swapped["wand"].position_m == pytest.approx(AT)
    assert swapped["crazyflie"].position_m == pytest.approx((1.2, -0.9, 0.05))

    capture = SimCapture(replace(EXACT, faults=((0.5, 1.0, CaptureFault(gone=True)),)))
    arrivals = [frame.t_s for frame in watched(capture, 1.5, Room())]
    assert not [t_s for t_s in arrivals if 0.515 < t_s < 1.0]
    capture = SimCapture(replace(EXACT, faults=((0.5, 1.0, CaptureFault(late_s=0.1)),)))
    arrivals = [frame.t_s for frame in watched(capture, 1.5, Room())]
    assert arrivals == sorted(arrivals)
    assert not [t_s for t_s in arrivals if 0.52 < t_s < 0.6]
    slow = watched(
        SimCapture(replace(EXACT, faults=((0.0, 9.0, CaptureFault(rate_hz=10)),))), 2.0, Room()
    )
    assert len(slow) == pytest.approx(20, abs=2)


def test_lockstep_hands_on_the_newest_once() -> None:
    capture, room = SimCapture(EXACT), Room()
    for _ in range(100):
        room.t_s += STEP_S
        capture.advance(room)
    frame = capture.poll(room.t_s)
    assert frame is not None
    assert room.t_s - frame.t_s < 1 / 120
    assert capture.poll(room.t_s) is None
    assert capture.problem(room.t_s) is None
    capture.close()


@pytest.mark.parametrize("axes", ["xyz", "+x+y-z", "+x+x+y", "+x+y", ""])
def test_axes_that_are_none_are_refused(axes: str) -> None:
    with pytest.raises(InvalidValue, match="axes"):
        CaptureSettings(axes=axes)
    with pytest.raises(InvalidValue, match="axes"):
        CaptureFault(axes=axes)


def test_settings_that_cannot_be_are_refused() -> None:
    assert CaptureSettings().axes == TRUE_AXES
    with pytest.raises(InvalidValue, match="Hz"):
        CaptureSettings(rate_hz=0.0)
    with pytest.raises(InvalidValue, match="one name"):
        CaptureSettings(body="wand")
