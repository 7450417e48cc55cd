"""Cameras of this computer: ``camera:N`` is /dev/videoN, read by a thread.

OpenCV delivers the pictures; the driver itself is asked what it is set to, and told what the
profile has fixed (`perchctl.camera.v4l2`). Without V4L2 the pictures come all the same.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2

from perchctl.camera.computer import cameras, listed
from perchctl.camera.controls import Wanted, set_controls, strayed_controls
from perchctl.camera.source import Clock, LiveSource
from perchctl.camera.v4l2 import (
    Call,
    Delivered,
    Mode,
    Opener,
    delivered_of,
    fourcc_text,
    modes_of,
    open_driver,
)
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import CameraConfig

LOST_AFTER_FAILURES = 25
RETRY_S = 0.04
RATE_TOLERANCE = 0.02
"""29.97 Hz are 30."""


@dataclass(frozen=True)
class Asked:
    """What is asked of the driver; None and an empty mapping leave it as it is."""

    size_px: tuple[int, int] | None = None
    format: str | None = None
    rate_hz: float | None = None
    controls: Wanted = field(default_factory=dict)


def asked_of(config: CameraConfig | None, size_px: tuple[int, int] | None) -> Asked:
    """The profile's wishes, at the calibration's size."""
    if config is None:
        return Asked(size_px)
    return Asked(size_px, config.format, config.rate_hz, config.controls)


def device_listing() -> list[str]:
    """The cameras that can be named: ``camera:0 (USB Video)``, ... (Linux)."""
    return [str(camera) for camera in cameras()]


def open_capture(number: int, asked: Asked) -> Any:
    """An opened cv2.VideoCapture; raises NotFound with what exists."""
    linux = sys.platform.startswith("linux")
    if not linux or Path(f"/dev/video{number}").exists():
        capture = cv2.VideoCapture(number, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
        if capture.isOpened():
            set_up(capture, asked)
            return capture
        capture.release()
        raise NotFound(
            f"camera:{number} exists but cannot be opened; close other programs that use it "
            f"and check that you may read /dev/video{number}"
        )
    known = cameras()
    there = f"there are {listed(known)}" if known else "no /dev/video* exists"
    raise NotFound(f"camera:{number} was not found; {there}; plug in the receiver or camera")


def set_up(capture: Any, asked: Asked) -> None:
    """Format, then size, then rate: what each may be hangs on the one before."""
    if asked.format is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*asked.format.ljust(4)))
    if asked.size_px is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, asked.size_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, asked.size_px[1])
    if asked.rate_hz is not None:
        capture.set(cv2.CAP_PROP_FPS, asked.rate_hz)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old frames waiting would add latency


def differences(asked: Asked, got: Delivered, modes: tuple[Mode, ...], source: str) -> list[str]:
    """A sentence for each wish that the driver did not fulfil, with what it has instead."""
    told = []
    if asked.format is not None and got.format and asked.format != got.format:
        has = ", ".join(dict.fromkeys(mode.format for mode in modes))
        told.append(
            f"{source} was asked for {asked.format} (camera.format) and gives {got.format}"
            + (f"; it has {has}" if has else "")
        )
    here = [mode for mode in modes if mode.format == got.format]
    if asked.size_px is not None and asked.size_px != got.size_px:
        has = ", ".join(dict.fromkeys("{}x{}".format(*m.size_px) for m in here if m.size_px))
        told.append(
            "{} was asked for {}x{} px, the calibration's, and gives {}x{} px".format(
                source, *asked.size_px, *got.size_px
            )
            + (f"; in {got.format} it has {has}" if has else "")
        )
    rate_hz = got.rate_hz
    if asked.rate_hz is not None and rate_hz and not _near(asked.rate_hz, rate_hz):
        rates = [hz for mode in here if mode.size_px == got.size_px for hz in mode.rates_hz]
        has = ", ".join(f"{hz:g}" for hz in rates)
        told.append(
            f"{source} was asked for {asked.rate_hz:g} Hz (camera.rate_hz) and gives "
            f"{rate_hz:.3g} Hz" + (f"; at this size and format it has {has} Hz" if has else "")
        )
    return told


def _near(one_hz: float, other_hz: float) -> bool:
    return abs(one_hz - other_hz) <= RATE_TOLERANCE * one_hz


class CaptureSource(LiveSource):
    """Keeps only the newest frame of what has read() and release(), as cv2.VideoCapture,
    stamped when the grab returns."""

    def __init__(
        self, name: str, latency_s: float, clock: Clock, capture: Any, retry_s: float = RETRY_S
    ) -> None:
        super().__init__(name, latency_s, clock)
        self._capture = capture
        self._retry_s = retry_s

    def begin(self) -> None:
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


class DeviceSource(CaptureSource):
    """A camera of this computer.

    `opened` replaces the real camera, anything with read(), get(), set() and release(), and
    `opener` its driver. Controls are set before the first picture, and once more after it where
    the driver has changed them when it began to stream.

    Errors: NotFound; InvalidValue, a control or format that the driver does not take.
    """

    _converted = True

    def __init__(
        self,
        number: int,
        latency_s: float,
        asked: Asked,
        clock: Clock,
        opened: Callable[[int, Asked], Any] = open_capture,
        opener: Opener = open_driver,
        retry_s: float = RETRY_S,
    ) -> None:
        super().__init__(f"camera:{number}", latency_s, clock, opened(number, asked), retry_s)
        self._asked = asked
        self._driver = lambda: opener(number)
        try:
            self._prepare()
        except BaseException:
            self._capture.release()
            raise
        self.begin()

    def _prepare(self) -> None:
        asked, source = self._asked, self._name
        if asked.format is None and not asked.controls:
            return
        try:
            with self._driver() as call:
                formats = dict.fromkeys(mode.format for mode in modes_of(call))
                if asked.format is not None and formats and asked.format not in formats:
                    raise InvalidValue(
                        f"{source} has no format {asked.format!r} (camera.format); it has "
                        f"{', '.join(formats)}"
                    )
                if asked.controls:
                    set_controls(call, asked.controls, source)
        except OSError as error:
            if asked.controls:
                raise InvalidValue(
                    f"{source}: camera.controls cannot be set, as its driver cannot be asked "
                    f"({error.strerror or error}); leave them out, or fix the exposure otherwise"
                ) from None

    def remarks(self) -> list[str]:
        """What the driver did not do as it was asked; to be asked once, after the first frame."""
        asked, told = self._asked, []
        try:
            with self._driver() as call:
                told = differences(asked, delivered_of(call), modes_of(call), self._name)
                told += self._controls_again(call)
        except OSError:
            with contextlib.suppress(cv2.error, AttributeError):
                told = differences(asked, self._without_driver(), (), self._name)
        return told

    def _without_driver(self) -> Delivered:
        """The size is the pictures': OpenCV is only asked for what they do not tell, as the
        grabbing thread is reading from it."""
        if self._asked.format is None and self._asked.rate_hz is None:
            return Delivered("", self._size_px or (0, 0), None)
        return _by_opencv(self._capture, self._size_px)

    def _controls_again(self, call: Call) -> list[str]:
        asked = self._asked.controls
        if not asked or not strayed_controls(call, asked, self._name):
            return []
        try:
            set_controls(call, asked, self._name)
        except InvalidValue as error:
            return [str(error)]
        return []


def _by_opencv(capture: Any, size_px: tuple[int, int] | None) -> Delivered:
    """What OpenCV says, where the driver cannot be asked; empty where it does not know either."""
    width, height = size_px or (0, 0)
    code, rate_hz = int(capture.get(cv2.CAP_PROP_FOURCC)), float(capture.get(cv2.CAP_PROP_FPS))
    return Delivered(fourcc_text(code) if code > 0 else "", (width, height), rate_hz or None)
