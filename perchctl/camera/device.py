"""Cameras connected to this computer: ``camera:N`` is /dev/videoN, read by a thread through
OpenCV."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from perchctl.camera.source import Clock, LiveSource, describe_error
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import CameraConfig

PLUG_IN = "plug in the receiver or camera"
LOST_AFTER_FAILURES = 25
READ_RETRY_S = 0.04
REOPEN_EVERY_S = 1.0
"""Time between attempts to reopen a lost camera, s: each attempt keeps the driver busy for 0.1
s."""


def open_video_capture(
    place: str, size_px: tuple[int, int] | None, config: CameraConfig | None
) -> Any:
    """Return an opened cv2.VideoCapture of the camera that `place` names, set to `size_px` and to
    the format and rate of `config`. Raises NotFound, which lists the existing cameras."""
    number, linux = camera_number(place), sys.platform.startswith("linux")
    if linux and not Path(f"/dev/video{number}").exists():
        raise _not_found(str(number), _known_cameras(DEVICES, NAMES))
    capture = cv2.VideoCapture(number, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
    if not capture.isOpened():
        capture.release()
        if not linux:
            raise NotFound(
                f"camera:{number} cannot be opened",
                "plug it in, close other programs that use it, and allow the terminal to use "
                "cameras (in the system's privacy settings)",
            )
        raise NotFound(
            f"camera:{number} exists but cannot be opened",
            f"close other programs that use it, and check your permission to open "
            f"/dev/video{number}",
        )
    configure_capture(capture, size_px, config)
    return capture


def configure_capture(
    capture: Any, size_px: tuple[int, int] | None, config: CameraConfig | None
) -> None:
    """Set format, size and rate in this order, because each limits the next one."""
    if config is not None and config.format is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.format.ljust(4)))
    if size_px is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
    if config is not None and config.rate_hz is not None:
        capture.set(cv2.CAP_PROP_FPS, config.rate_hz)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # queued frames would add latency


class DeviceSource(LiveSource):
    """A camera connected to this computer. Only the newest frame is kept; its time stamp is the
    time at which OpenCV's `grab` returns.

    Bad images are dropped. After `LOST_AFTER_FAILURES` successive bad images or failed reads, the
    camera counts as lost: it is released, and reopened once it is available again. `opener`
    returns a cv2.VideoCapture.
    """

    silent_advice = (
        "for a receiver: check that the camera has power and that the receiver is on its channel"
    )
    unreached_advice = ""
    reconnect_wait_s = REOPEN_EVERY_S
    max_failures = math.inf
    retry_s = READ_RETRY_S

    def __init__(
        self, name: str, latency_s: float, clock: Clock, opener: Callable[[], Any]
    ) -> None:
        super().__init__(name, latency_s, clock)
        self._opener = opener

    def _connection(self) -> str:
        capture, failures = self._opener(), 0
        self._connected()
        try:
            while not self._stop.is_set():
                why = "stopped delivering frames"
                try:
                    ok, image = capture.read()
                    if ok:
                        self._put(image)
                        failures = 0
                        continue
                except Exception as error:  # whatever OpenCV raises for a damaged image
                    why = f"delivers pictures that cannot be decoded ({describe_error(error)})"
                    self._drop(f"decoding failed ({describe_error(error)})")
                failures += 1
                if failures >= LOST_AFTER_FAILURES:
                    raise NotFound(
                        f"{self._name} {why}", "plug it in again, or name another camera"
                    )
                self._stop.wait(self.retry_s)
            return "closed"
        finally:
            capture.release()


# --- The connected cameras: their numbers, names and permanent paths


DEVICES = Path("/dev")
NAMES = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class ConnectedCamera:
    """A camera connected to this computer.

    `stable_path`: a link that does not depend on the USB port, or empty; `problem`: why the camera
    cannot be opened, or empty.
    """

    number: int
    name: str = ""
    stable_path: str = ""
    problem: str = ""

    def __str__(self) -> str:
        name = f" ({self.name})" if self.name else ""
        path = f" at {self.stable_path}" if self.stable_path else ""
        return f"camera:{self.number}{name}{path}"


def find_cameras() -> list[ConnectedCamera]:
    """Return the connected cameras, sorted by number. Nothing is opened. Errors: NotFound if none
    is found, because there is none, or because the operating system does not list cameras as Linux
    does."""
    if cameras := _known_cameras(DEVICES, NAMES):
        return cameras
    raise _no_camera()


def _no_camera() -> NotFound:
    if sys.platform.startswith("linux"):
        return NotFound("this computer has no camera", PLUG_IN, separator=": ")
    return NotFound(
        "perchctl lists cameras only on Linux", "use a number, such as camera:0", separator=": "
    )


def _known_cameras(devices: Path, names: Path) -> list[ConnectedCamera]:
    """List each camera once, with its first video node, since its other nodes often deliver no
    images."""
    stable: dict[int, str] = {}
    for link in sorted((devices / "v4l" / "by-id").glob("*")):
        for number in _video_numbers([link.resolve()]):
            stable.setdefault(number, str(link))
    found = []
    for number in sorted(_video_numbers(devices.glob("video*"))):
        if _of_system(number, "index", names) in ("", "0"):
            may = os.access(devices / f"video{number}", os.R_OK | os.W_OK)
            problem = "" if may else "no permission to open it"
            name = _of_system(number, "name", names)
            found.append(ConnectedCamera(number, name, stable.get(number, ""), problem))
    return found


def _video_numbers(paths: Iterable[Path]) -> list[int]:
    numbers = (path.name.removeprefix("video") for path in paths)
    return [int(n) for n in numbers if n.isascii() and n.isdigit()]


def _of_system(number: int, attribute: str, names: Path) -> str:
    try:
        return (names / f"video{number}" / attribute).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def camera_number(text: str, devices: Path = DEVICES, names: Path = NAMES) -> int:
    """Return the number of the camera named by the text after ``camera:``. The text is a number, a
    name or part of a name (quotes and case do not matter), or a device path.

    Errors: InvalidValue if several cameras match; NotFound.
    """
    wanted = text.strip().strip("\"'").strip()
    if wanted.isascii() and wanted.isdigit():
        return int(wanted)
    known = _known_cameras(devices, names)
    if wanted.startswith("/"):
        fitting = [c for c in known if c.number in _video_numbers([Path(wanted).resolve()])]
    else:
        named = ((c, f"{c.name} {Path(c.stable_path).name}".casefold()) for c in known)
        fitting = [camera for camera, name in named if wanted.casefold() in name]
    if len(fitting) == 1:
        return fitting[0].number
    if fitting:
        raise InvalidValue(
            f"camera:{wanted} matches {len(fitting)} cameras: {', '.join(map(str, fitting))}",
            "write more of the name, or use the path or number",
        )
    raise _not_found(wanted, known)


def _not_found(wanted: str, known: list[ConnectedCamera]) -> NotFound:
    if not known:
        nothing = _no_camera()
        return NotFound(f"camera:{wanted} was not found; {nothing.found}", nothing.advice)
    there = ", ".join(map(str, known))
    return NotFound(f"camera:{wanted} was not found; connected cameras: {there}", PLUG_IN)
