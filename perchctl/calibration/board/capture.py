"""Collect views of a board from images, a video or a live camera, and measure how similar two views
are."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from perchctl.calibration.board.detect import (
    BoardView,
    FoundViews,
    FrameCounts,
    Rejection,
    find_board,
)
from perchctl.calibration.board.recognise import MOST_PICTURES, describe_other_board
from perchctl.calibration.board.solve import MIN_VIEWS
from perchctl.calibration.live import GuidanceBar, GuidedFrame, poll_frames
from perchctl.camera import FrameSource, Grey, decode_picture
from perchctl.errors import InvalidValue, TimedOut
from perchctl.geometry import Array
from perchctl.target import Board
from perchctl.vision import Frame

# --- Images ---


def find_views(
    pictures: Sequence[Path],
    board: Board,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FoundViews:
    """Detect the board in image files. Images that are damaged or show no board are returned
    separately. `progress` is called with the number of images processed so far and the total
    number.

    Raises InvalidValue, before the search, if the images differ in size.
    """
    names = [path.name for path in pictures]
    if len(set(names)) < len(names):  # a glob may match files in several folders
        names = [str(path) for path in pictures]

    def search(name: str, path: Path) -> BoardView | str:
        try:
            return find_board(decode_picture(path.read_bytes()), board, name)
        except (OSError, ValueError) as error:
            return str(error)

    views: list[BoardView] = []
    missing: list[Rejection] = []
    with ThreadPoolExecutor() as pool:
        sizes = list(pool.map(_picture_size, pictures))
        _check_sizes(dict(zip(names, sizes, strict=True)))
        for name, seen in zip(names, pool.map(search, names, pictures), strict=True):
            if isinstance(seen, BoardView):
                views.append(seen)
            else:
                missing.append(Rejection(name, seen))
            progress(len(views) + len(missing), len(pictures))
    views, others = _of_one_layout(views)
    shown: list[Grey] = []
    if not views:
        readable = [path for path, size in zip(pictures, sizes, strict=True) if size]
        spread = readable[:: max(1, len(readable) // MOST_PICTURES)][:MOST_PICTURES]
        shown = [decode_picture(path.read_bytes()) for path in spread]
    return FoundViews(
        tuple(views), (*missing, *others), other_board=describe_other_board(shown, board)
    )


def _picture_size(path: Path) -> tuple[int, int] | None:
    """Width and height in px; None if the file cannot be read."""
    try:
        height, width = decode_picture(path.read_bytes()).shape
    except (OSError, ValueError):
        return None
    return width, height


def _check_sizes(sizes: Mapping[str, tuple[int, int] | None]) -> None:
    """Raise InvalidValue, naming all images whose size differs from that of the majority."""
    counts = Counter(size for size in sizes.values() if size)
    if len(counts) < 2:
        return
    (most, count), *_ = counts.most_common()
    odd = {name: size for name, size in sizes.items() if size not in (most, None)}
    named = ", ".join(f"{name} is {size[0]}x{size[1]} px" for name, size in odd.items() if size)
    raise InvalidValue(
        f"{count} of {counts.total()} images are {most[0]}x{most[1]} px, but {named}: "
        "a calibration needs images of the same size, so remove the others"
    )


def _of_one_layout(views: Sequence[BoardView]) -> tuple[list[BoardView], list[Rejection]]:
    """Return the views with the layout that most images show, and reject the others, because there
    is only one board."""
    legacy = 2 * sum(view.legacy for view in views) > len(views)
    reason = "its markers have a different layout from those in most images"
    others = [Rejection(view.name, reason) for view in views if view.legacy != legacy]
    return [view for view in views if view.legacy == legacy], others


# --- Similarity of two views ---


COVERAGE_AXES = ("position x", "position y", "size", "skew")
"""The names are those of ROS's camera_calibration."""
GOALS = {"position x": 0.5, "position y": 0.5, "size": 0.3, "skew": 0.4}
"""Spread of the views along each axis at which the axis counts as covered."""
NEW_BEYOND = 0.18
ENOUGH_VIEWS = 15
MOST_VIEWS = 40
"""Number of views that is always enough, whatever they cover."""
_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.7, 0.7])
_TILT_GAIN = 2.0


