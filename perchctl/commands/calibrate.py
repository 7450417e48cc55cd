"""The work behind `perchctl calibrate`: pictures in, calibration file and report out."""

from __future__ import annotations

import contextlib
import datetime
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path

from perchctl.calibration import (
    AUTO_MODEL,
    MODEL_NAMES,
    BoardView,
    Calibration,
    Grey,
    Rejection,
    assumed_size_warning,
    calibrate_camera,
    calibration_lines,
    calibration_record,
    calibration_text,
    camera_record,
    camera_text,
    check_calibration,
    check_record,
    learn_gear,
    load_calibration,
    load_sized,
    mask_png,
    views_of_images,
    views_of_video,
)
from perchctl.camera import FrameSource, check_size, parse_source
from perchctl.commands.calibrate_live import captured_views
from perchctl.commands.calibrate_mount_request import MountRequest
from perchctl.commands.calibrate_source import Source, sized, source_of
from perchctl.commands.interrupt import Stopper, drawn
from perchctl.commands.output import print_record, say
from perchctl.commands.page import page_port
from perchctl.commands.progress import search_bar
from perchctl.errors import InvalidValue, PerchError, TimedOut, UsageError
from perchctl.files import check_output, check_place, same_file, write_files
from perchctl.target import NOTABLE_SCALE_ERROR, Board, mm_text, parse_board, parse_length

FOLDER = Path("calib")
_TYPED = {"reject": "no-reject"}
_WITH_MOUNT = ("mount", "mounting", "output", "force", "as_json", "view", "view_port")
SUFFIXES, CONTENT = (".yaml", ".yml"), "the format of a calibration"


@dataclass(frozen=True)
class CalibrateRequest:
    """The command line as it was given; None is not given."""

    sources: tuple[str, ...] = ()
    board: str = "charuco:10x7:25mm:18mm:DICT_5X5_100"
    measured_width: str | None = None
    measured_height: str | None = None
    output: Path | None = None
    size: str | None = None
    name: str = "camera"
    model: str = AUTO_MODEL
    force: bool = False
    check: Path | None = None
    convert: Path | None = None
    cam: str | None = None
    mask: Path | None = None
    reject: bool = True
    plain_corners: bool = False
    skip_broken: bool = False
    keep_pictures: Path | None = None
    as_json: bool = False
    view: bool = False
    view_port: int = 0
    mount: bool = False
    mounting: MountRequest = field(default_factory=MountRequest)


@dataclass(frozen=True)
class _Found:
    """Views of the source, and pictures without the board."""

    views: list[BoardView]
    missing: list[Rejection]

    @property
    def size_px(self) -> tuple[int, int]:
        return self.views[0].size_px


def run(request: CalibrateRequest) -> int:
    """Calibrate, check, convert, learn a mask or measure the mounting; returns the exit code.

    Errors: NotFound, InvalidValue, UsageError, TimedOut (a silent camera); those of
    `measure_mount`.
    """
    if request.mount:
        return _mount(request)
    if (given := request.mounting.given()) is not None:
        raise UsageError(f"{given} goes with --mount, which measures how the camera is mounted")
    measured = request.measured_width is not None or request.measured_height is not None
    if measured and not (request.convert is request.mask is None):
        raise UsageError("--measured-* are a board's sides, and --convert and --mask look for none")
    if request.convert is not None:
        if request.sources or not (request.check is request.mask is None):
            raise UsageError("--convert takes a file and no source, --check or --mask")
        if request.size is not None:
            raise UsageError("--size is asked of a camera, and --convert looks through none")
        _refuse_beside("--convert takes over the file's lens model", request, "--model", "--view")
        return _convert(request, request.convert)
    if request.cam is not None and request.check is None:
        raise UsageError("--cam names a camera of the file of --check or --convert: give one")
    if not request.sources:
        raise UsageError(
            "a SOURCE is needed: images:DIR (or a pattern), video:FILE, camera:N, http://... or aideck://HOST"
        )
    source = sized(source_of(request.sources), request.size)
    if not parse_source(source.spec).live:
        _refuse_beside(f"{source} is no live camera", request, "--view")
    if request.check is not None:
        _refuse_beside("--check judges a calibration as it is", request, "--model", "--output")
    if request.mask is not None:
        if request.check is not None or request.output is not None:
            raise UsageError("--mask names its file itself, and takes no --output or --check")
        return write_mask(source, request.mask, request.force, request.as_json)
    board, notes = board_of(request.board, request.measured_width, request.measured_height)
    _check_request(request)
    for note in notes:
        say(note)
    if request.check is not None:
        return _check(request, request.check, source, board)
    return _calibrate(request, source, board)


