"""`perchctl track`: the pipeline on any source, without a vehicle."""

from __future__ import annotations

import contextlib
import json
import math
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from perchctl.calibration import SizeMissing, load_calibration
from perchctl.camera import (
    FrameSource,
    Recording,
    WrappedSource,
    check_size,
    mirrored_note,
    open_camera,
    parse_source,
    without_password,
)
from perchctl.commands.command_line import (
    CamOption,
    ForceOption,
    ProfileOption,
    ViewOption,
    ViewPortOption,
    command,
    new_app,
)
from perchctl.commands.guide import page_port
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import say
from perchctl.commands.progress import count_bar
from perchctl.commands.track_output import (
    CameraPose,
    Tracked,
    camera_pose,
    csv_file,
    overlay_file,
    text_line,
    text_rows,
    track_record,
    track_sketch,
    track_state,
)
from perchctl.display import AXES_OF_SIDE, live_page
from perchctl.errors import Interrupted, NotFound, UsageError
from perchctl.files import check_output, same_file
from perchctl.perception import Perception
from perchctl.places import is_shipped_example
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.target import PrintCheck
from perchctl.vision import (
    CameraModel,
    Frame,
    PipelineOutput,
    camera_profile,
    make_pipeline,
)

LIVE_RATE_HZ = 30.0
"""Of the video that is written of a live source: about how many pictures a second it gives."""
STILLS_HZ = 1.0
"""Of files of pictures that do not belong together: so each can be looked at, in the video too."""
POLL_S = 0.002
MOST_NOTES = 20
# A live picture that stands still or is noise is no measurement; the others are searched.
_NO_PICTURE = ("frozen", "snow")
INTERLACED = "interlaced: the two fields of a frame are measured each for itself"
_DISAGREE = "the two markers contradict: check the print's sizes and the calibration"

app = new_app()


