"""What a camera in a hand can do, and what no camera can."""

from __future__ import annotations

import math

import numpy as np
import pytest

from perchctl.track import Notes, Tally, Tracked
from perchctl.track.tracker import jumped
from perchctl.vision import MarkerPose

FRAME_S = 1.0 / 30.0


def pose(t_s: float, tvec_m: tuple[float, float, float], yaw_deg: float = 0.0) -> MarkerPose:
    return MarkerPose(
        "large", t_s, np.array([0.0, 0.0, math.radians(yaw_deg)]), np.array(tvec_m),
        np.zeros(3), 0.0, np.full(3, 1e-3), math.radians(0.5), 0.1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        (pose(FRAME_S, (0.05, 0.0, 0.3)), False),  # 1.5 m/s
        (pose(FRAME_S, (0.0, 0.0, 0.42)), False),  # 3.6 m/s: as much as a hand can do
        (pose(FRAME_S, (0.0, 0.0, 0.55)), True),
        (pose(FRAME_S, (0.0, 0.0, 0.3), 12.0), False),
        (pose(FRAME_S, (0.0, 0.0, 0.3), 95.0), True),
        (pose(10 * FRAME_S, (0.0, 0.0, 0.55)), False),  # unseen in between
        (pose(2.0, (0.5, 0.0, 1.5), 170.0), False),
        (None, False),
    ],
)
def test_a_jump_is_faster_than_any_hand(after: MarkerPose | None, expected: bool) -> None:
    before = pose(0.0, (0.0, 0.0, 0.3))
    assert jumped(before, after) is expected
    assert jumped(None, after) is False


def test_the_heading_turns_on_the_circle() -> None:
    assert not jumped(pose(0.0, (0, 0, 0.3), 178.0), pose(FRAME_S, (0, 0, 0.3), -178.0))


def test_far_away_a_turn_of_the_camera_moves_the_target_far() -> None:
    sideways = 0.15  # 2.25 rad/s of a camera 2 m below
    assert not jumped(pose(0.0, (0.0, 0.0, 2.0)), pose(FRAME_S, (sideways, 0.0, 2.0)))
    assert jumped(pose(0.0, (0.0, 0.0, 0.2)), pose(FRAME_S, (sideways, 0.0, 0.2)))


def test_a_note_is_counted_and_said_by_its_kind() -> None:
    """Each frame may say another distance."""
    said: list[str] = []
    tally, notes = Tally(), Notes(said.append)
    for k in range(5):
        note = f"not the tracked target: 0.{k}4 m away from it"
        tally.add(Tracked(k, k * FRAME_S), (note,))
        notes.changes(k, (note,))
    assert said == ["frame 0: not the tracked target: 0.04 m away from it"]
    assert tally.text(1.0).endswith("; not the tracked target in 5")
