"""Views of a board: from pictures, from videos, and from a live camera that a person is guided in
front of; and how alike two views are, which decides which of many are kept."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from perchctl.calibration.board.detect import BoardView, Rejection, find_board
from perchctl.calibration.live import GuidedFrame, poll_frames
from perchctl.camera import BrokenPicture, FrameSource, Grey, VideoSource, image_files, read_grey
from perchctl.errors import InvalidValue, TimedOut
from perchctl.geometry import Array
from perchctl.target import Board
from perchctl.vision import Frame, split_fields

MIN_VIEWS = 5
VIDEO_WINDOW = 8
"""Of so many frames in a row only the sharpest is searched for the board."""
_SHARPNESS_WIDTH = 480
Progress = Callable[[int, int | None], None]
"""Called with the number of pictures done, and of all where it is known."""


# --- Pictures ------------------------------------------------------------------------------


def views_of_images(
    where: str | Sequence[Path],
    board: Board,
    progress: Progress = lambda done, total: None,
) -> tuple[list[BoardView], list[Rejection]]:
    """Search every picture of a folder or glob (or those given); return the views of the board, and
    the pictures that are broken or show none.

    Raises:
        NotFound: no pictures. InvalidValue: unequal sizes.
    """
    paths = image_files(where)
    names = [path.name for path in paths]
    if len(set(names)) < len(names):  # a glob reached into several folders
        names = [str(path) for path in paths]

    def search(job: tuple[str, Path]) -> tuple[str, tuple[int, int] | None, BoardView | str]:
        name, path = job
        try:
            image = read_grey(path)
        except BrokenPicture as error:
            return name, None, error.reason
        return name, (image.shape[1], image.shape[0]), find_board(image, board, name)

    views: list[BoardView] = []
    missing: list[Rejection] = []
    first: tuple[str, tuple[int, int]] | None = None
    with ThreadPoolExecutor(_workers()) as pool:
        found = pool.map(search, zip(names, paths, strict=True))
        for done, (name, size_px, seen) in enumerate(found, start=1):
            if size_px is not None:
                first = first or (name, size_px)
                if size_px != first[1]:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise InvalidValue(
                        f"{name} is {size_px[0]}x{size_px[1]} px but {first[0]} is "
                        f"{first[1][0]}x{first[1][1]} px: a calibration belongs to one size, "
                        f"keep pictures of one only"
                    )
            if isinstance(seen, BoardView):
                views.append(seen)
            else:
                missing.append(Rejection(name, seen))
            progress(done, len(paths))
    return views, missing


def views_of_video(
    path: Path, board: Board, progress: Progress = lambda done, total: None
) -> tuple[list[BoardView], list[Rejection]]:
    """Return the sharp and different views of a video, and why there are none.

    Raises NotFound or InvalidValue for a file that is none.
    """

    def search(frame: Frame) -> BoardView | str:
        return find_board(frame.image, board, f"frame {frame.index}")

    source = VideoSource(path)
    found: list[BoardView] = []
    searched = 0
    try:
        with ThreadPoolExecutor(_workers()) as pool:
            sharpest = _sharpest_frames(source)
            # A whole video at once would not fit into the memory.
            while batch := [frame for frame, _ in zip(sharpest, range(4 * _workers()))]:  # noqa: B905
                seen = list(pool.map(search, batch))
                found += [view for view in seen if isinstance(view, BoardView)]
                searched += len(batch)
                progress(searched, None)
    finally:
        source.close()
    if not found:
        return [], [Rejection(f"{searched} frames", "no board found")]
    return select_views(found, board), []


def _sharpest_frames(source: VideoSource) -> Iterator[Frame]:
    """Yield the sharpest frame of each window."""
    window: list[Frame] = []
    while (frame := source.poll(0.0)) is not None:
        window.append(frame)
        if len(window) == VIDEO_WINDOW:
            yield max(window, key=lambda frame: sharpness(frame.image))
            window = []
    if window:
        yield max(window, key=lambda frame: sharpness(frame.image))


def sharpness(image: Grey) -> float:
    """Return the variance of a picture's second derivative; of one field where there are two: the
    comb of a moving picture is no sharpness."""
    image = split_fields(image)[0]
    step = max(1, image.shape[1] // _SHARPNESS_WIDTH)
    small = np.ascontiguousarray(image[::step, ::step])
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


def _workers() -> int:
    """Return the number of threads: OpenCV and numpy leave the interpreter free at work."""
    return max(1, min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2))


# --- How alike two views are ---------------------------------------------------------------


AXES = ("x", "y", "size", "tilt")
GOALS = {"x": 0.5, "y": 0.5, "size": 0.3, "tilt": 0.4}
"""Spread of each over the views, after which it counts as covered."""
NEW_BEYOND = 0.18
ENOUGH_VIEWS = 15
MOST_VIEWS = 40
_TILT_GAIN = 2.0
_BLUR_FACTOR = 1.7


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
        """Return how different two views are; beyond `NEW_BEYOND` one is new."""
        return float(np.abs(self._vector() - other._vector()).sum())

    def _vector(self) -> Array:
        return np.array([self.x, self.y, self.size, 0.7 * self.tilt_x, 0.7 * self.tilt_y])


def signature(view: BoardView, board: Board) -> Signature:
    """Return a view's signature, from the homography board -> picture; tilt is the change of scale
    across the board."""
    w, h = view.size_px
    x, y = (view.corners_px.mean(axis=0) / (w, h)).tolist()
    squares = view.object_m[:, :2] / board.square_m
    H, _ = cv2.findHomography(squares - squares.mean(axis=0), view.corners_px)
    if H is None:
        return Signature(x, y, 0.0, 0.0, 0.0)
    H = H / H[2, 2]
    affine = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    columns, rows = (side / board.square_m for side in board.size_m)
    area = abs(float(np.linalg.det(affine))) * columns * rows
    size = min(1.0, float(np.sqrt(area / (w * h))))
    # Brought from the board's axes to the picture's.
    rotation = affine / max(float(np.linalg.norm(affine[:, 0])), 1e-9)
    tilt = _TILT_GAIN * 0.5 * max(columns, rows) * (rotation @ H[2, :2])
    tilt_x, tilt_y = np.clip(tilt, -1.0, 1.0).tolist()
    return Signature(x, y, size, tilt_x, tilt_y)


def covered_shares(signatures: Sequence[Signature]) -> dict[str, float]:
    """Return how far each of `AXES` is covered, 0..1."""
    if not signatures:
        return dict.fromkeys(AXES, 0.0)
    shown = np.array([(s.x, s.y, s.size, s.tilt_x, s.tilt_y) for s in signatures])
    x, y, size, tilt_x, tilt_y = np.ptp(shown, axis=0)
    spread = {"x": x, "y": y, "size": size, "tilt": (tilt_x + tilt_y) / 2.0}
    return {axis: float(min(1.0, spread[axis] / GOALS[axis])) for axis in AXES}


def select_views(views: Sequence[BoardView], board: Board) -> list[BoardView]:
    """Return the sharp and different ones of a video's views, at most `MOST_VIEWS`, in order.

    The one most unlike those taken is taken next (the sharper the better), until what is
    left repeats them.
    """
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


# --- Guided capture ------------------------------------------------------------------------


_STILL_SHARE = 1.5 / 640.0  # of the width, between two frames
_BLUR_SHARE = 2.5 / 640.0


def capture_views(
    source: FrameSource,
    board: Board,
    show: Callable[[GuidedFrame], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    stopped: Callable[[], bool] = lambda: False,
) -> list[BoardView]:
    """Take views of a live camera until all is covered or `stopped`, whenever the view is new,
    sharp and still. `show` gets each frame's moment.

    A source that is gone ends the capture with what there is, if that may be enough.

    Raises TimedOut: the camera is gone before that.
    """
    state = Capture()
    ended = f"{source.describe()} has ended"
    try:
        for _, frame in poll_frames(source, clock, sleep):
            if stopped():
                return list(state.taken)
            if frame is None or frame.repeated:  # a repeated one would look still
                continue
            seen = find_board(frame.image, board, f"view {len(state.taken) + 1}")
            state = update_capture(state, seen, board)
            show(_moment(frame, seen, state))
            if state.finished:
                return list(state.taken)
    except TimedOut as gone:
        ended = str(gone)
    if len(state.taken) < MIN_VIEWS:
        raise TimedOut(
            f"{ended}; only {len(state.taken)} views were taken, at least {MIN_VIEWS} are needed"
        )
    return list(state.taken)


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
        """Enough of everything, or so many views that more would not change the solution."""
        covered = min(covered_shares(self.signatures).values()) >= 1.0
        return len(self.signatures) >= (ENOUGH_VIEWS if covered else MOST_VIEWS)


def update_capture(capture: Capture, seen: BoardView | str, board: Board) -> Capture:
    """Return the capture after one more picture: the automatic shutter takes a view that is new,
    sharp and still. `seen` is the board's view, or why there is none."""
    taken, signatures = capture.taken, capture.signatures
    if isinstance(seen, str):
        return Capture(taken, signatures, None, seen)
    width = seen.size_px[0]
    if _moved_px(capture.last, seen) > _STILL_SHARE * width:
        return Capture(taken, signatures, seen, "hold still")
    sharpest = min((v.blur_px for v in taken), default=np.inf)
    if seen.blur_px > max(_BLUR_SHARE * width, 1.0) or seen.blur_px > 2.5 * sharpest:
        return Capture(taken, signatures, seen, "too blurred: more light, or hold still")
    here = signature(seen, board)
    if any(here.distance(s) <= NEW_BEYOND for s in signatures):
        return Capture(taken, signatures, seen, next_advice(signatures))
    grown = (*signatures, here)
    return Capture((*taken, seen), grown, seen, f"taken, {len(grown)} views", True)