def _refuse_beside(asked: str, request: CalibrateRequest, *options: str) -> None:
    """Raises UsageError for an option that would be ignored."""
    given = {
        "--model": request.model != AUTO_MODEL,
        "--output": request.output is not None,
        "--view": request.view,
    }
    for option in options:
        if given[option]:
            raise UsageError(f"{asked}: {option} does not apply; leave it out")


def _mount(request: CalibrateRequest) -> int:
    from perchctl.commands.calibrate_mount import measure_mount

    if request.sources:
        raise UsageError(
            f"with --mount the camera is the profile's or named by --source {request.sources[0]}"
        )
    for each in fields(request):
        if each.name not in _WITH_MOUNT and getattr(request, each.name) != each.default:
            name = _TYPED.get(each.name, each.name.replace("_", "-"))
            raise UsageError(f"--{name} does not go with --mount: leave one of them out")
    return measure_mount(
        request.mounting,
        request.output,
        request.force,
        request.as_json,
        request.view,
        request.view_port,
    )


def _check_request(request: CalibrateRequest) -> None:
    if request.model not in (AUTO_MODEL, *MODEL_NAMES):
        allowed = ", ".join((AUTO_MODEL, *MODEL_NAMES))
        raise InvalidValue(f"lens model {request.model!r} is unknown; allowed are {allowed}")
    if request.output is not None:
        _check_output(request.output, request.force)
    if request.keep_pictures is not None:
        check_place(request.keep_pictures / "view_001.png", force=True)
    if not request.name.strip() or "/" in request.name:
        raise UsageError(f"--name {request.name!r} cannot name a file; use a word such as camera")


def _calibrate(request: CalibrateRequest, source: Source, board: Board) -> int:
    found = _find_views(request, source, board)
    output = _output(request, found.size_px)
    _check_output(output, request.force)
    missing = f", {len(found.missing)} without" if found.missing else ""
    say(f"{len(found.views)} views of the board{missing}")
    result = calibrate_camera(
        found.views, board.notation(), request.model, request.reject, found.missing
    )
    text = calibration_text(result, request.name, _now())
    write_files({output: text.encode()})
    for line in calibration_lines(result):
        say(line)
    picture = drawn(lambda: _draw(result, _picture_of(output)))
    say(f"wrote {output}" + ("" if picture is None else f" and {picture}"))
    if request.as_json:
        print_record(calibration_record(result, output, picture))
    else:
        print(output)
    return 0


def _draw(result: Calibration, picture: Path) -> Path:
    from perchctl.calibration import draw_calibration

    write_files({picture: draw_calibration(result)})
    return picture


def _check(request: CalibrateRequest, file: Path, source: Source, board: Board) -> int:
    """Judge an existing calibration by new pictures."""
    camera = load_sized(file, request.cam)
    found = _find_views(request, source, board)
    if camera is None:
        camera = load_calibration(file, found.size_px, request.cam)
        say(assumed_size_warning(file, found.size_px))
    check_size(found.size_px, camera, str(source))
    result = check_calibration(camera, found.views)
    for item in found.missing:
        say(f"{item.view}: {item.reason}")
    for item in result.rejections:
        say(f"left out {item.view}: {item.reason}")
    say(f"{'PASS' if result.passed else 'FAIL'}: {file}: {result.reason}")
    if request.as_json:
        print_record(check_record(result, file))
    else:
        print("pass" if result.passed else "fail")
    return 0 if result.passed else PerchError.exit_code


def _convert(request: CalibrateRequest, file: Path) -> int:
    """Another program's calibration (OpenCV, Kalibr, ROS) as perchctl's file."""
    camera = load_calibration(file, cam=request.cam)
    output = _output(request, camera.size_px)
    if same_file(output, file):
        raise UsageError(f"{output} is the file to convert; name another with --output")
    check_output(output, SUFFIXES, request.force, CONTENT)
    notes = {"date": _now(), "converted_from": file.name}
    text = camera_text(camera, request.name, notes)
    write_files({output: text.encode()})
    say(f"wrote {output} ({camera.model}, {camera.size_px[0]}x{camera.size_px[1]} px)")
    if request.as_json:
        print_record(camera_record(camera) | {"file": str(output)})
    else:
        print(output)
    return 0


# -- files --------------------------------------------------------------------


def _output(request: CalibrateRequest, size_px: tuple[int, int]) -> Path:
    return request.output or FOLDER / f"{request.name}_{size_px[0]}x{size_px[1]}.yaml"


def _picture_of(output: Path) -> Path:
    return output.with_suffix(".png")


def _pictures_folder(request: CalibrateRequest, size_px: tuple[int, int]) -> Path | None:
    """Where a live camera's pictures go; raises what `_check_output` does, before a person
    has worked for them."""
    if request.check is not None:
        return request.keep_pictures
    output = _output(request, size_px)
    _check_output(output, request.force)
    if request.keep_pictures is not None:
        return request.keep_pictures
    names = (f"{output.stem}_pictures{'' if n == 1 else f'_{n}'}" for n in itertools.count(1))
    return next(folder for name in names if not (folder := output.with_name(name)).exists())


