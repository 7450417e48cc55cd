"""The work behind `perchctl track`: the pipeline on any source, without a vehicle."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TextIO

import cv2

from perchctl.calibration.files import load_calibration
from perchctl.camera.files import DEFAULT_RATE_HZ, IMAGE_SUFFIXES, ImagesSource
from perchctl.camera.mirror import UnmirroredSource
from perchctl.camera.open import open_source
from perchctl.camera.source import FrameSource, check_size
from perchctl.commands.interrupt import Stopper
from perchctl.commands.progress import count_bar
from perchctl.display.page.flight import AXES_OF_SIDE
from perchctl.display.page.live import LivePage
from perchctl.display.page.sketch import Sketch
from perchctl.errors import Interrupted, NotFound, UsageError
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.track.files import CsvFile, OverlayFile, check_output
from perchctl.track.result import Tracked, record_of, text_line, text_rows
from perchctl.track.tracker import (
    Notes,
    PrintCheck,
    Tally,
    Tracker,
    camera_pipeline,
    sketch_of,
    track_state,
)
from perchctl.vision.types import CameraModel, Frame

POLL_S = 0.002
OPEN_PAGE_WITHIN_S = 60.0
"""How long a recording waits, on a terminal, for somebody to open the page."""
_SCHEMES = ("camera:", "video:", "images:", "http://", "https://", "sim:")


@dataclass(frozen=True)
class TrackOptions:
    """What the command line asked for, on top of the profile."""

    source: str
    profile: Profile
    calibration: Path
    stills: bool = False
    as_json: bool = False
    csv: Path | None = None
    overlay: Path | None = None
    view: bool = False
    view_port: int = 0


def resolve(
    source: str,
    profile_name: str,
    calibration: Path | None,
    *,
    stills: bool = False,
    as_json: bool = False,
    csv: Path | None = None,
    overlay: Path | None = None,
    view: bool = False,
    view_port: int = 0,
) -> TrackOptions:
    """The command line on top of the profile. Errors: NotFound, InvalidValue, UsageError."""
    profile = load_profile(profile_name)
    spec = source_spec(source)
    for path, suffix in ((csv, ".csv"), (overlay, ".mp4")):
        if path is not None:
            check_output(path, suffix)
            if path.exists() and spec.partition(":")[2] and _same(path, spec):
                raise UsageError(f"{path} is the source itself; write the result to another file")
    if calibration is None:
        file = find_calibration(profile.camera.calibration)
    else:
        file = find_calibration(str(calibration))
    return TrackOptions(spec, profile, file, stills, as_json, csv, overlay, view, view_port)


def source_spec(source: str) -> str:
    """The source as `open_source` takes it; a bare path names a video, picture or folder.

    Errors: NotFound for a path that is not there.
    """
    if source.startswith(_SCHEMES):
        return source
    path = Path(source).expanduser()
    if path.is_dir() or any(c in source for c in "*?["):
        return f"images:{source}"
    if path.is_file():
        return f"{'images' if path.suffix.lower() in IMAGE_SUFFIXES else 'video'}:{source}"
    if path.suffix or "/" in source:
        raise NotFound(
            f"{source} does not exist; a source is a video, picture or folder of pictures, or "
            f"one of camera:N, video:FILE, images:DIR, http://HOST:PORT/PATH"
        )
    return source  # `open_source` says what is allowed


def _same(path: Path, spec: str) -> bool:
    named = Path(spec.partition(":")[2]).expanduser()
    return named.exists() and named.samefile(path)


def run(
    options: TrackOptions,
    out: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
    stopper: Stopper | None = None,
) -> Tally:
    """Track to the source's end. Results go to `out` (stdout), all else to stderr.

    Errors: NotFound (source, no frame at all), InvalidValue (sizes, ports, files),
    TimedOut (a silent camera), Interrupted (Ctrl-C; the files are complete).
    """
    out = sys.stdout if out is None else out
    camera = load_calibration(options.calibration)
    setup = camera_pipeline(options.profile, camera, options.stills)
    start_s = clock()
    tally = Tally()

    def now() -> float:
        return clock() - start_s

    with contextlib.ExitStack() as stack:
        config = options.profile.camera
        raw = open_source(options.source, config.latency_s, camera.size_px, now)
        source: FrameSource = UnmirroredSource(raw) if config.mirrored else raw
        stack.callback(source.close)
        paths = raw.paths if isinstance(raw, ImagesSource) else None
        name = str(paths[0]) if paths else source.describe()
        check_size(source.size_px, camera, name)
        count, rate_hz = _length(options.source, paths, source.live)
        sinks = _Sinks(options, camera, rate_hz, out, stack)
        stop = stack.enter_context((stopper or Stopper()).installed())
        page = _page(options, camera, stack)
        tracker = Tracker(
            setup,
            live=source.live,
            stills=options.stills,
            recorded_stills=paths is not None,
            disagreement_frames=options.profile.merge.disagreement_frames,
        )
        show_bar = (count is not None or not source.live) and not (
            sinks.lines_shown and out.isatty()
        )
        advance = stack.enter_context(count_bar("frames", count, show_bar))
        pace = _Pace(now) if page is not None and not source.live else None
        if page is not None and not source.live:
            _await_reader(page, stop)
        prints = PrintCheck(camera, options.profile.target)
        say = Notes()
        axis_m = AXES_OF_SIDE * options.profile.target.large.side_m
        tally.started_s = now()
        for frame in frames(source, now, stop, say):
            shown = paths[frame.index].name if paths else frame.index
            file = str(paths[frame.index]) if paths else source.describe()
            check_size((frame.image.shape[1], frame.image.shape[0]), camera, file)
            tracked = tracker.track(frame, shown)
            if tracked is None:
                continue
            tally.add(tracked, tracker.notes)
            prints.add(tracker.output)
            say.changes(shown, tracker.notes)
            sketch = sketch_of(frame, tracked, axis_m)
            sinks.add(tracked, sketch)
            if page is not None:
                page.show(frame.index, sketch)
                page.tell(partial(track_state, tracked, tracker.notes))
            if pace is not None:
                pace.wait_until(frame.t_s, stop)
            advance()
        ended_s = now()
        if tally.frames == 0 and not stop.asked.is_set():
            raise NotFound(f"{source.describe()} gave no frame at all")
        sinks.keep()
    print(f"perchctl: {tally.text(ended_s)}", file=sys.stderr)
    if prints.judged:
        print(f"perchctl: {prints.verdict().text}", file=sys.stderr)
    if stop.asked.is_set():
        raise Interrupted("Ctrl-C: stopped; what was written is complete")
    return tally


def frames(
    source: FrameSource, now: Callable[[], float], stop: Stopper, say: Notes
) -> Iterator[Frame]:
    """A recording's every frame, a live source's newest ones, until the end or Ctrl-C."""
    while not stop.asked.is_set():
        now_s = now()
        frame = source.poll(now_s)
        if frame is not None:
            yield frame
            continue
        if source.finished:
            return
        # With no time passed nothing can be late: what is a problem even so is the end.
        if (gone := source.problem(-math.inf)) is not None:
            say.line(gone)
            return
        say.silence(source.problem(now_s) is not None, source.describe())
        stop.asked.wait(POLL_S)


class _Sinks:
    """Where results go: lines on `out`, CSV, video. Files that are not kept are removed."""

    def __init__(
        self,
        options: TrackOptions,
        camera: CameraModel,
        rate_hz: float | None,
        out: TextIO,
        stack: contextlib.ExitStack,
    ) -> None:
        self._out, self._as_json = out, options.as_json
        self._flush = rate_hz is None  # a live result is worth nothing late
        wanted_elsewhere = options.csv or options.overlay or options.view
        self.lines_shown = options.as_json or not wanted_elsewhere
        self._csv = CsvFile(options.csv) if options.csv else None
        stack.callback(self._close)
        self._overlay: OverlayFile | None = None
        if options.overlay:
            self._overlay = OverlayFile(options.overlay, camera, rate_hz)

    def add(self, tracked: Tracked, sketch: Sketch) -> None:
        if self._as_json:
            line = json.dumps(record_of(tracked), allow_nan=False)
            print(line, file=self._out, flush=self._flush)
        elif self.lines_shown:
            print(text_line(tracked), file=self._out, flush=self._flush)
        if self._csv is not None:
            self._csv.add(tracked)
        if self._overlay is not None:
            text = tuple(f"{name} {value}" for name, value in text_rows(tracked))
            self._overlay.add(tracked.t_s, replace(sketch, text=text))

    def keep(self) -> None:
        self._close(keep=True)

    def _close(self, keep: bool = False) -> None:
        csv, overlay, self._csv, self._overlay = self._csv, self._overlay, None, None
        if csv is not None:
            csv.close(keep)
        if overlay is not None:
            overlay.close(keep)


class _Pace:
    """Lets a recording that is looked at run as fast as it was recorded."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._offset_s: float | None = None

    def wait_until(self, t_s: float, stop: Stopper) -> None:
        if self._offset_s is None:
            self._offset_s = self._now() - t_s
        left_s = t_s + self._offset_s - self._now()
        if left_s > 0.0:
            stop.asked.wait(left_s)


