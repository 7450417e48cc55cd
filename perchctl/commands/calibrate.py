"""`perchctl calibrate`: make a calibration file or a mask from images, or check or convert a
calibration."""

from __future__ import annotations

import contextlib
import datetime
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import camera as cameras
from perchctl import display as displays
from perchctl import target as targets
from perchctl import vision as visions
from perchctl.commands.calibrate_mount import mount
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    SourceArgument,
    ViewOption,
    command,
    new_app,
)
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import print_result, say, say_on_terminal
from perchctl.errors import InvalidValue, PerchError, UsageError
from perchctl.files import check_output, file_kind, write_files

FOLDER = Path("calib")
SUFFIXES, CONTENT = (".yaml", ".yml"), "a calibration"
REPORT_SUFFIX = ".html"
DEFAULT_BOARD = "charuco:10x7:25mm:18mm:DICT_5X5_100"

BoardOption = Annotated[
    str,
    typer.Option(
        "--board",
        "-b",
        help="Board: chessboard:9x6:25mm (inner corners) or charuco:10x7:25mm:18mm:DICT_5X5_100 "
        "(squares). Append :measured=249.3x174.9mm if you have measured the printed black area.",
    ),
]
CheckBoardOption = Annotated[
    str | None,
    typer.Option("--board", "-b", help="Board, as for calibrate. Default: the calibration's."),
]
SizeOption = Annotated[
    tuple[int, int] | None,
    typer.Option(
        "--size", help="Width and height to request from camera:N. Default: the driver's choice."
    ),
]
OutputOption = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        help="Calibration file to write. Default: calib/camera_WIDTHxHEIGHT.yaml.",
    ),
]

app = new_app(Group)


@command(
    app,
    "perchctl calibrate images:board",
    "perchctl calibrate camera:0 --view",
    "perchctl calibrate 'left*.jpg' --board chessboard:9x6:25mm",
)
def camera(
    source: SourceArgument,
    board: BoardOption = DEFAULT_BOARD,
    output: OutputOption = None,
    force: ForceOption = False,
    view: ViewOption = False,
    as_json: JsonOption = False,
    size: SizeOption = None,
) -> None:
    """Calibrate the camera, and report the resulting error at the target in mm.

    A report next to the calibration file (same name, .html) shows the coverage of the image, the
    residuals, the spread of the views, and how to improve the calibration.

    A view is rejected if its RMS error exceeds 2.5 times the median over all views. A corner is
    rejected if its error exceeds 5 times the spread of the errors in its view. The report lists
    rejected views and corners, and images without a board.
    """
    say_on_terminal("looking for the board")
    pictures = _source(source, view)
    if output is not None:
        _check_camera_output(output, force)
    layout = targets.Board.parse(board)

    def checked_file(size_px: tuple[int, int]) -> Path:
        """Return the path for the calibration file. If the file cannot be written there, raise an
        error now, before the user has done any work."""
        file = _file(output, size_px)
        _check_camera_output(file, force)
        return file

    found = _find_views(pictures, size, layout, view, checked_file)
    file = checked_file(found.views[0].size_px)
    without = f", {len(found.without_board)} images without it" if found.without_board else ""
    say(f"{len(found.views)} views of the board{without}")
    seen = found.layout_of(layout)
    if seen.legacy != layout.legacy:
        say(f"the board has the layout used {'before' if seen.legacy else 'since'} OpenCV 4.6")
    result = calibrations.calibrate_camera(found, seen.notation())
    if found.frames is not None:
        say(found.frames.text)
    report, date = file.with_suffix(REPORT_SUFFIX), _now()
    write_files({file: result.file_text(file.stem, date).encode()})
    for line in result.lines():
        say(line)

    say(f"wrote {file}")
    write_files({report: calibrations.calibration_report(result, file.name, date).encode()})
    say(f"wrote {report}: open it in a browser")
    record = result.record() | {"file": str(file), "report": str(report)}
    print_result(record if as_json else file)


command(
    app,
    "perchctl calibrate mount -p mine.yaml -u radio://0/80/2M/E7E7E7E7E7",
    "perchctl calibrate mount -p mine.yaml --from mounting.jsonl --write",
    "perchctl calibrate mount -p mine.yaml --part pivot --source camera:0",
)(mount)


