"""`perchctl track`: the pipeline on any source, without a vehicle."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, TextIO

import typer

from perchctl.calibration import SizeMissing, load_calibration
from perchctl.camera import (
    FrameSource,
    Recording,
    WrappedSource,
    check_size,
    open_camera,
    parse_source,
    without_password,
)
from perchctl.commands.command_line import (
    CamOption,
    Command,
    ForceOption,
    ProfileOption,
    ViewOption,
    ViewPortOption,
    complete_source,
    examples,
    new_app,
    reporting,
)
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import say
from perchctl.commands.page import live_page, page_port
from perchctl.commands.progress import count_bar
from perchctl.display import AXES_OF_SIDE, LivePage, Sketch
from perchctl.errors import Interrupted, NotFound, UsageError
from perchctl.files import check_output, same_file
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.target import PrintCheck
from perchctl.track import (
    Notes,
    OutputOptions,
    Outputs,
    Tally,
    Tracked,
    Tracker,
    camera_pipeline,
    sketch_of,
    track_state,
)
from perchctl.vision import Frame

STILLS_HZ = 1.0
"""Of files of pictures that do not belong together: so each can be looked at, in the video too."""
POLL_S = 0.002
OPEN_PAGE_WITHIN_S = 60.0
"""How long a recording waits, on a terminal, for somebody to open the page."""


app = new_app()


@dataclass(frozen=True)
class TrackOptions:
    """The command line on top of the profile, checked. `source` as `open_camera` takes it;
    `stills`: each of its pictures for itself."""

    source: str
    profile: Profile
    calibration: Path
    cam: str | None
    stills: bool
    outputs: OutputOptions
    page_port: int | None


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl track camera:0 --view",
        "perchctl track video:flight.mp4 --overlay seen.mp4 --csv poses.csv",
        "perchctl track 'images:pictures/*.png' --json",
    ),
)
@reporting
def track(
    source: Annotated[
        str,
        typer.Argument(
            help="camera:N or its name, rtsp://..., http://..., aideck://HOST, video:FILE, "
            "images:DIR (or a pattern), or a path.",
            autocompletion=complete_source,
        ),
    ],
    profile: ProfileOption = "sim",
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration", help="Camera calibration (ROS, OpenCV or Kalibr); else the profile's."
        ),
    ] = None,
    cam: CamOption = None,
    stills: Annotated[
        bool,
        typer.Option(
            "--stills", help="Each picture alone, no window, no filter: as files of pictures are."
        ),
    ] = False,
    video: Annotated[
        bool, typer.Option("--video", help="The files are one video's pictures, at 30 Hz.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line a frame.")] = False,
    csv: Annotated[
        Path | None, typer.Option("--csv", help="Write the results as CSV, t_s first.")
    ] = None,
    overlay: Annotated[
        Path | None, typer.Option("--overlay", help="Write the pictures with results as .mp4.")
    ] = None,
    force: ForceOption = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
) -> int:
    """Find the target in a camera, video or pictures, without a vehicle.

    Poses are in the OpenCV camera frame with cv2.aruco's marker axes: X_cam = R(rvec) X_marker +
    tvec. A JSON line holds frame, t_s, stage (large, both, small, none), large and small (null,
    or corners_px TL TR BR BL, rvec_rad, tvec_m, reprojection_px) and target (null, or rvec_rad,
    tvec_m, yaw_rad, sigma_m, sigma_yaw_rad). With both markers in sight target is their joint
    pose; but for stills it is filtered, and goes on for a few frames after stage none.
    yaw_rad is atan2(R[1,0], R[0,0]): the marker's heading in the picture's plane. sigma_m is
    along the camera's x, y, z.
    """
    options = resolve(
        source, profile, calibration, cam, stills, video, as_json, csv, overlay, force,
        page_port(view, view_port),
    )  # fmt: skip
    track_source(options)
    return 0


def resolve(
    source: str,
    profile_name: str = "sim",
    calibration: Path | None = None,
    cam: str | None = None,
    stills: bool = False,
    video: bool = False,
    as_json: bool = False,
    csv: Path | None = None,
    overlay: Path | None = None,
    force: bool = False,
    port: int | None = None,
) -> TrackOptions:
    """What can be refused before anything is opened; None is not given. Errors: NotFound,
    InvalidValue, UsageError."""
    profile = load_profile(profile_name)
    source = parse_source(source, files=True).spec
    stills = _are_stills(source, stills, video)
    for path, suffix in ((csv, ".csv"), (overlay, ".mp4")):
        if path is not None:
            place = source.partition(":")[2]
            if place and same_file(path, Path(place).expanduser()):
                raise UsageError(f"{path} is the source itself; write the result to another file")
            check_output(path, (suffix,), force)
    if calibration is None:
        calibration = find_calibration(profile.camera.calibration)
        cam = cam or profile.camera.cam
    else:
        calibration = find_calibration(str(calibration))
    lines = as_json or not (csv or overlay or port is not None)
    outputs = OutputOptions(lines=lines, as_json=as_json, csv=csv, overlay=overlay)
    return TrackOptions(source, profile, calibration, cam, stills, outputs, port)


def _are_stills(source: str, stills: bool, video: bool) -> bool:
    """Files of pictures need not belong together, unless the user says so."""
    if video and stills:
        raise UsageError("--stills and --video contradict each other: give one of them")
    if video and not source.startswith("images:"):
        raise UsageError(
            f"--video is for files of pictures, and {source} gives a video anyway: leave it out"
        )
    return stills or (source.startswith("images:") and not video)


def track_source(
    options: TrackOptions,
    out: TextIO | None = None,
    clock: Callable[[], float] = time.monotonic,
    stopper: Stopper | None = None,
) -> Tally:
    """Track to the source's end. Results go to `out` (stdout), all else to stderr.

    Errors: NotFound (source, no frame at all), InvalidValue (sizes, ports, files),
    TimedOut (a silent camera), Interrupted (Ctrl-C; the files are complete).
    """
    start_s = clock()

    def now() -> float:
        return clock() - start_s

    with contextlib.ExitStack() as stack:
        stop = stopper or Stopper()
        run = _Run(options, now, sys.stdout if out is None else out, stop, stack)
        tally = run.tally
        tally.started_s = now()
        for frame in frames(run.input.source, now, stop, run.notes):
            run.take(frame)
        ended_s = now()
        if tally.frames == 0 and not stop.requested.is_set():
            raise NotFound(f"{run.input.source.describe()} gave no frame at all")
        run.outputs.close(keep=True)
    say(tally.text(ended_s))
    if run.prints.judged:
        say(run.prints.verdict().text)
    if stop.requested.is_set():
        raise Interrupted("Ctrl-C: stopped; what was written is complete")
    return tally


def frames(
    source: FrameSource, now: Callable[[], float], stop: Stopper, notes: Notes
) -> Iterator[Frame]:
    """A recording's every frame, a live source's newest ones, until the end or Ctrl-C."""
    while not stop.requested.is_set():
        now_s = now()
        frame = source.poll(now_s)
        if frame is not None:
            yield frame
            continue
        if source.finished:
            return
        # With no time passed nothing can be late: what is a problem even so is the end.
        if (gone := source.problem(-math.inf)) is not None:
            say(gone)
            return
        notes.silence(source.problem(now_s))
        stop.requested.wait(POLL_S)


@dataclass(frozen=True)
class _Input:
    """The open source. `paths` are those of pictures; a recording has a rate, and mostly a
    number of frames."""

    source: FrameSource
    paths: Sequence[Path]
    rate_hz: float | None
    count: int | None

    def frame_name(self, index: int) -> str | int:
        """How results name a frame."""
        return self.paths[index].name if self.paths else index

    def file_name(self, index: int) -> str:
        """How messages name the file that a frame is from."""
        return str(self.paths[index]) if self.paths else self.source.describe()


def _open(
    options: TrackOptions, size_px: tuple[int, int] | None, now: Callable[[], float]
) -> _Input:
    config = options.profile.camera
    pictures_hz = STILLS_HZ if options.stills else None
    source = open_camera(options.source, now, config, size_px=size_px, pictures_hz=pictures_hz)
    raw = source.inner if isinstance(source, WrappedSource) else source
    if isinstance(raw, Recording):
        return _Input(source, raw.paths, raw.rate_hz, raw.count)
    return _Input(source, (), None, None)


class _Run:
    """All that one run holds open, on the stack; `take` is what happens to a frame."""

    def __init__(
        self,
        options: TrackOptions,
        now: Callable[[], float],
        out: TextIO,
        stop: Stopper,
        stack: contextlib.ExitStack,
    ) -> None:
        camera = None
        with contextlib.suppress(SizeMissing):  # then the first picture's is taken
            camera = load_calibration(options.calibration, cam=options.cam)
        self.input = _open(options, None if camera is None else camera.size_px, now)
        source = self.input.source
        stack.callback(source.close)
        if camera is None:
            camera = load_calibration(options.calibration, source.size_px, options.cam)
        self.camera = camera
        check_size(source.size_px, camera, self.input.file_name(0))
        setup = camera_pipeline(options.profile, camera, options.stills)
        self.tally, self.notes = Tally(), Notes(say)
        self.prints = PrintCheck(camera, options.profile.target)
        self.outputs = Outputs(options.outputs, self.camera, self.input.rate_hz, out)
        stack.callback(self.outputs.close, keep=False)
        stack.enter_context(stop.installed())  # until here Ctrl-C ends at once
        self._tracker = Tracker(
            setup,
            live=source.live,
            stills=options.stills,
            disagreement_frames=options.profile.merge.disagreement_frames,
            camera=options.profile.camera,
        )
        self._axis_m = AXES_OF_SIDE * options.profile.target.large.side_m
        title = f"perchctl track {without_password(options.source)}"
        page = stack.enter_context(live_page(self.camera, title, options.page_port))
        bar = not source.live and not (options.outputs.lines and out.isatty())
        self._advance = stack.enter_context(count_bar("frames", self.input.count, bar))
        self._viewer = None if page is None else _Viewer(page, source.live, now, stop)

    def take(self, frame: Frame) -> None:
        """Track a frame, and hand the result to files, lines, page and tally."""
        size_px = (frame.image.shape[1], frame.image.shape[0])
        check_size(size_px, self.camera, self.input.file_name(frame.index))
        name = self.input.frame_name(frame.index)
        for tracked in self._tracker.results(frame, name):
            picture, notes = self._tracker.picture or frame, self._tracker.notes
            self.tally.add(tracked, notes)
            self.prints.add(self._tracker.output)
            self.notes.changes(name, notes)
            sketch = sketch_of(picture, tracked, self._axis_m)
            self.outputs.add(tracked, sketch, drawn=not self._tracker.more)
            if self._viewer is not None:
                self._viewer.show(picture, sketch, tracked, notes)
        self._advance()


class _Viewer:
    """Shows frames on the live page. A recording starts when the page is opened, and then
    runs as fast as it was recorded."""

    def __init__(self, page: LivePage, live: bool, now: Callable[[], float], stop: Stopper) -> None:
        self._page, self._live, self._now, self._stop = page, live, now, stop
        self._offset_s: float | None = None
        if not live:
            self._wait_for_reader()

    def show(self, frame: Frame, sketch: Sketch, tracked: Tracked, notes: tuple[str, ...]) -> None:
        self._page.show(frame.index, sketch)
        self._page.tell(partial(track_state, tracked, notes))
        if not self._live:
            self._keep_pace(frame.t_s)

    def _wait_for_reader(self) -> None:
        """Only where a person can be expected: on a terminal."""
        if not sys.stderr.isatty():
            return
        say("starts when the page is opened (Ctrl-C ends)")
        until_s = time.monotonic() + OPEN_PAGE_WITHIN_S
        while not (self._stop.requested.is_set() or self._page.opened.wait(0.1)):
            if time.monotonic() > until_s:
                return

    def _keep_pace(self, t_s: float) -> None:
        if self._offset_s is None:
            self._offset_s = self._now() - t_s
        left_s = t_s + self._offset_s - self._now()
        if left_s > 0.0:
            self._stop.requested.wait(left_s)
