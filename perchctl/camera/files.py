"""Recorded frames: ``video:FILE`` and ``images:DIR``. No frame of a recording is dropped."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera.jpeg import decode_grey, jpeg_end_and_size
from perchctl.camera.source import without_password
from perchctl.errors import InvalidValue, NotFound
from perchctl.files import RECORDING, ROS_BAG, SQLITE, file_kind, kind_note
from perchctl.vision import Frame, to_grey

DEFAULT_RATE_HZ = 30.0
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp"})

_EXPORT_BAG = (
    "export its images to a folder, or play the bag and name the http:// stream of its images "
    "(docs/tracking.md)"
)
_ADVICE = {
    RECORDING: "write the images of a perchctl recording to a folder first "
    "(docs/after-a-flight.md), and name the folder",
    ROS_BAG: _EXPORT_BAG,
    SQLITE: _EXPORT_BAG,
}
"""How to get at the images in a file that contains some, but is neither a picture nor a video."""


def refuse_other_kinds(path: Path) -> None:
    """Raise InvalidValue if the content of a file shows that it is neither a picture nor a video,
    or if a folder is a ROS bag.

    FFmpeg would search a recording or bag for JPEGs, and play whatever it mistakes for frames:
    fragments of images, with made-up times.
    """
    if note := kind_note(path, "a picture", "a video"):
        shown, advice = without_password(str(path)), _ADVICE.get(file_kind(path), "")
        raise InvalidValue(f"{shown} is neither a picture nor a video{note}", advice)


class RecordedSource:
    """Base of the recorded sources; `_read` returns the next image and its time, or None.

    `rate_hz` is the nominal frame rate; `count` is the number of frames, or None if unknown.
    `paths`: the image files, in the order of their frames' indices; empty for a video.
    """

    live = False
    paths: Sequence[Path] = ()

    def __init__(self, name: str, latency_s: float, rate_hz: float, count: int | None) -> None:
        self.rate_hz, self.count = rate_hz, count
        self._name = name
        self._latency_s = latency_s
        self._index = 0
        # read one image ahead, so that the image size and the end are known before they are needed
        self._ahead = self._read()
        if self._ahead is None:
            raise InvalidValue(
                f"{name} contains no readable frame", "check that it is a picture or video file"
            )
        image = self._ahead[0]
        self.size_px = (image.shape[1], image.shape[0])

    @property
    def finished(self) -> bool:
        return self._ahead is None

    def poll(self, now_s: float) -> Frame | None:
        """Return the next frame, with its time in the recording; None at the end."""
        if self._ahead is None:
            return None
        image, t_s = self._ahead
        frame = Frame(self._index, t_s, image, t_s + self._latency_s)
        self._index += 1
        self._ahead = self._read()
        return frame

    def problem(self, now_s: float) -> str | None:
        return None

    def describe(self) -> str:
        return "{} ({}x{} px)".format(self._name, *self.size_px)

    def close(self) -> None:
        self._ahead = None

    def _read(self) -> tuple[NDArray[np.uint8], float] | None:
        raise NotImplementedError


class VideoSource(RecordedSource):
    """A video file. Frame times are those in the container if they increase; otherwise they are
    computed from the frame rate."""

    def __init__(self, path: Path, latency_s: float = 0.0) -> None:
        refuse_other_kinds(path)
        if not path.is_file():
            raise NotFound(f"video file {without_password(str(path))} was not found")
        # perchctl reports errors itself, in one sentence, so OpenCV must not print anything
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        # do not rotate the image: calibration and mask refer to the sensor's pixels
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        rate_hz, count = (
            float(self._capture.get(key)) if self._capture.isOpened() else 0.0
            for key in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_COUNT)
        )
        if not 0.1 < rate_hz < 1000.0:
            rate_hz = DEFAULT_RATE_HZ
        self._period_s = 1.0 / rate_hz
        self._last_s = -self._period_s
        name = f"video:{without_password(str(path))}"
        super().__init__(name, latency_s, rate_hz, round(count) if count > 0 else None)

    def _read(self) -> tuple[NDArray[np.uint8], float] | None:
        ok, image = self._capture.read()
        if not ok:
            self._capture.release()
            return None
        t_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0
        if not t_s > self._last_s:
            t_s = self._last_s + self._period_s
        self._last_s = t_s
        return to_grey(image), t_s

    def close(self) -> None:
        super().close()
        self._capture.release()


class ImagesSource(RecordedSource):
    """The images in a folder, those that match a glob, or those in a list, in natural order (2
    before 10), at `rate_hz`."""

    def __init__(
        self,
        where: str | Sequence[Path],
        latency_s: float = 0.0,
        rate_hz: float = DEFAULT_RATE_HZ,
    ) -> None:
        self.paths = image_files(where)
        self._next = 0
        named = where if isinstance(where, str) else self.paths[0]
        super().__init__(
            f"images:{without_password(str(named))}", latency_s, rate_hz, len(self.paths)
        )

    def _read(self) -> tuple[NDArray[np.uint8], float] | None:
        if self._next >= len(self.paths):
            return None
        path, t_s = self.paths[self._next], self._next / self.rate_hz
        self._next += 1
        try:
            return decode_picture(path.read_bytes()), t_s
        except (OSError, ValueError) as error:
            raise InvalidValue(f"{path} cannot be used ({error})", "remove or replace it") from None


def decode_picture(data: bytes) -> NDArray[np.uint8]:
    """Decode a file's bytes to a grey image on the sensor's grid, ignoring the orientation tag.

    Raises ValueError if the image is truncated or if OpenCV cannot read it.
    """
    # OpenCV's decoders would fill the rest with grey and print a warning without the file name.
    png_ends = not data.startswith(b"\x89PNG") or b"IEND" in data
    jpeg_ends = not data.startswith(b"\xff\xd8") or jpeg_end_and_size(data) is not None
    if not (png_ends and jpeg_ends):
        raise ValueError("is truncated")
    image = decode_grey(data)
    if image is None:
        raise ValueError("cannot be read as a picture")
    return image


def image_files(where: str | Sequence[Path]) -> list[Path]:
    """Return the files given by a folder, glob or list, without duplicates, in natural order.
    Errors: NotFound, InvalidValue."""
    if not isinstance(where, str):
        return sorted(set(where), key=_natural)
    folder = Path(where)
    if folder.is_file():
        refuse_other_kinds(folder)
        found = [folder]
    elif folder.is_dir():
        found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    else:
        names = (Path(name) for name in glob.glob(where))
        found = [p for p in names if p.is_file() and p.suffix.lower() in IMAGE_SUFFIXES]
        if not found:
            shown = without_password(where)
            raise NotFound(f"{shown} is neither a folder nor a pattern that matches pictures")
    if not found:
        refuse_other_kinds(folder)
        allowed = " ".join(sorted(IMAGE_SUFFIXES))
        raise NotFound(f"folder {where} contains no pictures ({allowed})")
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]
