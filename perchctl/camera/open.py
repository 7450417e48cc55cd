"""From the profile's `camera.source` to an open frame source."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
from cv2 import videoio_registry

from perchctl.camera.aideck import FORM, AiDeckSource, aideck_address
from perchctl.camera.computer import camera_number, finder_of
from perchctl.camera.credentials import without_password
from perchctl.camera.device import CaptureSource, DeviceSource, asked_of
from perchctl.camera.files import DEFAULT_RATE_HZ, IMAGE_SUFFIXES, ImagesSource, VideoSource
from perchctl.camera.mjpeg import MjpegSource
from perchctl.camera.rtsp import RtspSource
from perchctl.camera.source import Clock, FrameSource, LiveSource, mirrored_as_profiled
from perchctl.camera.stream import StreamSource
from perchctl.errors import CameraNote, InvalidValue, NotFound, TimedOut
from perchctl.profile import CameraConfig

REAL = (
    "camera:N, camera:NAME, video:FILE, images:DIR (or a pattern), http://HOST:PORT/PATH, "
    f"rtsp://HOST/PATH, {FORM}, gst:PIPELINE"
)
ALLOWED_SOURCES = f"{REAL}, sim:"

FIRST_FRAME_WITHIN_S = 8.0
SCHEMES = ("camera", "video", "images", "http", "https", "rtsp", "aideck", "gst", "sim")
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
    if "://" in source or (scheme_of(source) and not path.suffix and "/" not in source):
        return source  # `open_source` names what is allowed
    raise NotFound(
        f"{without_password(source)} does not exist; a source is a video, picture or folder of "
        f"pictures, or one of {REAL}"
    )


def scheme_of(spec: str) -> str:
    """What stands before the colon, in small letters; the empty string where there is none."""
    scheme, colon, _ = spec.partition(":")
    return scheme.lower() if colon else ""


def is_live(spec: str) -> bool:
    """Whether the source runs in real time (cameras and streams), else it is a recording."""
    return scheme_of(spec) not in RECORDED


def is_pictures(spec: str) -> bool:
    """Whether the source is files of pictures, which may or may not belong together."""
    return scheme_of(spec) == "images"


def note(sentence: str) -> None:
    """Warn: the command line prints it, and a program that uses the package may catch it."""
    warnings.warn(sentence, CameraNote, stacklevel=3)


def open_source(
    spec: str,
    latency_s: float,
    size_px: tuple[int, int] | None,
    clock: Clock,
    timeout_s: float = FIRST_FRAME_WITHIN_S,
    pictures_hz: float = DEFAULT_RATE_HZ,
    config: CameraConfig | None = None,
    tell: Callable[[str], None] = note,
) -> FrameSource:
    """Open the source and wait for its first frame.

    Args:
        spec: one of `ALLOWED_SOURCES`; ``sim:`` belongs to the simulated vehicle, which
            resolves it to its own stream before this function is called.
        latency_s: time from exposure to arrival, taken off live frames' times.
        size_px: wanted width and height (requested of ``camera:N`` only).
        clock: the loop's clock, s.
        timeout_s: how long the first frame of a live source may take.
        pictures_hz: as if taken at this rate (``images:`` only).
        config: whose format, rate and controls are asked of ``camera:``; if it says that the
            pictures are mirrored, each is turned right.
        tell: gets a sentence for each thing that the camera does not do as asked.

    Raises:
        NotFound: no such camera, file or stream. InvalidValue: unknown scheme,
        unreadable content, a control or format that the camera lacks. TimedOut: no
        first frame in time.
    """
    source = _opened(spec, latency_s, size_px, clock, timeout_s, pictures_hz, config, tell)
    return source if config is None else mirrored_as_profiled(source, config)


def _opened(
    spec: str,
    latency_s: float,
    size_px: tuple[int, int] | None,
    clock: Clock,
    timeout_s: float,
    pictures_hz: float,
    config: CameraConfig | None,
    tell: Callable[[str], None],
) -> FrameSource:
    scheme, rest = scheme_of(spec), spec.partition(":")[2]
    if scheme in SCHEMES:
        spec = f"{scheme}:{rest}"  # FFmpeg knows rtsp:// and not RTSP://
    if scheme == "video" and rest:
        return VideoSource(Path(rest).expanduser(), latency_s)
    if scheme == "images" and rest:
        return ImagesSource(str(Path(rest).expanduser()), latency_s, pictures_hz)
    if scheme == "camera":
        number = camera_number(rest)
        device = DeviceSource(
            number, latency_s, asked_of(config, size_px), clock, find=finder_of(number)
        )
        return _started(device, timeout_s, tell)
    if scheme == "gst" and rest.strip():
        name = without_password(spec)
        pipeline = CaptureSource(name, latency_s, clock, lambda: open_pipeline(rest))
        pipeline.begin()
        return _started(pipeline, timeout_s, tell)
    if (stream := _stream(spec, scheme, rest, latency_s, clock)) is not None:
        try:
            started = _started(stream, timeout_s, tell)
            _tell_unasked(spec, config, tell)
            return started
        except TimedOut as error:
            if stream.not_found:
                raise NotFound(str(error)) from None
            raise
    if spec == "sim:":
        raise InvalidValue(
            "camera source sim: is the simulated vehicle's camera and needs a link of sim://; "
            f"other sources are {REAL}"
        )
    shown = without_password(spec)
    raise InvalidValue(f"camera source {shown!r} is unknown; allowed are {ALLOWED_SOURCES}")


def _stream(
    spec: str, scheme: str, rest: str, latency_s: float, clock: Clock
) -> StreamSource | None:
    if scheme == "aideck":
        return AiDeckSource(aideck_address(spec), latency_s, clock)
    kinds: dict[str, Callable[[str, float, Clock], StreamSource]]
    kinds = {"http": MjpegSource, "https": MjpegSource, "rtsp": RtspSource}
    if scheme not in kinds or not rest.strip("/"):
        return None
    port: int | str | None = None
    try:
        parts = urlsplit(spec)
        host = parts.hostname if rest.startswith("//") else None
        try:
            port = parts.port
        except ValueError:
            port = parts.netloc.rpartition(":")[2]
            host = None if "@" in spec else host  # part of a password, it may be
    except ValueError:
        host = None
    if not host:
        raise InvalidValue(
            f"camera source {without_password(spec)!r} lacks a host that can be read, as in "
            f"{scheme}://192.168.1.20/stream; in a name or password @ is %40, : is %3A, / is %2F"
        )
    if port == 0 or isinstance(port, str):
        raise InvalidValue(
            f"camera source {without_password(spec)!r} has port {port}; allowed are 1 to 65535, "
            f"as in {scheme}://{host}:{_USUAL_PORT[scheme]}/stream, or none for the usual one"
        )
    return kinds[scheme](spec, latency_s, clock)


_USUAL_PORT = {"http": 80, "https": 443, "rtsp": 554}


def _tell_unasked(spec: str, config: CameraConfig | None, tell: Callable[[str], None]) -> None:
    """What the profile asks of a driver, and no network camera has."""
    keys = {} if config is None else {"format": config.format, "controls": config.controls}
    given = [f"camera.{key}" for key, value in keys.items() if value]
    if given:
        verb = "is" if len(given) == 1 else "are"
        tell(
            f"{' and '.join(given)} {verb} not used with {without_password(spec)}: only camera: "
            f"sources have a driver to ask; set that in the camera itself"
        )


def _started(source: LiveSource, timeout_s: float, tell: Callable[[str], None]) -> FrameSource:
    if source.wait_first(timeout_s):
        for sentence in source.remarks():
            tell(sentence)
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


# --- ``gst:PIPELINE``: what GStreamer makes of it, where this OpenCV was built with it ---------


READ_TIMEOUT_MS = 2000


def has_gstreamer() -> bool:
    return bool(videoio_registry.hasBackend(cv2.CAP_GSTREAMER))


def open_pipeline(text: str) -> Any:
    """An opened cv2.VideoCapture.

    Errors: InvalidValue, this OpenCV has no GStreamer; NotFound, the pipeline does not run.
    """
    if not has_gstreamer():
        raise InvalidValue(
            f"gst: needs an OpenCV that was built with GStreamer, and this one ({cv2.__version__}) "
            f"was not, as none from pip is; name the camera by rtsp://..., http://... or camera:N"
        )
    capture = cv2.VideoCapture(
        text,
        cv2.CAP_GSTREAMER,
        [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS],
    )
    if not capture.isOpened():
        capture.release()
        raise NotFound(
            f"the pipeline gst:{without_password(text)} does not run; try it with gst-launch-1.0, "
            f"and let it end in appsink drop=true max-buffers=1 sync=false"
        )
    return capture