def _page(
    options: TrackOptions, camera: CameraModel, stack: contextlib.ExitStack
) -> LivePage | None:
    if not options.view:
        return None
    page = LivePage(camera, f"perchctl track {_public(options.source)}", options.view_port)
    stack.callback(_close_page, page)
    print(f"perchctl: live page: {page.url}", file=sys.stderr)
    return page


def _close_page(page: LivePage) -> None:
    page.close()
    if page.problem is not None:
        print(f"perchctl: the live page failed: {page.problem}", file=sys.stderr)


def _public(source: str) -> str:
    """The source without the name and password that a stream's address may hold."""
    scheme, slashes, rest = source.partition("://")
    host, slash, path = rest.partition("/")
    return f"{scheme}{slashes}{host.rpartition('@')[2]}{slash}{path}" if slashes else source


def _await_reader(page: LivePage, stop: Stopper) -> None:
    """On a terminal a recording starts when its page is opened; else at once."""
    if not sys.stderr.isatty():
        return
    print("perchctl: starts when the page is opened (Ctrl-C ends)", file=sys.stderr)
    until_s = time.monotonic() + OPEN_PAGE_WITHIN_S
    while not (stop.asked.is_set() or page.opened.wait(0.1) or time.monotonic() > until_s):
        pass


def _length(spec: str, paths: list[Path] | None, live: bool) -> tuple[int | None, float | None]:
    """Frames (None: unknown) and frames a second (None: live) of a source."""
    if live:
        return None, None
    if paths is not None:
        return len(paths), DEFAULT_RATE_HZ
    capture = cv2.VideoCapture(str(Path(spec.partition(":")[2]).expanduser()), cv2.CAP_FFMPEG)
    try:
        count, rate_hz = (
            float(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS)
        )
    finally:
        capture.release()
    return (
        round(count) if count > 0 else None,
        rate_hz if 0.1 < rate_hz < 1000.0 else DEFAULT_RATE_HZ,
    )
