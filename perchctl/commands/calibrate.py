"""The work behind `perchctl calibrate`: pictures in, calibration file and report out."""

from __future__ import annotations

import contextlib
import datetime
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perchctl.calibration.check import CheckResult, check
from perchctl.calibration.files import load_calibration
from perchctl.calibration.guided import Moment, capture
from perchctl.calibration.lens import MODEL_NAMES, PARAMETERS
from perchctl.calibration.pictures import views_of_images, views_of_video
from perchctl.calibration.seen import larger_than, seen_instead
from perchctl.calibration.solve import AUTO, calibrate
from perchctl.calibration.types import Calibration, Grey, Rejection, View
from perchctl.calibration.verdict import level, limit_mm, sentence
from perchctl.calibration.writing import calibration_text, camera_text
from perchctl.camera.files import VideoSource, image_files, read_grey
from perchctl.camera.open import open_source
from perchctl.camera.source import check_size
from perchctl.commands.coverage import coverage_bars, search_bar
from perchctl.commands.interrupt import Stopper
from perchctl.commands.track import source_spec
from perchctl.display.page.live import LivePage
from perchctl.display.page.sketch import Sketch
from perchctl.errors import InvalidValue, UsageError
from perchctl.files import check_place, same_file, write_files
from perchctl.target.boards import Board, parse_board
from perchctl.vision.types import CameraModel

FOLDER = Path("calib")
_LOOK_AGAIN = 4  # pictures that are searched for another board when none shows the named one


@dataclass(frozen=True)
class CalibrateOptions:
    """What the command line asked for."""

    source: str
    board: Board
    output: Path | None = None
    name: str = "camera"
    model: str = AUTO
    force: bool = False
    rejecting: bool = True
    refine: bool = True
    as_json: bool = False
    view: bool = False
    view_port: int = 0
    pictures: Path | None = None


def resolve(source: str, board: str, **options: Any) -> CalibrateOptions:
    """Options checked before any work. Errors: NotFound, InvalidValue, UsageError."""
    found = CalibrateOptions(source_spec(source), parse_board(board), **options)
    if found.model not in (AUTO, *MODEL_NAMES):
        raise InvalidValue(
            f"lens model {found.model!r} is unknown; allowed are {', '.join((AUTO, *MODEL_NAMES))}"
        )
    if found.output is not None:
        _check_output(found.output, found.force)
    if not found.name.strip() or "/" in found.name:
        raise UsageError(f"--name {found.name!r} cannot name a file; use a word such as camera")
    return found


def run(options: CalibrateOptions) -> None:
    """Calibrate and write the file and its report. Errors: see `perchctl.errors`."""
    views, missing, size_px = _views(options)
    output = options.output or FOLDER / f"{options.name}_{size_px[0]}x{size_px[1]}.yaml"
    report = output.with_suffix(".png")
    _check_output(output, options.force)
    _say(f"{len(views)} views of the board" + (f", {len(missing)} without" if missing else ""))
    result = calibrate(views, options.board.notation(), options.model, options.rejecting, missing)
    from perchctl.calibration.plot import draw_calibration

    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    text = calibration_text(result, options.name, now)
    write_files({output: text.encode(), report: draw_calibration(result)}, make_folders=True)
    for line in _lines(result):
        _say(line)
    _say(f"wrote {output} and {report}")
    if options.as_json:
        print(json.dumps(record_of(result, output, report)))
    else:
        print(output)


def run_check(options: CalibrateOptions, file: Path) -> bool:
    """Judge an existing calibration by new pictures; True when it passes."""
    camera = load_calibration(file)
    views, missing, size_px = _views(options)
    check_size(size_px, camera, options.source)
    result = check(camera, views)
    for item in missing:
        _say(f"{item.view}: {item.reason}")
    for item in result.rejections:
        _say(f"left out {item.view}: {item.reason}")
    _say(f"{'PASS' if result.passed else 'FAIL'}: {file}: {result.reason}")
    if options.as_json:
        print(json.dumps(_check_record(result, file)))
    else:
        print("pass" if result.passed else "fail")
    return result.passed


def run_convert(
    file: Path, output: Path | None, name: str, force: bool, as_json: bool = False
) -> None:
    """Another program's calibration (OpenCV, Kalibr, ROS) as perchctl's file."""
    camera = load_calibration(file)
    w, h = camera.size_px
    target = output or FOLDER / f"{name}_{w}x{h}.yaml"
    check_place(target, replace=force, make_folders=True)
    if same_file(target, file):
        raise UsageError(f"{target} is the file to convert; name another with --output")
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    notes = {"date": now, "converted_from": file.name}
    write_files({target: camera_text(camera, name, notes).encode()}, make_folders=True)
    _say(f"wrote {target} ({camera.model}, {w}x{h} px)")
    print(json.dumps(_camera_record(camera) | {"file": str(target)}) if as_json else target)


