"""Open a frame source from its name in a profile or on the command line."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from perchctl.camera.aideck import AiDeckSource
from perchctl.camera.device import DeviceSource, camera_number, open_video_capture
from perchctl.camera.files import (
    DEFAULT_RATE_HZ,
    IMAGE_SUFFIXES,
    ImagesSource,
    VideoSource,
    refuse_other_kinds,
)
from perchctl.camera.network import MjpegSource, RtspSource
from perchctl.camera.source import (
    Clock,
    FrameSource,
    GuardedSource,
    LiveSource,
    WrappedSource,
    unmirror_frame,
    without_password,
)
from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.extensions import is_extension, make_extension
from perchctl.profile import CameraConfig

REAL = (
    "camera:N, camera:NAME, video:FILE, images:DIR (or a pattern), http://HOST:PORT/PATH, "
    "rtsp://HOST/PATH, aideck://HOST[:5000]"
)
STREAMS: dict[str, Callable[[str, float, Clock], LiveSource]] = {
    "http": MjpegSource,
    "https": MjpegSource,
    "rtsp": RtspSource,
    "aideck": AiDeckSource,
}
SCHEMES = ("camera", "video", "images", "sim", *STREAMS)
FIRST_FRAME_WITHIN_S = 8.0


@dataclass(frozen=True)
class SourceName:
    """A parsed source text. `scheme`: one of `SCHEMES`; `place`: the text after the colon. `str()`
    leaves out the password."""

    scheme: str
    place: str

    @property
    def spec(self) -> str:
        """The text that `open_camera` takes, with its password."""
        return f"{self.scheme}:{self.place}"

    @property
    def live(self) -> bool:
        """True for cameras and streams, which run in real time; False for recordings."""
        return self.scheme not in ("video", "images")

    @property
    def is_own(self) -> bool:
        """True for a camera of your own, ``my_module:MyCamera``."""
        return self.scheme not in SCHEMES

    @property
    def device(self) -> str:
        """Return the same text for all names of a connected camera (its number, its name, or a
        path). If the camera is not connected, return the given text, but with its number instead of
        a path such as /dev/video0. Nothing is opened."""
        if self.scheme != "camera":
            return str(self)
        try:
            return f"camera:{camera_number(self.place)}"
        except PerchError:
            number = re.fullmatch(r"/dev/video([0-9]+)", self.place.strip())
            return f"camera:{int(number[1])}" if number else str(self)

    def __str__(self) -> str:
        return without_password(self.spec)


def parse_source(text: str) -> SourceName:
    """Parse a source text: a scheme (in upper or lower case) and a place, the bare path of a video,
    image, pattern or folder, or a camera of your own, ``my_module:MyCamera``. Nothing is opened.

    Errors: InvalidValue for an unknown scheme or a stream without a host; NotFound for a bare path
    that does not exist.
    """
    scheme, colon, place = text.partition(":")
    name = SourceName(scheme.lower() if colon else "", place)
    if name.scheme in STREAMS:
        _check_address(name)
    if name.scheme in SCHEMES:
        return name  # FFmpeg knows rtsp:// but not RTSP://
    path, shown = Path(text).expanduser(), without_password(text)
    if path.is_dir() or any(c in text for c in "*?["):
        return SourceName("images", text)
    if path.is_file():
        refuse_other_kinds(path)
        return SourceName("images" if path.suffix.lower() in IMAGE_SUFFIXES else "video", text)
    if is_extension(text):
        return SourceName(scheme, place)
    if name.scheme:
        raise InvalidValue(
            f"camera source {shown!r} is unknown",
            f"allowed are {REAL}, sim:, or my_module:MyCamera with my_module in {Path.cwd()}",
        )
    raise NotFound(
        f"{shown} does not exist",
        f"a source is a video, a picture, a folder of pictures, or one of {REAL}",
    )


def _check_address(name: SourceName) -> None:
    """Raise InvalidValue for a URL without host or with a wrong port."""
    try:
        parts = urlsplit(name.spec)
        is_right = name.place.startswith("//") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        is_right = False
    if not is_right:
        raise InvalidValue(
            f"camera source {str(name)!r} has no valid host and port, as in "
            f"{name.scheme}://192.168.1.20:5000/stream; a port is 1 to 65535",
            "in a user name or password write @ as %40, : as %3A and / as %2F",
        )


def open_camera(
    source: str | Sequence[Path],
    clock: Clock = time.monotonic,
    config: CameraConfig | None = None,
    *,
    size_px: tuple[int, int] | None = None,
    latency_s: float | None = None,
    pictures_hz: float | None = None,
    timeout_s: float | None = None,
) -> FrameSource:
    """Open any source and wait for its first frame.

    Args:
        source: a text for `parse_source`, or a list of image files. ``sim:`` is not allowed: the
            caller passes the address of the simulated vehicle's stream instead. For
            ``my_module:MyCamera``, the class is called with `clock` and `config`.
        clock: the clock for the frames' times, s.
        config: the profile's section `camera`. Its latency is subtracted from the times of live
            frames, its format and rate are requested from a ``camera:`` source, and mirrored images
            are flipped back.
        size_px: width and height to request (``camera:`` only).
        latency_s: time from exposure to arrival, instead of the one in `config` (0 without a
            `config`).
        pictures_hz: rate at which the images are assumed to have been taken (``images:`` only; 30
            by default).
        timeout_s: time limit for the first frame of a live source, instead of the profile's.

    Raises:
        NotFound: there is no such camera, file or stream, or it cannot be reached.
        InvalidValue: the scheme is unknown, or the content is unreadable.
        TimedOut: no frame arrived in time.
    """
    if latency_s is None:
        latency_s = 0.0 if config is None else config.start_latency_s
    if timeout_s is None:
        timeout_s = FIRST_FRAME_WITHIN_S if config is None else config.start_timeout_s
    pictures_hz = DEFAULT_RATE_HZ if pictures_hz is None else pictures_hz
    opened: FrameSource
    if not isinstance(source, str):
        opened = ImagesSource(source, latency_s, pictures_hz)
    else:
        name = parse_source(source)
        if name.scheme == "video" and name.place:
            opened = VideoSource(Path(name.place).expanduser(), latency_s)
        elif name.is_own:
            own = make_extension(name.spec, "camera.source", FrameSource, clock, config)
            opened = checked = GuardedSource(own, name.spec, clock)
            checked.wait_first_frame(timeout_s)
        elif name.scheme == "images" and name.place:
            opened = ImagesSource(str(Path(name.place).expanduser()), latency_s, pictures_hz)
        else:
            live = _live(name, latency_s, size_px, clock, config)
            opened = _started(live, timeout_s)
    is_mirrored = config is not None and config.mirrored
    return WrappedSource(opened, unmirror_frame) if is_mirrored else opened


def _live(
    name: SourceName,
    latency_s: float,
    size_px: tuple[int, int] | None,
    clock: Clock,
    config: CameraConfig | None,
) -> LiveSource:
    if name.scheme == "camera":
        opener = partial(open_video_capture, name.place, size_px, config)
        return DeviceSource(str(name), latency_s, clock, opener)
    if name.scheme in STREAMS:
        return STREAMS[name.scheme](name.spec, latency_s, clock)
    raise InvalidValue(
        f"camera source {str(name)!r} is not a camera or file",
        f"allowed are {REAL}, and sim: with the link sim://",
    )


def _started(source: LiveSource, timeout_s: float) -> FrameSource:
    """Wait for the first frame. If the source fails, close it and raise its error, or TimedOut."""
    source.begin()
    if source.wait_first_frame(timeout_s):
        return source
    error = source.failure or source.no_first_frame(timeout_s)
    source.close()
    raise error
