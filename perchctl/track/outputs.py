"""Where the results of `perchctl track` go: lines, a CSV and a video."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TextIO

import numpy as np

from perchctl.display import Sketch, draw_sketch
from perchctl.files import PartFile, cannot_be_written
from perchctl.track.result import CSV_COLUMNS, Tracked, csv_row, text_line, text_rows, track_record
from perchctl.vision import CameraModel

LIVE_RATE_HZ = 30.0


@dataclass(frozen=True)
class OutputOptions:
    """What is written. `lines` go to stdout, as JSON or as text; paths are None for no file."""

    lines: bool = True
    as_json: bool = False
    csv: Path | None = None
    overlay: Path | None = None


class Outputs:
    """The lines on `out`, the CSV and the video of one run.

    Errors: InvalidValue for a file that cannot be written, also from `add` and `close`.
    """

    def __init__(
        self, options: OutputOptions, camera: CameraModel, rate_hz: float | None, out: TextIO
    ) -> None:
        """`rate_hz` of a recording; None for a live source."""
        self._options, self._out = options, out
        self._flush = rate_hz is None  # a live result is worth nothing late
        self._csv: CsvFile | None = None
        self._overlay: OverlayFile | None = None
        try:
            if options.csv:
                self._csv = CsvFile(options.csv)
            if options.overlay:
                self._overlay = OverlayFile(options.overlay, camera, rate_hz or LIVE_RATE_HZ)
        except BaseException:
            self.close(keep=False)
            raise

    def add(self, tracked: Tracked, sketch: Sketch, drawn: bool = True) -> None:
        """`drawn` false leaves the picture out of the video: of two fields, one is drawn."""
        if self._options.lines:
            line = (
                json.dumps(track_record(tracked), allow_nan=False)
                if self._options.as_json
                else text_line(tracked)
            )
            print(line, file=self._out, flush=self._flush)
        if self._csv is not None:
            self._csv.add(tracked)
        if self._overlay is not None and drawn:
            text = tuple(f"{name} {value}" for name, value in text_rows(tracked))
            self._overlay.add(tracked.t_s, replace(sketch, text=text))

    def close(self, keep: bool) -> None:
        """Put the files in their places, or remove them. A second call does nothing."""
        if self._csv is not None:
            csv, self._csv = self._csv, None
            csv.close(keep)
        if self._overlay is not None:
            overlay, self._overlay = self._overlay, None
            overlay.close(keep)


# --- Files of `perchctl track`: written under a temporary name, renamed when they are whole ----


_TICKS_HZ = 90_000  # of the video's times
_H264 = {"preset": "veryfast", "crf": "20", "bf": "0"}  # no frames out of order: times begin at 0


class _ResultFile:
    """A file that grows under a temporary name; `close` puts it in its place or removes it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = PartFile(path)
        except OSError as error:
            raise cannot_be_written(path, error) from None

    def close(self, keep: bool) -> None:
        """Errors: InvalidValue for a file that cannot be completed; it is then removed."""
        try:
            self._end(keep)
            if keep:
                self._file.sync()
                self._file.keep()
        except OSError as error:
            if keep:
                raise cannot_be_written(self._path, error) from None
        finally:
            self._file.drop()

    def _end(self, keep: bool) -> None:
        """Write what is left, if it is wanted, and close. Raises OSError."""
        raise NotImplementedError


class CsvFile(_ResultFile):
    """One row a frame, `t_s` first. Errors: InvalidValue where it cannot be written."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._stream = self._file.part.open("w", encoding="utf-8", newline="")
        except OSError as error:
            self._file.drop()
            raise cannot_be_written(path, error) from None
        self._writer = csv.writer(self._stream, lineterminator="\n")
        self._writer.writerow(CSV_COLUMNS)

    def add(self, tracked: Tracked) -> None:
        try:
            self._writer.writerow(csv_row(tracked))
        except OSError as error:
            raise cannot_be_written(self._path, error) from None

    def _end(self, keep: bool) -> None:
        self._stream.close()


class OverlayFile(_ResultFile):
    """The pictures with what was found, as H.264 in MP4, which browsers play.

    Each picture is shown from its own time on until the next one's, however irregular they are.

    Args:
        rate_hz: about how many pictures a second; the last one is shown for one of them.

    Errors: InvalidValue where it cannot be written, also from `add`.
    """

    def __init__(self, path: Path, camera: CameraModel, rate_hz: float) -> None:
        import av  # late: most runs write no video

        super().__init__(path)
        self._camera, self._start_s, self._last = camera, 0.0, -1
        try:
            with _as_os_error():
                # The index in front, so that a browser plays it before it has all of it.
                self._video = av.open(str(self._file.part), "w", options={"movflags": "faststart"})
                rate = Fraction(rate_hz).limit_denominator(1001)
                self._stream = self._video.add_stream("libx264", rate, options=_H264)
                # Players want even sizes: an odd one gets a line more.
                self._stream.width, self._stream.height = (n + n % 2 for n in camera.size_px)
                self._stream.pix_fmt = "yuv420p"
                self._stream.codec_context.time_base = Fraction(1, _TICKS_HZ)
                self._video.start_encoding()
        except OSError as error:
            self._file.drop()
            raise cannot_be_written(path, error) from None

    def add(self, t_s: float, sketch: Sketch) -> None:
        from av import VideoFrame

        picture = draw_sketch(sketch, self._camera)
        more_x, more_y = (size % 2 for size in self._camera.size_px)
        picture = np.pad(picture, ((0, more_y), (0, more_x), (0, 0)), mode="edge")
        frame = VideoFrame.from_ndarray(picture, format="bgr24")
        if self._last < 0:
            self._start_s = t_s
        # A time that does not rise, as of a clock that was set, counts as the next tick.
        self._last = max(round((t_s - self._start_s) * _TICKS_HZ), self._last + 1)
        frame.pts, frame.time_base = self._last, Fraction(1, _TICKS_HZ)
        try:
            with _as_os_error():
                self._video.mux(self._stream.encode(frame))
        except OSError as error:
            raise cannot_be_written(self._path, error) from None

    def _end(self, keep: bool) -> None:
        with _as_os_error():
            try:
                if keep:
                    self._video.mux(self._stream.encode(None))
            finally:
                self._video.close()


@contextmanager
def _as_os_error() -> Iterator[None]:
    from av import FFmpegError

    try:
        yield
    except FFmpegError as error:
        raise OSError(error.errno, error.strerror) from None
