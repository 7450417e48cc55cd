"""From the profile's `camera.source` to an open frame source."""

from __future__ import annotations

from pathlib import Path

from perchctl.camera.aideck import FORM, AiDeckSource, aideck_address
from perchctl.camera.device import DeviceSource
from perchctl.camera.files import DEFAULT_RATE_HZ, IMAGE_SUFFIXES, ImagesSource, VideoSource
from perchctl.camera.mjpeg import MjpegSource
from perchctl.camera.source import Clock, FrameSource, LiveSource
from perchctl.errors import InvalidValue, NotFound, TimedOut

REAL = f"camera:N, video:FILE, images:DIR (or a pattern), http://HOST:PORT/PATH, {FORM}"
ALLOWED = f"{REAL}, sim:"

FIRST_FRAME_WITHIN_S = 8.0
SCHEMES = ("camera", "video", "images", "http", "https", "aideck", "sim")
RECORDED = ("video", "images")


def source_spec(source: str) -> str:
    """The source as `open_source` takes it; a bare path names a video, picture or folder.

    Errors: NotFound for a path that is not there.
    """
    if scheme_of(source) in SCHEMES:
        return source
    path = Path(source).expanduser()
    if path.is_dir() or any(c in source for c in "*?["):
        return f"images:{source}"
    if path.is_file():
        return f"{'images' if path.suffix.lower() in IMAGE_SUFFIXES else 'video'}:{source}"
    if scheme_of(source) and not path.suffix and "/" not in source:
        return source  # `open_source` names what is allowed
    raise NotFound(
        f"{source} does not exist; a source is a video, picture or folder of pictures, or "
        f"one of camera:N, video:FILE, images:DIR, http://HOST:PORT/PATH, {FORM}"
    )


def scheme_of(spec: str) -> str:
    """What stands before the colon; the empty string where there is none."""
    scheme, colon, _ = spec.partition(":")
    return scheme if colon else ""


def is_live(spec: str) -> bool:
    """Whether the source runs in real time (cameras and streams), else it is a recording."""
    return scheme_of(spec) not in RECORDED


def of_pictures(spec: str) -> bool:
    """Whether the source is files of pictures, which may or may not belong together."""
    return scheme_of(spec) == "images"


def open_source(
    spec: str,
    latency_s: float,
    size_px: tuple[int, int] | None,
    clock: Clock,
    timeout_s: float = FIRST_FRAME_WITHIN_S,
    pictures_hz: float = DEFAULT_RATE_HZ,
) -> FrameSource:
    """Open the source and wait for its first frame.

    Args:
        spec: one of `ALLOWED`; ``sim:`` belongs to the simulated vehicle, which
            resolves it to its own stream before this function is called.
        latency_s: time from exposure to arrival, taken off live frames' times.
        size_px: wanted width and height (requested of ``camera:N`` only).
        clock: the loop's clock, s.
        timeout_s: how long the first frame of a live source may take.
        pictures_hz: as if taken at this rate (``images:`` only).

    Raises:
        NotFound: no such camera, file or stream. InvalidValue: unknown scheme or
        unreadable content. TimedOut: no first frame in time.
    """
    scheme, _, rest = spec.partition(":")
    if scheme == "video" and rest:
        return VideoSource(Path(rest).expanduser(), latency_s)
    if scheme == "images" and rest:
        return ImagesSource(str(Path(rest).expanduser()), latency_s, pictures_hz)
    if scheme == "camera":
        if not (rest.isascii() and rest.isdigit()):
            raise InvalidValue(f"camera source {spec!r} lacks a camera number, as in camera:0")
        return _started(DeviceSource(int(rest), latency_s, size_px, clock), timeout_s)
    if scheme in ("http", "https") and rest.strip("/"):
        stream = MjpegSource(spec, latency_s, clock)
        try:
            return _started(stream, timeout_s)
        except TimedOut as error:
            if stream.not_found:
                raise NotFound(str(error)) from None
            raise
    if scheme == "aideck":
        return _started(AiDeckSource(aideck_address(spec), latency_s, clock), timeout_s)
    if spec == "sim:":
        raise InvalidValue(
            "camera source sim: is the simulated vehicle's camera and needs a link of sim://; "
            f"other sources are {REAL}"
        )
    raise InvalidValue(f"camera source {spec!r} is unknown; allowed are {ALLOWED}")


def _started(source: LiveSource, timeout_s: float) -> FrameSource:
    if source.wait_first(timeout_s):
        return source
    problem = source.problem(float("-inf"))
    described = source.describe()
    source.close()
    if problem is not None:
        raise TimedOut(f"no first frame: {problem}")
    raise TimedOut(
        f"{described}: no first frame within {timeout_s:g} s; is the camera powered, and its "
        f"receiver on the right channel?"
    )
