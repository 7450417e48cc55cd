"""Cameras of this computer: ``camera:N`` is /dev/videoN, read by a thread.

OpenCV delivers the pictures; the driver itself sets what the profile has fixed
(`perchctl.camera.v4l2`). Without V4L2 the pictures come all the same.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2

from perchctl.camera.source import Clock, LiveSource, one_line
from perchctl.camera.v4l2 import (
    Call,
    CameraControl,
    Opener,
    card_of,
    controls_of,
    open_driver,
    set_value,
    value_of,
)
from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.profile import CameraConfig

LOST_AFTER_FAILURES = 25
RETRY_S = 0.04
REOPEN_EVERY_S = 1.0
"""Between two attempts to open a camera that was lost: an attempt takes a driver some 0.1 s."""
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
    known = find_cameras()
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


class DeviceSource(LiveSource):
    """A camera of this computer: only the newest frame is kept, stamped when the grab returns.

    `opened` replaces the real camera, anything with read(), get(), set() and release(), and
    `opener` its driver. Controls are set before the first picture and once more after it, since
    some drivers reset them when they begin to stream. A picture that cannot be read or decoded is
    dropped. After `LOST_AFTER_FAILURES` in a row the camera counts as lost: it is released, and
    opened again as soon as it is back. One that has never given a picture fails at once.

    Errors: NotFound; InvalidValue, a control that the driver does not take.
    """

    def __init__(
        self,
        number: int,
        latency_s: float,
        asked: Asked,
        clock: Clock,
        opened: Callable[[int, Asked], Any] = open_capture,
        opener: Opener = open_driver,
        retry_s: float = RETRY_S,
        reopen_every_s: float = REOPEN_EVERY_S,
        find: Callable[[], int] | None = None,
    ) -> None:
        """`find` gives the camera's number once it is back; without it that is the same one."""
        super().__init__(f"camera:{number}", latency_s, clock)
        self._number = number
        self._find = find
        self._asked = asked
        self._open_number = opened
        self._opener = opener
        self._retry_s = retry_s
        self._reopen_every_s = reopen_every_s
        self._format, self._rate_hz = "", 0.0
        self._reopened = False
        self._capture = self._prepared()
        self._start(self._grab)

    def _prepared(self) -> Any:
        """The opened camera, with its controls set."""
        capture = self._open_number(self._number, self._asked)
        try:
            with contextlib.suppress(cv2.error, AttributeError):  # before a thread reads from it
                code = int(capture.get(cv2.CAP_PROP_FOURCC))
                self._format = _fourcc_text(code) if code > 0 else ""
                self._rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
            self._set_controls()
        except BaseException:
            capture.release()
            raise
        return capture

    def _set_controls(self) -> None:
        """Errors: InvalidValue."""
        if not self._asked.controls:
            return
        try:
            with self._opener(self._number) as call:
                set_controls(call, self._asked.controls, self._name)
        except OSError as error:
            raise InvalidValue(
                f"{self._name}: camera.controls cannot be set, as its driver cannot be asked "
                f"({error.strerror or error}); leave them out, or fix the exposure otherwise"
            ) from None

    def remarks(self) -> list[str]:
        """What the driver did not do as it was asked; to be asked once, after the first frame."""
        asked, got = self._asked, f"{self._name} was asked for"
        told = []
        if asked.format is not None and self._format not in ("", asked.format):
            told.append(f"{got} {asked.format} (camera.format) and gives {self._format}")
        if asked.size_px is not None and self._size_px not in (None, asked.size_px):
            wanted, given = ("{}x{} px".format(*size) for size in (asked.size_px, self._size_px))
            told.append(f"{got} {wanted}, the calibration's, and gives {given}")
        if asked.rate_hz is not None and self._rate_hz > 0.0:
            off_hz = abs(asked.rate_hz - self._rate_hz)
            if off_hz > RATE_TOLERANCE * asked.rate_hz:
                gives = f"{self._rate_hz:.3g} Hz"
                told.append(f"{got} {asked.rate_hz:g} Hz (camera.rate_hz) and gives {gives}")
        try:
            self._set_controls()
        except InvalidValue as error:
            told.append(str(error))
        return told

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
                    if self._reopened:
                        self._reopened = False
                        with contextlib.suppress(InvalidValue):
                            self._set_controls()
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
                self._capture = self._prepared()
                self._reopened = True
                return
            except Exception as error:
                reason = str(error) if isinstance(error, PerchError) else one_line(error)
                self._why_silent = f"{lost}; the last attempt: {reason}"


def _fourcc_text(code: int) -> str:
    """Of a pixel format's number: ``MJPG``, ``YUYV``, ..."""
    return code.to_bytes(4, "little").decode("ascii", "replace").rstrip("\0 ")


# --- `camera.controls`: exposure, white balance, gain and focus as the profile has them --------


Wanted = Mapping[str, int | str]


def set_controls(call: Call, wanted: Wanted, source: str) -> None:
    """Set them, switches and menus first: an automatic one holds others fast. Read back.

    Errors: InvalidValue, a control that the driver lacks, a value that it does not take, one
    that did not stay; OSError.
    """
    controls = controls_of(call)
    values = {name: _value(controls, name, value, source) for name, value in wanted.items()}
    for name in sorted(values, key=lambda name: controls[name].kind == "integer"):
        try:
            set_value(call, controls[name], values[name])
        except OSError as error:
            raise InvalidValue(
                f"{source}: camera.controls.{name} could not be set to {values[name]} "
                f"({error.strerror}){_held(call, name)}; change it, or leave it out"
            ) from None
    for name, number in values.items():
        reads = value_of(call, controls[name])
        if reads != number:
            raise InvalidValue(
                f"{source}: camera.controls.{name} was set to {number} and reads "
                f"{reads}{_held(call, name)}; change it, or leave it out"
            )