def _moved_px(before: BoardView | None, now: BoardView) -> float:
    """Return the median motion in px of the corners that both views show; infinite without any."""
    if before is None:
        return float("inf")
    _, a, b = np.intersect1d(before.ids, now.ids, return_indices=True)
    if len(a) == 0:
        return float("inf")
    return float(np.median(np.linalg.norm(before.corners_px[a] - now.corners_px[b], axis=1)))


def next_advice(signatures: Sequence[Signature]) -> str:
    """Return one thing to do, in the picture's directions: towards where the least was shown so far
    of what is covered least."""
    done = covered_shares(signatures)
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


def _moment(frame: Frame, seen: BoardView | str, state: Capture) -> GuidedFrame:
    """Return what to show of a frame."""
    outlines: tuple[tuple[str, Array], ...] = ()
    if isinstance(seen, BoardView):
        hull = cv2.convexHull(seen.corners_px.astype(np.float32)).reshape(-1, 2)
        outlines = (("small" if state.shot else "large", hull.astype(np.float64)),)
    covered = {
        name: (f"{100 * s:.0f} %", s) for name, s in covered_shares(state.signatures).items()
    }
    shares = ", ".join(f"{name} {text}" for name, (text, _) in covered.items())
    taken = len(state.taken)
    return GuidedFrame(
        frame.index,
        frame.image,
        outlines,
        (*((name, text, share) for name, (text, share) in covered.items()),
         ("views", str(taken), None)),
        state.advice,
        f"{taken} views; {shares}",
        state.shot,
    )  # fmt: skip
