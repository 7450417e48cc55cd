"""How well the camera saw: frames, detections, ages, what the poses left over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log import log_frames, shows_target
from perchctl.report.track import Track

PHASES = ("SEARCH", "ESTIMATE", "ALIGN", "ASCEND", "PERCH", "RECOVER")
RMS_KEYS = ("j_rms_px", "l_rms_px", "s_rms_px")


@dataclass(frozen=True)
class Seen:
    """Of one phase, all its stays together; NaN where nothing is known.

    Attributes:
        frames, with_target: that the pipeline was given, and those of them that held it.
        rate_hz: by the median time between two frames, as `perchctl log show` has it.
        age_s, age_most_s: of the picture when it was used: median, and 95 of 100 are below.
        rms_px: what the corners miss the pose by, median.
        blur_px, blur_most_px: as `perchctl.report.track`: median, and 95 of 100 are below.
        strangers: frames whose pose was not taken for the target's.
    """

    phase: str
    frames: int
    with_target: int
    rate_hz: float
    age_s: float
    age_most_s: float
    rms_px: float
    blur_px: float
    blur_most_px: float
    strangers: int

    @property
    def share(self) -> float:
        return self.with_target / self.frames if self.frames else math.nan


@dataclass(frozen=True)
class Sight:
    """`gaps_s`: from when to when no picture came that could be used; `exposure_s`: None where
    nobody knows it."""

    whole: Seen
    phases: tuple[Seen, ...]
    gaps_s: tuple[tuple[float, float], ...]
    exposure_s: float | None


def sight_of(track: Track) -> Sight:
    """Of the whole flight and of each phase in which the camera leads."""
    taken = [(i, r) for i, r in enumerate(track.log.records) if r.get("frame_t_s") is not None]
    leading = [(i, r) for i, r in taken if r.get("phase") in PHASES]
    each = tuple(
        _seen(track, phase, [(i, r) for i, r in leading if r.get("phase") == phase])
        for phase in PHASES
    )
    gaps = log_frames(track.log).gaps_s
    return Sight(
        _seen(track, "in these phases", leading),
        tuple(seen for seen in each if seen.frames),
        tuple((float(a), float(b)) for a, b in gaps),
        track.motion.exposure_s,
    )


def _seen(track: Track, phase: str, taken: Sequence[tuple[int, dict[str, Any]]]) -> Seen:
    records = [record for _, record in taken]
    at_s = np.array([r["frame_t_s"] for r in records], dtype=np.float64)
    ages = np.array([r["t_s"] for r in records], dtype=np.float64) - at_s
    rms = np.array([v for r in records for k in RMS_KEYS if (v := r.get(k)) is not None])
    blur = track.motion.blur_px[[i for i, _ in taken]] if taken else np.empty(0)
    return Seen(
        phase,
        len(records),
        sum(shows_target(r) for r in records),
        _rate_hz(at_s),
        part_of(ages, 50),
        part_of(ages, 95),
        part_of(rms, 50),
        part_of(blur, 50),
        part_of(blur, 95),
        sum(bool(r.get("lock_note")) for r in records),
    )


def _rate_hz(at_s: Array) -> float:
    between = np.diff(at_s)
    between = between[between > 0]
    return 1.0 / float(np.median(between)) if between.size else math.nan


def part_of(values: Array, percent: float) -> float:
    """A percentile of what is known; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if known.size else math.nan
