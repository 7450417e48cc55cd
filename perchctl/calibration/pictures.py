"""Views of the board from recorded pictures: folders, globs, videos."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from perchctl.calibration.detect import find_board
from perchctl.calibration.novelty import pick
from perchctl.calibration.types import BoardView, Grey, Rejection
from perchctl.camera import BrokenPicture, VideoSource, image_files, read_grey
from perchctl.errors import InvalidValue
from perchctl.target import Board
from perchctl.vision import field_picture, is_combed

VIDEO_WINDOW = 8
"""Of so many frames in a row only the sharpest is searched for the board."""
_SHARPNESS_WIDTH = 480
Progress = Callable[[int, int | None], None]
"""Called with the number of pictures done, and of all where it is known."""


def views_of_images(
    where: str | Sequence[Path],
    board: Board,
    refine: bool = True,
    progress: Progress = lambda done, total: None,
    skip_broken: bool = False,
) -> tuple[list[BoardView], list[Rejection]]:
    """Every picture of a folder or glob (or those given): the views, and those without a board.

    Args:
        skip_broken: leave out what is no picture, or only a part of one.

    Raises:
        NotFound: no pictures. InvalidValue: broken ones (all are named), or unequal sizes.
    """
    paths = image_files(where)
    names = _names(paths)

    broken: dict[str, str] = {}

    def look(job: tuple[str, Path]) -> tuple[str, tuple[int, int] | None, BoardView | str]:
        name, path = job
        try:
            image = read_grey(path)
        except BrokenPicture as error:
            broken[name] = error.reason
            return name, None, error.reason
        if broken and not skip_broken:
            return name, None, ""  # only the broken ones are still asked for
        size_px = (image.shape[1], image.shape[0])
        return name, size_px, find_board(image, board, name, refine)

    views: list[BoardView] = []
    missing: list[Rejection] = []
    first: tuple[str, tuple[int, int]] | None = None
    with _pool() as pool:
        for done, (name, size_px, seen) in enumerate(
            pool.map(look, zip(names, paths, strict=True)), start=1
        ):
            if size_px is not None:
                first = first or (name, size_px)
            if size_px is not None and first is not None and size_px != first[1]:
                pool.shutdown(wait=False, cancel_futures=True)
                raise InvalidValue(
                    f"{name} is {size_px[0]}x{size_px[1]} px but {first[0]} is "
                    f"{first[1][0]}x{first[1][1]} px: a calibration belongs to one size, "
                    f"keep pictures of one only"
                )
            _sort(seen, name, views, missing)
            progress(done, len(paths))
    if broken and not (skip_broken and first):
        raise InvalidValue(_broken_text(broken, len(paths)))
    return views, missing


def _broken_text(broken: Mapping[str, str], count: int) -> str:
    """All of them by name, and what to do."""
    named = ", ".join(f"{name} {reason}" for name, reason in broken.items())
    if len(broken) == count:
        return f"none of the {count} pictures can be used: {named}"
    return (
        f"{len(broken)} of {count} pictures cannot be used: {named}; replace or remove them, or "
        f"leave them out with --skip-broken"
    )


def views_of_video(
    path: Path, board: Board, refine: bool = True, progress: Progress = lambda done, total: None
) -> tuple[list[BoardView], list[Rejection]]:
    """The sharp and different views of a video.

    Raises NotFound or InvalidValue for a file that is none.
    """
    source = VideoSource(path)
    try:
        found: list[BoardView] = []
        searched = 0

        def look(job: tuple[str, Grey]) -> BoardView | str:
            return find_board(job[1], board, job[0], refine)

        with _pool() as pool:
            for batch in _batches(_sharpest(source), 4 * _workers()):
                for seen in pool.map(look, batch):
                    searched += 1
                    if isinstance(seen, BoardView):
                        found.append(seen)
                progress(searched, None)
    finally:
        source.close()
    if not found:
        return [], [Rejection(f"{searched} frames", "no board found")]
    return pick(found, board), []


def _sharpest(source: VideoSource) -> Iterator[tuple[str, Grey]]:
    """The sharpest frame of each window, with its name."""
    best: tuple[float, str, Grey] | None = None
    count = 0
    while (frame := source.poll(0.0)) is not None:
        sharpness = _sharpness(frame.image)
        if best is None or sharpness > best[0]:
            best = (sharpness, f"frame {frame.index}", frame.image)
        count += 1
        if count == VIDEO_WINDOW:
            yield best[1], best[2]
            best, count = None, 0
    if best is not None:
        yield best[1], best[2]


def _sharpness(image: Grey) -> float:
    """Of one field where there are two: the comb of a moving picture is no sharpness."""
    if is_combed(image):
        image = field_picture(image, 0)
    step = max(1, image.shape[1] // _SHARPNESS_WIDTH)
    small = np.ascontiguousarray(image[::step, ::step])
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


def _batches(items: Iterable[tuple[str, Grey]], size: int) -> Iterator[list[tuple[str, Grey]]]:
    batch: list[tuple[str, Grey]] = []
    for item in items:
        batch.append(item)
        if len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch


def _sort(
    seen: BoardView | str, name: str, views: list[BoardView], missing: list[Rejection]
) -> None:
    if isinstance(seen, BoardView):
        views.append(seen)
    else:
        missing.append(Rejection(name, seen))


def _names(paths: list[Path]) -> list[str]:
    """File names, or whole paths where a glob reached into several folders."""
    names = [p.name for p in paths]
    return names if len(set(names)) == len(names) else [str(p) for p in paths]


def _workers() -> int:
    return max(1, min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2))


def _pool() -> ThreadPoolExecutor:
    """OpenCV and numpy leave the interpreter free while they work."""
    return ThreadPoolExecutor(_workers())