@command(
    app,
    "perchctl calibrate mask images:turned",
    "perchctl calibrate mask camera:0 -o gear.png",
    "perchctl calibrate mask video:turned.mp4 -o gear.png --force",
)
def mask(
    source: SourceArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Mask to write, a PNG. Name it in camera.mask.")
    ] = Path("gear.png"),
    force: ForceOption = False,
    size: SizeOption = None,
) -> None:
    """While you turn the vehicle in your hand, find the parts of the image that it covers.

    If it covers none, you need no mask: perchctl says so, writes no file, and the exit code is 0.
    """
    say_on_terminal("looking for the parts that the vehicle covers")
    pictures = _source(source)
    check_output(output, (".png",), force, "a mask")
    with contextlib.ExitStack() as stack:
        frames = cameras.open_camera(pictures, time.monotonic, size_px=size)
        stack.callback(frames.close)
        stop = stack.enter_context(Stopper().as_handler())
        if frames.live:
            say("turn the vehicle around in your hand for 20 s (Ctrl-C stops and writes the mask)")
        covered = calibrations.learn_gear_mask(frames, stop.requested.is_set)
    if not covered.any():
        say(
            "the vehicle covers no part of the image, so camera.mask is not needed: "
            f"{output} was not written"
        )
        return
    import cv2

    write_files({output: cv2.imencode(".png", 255 * covered.astype("uint8"))[1].tobytes()})
    share = 100.0 * covered.mean()
    say(
        f"wrote {output}: the vehicle covers {share:.1f} % of the image; name this "
        "file in camera.mask"
    )
    print_result(output)


@command(
    app,
    "perchctl calibrate check camera.yaml images:new",
    "perchctl calibrate check camera.yaml camera:0",
    "perchctl calibrate check camera.yaml video:board.mp4 --json",
)
def check(
    calibration: Annotated[Path, typer.Argument(help="Calibration file to check.")],
    source: SourceArgument,
    board: CheckBoardOption = None,
    as_json: JsonOption = False,
) -> int:
    """Check a calibration against new images of a board (exit code 1 if it fails)."""
    say_on_terminal(f"reading {calibration}")
    if not calibration.is_file() and file_kind(Path(source)) == "a camera calibration":
        raise UsageError(
            f"{source} is a camera calibration: name it first, and then the images, as in "
            f"perchctl calibrate check {source} {calibration}"
        )
    pictures = _source(source)
    model = calibrations.load_calibration(calibration)
    notes = calibrations.load_notes(calibration)
    layout = targets.Board.parse(board or notes.board or DEFAULT_BOARD)
    if board is None:
        origin = "from the calibration" if notes.board else "the default"
        say(f"the board is {layout.notation()} ({origin})")
    found = _find_views(pictures, model.size_px, layout)
    cameras.check_size(found.views[0].size_px, model, cameras.without_password(pictures))
    result = calibrations.check_calibration(model, found, notes.picture_hashes)
    for item in found.without_board:
        say(f"{item.view}: {item.reason}")
    for item in result.rejections:
        say(f"left out {item.view}: {item.reason}")
    say(f"{'PASS' if result.passed else 'FAIL'}: {calibration}: {result.reason}")
    print_result(result.record(calibration) if as_json else "pass" if result.passed else "fail")
    return 0 if result.passed else PerchError.exit_code


@command(
    app,
    "perchctl calibrate convert opencv.yaml",
    "perchctl calibrate convert camchain.yaml -o mine.yaml",
    "perchctl calibrate convert ost.yaml -o calib/fpv.yaml",
)
def convert(
    calibration: Annotated[
        Path, typer.Argument(help="Calibration file from OpenCV, Kalibr or ROS.")
    ],
    output: OutputOption = None,
    force: ForceOption = False,
) -> None:
    """Convert a calibration from OpenCV, Kalibr or ROS to perchctl's format."""
    say_on_terminal(f"reading {calibration}")
    model = calibrations.load_calibration(calibration)
    file = _file(output, model.size_px)
    check_output(file, SUFFIXES, force, CONTENT, makes_folder=file.parent == FOLDER)
    notes = {"date": _now(), "converted_from": calibration.name}
    write_files({file: calibrations.calibration_text(model, file.stem, notes).encode()})
    say(f"wrote {file} ({model.model}, {model.size_px[0]}x{model.size_px[1]} px)")
    print_result(file)


