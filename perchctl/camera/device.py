"""Cameras of this computer: ``camera:N`` is /dev/videoN, read by a thread."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from perchctl.camera.source import Clock, LiveSource
from perchctl.errors import NotFound

LOST_AFTER_FAILURES = 25
RETRY_S = 0.04


def device_listing() -> list[str]:
    """The cameras that can be named: ``camera:0``, ... (Linux)."""
    numbers = (p.name.removeprefix("video") for p in Path("/dev").glob("video*"))
    return [f"camera:{n}" for n in sorted(int(n) for n in numbers if n.isdigit())]


def open_capture(number: int, size_px: tuple[int, int] | None) -> Any:
    """An opened cv2.VideoCapture; raises NotFound with what exists."""
    linux = sys.platform.startswith("linux")
    if not linux or Path(f"/dev/video{number}").exists():
        capture = cv2.VideoCapture(number, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
        if capture.isOpened():
            if size_px is not None:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old frames waiting would add latency
            return capture
        capture.release()
        raise NotFound(
            f"camera:{number} exists but cannot be opened; close other programs that use it "
            f"and check that you may read /dev/video{number}"
        )
    known = device_listing()
    there = f"there are {', '.join(known)}" if known else "no /dev/video* exists"
    raise NotFound(f"camera:{number} was not found; {there}; plug in the receiver or camera")


class DeviceSource(LiveSource):
    """Keeps only the newest frame, stamped when the grab returns.

    `opened` replaces the real camera: anything with read() and release().
    """

    def __init__(
        self,
        number: int,
        latency_s: float,
        size_px: tuple[int, int] | None,
        clock: Clock,
        opened: Callable[[int, tuple[int, int] | None], Any] = open_capture,
        retry_s: float = RETRY_S,
    ) -> None:
        super().__init__(f"camera:{number}", latency_s, clock)
        self._capture = opened(number, size_px)
        self._retry_s = retry_s
        self._start(self._grab)

    def _grab(self) -> None:
        failures = 0
        try:
            while not self._stop.is_set():
                ok, image = self._capture.read()
                if ok:
                    failures = 0
                    self._put(image)
                    continue
                failures += 1
                if failures >= LOST_AFTER_FAILURES:
                    self._fail(f"{self._name} stopped delivering frames; is it unplugged?")
                    return
                self._stop.wait(self._retry_s)
        except cv2.error as error:
            self._fail(f"{self._name} failed while reading: {str(error).strip()}")
        finally:
            self._capture.release()
