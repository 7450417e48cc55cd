"""Cameras of this computer: ``camera:N`` is /dev/videoN, read by a thread through OpenCV."""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from perchctl.camera.source import Clock, LiveSource, one_line
from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.profile import CameraConfig

LOST_AFTER_FAILURES = 25
RETRY_S = 0.04
REOPEN_EVERY_S = 1.0
"""Between two attempts to open a camera that was lost: an attempt takes a driver some 0.1 s."""


@dataclass(frozen=True)
class Asked:
    """Picture size, format and rate that are asked of the driver; None leaves it as it is."""

    size_px: tuple[int, int] | None = None
    format: str | None = None
    rate_hz: float | None = None


def asked_of(config: CameraConfig | None, size_px: tuple[int, int] | None) -> Asked:
    """Return what the profile asks of a driver, at the calibration's size."""
    return Asked(size_px) if config is None else Asked(size_px, config.format, config.rate_hz)


def open_capture(number: int, asked: Asked) -> Any:
    """Return an opened cv2.VideoCapture; raises NotFound with the cameras that exist."""
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
    known = find_cameras()
    there = f"there are {listed(known)}" if known else "no /dev/video* exists"
    raise NotFound(f"camera:{number} was not found; {there}; plug in the receiver or camera")


def set_up(capture: Any, asked: Asked) -> None:
    """Set format, then size, then rate, as what each may be hangs on the one before."""
    if asked.format is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*asked.format.ljust(4)))
    if asked.size_px is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, asked.size_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, asked.size_px[1])
    if asked.rate_hz is not None:
        capture.set(cv2.CAP_PROP_FPS, asked.rate_hz)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old frames waiting would add latency


class DeviceSource(LiveSource):
    """A camera of this computer: only the newest frame is kept, stamped when the grab returns.

    A picture that cannot be read or decoded is dropped. After `LOST_AFTER_FAILURES` in a row the
    camera counts as lost: it is released, and opened again as soon as it is back. One that has
    never given a picture fails at once. `open_number` replaces the real camera by anything with
    read(), get(), set() and release().

    Errors: NotFound.
    """

    def __init__(
        self,
        number: int,
        latency_s: float,
        asked: Asked,
        clock: Clock,
        open_number: Callable[[int, Asked], Any] = open_capture,
        retry_s: float = RETRY_S,
        reopen_every_s: float = REOPEN_EVERY_S,
        find: Callable[[], int] | None = None,
    ) -> None:
        """`find` gives the camera's number once it is back; without it that is the same one."""
        super().__init__(f"camera:{number}", latency_s, clock)
        self._number = number
        self._find = find
        self._asked = asked
        self._open_number = open_number
        self._retry_s = retry_s
        self._reopen_every_s = reopen_every_s
        self._capture = open_number(number, asked)
        self._start(self._grab)

    def _grab(self) -> None:
        try:
            while (why := self._read_until_lost()) is not None:
                if self._count == 0:
                    self._fail(f"{self._name} {why}; plug it in again, or name another camera")
                    return
                self._capture.release()
                self._reopen(why)
        finally:
            self._capture.release()

    def _read_until_lost(self) -> str | None:
        """Return why the camera counts as lost; None if the source was closed."""
        failures = 0
        while not self._stop.is_set():
            why = "stopped delivering frames"
            try:
                ok, image = self._capture.read()
                if ok:
                    self._put(image)
                    failures = 0
                    continue
            except Exception as error:  # whatever a damaged picture does to OpenCV
                why = f"gives pictures that cannot be decoded ({one_line(error)})"
            failures += 1
            if failures >= LOST_AFTER_FAILURES:
                return why
            self._stop.wait(self._retry_s)
        return None

    def _reopen(self, why: str) -> None:
        """Try until the camera is open, or the source is closed."""
        lost = f"it {why}, and is opened again every {self._reopen_every_s:g} s"
        self._why_silent = lost
        while not self._stop.wait(self._reopen_every_s):
            try:
                if self._find is not None:
                    self._number = self._find()
                self._capture = self._open_number(self._number, self._asked)
                return
            except Exception as error:
                reason = str(error) if isinstance(error, PerchError) else one_line(error)
                self._why_silent = f"{lost}; the last attempt: {reason}"


# --- The cameras of this computer: their numbers, names and lasting paths


DEVICES = Path("/dev")
NAMES = Path("/sys/class/video4linux")

# VIDIOC_QUERYCAP of videodev2.h, and its structure's two words of capabilities.
_QUERYCAP = 0x80685600
_CAPABILITY = struct.Struct("=84xII12x")
_HAS_DEVICE_CAPS, _VIDEO_CAPTURE = 0x80000000, 1


@dataclass(frozen=True)
class ConnectedCamera:
    """`stable_path` names it wherever it is plugged in, where the system keeps such a link;
    `problem` says why it cannot be opened."""

    number: int
    name: str = ""
    stable_path: str = ""
    problem: str = ""

    @property
    def source(self) -> str:
        return f"camera:{self.number}"

    def __str__(self) -> str:
        return f"{self.source} ({self.name})" if self.name else self.source


