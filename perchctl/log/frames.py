"""What became of a flight's camera frames, read off its log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log.read import FlightLog

_BLIND_PHASE = "COMPLETE"  # against the ceiling no frame is looked at
_GAP_PERIODS = 2.5  # frames come irregularly: less than that may be a late one


@dataclass(frozen=True, eq=False)
class Frames:
    """Times of exposure, s after the flight's first tick.

    Attributes:
        seen_s, unseen_s: (n,) of the frames that showed the target, and of the others.
        gaps_s: (k, 2) from when to when no frame came that could be used.
    """

    seen_s: Array
    unseen_s: Array
    gaps_s: Array


def log_frames(log: FlightLog) -> Frames:
    """The frames of a flight; what is a gap, the median period says."""
    taken = [record for record in log.records if record.get("frame_t_s") is not None]
    times_s = log.since(np.array([record["frame_t_s"] for record in taken], dtype=np.float64))
    seen = np.array([shows_target(record) for record in taken], dtype=bool)
    if not taken:
        return Frames(times_s, times_s, np.empty((0, 2)))
    # The flight's end, as old as frames are when they are measured, may end a gap, too.
    late_s = float(np.median([record["t_s"] - record["frame_t_s"] for record in taken]))
    end_s = max(log.since(log.records[-1]["t_s"]) - late_s, times_s[-1])
    gaps_s = _gaps_s(log, np.append(times_s, end_s))
    return Frames(times_s[seen], times_s[~seen], gaps_s)


def shows_target(record: dict[str, Any]) -> bool:
    """Whether the frame of a tick held the target, as the planner's estimate took it."""
    found = any(record.get(f"{source}x_m") is not None for source in "jls")
    return found and record.get("measured") is not False


def _gaps_s(log: FlightLog, times_s: Array) -> Array:
    between_s = np.diff(times_s)
    gaps_s = np.stack([times_s[:-1], times_s[1:]], axis=1)
    gaps_s = gaps_s[between_s > _GAP_PERIODS * np.median(between_s)]
    for span in log.phases:
        if span.phase == _BLIND_PHASE:
            start_s, end_s = log.since(span.start_s), log.since(span.end_s)
            gaps_s = gaps_s[(gaps_s[:, 1] <= start_s) | (gaps_s[:, 0] >= end_s)]
    return gaps_s
