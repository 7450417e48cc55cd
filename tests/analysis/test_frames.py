"""Which frames were lost, by a flight's log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.analysis.sight import frames_of
from perchctl.record import FlightLog

PERIOD_S = 1.0 / 30.0


def flight(exposed_s: list[float], **changes: dict[int, Any]) -> FlightLog:
    """A log with a tick a frame, each of which shows the target; `changes` by tick."""
    records = [
        {
            "t_s": t_s + 0.05, "frame_t_s": t_s, "phase": "ASCEND", "measured": True, "jx_m": 0.1,
            **{key: by_tick[k] for key, by_tick in changes.items() if k in by_tick},
        }
        for k, t_s in enumerate(exposed_s)
    ]  # fmt: skip
    return FlightLog(Path("f.jsonl"), {}, records, [], None, True)


def regular(count: int) -> list[float]:
    return [7.0 + k * PERIOD_S for k in range(count)]


def test_a_gap_is_where_no_frame_came() -> None:
    times = regular(30)
    frames = frames_of(flight(times[:10] + times[16:]))
    (gap_s,) = frames.gaps_s
    assert gap_s == pytest.approx([9 * PERIOD_S - 0.05, 16 * PERIOD_S - 0.05])
    irregular = [t + (0.0, 0.012, -0.008)[k % 3] for k, t in enumerate(times)]
    assert frames_of(flight(irregular)).gaps_s.size == 0


def test_a_camera_that_does_not_come_back_is_a_gap_to_the_end() -> None:
    times = regular(60)
    frames = frames_of(flight(times, frame_t_s=dict.fromkeys(range(40, 60))))
    (gap_s,) = frames.gaps_s
    assert gap_s == pytest.approx([39 * PERIOD_S - 0.05, 59 * PERIOD_S - 0.05])


def test_frames_without_the_target_are_told_apart() -> None:
    log = flight(regular(10), jx_m={3: None, 4: None}, measured={4: False, 7: False})
    frames = frames_of(log)
    assert frames.unseen_s == pytest.approx(np.array([3, 4, 7]) * PERIOD_S - 0.05)
    assert len(frames.seen_s) == 7
    assert (frames.rate_hz, frames.age_s) == pytest.approx((30.0, 0.05))


def test_only_both_markers_together_tell_the_misfit() -> None:
    """Four corners alone fit nearly any pose."""
    alone = {"l_rms_px": dict.fromkeys(range(10), 0.1)}
    assert frames_of(flight(regular(10), **alone)).misfit_px == pytest.approx(0.1)
    both = {"j_rms_px": {3: 0.4, 5: 0.6, 6: 0.5}}
    assert frames_of(flight(regular(10), **alone, **both)).misfit_px == pytest.approx(0.5)


def test_where_no_frame_is_looked_at_none_is_lost() -> None:
    """In contact with the ceiling the pictures are left alone, and looked at again after."""
    times = regular(60)
    log = flight(
        times,
        frame_t_s=dict.fromkeys(range(20, 40)),
        phase=dict.fromkeys(range(20, 40), "COMPLETE"),
    )
    assert frames_of(log).gaps_s.size == 0
    bare = flight(times, frame_t_s=dict.fromkeys(range(20, 40)))
    assert len(frames_of(bare).gaps_s) == 1


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_frames(count: int) -> None:
    frames = frames_of(flight(regular(count)))
    assert len(frames.seen_s) == count
    assert frames.gaps_s.shape == (0, 2)