# --- files ---


def _file(output: Path | None, size_px: tuple[int, int]) -> Path:
    return output or FOLDER / f"camera_{size_px[0]}x{size_px[1]}.yaml"


def _check_camera_output(file: Path, force: bool) -> None:
    """Check that a calibration file and its report can be written. Raises InvalidValue, as
    `check_output` does."""
    report, makes_folder = file.with_suffix(REPORT_SUFFIX), file.parent == FOLDER
    check_output(file, SUFFIXES, force, CONTENT, makes_folder=makes_folder)
    check_output(report, (REPORT_SUFFIX,), force, "a report", makes_folder=makes_folder)


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


# --- the source ---


def _source(text: str, view: bool = False) -> str:
    """Return the source to pass to `open_camera`. Raises NotFound, InvalidValue, UsageError."""
    source = cameras.parse_source(text)
    if view and not source.live:
        raise UsageError(f"{source} is not a live camera, so --view does not apply: leave it out")
    return source.spec


# --- the board and its views ---


def _find_views(
    spec: str,
    size_px: tuple[int, int] | None,
    board: targets.Board,
    view: bool = False,
    check: Callable[[tuple[int, int]], object] = lambda size_px: None,
) -> calibrations.FoundViews:
    """Return the views, at least one, and the images without a board.

    Args:
        view: serve the live page, if the source is a live camera.
        check: called with a live camera's image size before the user starts.
    """
    source = cameras.parse_source(spec)
    if source.scheme != "images":
        frames = cameras.open_camera(spec, time.monotonic, size_px=size_px)
        with contextlib.closing(frames):
            if frames.size_px is not None:
                check(frames.size_px)
            return capture_live_views(frames, board, view)
    from perchctl.commands.progress import done_of_total_bar

    with done_of_total_bar("looking for the board") as progress:
        pictures = cameras.image_files(str(Path(source.place).expanduser()))
        found = calibrations.find_views(pictures, board, progress)
    if not found.views:
        first = found.without_board[0]
        seen = f"they show {found.other_board}"
        why = (
            f"{first.view}: {first.reason}; is the whole board in view and sharp, and does "
            "--board match it?"
        )
        raise InvalidValue(
            f"none of {len(found.without_board)} images of {source} shows the board "
            f"{board.notation()}: {seen if found.other_board else why}"
        )
    return found


def capture_live_views(
    source: cameras.FrameSource, board: targets.Board, view: bool
) -> calibrations.FoundViews:
    """Take views from a video or live camera until they cover everything, or until Ctrl-C is
    pressed.

    Raises InvalidValue if no view was taken, and the errors of `capture_views`.
    """
    import numpy as np

    from perchctl.commands.progress import guidance_display

    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(Stopper().as_handler())
        # The page draws the image and its corners, but no axes, so any camera model will do.
        any_camera = visions.CameraModel(source.size_px or (640, 480), np.eye(3), np.zeros(5))
        page = stack.enter_context(displays.live_page(any_camera, "perchctl calibrate", view, say))
        show = stack.enter_context(guidance_display(page))
        if source.live:
            say(
                "show the board near and far, tilted, and in every corner of the image "
                "(Ctrl-C stops and calibrates)"
            )
        found = calibrations.capture_views(source, board, show, stopped=stop.requested.is_set)
    if not found.views:
        raise InvalidValue(
            f"no view of the board {board.notation()} was taken from {source.describe()}: "
            f"{_no_view_text(found)}"
        )
    return found


def _no_view_text(found: calibrations.FoundViews) -> str:
    """Return why there is no view of the board from a video or camera, and what to do."""
    if found.other_board:
        return f"it shows {found.other_board}"
    if found.frames is None:
        return "no frame arrived"
    advice = (
        found.frames.advice or "is the whole board in view and sharp, and does --board match it?"
    )
    return f"{found.frames.text}; {advice}"
