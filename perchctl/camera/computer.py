"""The cameras of this computer: their numbers, names, lasting paths, and what they can."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from perchctl.camera.v4l2 import (
    CameraControl,
    Mode,
    Opener,
    card_of,
    controls_of,
    modes_of,
    open_driver,
    value_of,
)
from perchctl.errors import InvalidValue, NotFound

DEVICES = Path("/dev")
NAMES = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class ConnectedCamera:
    """`stable_path` names it wherever it is plugged in, where the system keeps such a link;
    `problem` says why the driver was not asked for modes and controls."""

    number: int
    name: str = ""
    stable_path: str = ""
    modes: tuple[Mode, ...] = ()
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

    `asked`: also for modes and controls. Opens each for a moment, streams from none.
    """
    stable = _stable_paths(devices)
    found = []
    for number in camera_numbers(devices):
        name, problem = _name_of(number, names), ""
        modes: tuple[Mode, ...] = ()
        controls: tuple[tuple[CameraControl, int | None], ...] = ()
        try:
            with opener(number) as call:
                name, gives_pictures = card_of(call)
                if not gives_pictures:
                    continue
                if asked:
                    modes = modes_of(call)
                    controls = tuple((c, _read(call, c)) for c in controls_of(call).values())
        except OSError as error:
            problem = f"it cannot be asked: {error.strerror or error}"
        found.append(
            ConnectedCamera(number, name, stable.get(number, ""), modes, controls, problem)
        )
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