def view_signature(view: BoardView, board: Board) -> Array:
    """Describe the board's position, size and tilt in a view by five numbers, (5,): x and y of the
    corners' centre and the size of the board, relative to the image, and two tilts. The tilts say
    how much farther away the right side is than the left one, and the lower side than the upper
    one."""
    w, h = view.size_px
    x, y = view.corners_px.mean(axis=0) / (w, h)
    squares = view.corners_m[:, :2] / board.square_m
    H, _ = cv2.findHomography(squares - squares.mean(axis=0), view.corners_px)
    if H is None:
        return np.array([x, y, 0.0, 0.0, 0.0])
    H = H / H[2, 2]
    affine = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    columns, rows = board.squares
    size = np.sqrt(abs(np.linalg.det(affine)) * columns * rows / (w * h))
    # The tilts are rotated from the board's axes to those of the image.
    rotation = affine / max(float(np.linalg.norm(affine[:, 0])), 1e-9)
    tilt = _TILT_GAIN * 0.5 * max(columns, rows) * (rotation @ H[2, :2])
    return np.array([x, y, min(1.0, size), *np.clip(tilt, -1.0, 1.0)])


def signature_distance(signature: Array, other: Array) -> float:
    """Return the weighted distance between two view signatures (5,). A view is new if its distance
    to all others exceeds `NEW_BEYOND`."""
    return float(np.abs(signature - other) @ _WEIGHTS)


def covered_shares(signatures: Sequence[Array]) -> dict[str, float]:
    """For each of `COVERAGE_AXES`, the spread of the view signatures divided by the required
    spread, capped at 1. Skew is the mean of both tilts."""
    x, y, size, *tilts = np.ptp(signatures, axis=0) if signatures else np.zeros(5)
    spreads = zip(COVERAGE_AXES, (x, y, size, sum(tilts) / 2.0), strict=True)
    return {axis: float(min(1.0, spread / GOALS[axis])) for axis, spread in spreads}


def coverage_bars(signatures: Sequence[Array]) -> dict[str, GuidanceBar]:
    """The bar for each of `COVERAGE_AXES`. The bars for positions and size reach from the smallest
    to the largest value in the view signatures, as fractions of the image, so that a gap shows what
    is missing. The bar for the skew is the skew's spread as a share of the required spread."""
    shares = covered_shares(signatures)
    reach = dict.fromkeys(COVERAGE_AXES, (0.0, 0.0))
    if signatures:
        parts = np.clip(signatures, 0.0, 1.0)[:, :3].T
        reach |= {
            axis: (float(part.min()), float(part.max()))
            for axis, part in zip(COVERAGE_AXES, parts, strict=False)
        }
    reach["skew"] = (0.0, shares["skew"])
    return {axis: GuidanceBar(*reach[axis], shares[axis] >= 1.0) for axis in COVERAGE_AXES}


# --- Guided capture ---


_STILL_SHARE = 1.5 / 640.0  # largest motion between two still frames, in image widths
_BLUR_SHARE = 2.5 / 640.0
_UNSEEN_EVERY = 15
"""One in this many frames without the board is kept, to find out which board is in use instead."""
_ADVICE = (
    (0.5, "move the board to the right edge", "move the board to the left edge"),
    (0.5, "move the board to the bottom edge", "move the board to the top edge"),
    (0.5, "move closer", "move farther away"),
    (0.0, "tilt the board's right side away", "tilt the board's left side away"),
    (0.0, "tilt the board's bottom side away", "tilt the board's top side away"),
)
"""The middle of each component of a view signature, and the instructions that increase and decrease
this component."""


