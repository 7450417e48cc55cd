"""When the target was out of sight while it was needed, and what the vehicle did then."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.log import shows_target
from perchctl.report.track import Track

LEAST_S = 0.3
"""A shorter gap is coasted through and changes nothing."""
SEEN_IN = frozenset({"ESTIMATE", "ALIGN", "ASCEND", "PERCH", "RECOVER"})
AT_THE_CEILING = frozenset({"COMPLETE", "PERCHED"})
BEGINNING_S = 1.0
"""What made it go is looked for in the first second."""


@dataclass(frozen=True)
class Loss:
    """From the last sight to the next, s from the first tick; without one to the end.

    Attributes:
        frames: those that came without the target; 0: no picture came at all.
        blur_px, flow_pxps, speed_mps: the fastest motion in the picture at its beginning,
            and the vehicle's speed then; NaN where unknown.
        phase: the one in which it went out of sight.
    """

    start_s: float
    end_s: float
    regained: bool
    frames: int
    blur_px: float
    flow_pxps: float
    speed_mps: float
    phase: str

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


def losses_of(track: Track) -> tuple[Loss, ...]:
    """In order. What is at the ceiling looks at nothing, and loses nothing."""
    taken = [
        (track.log.since(float(r["frame_t_s"])), shows_target(r))
        for r in track.log.records
        if r.get("frame_t_s") is not None
    ]
    seen_s = [t_s for t_s, seen in taken if seen]
    unseen_s = np.array([t_s for t_s, seen in taken if not seen])
    found = []
    for i, start_s in enumerate(seen_s):
        regained = i + 1 < len(seen_s)
        end_s = seen_s[i + 1] if regained else track.end_s
        loss = _loss(track, start_s, end_s, regained, unseen_s)
        if loss is not None:
            found.append(loss)
    return tuple(found)


def _loss(
    track: Track, start_s: float, end_s: float, regained: bool, unseen_s: np.ndarray
) -> Loss | None:
    if end_s - start_s < LEAST_S:
        return None
    phase = _phase_at(track, start_s + LEAST_S / 2)  # the last sight may be just before it
    left = next(
        (s for s in track.steps if s.start_s > start_s and s.phase not in SEEN_IN | {"SEARCH"}),
        None,
    )
    if left is not None and left.phase in AT_THE_CEILING and left.start_s <= end_s:
        if phase == "PERCH":
            return None  # so near that no marker fits into the picture, as it should be
        end_s = left.start_s
    if phase not in SEEN_IN or (left is not None and left.start_s - start_s < LEAST_S):
        return None
    beginning = track.within(start_s, min(end_s, start_s + BEGINNING_S))
    flow, speed = track.motion.flow_pxps[beginning], track.motion.speed_mps[beginning]
    blur, fastest = math.nan, math.nan
    if np.isfinite(flow).any():
        worst = int(np.nanargmax(flow))
        fastest, at_mps = float(flow[worst]), float(speed[worst])
        blur = float(track.motion.blur_px[beginning][worst])
    else:
        at_mps = float(np.nanmax(speed, initial=0.0))
    frames = int(np.count_nonzero((unseen_s > start_s) & (unseen_s < end_s)))
    return Loss(start_s, end_s, regained, frames, blur, fastest, at_mps, phase)


def _phase_at(track: Track, t_s: float) -> str:
    return next((s.phase for s in reversed(track.steps) if s.start_s <= t_s), "")
