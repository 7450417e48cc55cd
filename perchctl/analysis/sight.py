"""What the camera saw, according to a flight's log: timing of the frames, and losses of the
target."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.record import FlightLog, PhaseSpan

BLIND_PHASE = "COMPLETE"
"""Phase at the ceiling, in which no frames are searched."""
GAP_PERIODS = 2.5
"""Number of median periods up to which a gap may be a late frame rather than a missing one, since
frames arrive irregularly."""


def percentile(values: Array, percent: float) -> float:
    """The percentile at `percent` (0 to 100) of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if known.size else math.nan


# --- frames ---


@dataclass(frozen=True, eq=False)
class Frames:
    """Timing of the camera frames that the pipeline processed, oldest first.

    Attributes:
        t_s: (n,) exposure times, measured from the first iteration in which the vehicle was flown.
        has_target: (n,) bool, True for the frames that showed the target.
        gaps_s: (k, 2) start and end of each gap without a usable frame.
        rate_hz: 1 over the median time between two frames; NaN if unknown.
        median_age_s: median age of an image when it was used; NaN if unknown.
    """

    t_s: Array
    has_target: NDArray[np.bool_]
    gaps_s: Array
    rate_hz: float
    median_age_s: float

    @property
    def times_with_target_s(self) -> Array:
        """Times of the frames that showed the target."""
        return self.t_s[self.has_target]

    @property
    def times_without_target_s(self) -> Array:
        """Times of the frames that did not show the target."""
        return self.t_s[~self.has_target]


def read_frames(log: FlightLog) -> Frames:
    """A flight's frame timing; a gap is longer than `GAP_PERIODS` median frame periods."""
    records = [record for record in log.records if record.get("frame_t_s") is not None]
    times_s = log.to_flight_s(np.array([r["frame_t_s"] for r in records], dtype=np.float64))
    ages_s = np.array([r["t_s"] - r["frame_t_s"] for r in records], dtype=np.float64)
    age_s, gaps_s = percentile(ages_s, 50), np.empty((0, 2))
    if records:
        # The last gap may end with the flight. In that case, the newest possible exposure is the
        # flight's end minus the usual age of a frame.
        gaps_s = _gaps(log, np.append(times_s, max(log.end_s - age_s, times_s[-1])))
    between_s = np.diff(np.sort(times_s))
    return Frames(
        t_s=times_s,
        has_target=np.array([shows_target(record) for record in records], dtype=bool),
        gaps_s=gaps_s,
        rate_hz=1.0 / percentile(between_s[between_s > 0], 50),
        median_age_s=age_s,
    )


def shows_target(record: Mapping[str, Any]) -> bool:
    """True if the `record` of a tick says that the target was detected and its pose accepted."""
    found = any(record.get(f"{source}x_m") is not None for source in "jls")
    return found and record.get("measured") is not False


def _gaps(log: FlightLog, times_s: Array) -> Array:
    between_s = np.diff(times_s)
    gaps_s = np.stack([times_s[:-1], times_s[1:]], axis=1)
    gaps_s = gaps_s[between_s > GAP_PERIODS * np.median(between_s)]
    for span in log.phases:
        if span.phase == BLIND_PHASE:
            gaps_s = gaps_s[(gaps_s[:, 1] <= span.start_s) | (gaps_s[:, 0] >= span.end_s)]
    return gaps_s


# --- losses ---

LEAST_LOSS_S = 0.3
"""Duration below which the filter bridges a loss of the target, so that the loss has no effect,
s."""
NEEDED_IN = frozenset({"ESTIMATE", "ALIGN", "ASCEND", "PERCH", "RECOVER", "HOVER"})
AT_THE_CEILING = frozenset({"COMPLETE", "PERCHED"})


@dataclass(frozen=True)
class TargetLoss:
    """An interval in which the target was not seen, in a phase that needs it: from the last frame
    that showed the target to the next such frame (`is_regained`), or to the end of the flight.

    Attributes:
        frames_without_target: number of frames in the interval; 0 if none arrived at all.
    """

    start_s: float
    end_s: float
    is_regained: bool
    frames_without_target: int

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


def target_losses(log: FlightLog, frames: Frames) -> tuple[TargetLoss, ...]:
    """All target losses, oldest first. There are none while the vehicle is at the ceiling, where
    images are not evaluated."""
    stays = log.phases
    starts_s = [float(t_s) for t_s in frames.times_with_target_s]
    ends_s = [*starts_s[1:], log.end_s]
    found = []
    for start_s, next_s in zip(starts_s, ends_s, strict=False):
        end_s = _end_of_loss(start_s, next_s, stays)
        if end_s is not None:
            unseen = (frames.times_without_target_s > start_s) & (
                frames.times_without_target_s < end_s
            )
            regained = start_s != starts_s[-1]
            found.append(TargetLoss(start_s, end_s, regained, int(np.count_nonzero(unseen))))
    return tuple(found)


def _end_of_loss(start_s: float, end_s: float, stays: Sequence[PhaseSpan]) -> float | None:
    """When the loss ended; None without a loss."""
    if end_s - start_s < LEAST_LOSS_S:
        return None
    at_s = start_s + LEAST_LOSS_S / 2  # the target may have been last seen just before the phase
    phase = next((s.phase for s in reversed(stays) if s.start_s <= at_s), "")
    left = next(
        (s for s in stays if s.start_s > start_s and s.phase not in NEEDED_IN | {"SEARCH"}), None
    )
    if left is not None and left.phase in AT_THE_CEILING and left.start_s <= end_s:
        if phase == "PERCH":
            return None  # expected: at this distance, no marker fits into the image
        end_s = left.start_s
    if phase not in NEEDED_IN or (left is not None and left.start_s - start_s < LEAST_LOSS_S):
        return None
    return end_s