def capture_views(
    source: FrameSource,
    board: Board,
    show: Callable[[GuidedFrame], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    stopped: Callable[[], bool] = lambda: False,
) -> FoundViews:
    """Collect new, sharp, still views of the board from a video or live camera, until the views
    vary enough, the source ends, or `stopped` returns True. `show` is called for each frame.

    Raises TimedOut if the camera is lost before there are `MIN_VIEWS` views.
    """
    capture = GuidedCapture(board, source.live)
    unseen: list[Grey] = []
    try:
        for _, frame in poll_frames(source, clock, sleep):
            if stopped():
                break
            if frame is None:
                continue
            if frame.is_repeated:  # a repeated frame would make the board seem to be still
                capture.count_repeated()
                continue
            seen = find_board(frame.image, board, f"view {len(capture.taken) + 1}")
            taken = capture.update(seen)
            if isinstance(seen, str) and frame.index % _UNSEEN_EVERY == 0:
                unseen = [*unseen[1 - MOST_PICTURES :], frame.image]
            show(capture.guided_frame(frame, seen, taken))
            if capture.is_finished:
                break
    except TimedOut as gone:
        if len(capture.taken) < MIN_VIEWS:
            raise TimedOut(f"{gone}; only {len(capture.taken)} views were taken") from None
    views, others = _of_one_layout(capture.taken)
    other_board = "" if views else describe_other_board(unseen, board)
    return FoundViews(tuple(views), tuple(others), capture.counts, other_board)


class GuidedCapture:
    """State of a guided capture: the views `taken`, `advice` on the next view (for a recording, the
    result of the current frame), and `counts`, the results of all frames."""

    def __init__(self, board: Board, live: bool = True) -> None:
        self._board = board
        self._signatures: list[Array] = []
        self._last: BoardView | None = None
        self.taken: list[BoardView] = []
        self.counts = FrameCounts(live=live, still_px=0.0)
        self.advice = "show the board to the camera" if live else "no board found yet"

    @property
    def is_finished(self) -> bool:
        """True if enough views were taken and they vary enough, or if `MOST_VIEWS` were taken."""
        covered = min(covered_shares(self._signatures).values()) >= 1.0
        return len(self.taken) >= (ENOUGH_VIEWS if covered else MOST_VIEWS)

    def count_repeated(self) -> None:
        """Count a frame that the source returned twice."""
        self._count("repeated")

    def update(self, view_or_reason: BoardView | str) -> bool:
        """Process the next image: extract its view of the board, or find out why there is none.

        Return True if the view was taken, that is, if it is new, sharp and still.
        """
        before, seen = self._last, view_or_reason
        self._last = seen if isinstance(seen, BoardView) else None
        live = self.counts.live
        if isinstance(seen, str):
            self._count("without_board")
            self.advice = seen
            return False
        width = seen.size_px[0]
        self.counts = replace(self.counts, still_px=_STILL_SHARE * width)
        sharpest_px = min((view.blur_px for view in self.taken), default=np.inf)
        here = view_signature(seen, self._board)
        if before is None or _moved_px(before, seen) > self.counts.still_px:
            self._count("moved")
            self.advice = "hold still" if live else "moved since the previous frame"
        elif seen.blur_px > min(max(_BLUR_SHARE * width, 1.0), 2.5 * sharpest_px):
            self._count("blurred")
            self.advice = "too blurred: add light, or hold still" if live else "too blurred"
        elif any(signature_distance(here, there) <= NEW_BEYOND for there in self._signatures):
            self._count("alike")
            self.advice = (
                next_advice(self._signatures) if live else "similar to a view already taken"
            )
        else:
            self._count("taken")
            self.taken.append(seen)
            self._signatures.append(here)
            self.advice = f"taken, {len(self.taken)} views"
            return True
        return False

    def _count(self, what: str) -> None:
        self.counts = replace(self.counts, **{what: getattr(self.counts, what) + 1})

    def guided_frame(
        self, frame: Frame, view_or_reason: BoardView | str, taken: bool
    ) -> GuidedFrame:
        """The frame with the board's outline, the coverage and the advice."""
        outlines: tuple[tuple[str, Array], ...] = ()
        if isinstance(view_or_reason, BoardView):
            hull = cv2.convexHull(view_or_reason.corners_px.astype(np.float32)).reshape(-1, 2)
            outlines = (("small" if taken else "large", hull.astype(np.float64)),)
        shares, bars = covered_shares(self._signatures), coverage_bars(self._signatures)
        rows = [(name, f"{100 * share:.0f} %", bars[name]) for name, share in shares.items()]
        line = f"{len(self.taken)} views; {', '.join(f'{name} {text}' for name, text, _ in rows)}"
        views = ("views", str(len(self.taken)), None)
        return GuidedFrame(
            frame.index, frame.image, outlines, (*rows, views), self.advice, line, taken
        )


def _moved_px(before: BoardView, now: BoardView) -> float:
    """Return the median motion in px of the corners that both views show; infinite if they have no
    corner in common."""
    _, a, b = np.intersect1d(before.ids, now.ids, return_indices=True)
    ways = np.linalg.norm(before.corners_px[a] - now.corners_px[b], axis=1)
    return float(np.median(ways)) if len(a) else float("inf")


def next_advice(signatures: Sequence[Array]) -> str:
    """Return how to move or tilt the board next, to extend the axis that the view `signatures`
    cover least. Directions are those in the image."""
    done = covered_shares(signatures)
    least = min(COVERAGE_AXES, key=lambda axis: done[axis])
    if done[least] >= 1.0:
        return "move the board to a new place"
    return axis_advice(signatures, least)


def axis_advice(signatures: Sequence[Array], axis: str) -> str:
    """Return how to move or tilt the board so that the view signatures (at least one) spread more
    widely along one of `COVERAGE_AXES`."""
    k = COVERAGE_AXES.index(axis)
    if axis == "skew":
        across, down = np.ptp(signatures, axis=0)[3:]
        k = 3 if across <= down else 4
    shown = [part[k] for part in signatures]
    middle, more, less = _ADVICE[k]
    return more if min(shown) + max(shown) < 2.0 * middle else less