def _check_output(output: Path, force: bool) -> None:
    check_output(output, SUFFIXES, force, f"{CONTENT}; the report goes beside it as .png")
    check_place(_picture_of(output), force)


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


# -- views --------------------------------------------------------------------


def _find_views(request: CalibrateRequest, source: Source, board: Board) -> _Found:
    if source.scheme not in ("images", "video"):
        return _Found(_live_views(request, source, board), [])
    refine = not request.plain_corners
    with search_bar("searching the board") as progress:
        if source.scheme == "images":
            pictures, skip = source.pictures(), request.skip_broken
            views, missing = views_of_images(pictures, board, refine, progress, skip)
        else:
            views, missing = views_of_video(Path(source.place), board, refine, progress)
    if not views:
        count = f"{len(missing)} pictures" if source.scheme == "images" else missing[0].view
        raise InvalidValue(
            f"none of {count} of {source} shows the board {board.notation()}; is it wholly in "
            f"view, sharp, and --board its true layout?"
        )
    return _Found(views, missing)


def _live_views(request: CalibrateRequest, source: Source, board: Board) -> list[BoardView]:
    frames = source.open()
    try:
        assert frames.size_px is not None  # the first frame is there
        pictures = _pictures_folder(request, frames.size_px)
        port = page_port(request.view, request.view_port)
        return captured_views(frames, board, pictures, port)
    finally:
        frames.close()


# --- The board that `perchctl calibrate` looks for: its notation, and what its print measures ---


def board_of(notation: str, width: str | None, height: str | None) -> tuple[Board, list[str]]:
    """The board, and what its measured sides (of the black area, mm) say of the print.

    Raises NotFound, InvalidValue, UsageError.
    """
    board = parse_board(notation)
    if width is None and height is None:
        return board, []
    if width is None or height is None:
        raise UsageError(
            "--measured-width and --measured-height go together: a lens is told from the "
            "print's proportions, which one of them leaves open"
        )
    sides_m = (
        parse_length(width, "--measured-width", bare_unit="mm"),
        parse_length(height, "--measured-height", bare_unit="mm"),
    )
    board = board.measured(*sides_m)
    notes = []
    for name, meant_m, is_m, scale in zip(
        ("width", "height"), board.size_m, sides_m, board.scale, strict=True
    ):
        off = f"{100 * (scale - 1):+.2f} % against {mm_text(meant_m)} mm"
        notes.append(f"{name}: {mm_text(is_m)} mm, {off}")
        if abs(scale - 1) > NOTABLE_SCALE_ERROR:
            notes.append(f"{name}: more than 1 % off: was the page scaled when it was printed?")
    return board, notes


# --- `perchctl calibrate --mask`: what the vehicle's own gear covers, learned from any source ---


LIVE_S = 20.0
"""For which a live camera is looked at."""
_PAUSE_S = 0.005


def write_mask(source: Source, output: Path, force: bool, as_json: bool) -> int:
    """Learn the mask and write it; returns the exit code.

    Errors: NotFound, InvalidValue, TimedOut (a silent camera).
    """
    check_output(output, (".png",), force, "a mask's format")
    with contextlib.ExitStack() as stack:
        frames = source.open()
        stack.callback(frames.close)
        stop = stack.enter_context(Stopper().installed())
        if frames.live:
            say(f"turn the vehicle about for {LIVE_S:g} s (Ctrl-C ends and writes the mask)")
        gear = learn_gear(_pictures(frames, stop.requested.is_set))
    write_files({output: mask_png(gear)})
    say(
        f"wrote {output}: the vehicle covers {100 * gear.share:.1f} % of the picture, by "
        f"{gear.pictures} pictures; set camera.mask to it"
    )
    if as_json:
        height, width = gear.covered.shape
        record = {"file": str(output), "covered": round(gear.share, 4)}
        print_record(record | {"pictures": gear.pictures, "size_px": [width, height]})
    else:
        print(output)
    return 0


def _pictures(source: FrameSource, stopped: Callable[[], bool]) -> Iterator[Grey]:
    """Those of a recording, or of a camera for some seconds."""
    start_s = time.monotonic()
    while not (stopped() or source.finished):
        now_s = time.monotonic()
        frame = source.poll(now_s)
        if frame is not None:
            yield frame.image
        elif source.live:
            problem = source.problem(now_s)
            if problem is not None:
                raise TimedOut(problem)
            time.sleep(_PAUSE_S)
        if source.live and now_s - start_s > LIVE_S:
            return