def record_of(result: Calibration, file: Path, report: Path) -> dict[str, Any]:
    """The one object of `--json`."""
    solution = result.solution
    names = PARAMETERS[result.camera.model]
    view_rms = solution.view_rms_px()
    return _camera_record(result.camera) | {
        "board": result.board,
        "rms_px": solution.rms_px,
        "views_used": len(result.views),
        "views": [
            {"name": v.name, "rms_px": float(rms), "corners": len(v)}
            for v, rms in zip(result.views, view_rms, strict=True)
        ],
        "views_rejected": [
            {"name": r.view, "reason": r.reason} for r in result.rejections if not r.corners
        ],
        "corners_rejected": [
            {"name": r.view, "reason": r.reason, "corners": list(r.corners)}
            for r in result.rejections
            if r.corners
        ],
        "pictures_without_board": [{"name": r.view, "reason": r.reason} for r in result.missing],
        "std": {n: float(s) for n, s in zip(names, solution.std, strict=True)},
        "error_mm": [
            {
                "z_m": e.z_m,
                "mm95": e.mm95,
                "axis_mm95": e.axis_mm95,
                "limit_mm": limit_mm(e.z_m),
            }
            for e in result.errors
        ],
        "ray_error_px": {"rms95": result.ray_rms_px95, "max95": result.ray_max_px95},
        "models": [
            {"model": s.model, "rms_px": s.rms_px, "held_out_px": s.held_out_px, "note": s.note}
            for s in result.scores
        ],
        "recommended": result.recommended,
        "coverage": float(result.covered.mean()),
        "warnings": list(result.warnings),
        "verdict": level(result),
        "file": str(file),
        "report": str(report),
    }


def _camera_record(camera: CameraModel) -> dict[str, Any]:
    K = camera.K
    return {
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "distortion": [float(d) for d in camera.dist],
        "model": camera.model,
        "size_px": list(camera.size_px),
    }


def _check_record(result: CheckResult, file: Path) -> dict[str, Any]:
    finite = np.isfinite(result.rms_px)
    return {
        "pass": result.passed,
        "reason": result.reason,
        "file": str(file),
        "rms_px": result.rms_px if finite else None,
        "best_rms_px": result.free_rms_px,
        "views": [{"name": name, "rms_px": rms} for name, rms in result.views],
        "views_rejected": [
            {"name": r.view, "reason": r.reason} for r in result.rejections if not r.corners
        ],
        "error_mm": [
            {"z_m": d.z_m, "mm": d.mm, "mm95": d.mm95}
            for d in result.deviations
            if np.isfinite(d.mm)
        ],
    }


def _lines(result: Calibration) -> list[str]:
    """What a person needs to know, in the order of importance."""
    solution = result.solution
    lines = [f"left out {r.view}: {r.reason}" for r in result.missing[:8]]
    if len(result.missing) > 8:
        lines.append(f"left out {len(result.missing) - 8} more pictures without a board")
    for r in result.rejections:
        what = f"corners {', '.join(map(str, r.corners))} of {r.view}" if r.corners else r.view
        lines.append(f"rejected {what}: {r.reason}")
    names = PARAMETERS[result.camera.model]
    known = [
        f"{n} {value:.2f} +- {std:.2f}"
        for n, value, std in zip(names[:4], solution.parameters, solution.std, strict=False)
    ]
    lines.append(f"{len(result.views)} views, RMS {solution.rms_px:.3f} px, {', '.join(known)} px")
    tried = [
        f"{s.model} {'-' if s.held_out_px is None else format(s.held_out_px, '.3f')} px"
        + (f" ({s.note})" if s.note else "")
        for s in result.scores
    ]
    lines.append(f"on views held out: {', '.join(tried)}; {result.recommended} is recommended")
    if result.camera.model != result.recommended:
        lines.append(f"--model {result.camera.model} was used as asked")
    lines += list(result.warnings)
    lines.append(sentence(result))
    return lines


def _check_output(output: Path, force: bool) -> None:
    for path in (output, output.with_suffix(".png")):
        check_place(path, replace=force, make_folders=True)


