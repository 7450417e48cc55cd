"""The files of `perchctl track`, a CSV and a video: there whole, or not at all."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np

from perchctl.display import Sketch, draw_sketch
from perchctl.files import PartFile, cannot_be_written
from perchctl.track.result import CSV_COLUMNS, Tracked, csv_record
from perchctl.vision import CameraModel

_TICKS_HZ = 90_000  # of the video's times
_H264 = {"preset": "veryfast", "crf": "20", "bf": "0"}  # no frames out of order: times begin at 0


@contextmanager
def csv_file(path: Path) -> Iterator[Callable[[Tracked], None]]:
    """Yields the function that adds a row for one result, `t_s` first.

    The file gets its place as the block ends, and is removed where something fails within it.
    Errors: InvalidValue where it cannot be written, also from adding.
    """
    with _whole(path) as part:
        with _refused(path):
            stream = part.open("w", encoding="utf-8", newline="")
        table = csv.DictWriter(stream, CSV_COLUMNS, lineterminator="\n")

        def add(tracked: Tracked) -> None:
            with _refused(path):
                table.writerow(csv_record(tracked))

        try:
            with _refused(path):
                table.writeheader()
            yield add
        finally:
            with _refused(path):
                stream.close()


@contextmanager
def overlay_file(
    path: Path, camera: CameraModel, rate_hz: float
) -> Iterator[Callable[[float, Sketch], None]]:
    """Yields the function that adds a picture, drawn, at its time: H.264 in MP4, which browsers
    play.

    Each picture is shown from its own time on until the next one's, however irregular they are;
    the last one is shown for one period of `rate_hz`. The file gets its place as the block ends,
    and is removed where something fails within it. Errors: InvalidValue where it cannot be
    written, also from adding.
    """
    import av  # late: most runs write no video

    start_s, last = 0.0, -1
    # Players want even sizes: an odd one gets a line more.
    more_x, more_y = (n % 2 for n in camera.size_px)

    def add(t_s: float, sketch: Sketch) -> None:
        nonlocal start_s, last
        picture = draw_sketch(sketch, camera)
        picture = np.pad(picture, ((0, more_y), (0, more_x), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
        if last < 0:
            start_s = t_s
        # A time that does not rise, as of a clock that was set, counts as the next tick.
        last = max(round((t_s - start_s) * _TICKS_HZ), last + 1)
        frame.pts, frame.time_base = last, Fraction(1, _TICKS_HZ)
        with _refused(path):
            video.mux(stream.encode(frame))

    with _whole(path) as part:
        with _refused(path):
            # The index in front, so that a browser plays it before it has all of it.
            video = av.open(str(part), "w", options={"movflags": "faststart"})
            rate = Fraction(rate_hz).limit_denominator(1001)
            stream = video.add_stream("libx264", rate, options=_H264)
            stream.width, stream.height = camera.size_px[0] + more_x, camera.size_px[1] + more_y
            stream.pix_fmt = "yuv420p"
            stream.codec_context.time_base = Fraction(1, _TICKS_HZ)
            video.start_encoding()
        try:
            yield add
            with _refused(path):
                video.mux(stream.encode(None))
        finally:
            with _refused(path):
                video.close()


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """The name to write under: at the end it becomes `path`; after an error nothing is left."""
    with _refused(path):
        file = PartFile(path)
    try:
        yield file.part
        with _refused(path):
            file.sync()
            file.keep()
    finally:
        file.drop()


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Turns what the system, or FFmpeg, refuses within the block into InvalidValue."""
    try:
        yield
    except Exception as error:
        why = getattr(error, "strerror", None)
        if why is None:
            raise
        raise cannot_be_written(path, OSError(getattr(error, "errno", 0), why)) from None