@command(
    app,
    "perchctl track camera:0 --view",
    "perchctl track video:flight.mp4 --overlay seen.mp4 --csv poses.csv",
    "perchctl track 'images:pictures/*.png' --json",
)
def track(
    source: Annotated[
        str,
        typer.Argument(
            help="camera:N or its name, rtsp://..., http://..., aideck://HOST, video:FILE, "
            "images:DIR (or a pattern), or a path."
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
        bool | None,
        typer.Option(
            "--stills/--video",
            help="Each picture alone, no window, no filter, as files of pictures are tracked; or "
            "all as one video's, files at 30 Hz.",
        ),
    ] = None,
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
) -> None:
    """Find the target in a camera, video or pictures, without a vehicle.

    Poses are in the OpenCV camera frame with cv2.aruco's marker axes: X_cam = R(rvec) X_marker +
    tvec. A JSON line holds frame, t_s, stage (large, both, small, none), large and small (null,
    or corners_px TL TR BR BL, rvec_rad, tvec_m, reprojection_px) and target (null, or rvec_rad,
    tvec_m, yaw_rad, sigma_m, sigma_yaw_rad). With both markers in sight target is their joint
    pose; but for stills it is filtered, and goes on for a few frames after stage none.
    yaw_rad is atan2(R[1,0], R[0,0]): the marker's heading in the picture's plane. sigma_m is
    along the camera's x, y, z.
    """
    flown = load_profile(profile)
    source = parse_source(source, files=True).spec
    if stills is None:  # files of pictures need not belong together
        stills = source.startswith("images:")
    for path, suffix in ((csv, ".csv"), (overlay, ".mp4")):
        if path is not None:
            place = source.partition(":")[2]
            if place and same_file(path, Path(place).expanduser()):
                raise UsageError(f"{path} is the source itself; write the result to another file")
            check_output(path, (suffix,), force)
    if calibration is None:
        cam = cam or flown.camera.cam
    file = find_calibration(str(calibration or flown.camera.calibration))
    port = page_port(view, view_port)
    lines = as_json or not (csv or overlay or port is not None)
    start_s = time.monotonic()

    def now() -> float:
        return time.monotonic() - start_s

    stop, summary = Stopper(), TrackSummary()
    with contextlib.ExitStack() as stack:
        opened, camera = _open(source, flown, file, cam, stills, now)
        stack.callback(opened.close)
        recording = opened.inner if isinstance(opened, WrappedSource) else opened
        paths: Sequence[Path] = ()
        rate_hz = count = None
        if isinstance(recording, Recording):
            paths, rate_hz, count = recording.paths, recording.rate_hz, recording.count
        is_example = is_shipped_example(file)
        ending = (
            ", the shipped example: give your camera's with --calibration" if is_example else ""
        )
        say(f"calibration: {file.name}{ending}")
        prints = PrintCheck(camera, flown.target)
        tracker = Tracker(flown, camera, live=opened.live, stills=stills)
        add_row = stack.enter_context(csv_file(csv)) if csv else None
        add_picture = None
        if overlay:
            film = overlay_file(overlay, camera, rate_hz or LIVE_RATE_HZ)
            add_picture = stack.enter_context(film)
        stack.enter_context(stop.installed())  # until here Ctrl-C ends at once
        title = f"perchctl track {without_password(source)}"
        page = stack.enter_context(live_page(camera, title, port, say))
        has_bar = not opened.live and not (lines and sys.stdout.isatty())
        advance = stack.enter_context(count_bar("frames", count, has_bar))
        first: tuple[float, float] | None = None  # times of the first frame and of now
        for frame in frames(opened, now, stop, summary):
            place = str(paths[frame.index]) if paths else opened.describe()
            check_size((frame.image.shape[1], frame.image.shape[0]), camera, place)
            name = paths[frame.index].name if paths else frame.index
            results = tracker.results(frame, name)
            for tracked in results:
                summary.add(tracked)
                prints.add(tracked.output)
                if lines:
                    line = json.dumps(track_record(tracked)) if as_json else text_line(tracked)
                    # A live result is worth nothing late.
                    print(line, flush=opened.live)
                if add_row is not None:
                    add_row(track_record(tracked))
                sketch = track_sketch(tracked, AXES_OF_SIDE * flown.target.large.side_m)
                if add_picture is not None and tracked is results[-1]:  # of two fields, one
                    text = tuple(f"{label} {value}" for label, value in text_rows(tracked))
                    add_picture(tracked.t_s, replace(sketch, text=text))
                if page is not None:
                    page.show(frame.index, sketch)
                    page.set_state(partial(track_state, tracked))
            advance()
            if page is not None and not opened.live:  # a recording is watched at its own pace
                first = first or (frame.t_s, now())
                stop.requested.wait(max(0.0, frame.t_s - first[0] - (now() - first[1])))
        ended_s = now()
        if summary.frames == 0 and not stop.requested.is_set():
            raise NotFound(f"{opened.describe()} gave no frame at all")
    say(summary.text(ended_s))
    if prints.judged and not is_example:  # another lens would say something of its own
        say(prints.verdict().text)
    for path in (csv, overlay):
        if path is not None:
            say(f"wrote {path}")
    if stop.requested.is_set():
        raise Interrupted("Ctrl-C: stopped; what was written is complete")


def _open(
    source: str,
    profile: Profile,
    calibration: Path,
    cam: str | None,
    stills: bool,
    now: Callable[[], float],
) -> tuple[FrameSource, CameraModel]:
    """Return the open source, and its camera. Errors: NotFound, InvalidValue."""
    camera = None
    with contextlib.suppress(SizeMissing):  # then the first picture's is taken
        camera = load_calibration(calibration, cam=cam)
    size_px = None if camera is None else camera.size_px
    pictures_hz = STILLS_HZ if stills else None
    opened = open_camera(source, now, profile.camera, size_px=size_px, pictures_hz=pictures_hz)
    if camera is None:
        camera = load_calibration(calibration, opened.size_px, cam)
    return opened, camera


def frames(
    source: FrameSource, now: Callable[[], float], stop: Stopper, summary: TrackSummary
) -> Iterator[Frame]:
    """Yield every frame of a recording, the newest ones of a live source, until the end or
    Ctrl-C."""
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
        summary.add_silence(source.problem(now_s))
        stop.requested.wait(POLL_S)


class Tracker:
    """Turns frames into results by the profile's pipeline, with the camera in the place of vehicle
    and gear; with `stills` each picture is searched thoroughly, and nothing is remembered."""

    def __init__(self, profile: Profile, camera: CameraModel, *, live: bool, stills: bool) -> None:
        bare = camera_profile(profile)
        if stills:
            detector = bare.detector.model_copy(update={"blurred_every": 1})
            bare = bare.model_copy(update={"detector": detector})
        self._perception = Perception(make_pipeline(bare, camera), stills=stills)
        self._config, self._live, self._stills = profile.camera, live, stills
        self._disagreement_frames = 1 if stills else profile.merge.disagreement_frames
        self._target: CameraPose | None = None
        self._interlaced = False

    def results(self, frame: Frame, name: str | int) -> list[Tracked]:
        """Return the frame's result, or those of its two fields; none for a live source's
        repetition of the last picture."""
        judged = self._perception.assess(frame, self._live or not self._stills)
        if self._live and judged.kind == "repeated":
            return []
        about = () if judged.kind in ("ok", "repeated") else (judged.text,)
        if self._live and judged.kind in _NO_PICTURE:
            return [Tracked(name, frame.t_s, frame.image, notes=about)]
        results = []
        for picture, output in self._perception.look(frame):
            self._target = camera_pose(output, not self._stills, self._target)
            notes = (*about, *self._notes(output))
            results.append(Tracked(name, picture.t_s, picture.image, output, self._target, notes))
        return results

    def _notes(self, output: PipelineOutput) -> Iterator[str]:
        interlaced = output.fields != "whole"
        if not self._stills:  # at rest nothing is combed, and that is no news
            self._interlaced = interlaced = interlaced or self._interlaced
        if interlaced:
            yield INTERLACED
        if output.lock_note:
            yield output.lock_note
        if output.detections.mirrored:
            yield mirrored_note(self._config)
        if output.disagreeing_frames >= self._disagreement_frames:
            yield _DISAGREE


class TrackSummary:
    """Counts results, and prints a sentence as a condition begins, `MOST_NOTES` at the most."""

    def __init__(self) -> None:
        self.frames = 0
        self._found: Counter[str] = Counter()
        self._noted: Counter[str] = Counter()
        self._before: frozenset[str] = frozenset()
        self._left = MOST_NOTES
        self._silent = False

    def add(self, tracked: Tracked) -> None:
        """Count this result, and print what is new in it."""
        self.frames += 1
        self._found.update(list(tracked.markers))
        name = tracked.frame if isinstance(tracked.frame, str) else f"frame {tracked.frame}"
        for note in tracked.notes:
            if _kind(note) in self._before:
                continue
            self._left -= 1
            if self._left >= 0:
                say(f"{name}: {note}")
            if self._left == 0:
                say("more of this kind is only counted from here on")
        self._before = frozenset(map(_kind, tracked.notes))
        self._noted.update(self._before)
        self._silent = False

    def add_silence(self, problem: str | None) -> None:
        """Print once why the source gives no frame at present; None if it only has none yet."""
        if problem is not None and not self._silent:
            say(f"{problem}; waiting for it (Ctrl-C ends)")
        self._silent = self._silent or problem is not None

    def text(self, took_s: float) -> str:
        """Return the sentence at the end."""
        frames, took_s = self.frames, max(took_s, 1e-6)
        large, small = (100.0 * self._found[name] / max(frames, 1) for name in ("large", "small"))
        counted = "".join(f"; {note} in {n}" for note, n in self._noted.items())
        return (
            f"{frames} {'frame' if frames == 1 else 'frames'} in {took_s:.1f} s "
            f"({frames / took_s:.0f} a second): large {large:.0f} %, small {small:.0f} %{counted}"
        )


def _kind(note: str) -> str:
    """Return the note without what differs from frame to frame."""
    return re.split("[:,]", note, maxsplit=1)[0]