def _held(call: Call, name: str) -> str:
    control = controls_of(call).get(name)
    if control is None or not control.inactive:
        return ""
    return " while an automatic control has it: fix that one in camera.controls, too"


def _value(controls: Mapping[str, CameraControl], name: str, value: int | str, source: str) -> int:
    control = controls.get(name)
    if control is None:
        has = f"it has {', '.join(controls)}" if controls else "its driver has none at all"
        raise InvalidValue(f"{source} has no control {name!r} (camera.controls); {has}")
    key = f"{source}: camera.controls.{name}"
    if not control.settable:
        raise InvalidValue(f"{key} can only be read; leave it out")
    if control.menu and isinstance(value, str):
        texts = {text.lower(): index for index, text in control.menu}
        value = texts.get(value.lower(), value)
    if (
        isinstance(value, str)
        or not control.low <= value <= control.high
        or (value - control.low) % max(control.step, 1)
        or (control.menu and value not in dict(control.menu))
    ):
        raise InvalidValue(f"{key}: found {value!r}; allowed are {control.allowed}")
    return value


# --- The cameras of this computer: their numbers, names, lasting paths and controls


DEVICES = Path("/dev")
NAMES = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class ConnectedCamera:
    """`stable_path` names it wherever it is plugged in, where the system keeps such a link;
    `problem` says why the driver was not asked for controls."""

    number: int
    name: str = ""
    stable_path: str = ""
    controls: tuple[tuple[CameraControl, int | None], ...] = ()
    problem: str = ""

    @property
    def source(self) -> str:
        return f"camera:{self.number}"

    def __str__(self) -> str:
        return f"{self.source} ({self.name})" if self.name else self.source


def camera_numbers(devices: Path = DEVICES) -> list[int]:
    """Of /dev/videoN; a camera may have nodes beside it that give no pictures."""
    numbers = (path.name.removeprefix("video") for path in devices.glob("video*"))
    return sorted(int(n) for n in numbers if n.isascii() and n.isdigit())


def find_cameras(
    opener: Opener = open_driver, devices: Path = DEVICES, names: Path = NAMES, asked: bool = False
) -> list[ConnectedCamera]:
    """Those that give pictures; a node that cannot be asked counts as one.

    `asked`: also for its controls. Opens each for a moment, streams from none.
    """
    stable = _stable_paths(devices)
    found = []
    for number in camera_numbers(devices):
        name, problem = _name_of(number, names), ""
        controls: tuple[tuple[CameraControl, int | None], ...] = ()
        try:
            with opener(number) as call:
                name, gives_pictures = card_of(call)
                if not gives_pictures:
                    continue
                if asked:
                    controls = tuple((c, _read(call, c)) for c in controls_of(call).values())
        except OSError as error:
            problem = f"it cannot be asked: {error.strerror or error}"
        found.append(ConnectedCamera(number, name, stable.get(number, ""), controls, problem))
    return found


def _read(call: Callable[[int, bytearray], None], control: CameraControl) -> int | None:
    try:
        return value_of(call, control)
    except OSError:
        return None


def _name_of(number: int, names: Path) -> str:
    """From the system's own list, which needs no right to open the camera."""
    try:
        return (names / f"video{number}" / "name").read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _stable_paths(devices: Path) -> dict[int, str]:
    found: dict[int, str] = {}
    for link in sorted((devices / "v4l" / "by-id").glob("*")):
        number = link.resolve().name.removeprefix("video")
        if number.isascii() and number.isdigit():
            found.setdefault(int(number), str(link))
    return found


def camera_number(
    text: str, opener: Opener = open_driver, devices: Path = DEVICES, names: Path = NAMES
) -> int:
    """The N of what stands behind ``camera:``: a number, a name or a part of one (quotes and
    capitals do not matter), or a path of the device.

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
    known = find_cameras(opener, devices, names)
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


def finder_of(
    number: int, opener: Opener = open_driver, devices: Path = DEVICES, names: Path = NAMES
) -> Callable[[], int]:
    """A function that finds the camera of that number again after it was unplugged: by its
    lasting path, else by its name, as the system may give it another number.

    Errors of that function: NotFound.
    """
    before = next((c for c in find_cameras(opener, devices, names) if c.number == number), None)

    def find() -> int:
        if before is None or not (before.stable_path or before.name):
            return number
        known = find_cameras(opener, devices, names)
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
    """By the whole name, else by a part of it or of the path."""
    low = wanted.casefold()
    if wanted.startswith("/"):
        device = Path(wanted).resolve().name
        return [c for c in known if wanted == c.stable_path or device == f"video{c.number}"]
    whole = [c for c in known if c.name.casefold() == low]
    return whole or [
        c for c in known if low in c.name.casefold() or low in Path(c.stable_path).name.casefold()
    ]


def listed(known: Sequence[ConnectedCamera], paths: bool = False) -> str:
    """For a sentence."""
    return ", ".join(
        f"{c} at {c.stable_path}" if paths and c.stable_path else str(c) for c in known
    )
