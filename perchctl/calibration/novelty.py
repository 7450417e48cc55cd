"""How alike two views are, and which of many are worth keeping."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from perchctl.calibration.types import BoardView
from perchctl.geometry import Array
from perchctl.target import Board

AXES = ("x", "y", "size", "tilt")
GOALS = {"x": 0.5, "y": 0.5, "size": 0.3, "tilt": 0.4}
"""Spread of each over the views, after which it counts as covered."""
NEW_BEYOND = 0.18
ENOUGH_VIEWS = 15
MOST_VIEWS = 40
_TILT_GAIN = 2.0
_STILL_SHARE = 1.5 / 640.0  # of the width, between two frames
_BLUR_FACTOR = 1.7
_BLUR_SHARE = 2.5 / 640.0


@dataclass(frozen=True)
class Signature:
    """Where and how a view shows the board: middle of its corners as a part of the width
    and the height, size as a part of the picture, and by how much its right and its lower side
    are farther away than the others."""

    x: float
    y: float
    size: float
    tilt_x: float
    tilt_y: float

    def distance(self, other: Signature) -> float:
        here, there = self._vector(), other._vector()
        return float(np.abs(here - there).sum())

    def _vector(self) -> Array:
        return np.array([self.x, self.y, self.size, 0.7 * self.tilt_x, 0.7 * self.tilt_y])


def signature(view: BoardView, board: Board) -> Signature:
    """From the homography board -> picture; tilt is the change of scale across the board."""
    w, h = view.size_px
    middle = view.corners_px.mean(axis=0) / (w, h)
    squares = view.object_m[:, :2] / board.square_m
    centre = squares.mean(axis=0)
    H, _ = cv2.findHomography(squares - centre, view.corners_px)
    if H is None:
        return Signature(float(middle[0]), float(middle[1]), 0.0, 0.0, 0.0)
    H = H / H[2, 2]
    affine = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    columns, rows = (side / board.square_m for side in board.size_m)
    area = abs(float(np.linalg.det(affine))) * columns * rows
    size = min(1.0, float(np.sqrt(area / (w * h))))
    reach = 0.5 * max(columns, rows)
    # Brought from the board's axes to the picture's.
    turn = affine / max(float(np.linalg.norm(affine[:, 0])), 1e-9)
    tilt = np.clip(_TILT_GAIN * reach * (turn @ H[2, :2]), -1.0, 1.0)
    return Signature(float(middle[0]), float(middle[1]), size, float(tilt[0]), float(tilt[1]))


def progress(signatures: Sequence[Signature]) -> dict[str, float]:
    """How far each of `AXES` is covered, 0..1."""
    if not signatures:
        return dict.fromkeys(AXES, 0.0)
    tilts = [np.ptp([s.tilt_x for s in signatures]), np.ptp([s.tilt_y for s in signatures])]
    spread = {
        "x": np.ptp([s.x for s in signatures]),
        "y": np.ptp([s.y for s in signatures]),
        "size": np.ptp([s.size for s in signatures]),
        "tilt": float(np.mean(tilts)),
    }
    return {axis: float(min(1.0, spread[axis] / GOALS[axis])) for axis in AXES}


def is_covered(signatures: Sequence[Signature]) -> bool:
    """Enough of everything, or so many views that more would not change the solution."""
    covered = min(progress(signatures).values()) >= 1.0
    return len(signatures) >= (ENOUGH_VIEWS if covered else MOST_VIEWS)


def is_new(candidate: Signature, taken: Sequence[Signature]) -> bool:
    return all(candidate.distance(s) > NEW_BEYOND for s in taken)


def pick(views: Sequence[BoardView], board: Board) -> list[BoardView]:
    """The sharp and different ones of a video's views, at most `MOST_VIEWS`, in order.

    The one most unlike those taken is taken next (the sharper the better), until what is
    left repeats them.
    """
    if not views:
        return []
    blur = np.array([v.blur_px for v in views])
    limit = _BLUR_FACTOR * max(float(np.median(blur)), 1e-9)
    sharp = [i for i in range(len(views)) if blur[i] <= limit]
    signatures = {i: signature(views[i], board) for i in sharp}
    taken = [min(sharp, key=lambda i: blur[i])]
    while len(taken) < min(MOST_VIEWS, len(sharp)):
        apart = {
            i: min(signatures[i].distance(signatures[j]) for j in taken)
            for i in sharp
            if i not in taken
        }
        best = max(apart, key=lambda i: apart[i] / (0.5 + blur[i] / limit))
        if apart[best] < 0.4 * NEW_BEYOND:
            break
        taken.append(best)
    return [views[i] for i in sorted(taken)]


@dataclass(frozen=True, eq=False)
class Capture:
    """Memory of a guided capture; `Capture()` is a fresh start.

    advice: what to do next, for the person with the board.
    """

    taken: tuple[BoardView, ...] = ()
    signatures: tuple[Signature, ...] = ()
    last: BoardView | None = None
    advice: str = "show the board to the camera"
    shot: bool = False  # the newest frame was taken

    @property
    def finished(self) -> bool:
        return is_covered(self.signatures)


def consider(capture: Capture, seen: BoardView | str, board: Board) -> Capture:
    """The automatic shutter: takes the view when it is new, sharp and still."""
    taken, signatures = capture.taken, capture.signatures
    if isinstance(seen, str):
        return Capture(taken, signatures, None, seen)
    width = seen.size_px[0]
    here = signature(seen, board)
    if _moved_px(capture.last, seen) > _STILL_SHARE * width:
        return Capture(taken, signatures, seen, "hold still")
    sharpest = min((v.blur_px for v in taken), default=np.inf)
    if seen.blur_px > max(_BLUR_SHARE * width, 1.0) or seen.blur_px > 2.5 * sharpest:
        return Capture(taken, signatures, seen, "too blurred: more light, or hold still")
    if not is_new(here, signatures):
        return Capture(taken, signatures, seen, hint(signatures))
    grown = (*signatures, here)
    return Capture((*taken, seen), grown, seen, f"taken, {len(grown)} views", True)


def _moved_px(before: BoardView | None, now: BoardView) -> float:
    if before is None:
        return float("inf")
    _, a, b = np.intersect1d(before.ids, now.ids, return_indices=True)
    if len(a) == 0:
        return float("inf")
    return float(np.median(np.linalg.norm(before.corners_px[a] - now.corners_px[b], axis=1)))


def hint(signatures: Sequence[Signature]) -> str:
    """One thing to do, in the picture's directions: towards where the least was shown so far
    of what is covered least."""
    done = progress(signatures)
    least = min(AXES, key=lambda axis: done[axis])
    if done[least] >= 1.0:
        return "show the board somewhere new"
    if least != "tilt":
        shown = [getattr(s, least) for s in signatures]
        more = min(shown) + max(shown) < 1.0
        return {
            "x": f"move the board to the {'right' if more else 'left'} rim",
            "y": f"move the board to the {'bottom' if more else 'top'} rim",
            "size": "come nearer" if more else "go farther away",
        }[least]
    across, down = [s.tilt_x for s in signatures], [s.tilt_y for s in signatures]
    if np.ptp(across) <= np.ptp(down):
        side = "right" if min(across) + max(across) < 0.0 else "left"
    else:
        side = "lower" if min(down) + max(down) < 0.0 else "upper"
    return f"tilt the board's {side} side away"
