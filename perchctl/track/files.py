"""Files of `perchctl track`: written under a temporary name, renamed when they are whole."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2

from perchctl.display.page.sketch import Sketch, draw
from perchctl.errors import InvalidValue
from perchctl.files import PartFile, cannot_be_written
from perchctl.track.result import CSV_COLUMNS, Tracked, csv_row
from perchctl.vision.types import CameraModel

LIVE_RATE_HZ = 30.0
_LONGEST_STILL_S = 10.0  # a live source's pause is kept in the video up to this


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
            self._end()
            if keep:
                self._file.sync()
                self._file.keep()
        except OSError as error:
            if keep:
                raise cannot_be_written(self._path, error) from None
        finally:
            self._file.drop()

    def _end(self) -> None:
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

    def _end(self) -> None:
        self._stream.close()


class OverlayFile(_ResultFile):
    """The pictures with what was found, as MPEG-4 video.

    Args:
        rate_hz: of a recording, each of whose frames is written once. None for a live
            source: frames are then repeated so that the video runs as fast as it was seen.
    """

    def __init__(self, path: Path, camera: CameraModel, rate_hz: float | None) -> None:
        super().__init__(path)
        self._camera = camera
        self._live = rate_hz is None
        self._rate_hz = rate_hz or LIVE_RATE_HZ
        self._start_s: float | None = None
        self._written = 0
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        self._video = cv2.VideoWriter(
            str(self._file.part), fourcc, self._rate_hz, camera.size_px, True
        )
        if not self._video.isOpened():
            self._file.drop()
            raise InvalidValue(
                f"{path} cannot be written as an MPEG-4 video; is the disk writable?"
            )

    def add(self, t_s: float, sketch: Sketch) -> None:
        picture = draw(sketch, self._camera)
        for _ in range(self._due(t_s)):
            self._video.write(picture)
            self._written += 1

    def _end(self) -> None:
        self._video.release()

    def _due(self, t_s: float) -> int:
        if not self._live:
            return 1
        if self._start_s is None:
            self._start_s = t_s
        due = math.floor((t_s - self._start_s) * self._rate_hz) + 1 - self._written
        longest = round(_LONGEST_STILL_S * self._rate_hz)
        if due > longest:
            self._start_s += (due - longest) / self._rate_hz
        return min(max(due, 0), longest)