def find_cameras(devices: Path = DEVICES, names: Path = NAMES) -> list[ConnectedCamera]:
    """Return this computer's cameras by their numbers.

    A camera may have nodes that give no pictures: they are left out. Opens each node for a moment,
    and streams from none.
    """
    stable: dict[int, str] = {}
    for link in sorted((devices / "v4l" / "by-id").glob("*")):
        for number in _video_numbers([link.resolve()]):
            stable.setdefault(number, str(link))
    found = []
    for number in sorted(_video_numbers(devices.glob("video*"))):
        if not _gives_pictures(number, devices, names):
            continue
        may = os.access(devices / f"video{number}", os.R_OK | os.W_OK)
        problem = "" if may else "you may not open it: Permission denied"
        name = _of_system(number, "name", names)
        found.append(ConnectedCamera(number, name, stable.get(number, ""), problem))
    return found


def _video_numbers(paths: Iterable[Path]) -> list[int]:
    """Return the N of each path that is a videoN."""
    numbers = (path.name.removeprefix("video") for path in paths)
    return [int(n) for n in numbers if n.isascii() and n.isdigit()]


def _gives_pictures(number: int, devices: Path, names: Path) -> bool:
    """Return whether a node's driver says that it captures video. Of a camera whose driver cannot
    be asked only the first node counts."""
    data = bytearray(_CAPABILITY.size)
    try:
        import fcntl  # late: Windows has none

        node = os.open(devices / f"video{number}", os.O_RDWR | os.O_NONBLOCK)
        try:
            fcntl.ioctl(node, _QUERYCAP, data, True)
        finally:
            os.close(node)
    except (ImportError, OSError):
        return _of_system(number, "index", names) in ("", "0")
    of_all_nodes, of_this = _CAPABILITY.unpack(data)
    return bool((of_this if of_all_nodes & _HAS_DEVICE_CAPS else of_all_nodes) & _VIDEO_CAPTURE)


def _of_system(number: int, attribute: str, names: Path) -> str:
    """Return an attribute of a camera by the system's own list; empty where it has none."""
    try:
        return (names / f"video{number}" / attribute).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def camera_number(text: str, devices: Path = DEVICES, names: Path = NAMES) -> int:
    """Return the N of what stands behind ``camera:``: a number, a name or a part of one (quotes
    and capitals do not matter), or a path of the device.

    Errors: InvalidValue, nothing given, or several that fit; NotFound.
    """
    wanted = text.strip().strip("\"'").strip()
    if wanted.isascii() and wanted.isdigit():
        return int(wanted)
    if not wanted or wanted.lstrip("-").isdigit():
        raise InvalidValue(
            f"camera source 'camera:{text}' lacks a camera's number or name, as in camera:0 or "
            f"camera:USB Video; perchctl check --cameras lists them"
        )
    known = find_cameras(devices, names)
    fitting = _fitting(wanted, known)
    if len(fitting) == 1:
        return fitting[0].number
    if fitting:
        raise InvalidValue(
            f"camera:{wanted} fits {len(fitting)} cameras: {listed(fitting, paths=True)}; give "
            f"more of the name, the path, or the number"
        )
    there = f"there are {listed(known)}" if known else "this computer has no camera"
    raise NotFound(f"camera:{wanted} was not found; {there}; plug in the receiver or camera")


def finder_of(number: int, devices: Path = DEVICES, names: Path = NAMES) -> Callable[[], int]:
    """Return a function that finds the camera of that number again after it was unplugged: by its
    lasting path, else by its name, as the system may give it another number.

    Errors of that function: NotFound.
    """
    before = next((c for c in find_cameras(devices, names) if c.number == number), None)

    def find() -> int:
        if before is None or not (before.stable_path or before.name):
            return number
        known = find_cameras(devices, names)
        back = [c.number for c in known if c.stable_path and c.stable_path == before.stable_path]
        if not back and not before.stable_path:
            back = [c.number for c in known if c.name == before.name]
        if number in back:
            return number
        if len(back) == 1:
            return back[0]
        there = f"there are {listed(known, paths=True)}" if known else "no camera is there"
        raise NotFound(f"{before} is not back; {there}")

    return find


def _fitting(wanted: str, known: Sequence[ConnectedCamera]) -> list[ConnectedCamera]:
    """Return those that fit by the whole name, else by a part of it or of the path."""
    low = wanted.casefold()
    if wanted.startswith("/"):
        device = Path(wanted).resolve().name
        return [c for c in known if wanted == c.stable_path or device == f"video{c.number}"]
    whole = [c for c in known if c.name.casefold() == low]
    return whole or [
        c for c in known if low in c.name.casefold() or low in Path(c.stable_path).name.casefold()
    ]


def listed(known: Sequence[ConnectedCamera], paths: bool = False) -> str:
    """Name the cameras in a sentence."""
    return ", ".join(
        f"{c} at {c.stable_path}" if paths and c.stable_path else str(c) for c in known
    )
