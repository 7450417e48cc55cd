"""Files of `perchctl track`: written under a temporary name, renamed when they are whole."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2

from perchctl.display.page.sketch import Sketch, draw
from perchctl.errors import InvalidValue, NotFound
from perchctl.track.result import CSV_COLUMNS, Tracked, csv_row
from perchctl.vision.types import CameraModel

LIVE_RATE_HZ = 30.0
_LONGEST_STILL_S = 10.0  # a live source's pause is kept in the video up to this


def check_output(path: Path, suffix: str) -> None:
    """Whether a file can be made there. Errors: InvalidValue (name), NotFound (folder)."""
    if path.suffix.lower() != suffix:
        raise InvalidValue(f"{path} must end in {suffix}, which is the format that is written")
    if path.is_dir():
        raise InvalidValue(f"{path} is a folder; name a file in it")
    if not path.parent.is_dir():
        raise NotFound(f"folder {path.parent} for {path.name} does not exist; create it first")


class _Part:
    """The temporary file beside the wanted one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(f".{path.stem}.part{path.suffix}")

    def keep(self) -> None:
        self.part.replace(self.path)

    def drop(self) -> None:
        self.part.unlink(missing_ok=True)


class CsvFile:
    """One row a frame, `t_s` first. Errors: InvalidValue where it cannot be written."""

    def __init__(self, path: Path) -> None:
        check_output(path, ".csv")
        self._file = _Part(path)
        try:
            self._stream = self._file.part.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise InvalidValue(f"{path} cannot be written: {error.strerror}") from None
        self._writer = csv.writer(self._stream, lineterminator="\n")
        self._writer.writerow(CSV_COLUMNS)

    def add(self, tracked: Tracked) -> None:
        self._writer.writerow(csv_row(tracked))

    def close(self, keep: bool) -> None:
        self._stream.close()
        if keep:
            self._file.keep()
        else:
            self._file.drop()


class OverlayFile:
    """The pictures with what was found, as MPEG-4 video.

    Args:
        rate_hz: of a recording, each of whose frames is written once. None for a live
            source: frames are then repeated so that the video runs as fast as it was seen.
    """

    def __init__(self, path: Path, camera: CameraModel, rate_hz: float | None) -> None:
        check_output(path, ".mp4")
        self._file = _Part(path)
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

    def close(self, keep: bool) -> None:
        self._video.release()
        if keep:
            self._file.keep()
        else:
            self._file.drop()

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