def _views(
    options: CalibrateOptions,
) -> tuple[list[View], list[Rejection], tuple[int, int]]:
    """Views of the source, pictures without a board, the pictures' size."""
    scheme, _, rest = options.source.partition(":")
    if scheme not in ("images", "video"):
        views = _live_views(options)
        return views, [], views[0].size_px
    with search_bar() as told:
        if scheme == "images":
            views, missing = views_of_images(rest, options.board, options.refine, told)
        else:
            path = Path(rest).expanduser()
            views, missing = views_of_video(path, options.board, options.refine, told)
    if not views:
        count = f"{len(missing)} pictures" if scheme == "images" else missing[0].view
        other = seen_instead(_samples(scheme, rest), options.board)
        hint = other or "is it wholly in view, sharp, and --board its true layout?"
        raise InvalidValue(
            f"none of {count} of {options.source} shows the board {options.board.notation()}; "
            f"{hint}"
        )
    _check_whole(options, scheme, rest)
    return views, missing, views[0].size_px


def _check_whole(options: CalibrateOptions, scheme: str, rest: str) -> None:
    """Raises InvalidValue when the pictures show a larger board than the named one."""
    whole = larger_than(_samples(scheme, rest), options.board)
    if whole:
        raise InvalidValue(
            f"the pictures show a larger board than {options.board.notation()}: use --board {whole}"
        )


def _samples(scheme: str, rest: str) -> list[Grey]:
    """A few pictures from over the whole source."""
    if scheme == "images":
        paths = image_files(str(Path(rest).expanduser()))
        step = max(1, len(paths) // _LOOK_AGAIN)
        return [read_grey(p) for p in paths[::step][:_LOOK_AGAIN]]
    source = VideoSource(Path(rest).expanduser())
    frames: list[Grey] = []
    while (frame := source.poll(0.0)) is not None and len(frames) < _LOOK_AGAIN:
        if frame.index % 30 == 0:
            frames.append(frame.image)
    source.close()
    return frames


def _live_views(options: CalibrateOptions) -> list[View]:
    """Guided capture; Ctrl-C ends it with the views there are."""
    with contextlib.ExitStack() as stack:
        source = open_source(options.source, 0.0, None, time.monotonic)
        stack.callback(source.close)
        stop = stack.enter_context(Stopper().installed())
        page = _page(options, source.size_px or (640, 480), stack)
        bars = stack.enter_context(coverage_bars())
        _say("show the board near and far, tilted, in all corners (Ctrl-C ends and calibrates)")

        def show(moment: Moment) -> None:
            bars(moment.covered, moment.taken, moment.advice)
            if page is not None:
                page.show(moment.index, _sketch(moment))
                page.tell(lambda: _page_state(moment))

        views, pictures = capture(source, options.board, show, stopped=stop.asked.is_set)
    if options.pictures is not None and pictures:
        _keep(pictures, options.pictures)
    if not views:
        raise InvalidValue(
            f"no view of the board {options.board.notation()} was taken from {options.source}"
        )
    return views


def _page(
    options: CalibrateOptions, size_px: tuple[int, int], stack: contextlib.ExitStack
) -> LivePage | None:
    if not (options.view or options.view_port):
        return None
    # Only the picture and its corners are drawn; no axes, so any camera will do.
    w, h = size_px
    K = np.array([[w, 0.0, w / 2], [0.0, w, h / 2], [0.0, 0.0, 1.0]])
    page = LivePage(CameraModel(size_px, K, np.zeros(5)), "perchctl calibrate", options.view_port)
    stack.callback(page.close)
    _say(f"live page: {page.url}")
    return page


def _sketch(moment: Moment) -> Sketch:
    outlines: tuple[tuple[str, Any], ...] = ()
    if len(moment.corners_px) >= 3:
        hull = cv2.convexHull(moment.corners_px.astype(np.float32)).reshape(-1, 2)
        outlines = (("small" if moment.shot else "large", hull.astype(np.float64)),)
    return Sketch(moment.image, outlines, None, (moment.advice,))


def _page_state(moment: Moment) -> dict[str, Any]:
    rows = [
        [name, "#" * round(20 * share) + "." * (20 - round(20 * share)) + f" {100 * share:.0f} %"]
        for name, share in moment.covered.items()
    ]
    return {"rows": [*rows, ["views", str(moment.taken)]], "phase": moment.advice}


def _keep(pictures: list[Grey], folder: Path) -> None:
    encoded = [cv2.imencode(".png", picture)[1].tobytes() for picture in pictures]
    files = {folder / f"view_{i:03d}.png": png for i, png in enumerate(encoded, start=1)}
    write_files(files, make_folders=True)
    _say(f"kept {len(pictures)} pictures in {folder}")


def _say(line: str) -> None:
    print(f"perchctl: {line}", file=sys.stderr)
