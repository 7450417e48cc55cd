"""The work behind `perchctl make-target`: print, check, design, and write what was measured."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue, UsageError
from perchctl.files import check_place, write_files
from perchctl.profile import (
    MarkerConfig,
    Profile,
    TargetConfig,
    find_calibration,
    load_profile,
)
from perchctl.profile.dictionaries import check_marker_id
from perchctl.target.lengths import millimetres, parse_length

DEFAULT_OUTPUT = "target.pdf"
DEFAULT_PLOT = "design.png"
DEFAULT_PROFILE = "sim"
BASE_FOR_NEW = "crazyflie"
"""What a new profile extends where -p names a file that does not exist yet."""
SIDE_LIMITS_M = (0.004, 2.0)
BLUR_LIMIT_PX, NOISE_LIMIT = 20.0, 60.0


@dataclass(frozen=True)
class TargetRequest:
    """The command line as it was given; None is not given. Sizes are still text."""

    profile: str | None = None
    output: Path | None = None
    page: str = "a4"
    large: str | None = None
    large_id: int | None = None
    large_dict: str | None = None
    small: str | None = None
    small_id: int | None = None
    small_dict: str | None = None
    magnet: str = "50mm"
    png_dpi: int | None = None
    svg: bool = False
    board: str | None = None
    camera: str | None = None
    ceiling_m: float | None = None
    blur_px: float = 1.0
    noise: float = 5.0
    plot: Path | None = None
    suggest: bool = False
    measured_large: str | None = None
    measured_small: str | None = None
    force: bool = False
    as_json: bool = False


def run(request: TargetRequest) -> str:
    """Do what was asked; returns the text (or JSON) for stdout.

    Raises NotFound, InvalidValue, UsageError; then nothing has been written.
    """
    measured = request.measured_large is not None or request.measured_small is not None
    wishes = [
        name
        for name, given in (
            ("--board", request.board is not None),
            ("--camera", request.camera is not None),
            ("--measured-large and --measured-small", measured),
        )
        if given
    ]
    if len(wishes) > 1:
        raise UsageError(f"{wishes[0]} and {wishes[1]} are different tasks: give one of them")
    if request.camera is None:
        for name, given in (
            ("--ceiling", request.ceiling_m is not None),
            ("--suggest", request.suggest),
            ("--plot", request.plot is not None),
        ):
            if given:
                raise UsageError(f"{name} needs --camera with a calibration file")
    if request.board is not None:
        text, record = _print_board(request, request.board)
    elif measured:
        text, record = _write_measured(request)
    elif request.camera is not None:
        text, record = _design(request, request.camera)
    else:
        profile = load_profile(request.profile or DEFAULT_PROFILE)
        text, record = _print_target(request, profile, _target(request, profile))
    return json.dumps(record) if request.as_json else text


# -- printing -----------------------------------------------------------------


def _print_target(
    request: TargetRequest, profile: Profile, target: TargetConfig
) -> tuple[str, dict[str, Any]]:
    from perchctl.target.checks import check_target
    from perchctl.target.page import parse_page
    from perchctl.target.sheets import target_pages

    magnet_m = _magnet_m(request)
    page = parse_page(request.page)
    check = check_target(target, magnet_m)
    # Options on top of a profile make it another target, with no date.
    own = target == profile.target
    pages = target_pages(
        target,
        page,
        magnet_m,
        f"profile {profile.name}" if own else "sizes from the command line",
        profile.date if own else None,
    )
    title = f"perchctl target, {millimetres(target.large.side_m)} mm"
    written = _write_pages(request, list(pages), title, profile.date if own else None)
    lines = [f"wrote {path}" for path in written]
    lines.append(check.text(target))
    lines.append("print at 100 % and measure both rulers: 100 mm each")
    record = {
        "files": [str(path) for path in written],
        "target": target.model_dump(mode="json"),
        "white_centre": check.white_centre,
        "white_centre_ids": list(check.white_ids),
    }
    return "\n".join(lines), record


def _print_board(request: TargetRequest, notation: str) -> tuple[str, dict[str, Any]]:
    from perchctl.target.boards import parse_board
    from perchctl.target.page import parse_page
    from perchctl.target.sheets import board_page

    board = parse_board(notation)
    page = board_page(board, parse_page(request.page))
    written = _write_pages(request, [page], f"perchctl {board.notation()}")
    lines = [f"wrote {path}" for path in written]
    lines.append("print at 100 %, glue it on something flat, and measure both rulers: 100 mm each")
    return "\n".join(lines), {"files": [str(p) for p in written], "board": board.notation()}


def _write_pages(
    request: TargetRequest, pages: list[Any], title: str, date: Any = None
) -> list[Path]:
    from perchctl.target.pdf import pdf_bytes
    from perchctl.target.png import png_bytes
    from perchctl.target.svg import svg_bytes

    default = DEFAULT_OUTPUT if request.board is None else "board.pdf"
    pdf = request.output or Path(default)
    if pdf.suffix.lower() != ".pdf":
        raise UsageError(
            f"-o {pdf}: the file must end in .pdf; --svg and --png DPI write pictures beside it"
        )
    files = {pdf: pdf_bytes(pages, title, date)}
    for number, page in enumerate(pages):
        side = "" if number == 0 else "_back"
        if request.svg:
            files[pdf.with_name(f"{pdf.stem}{side}.svg")] = svg_bytes(page)
        if request.png_dpi is not None:
            files[pdf.with_name(f"{pdf.stem}{side}.png")] = png_bytes(page, request.png_dpi)
    write_files(files)
    return list(files)


# -- designing ----------------------------------------------------------------


def _design(request: TargetRequest, camera_name: str) -> tuple[str, dict[str, Any]]:
    from perchctl.calibration.files import load_calibration
    from perchctl.target.design import error_curve, make_design
    from perchctl.target.design_text import design_record, design_text
    from perchctl.target.limits import Optics
    from perchctl.target.plot import draw_design
    from perchctl.target.suggest import suggest

    if request.suggest and request.output is not None:
        raise UsageError("--suggest prints a command to run; give -o to that command")
    _within("--blur", request.blur_px, 0.0, BLUR_LIMIT_PX, "px")
    _within("--noise", request.noise, 0.0, NOISE_LIMIT, "grey levels")
    if request.ceiling_m is not None:
        _within("--ceiling", request.ceiling_m, 0.3, 50.0, "m")
    profile = load_profile(request.profile or DEFAULT_PROFILE)
    path = find_calibration(camera_name)
    camera = load_calibration(path)
    plot = request.plot or Path(DEFAULT_PLOT)
    check_place(plot)
    optics = Optics(request.blur_px, request.noise)
    lines: list[str] = []
    record: dict[str, Any] = {}
    if request.suggest:
        found, design = suggest(camera, optics, profile, _magnet_m(request), request.ceiling_m)
        lines += [f"note: {note}" for note in found.notes] + [found.command(), ""]
        record = {"command": found.command(), "notes": list(found.notes)}
    else:
        design = make_design(_target(request, profile), camera, optics, profile, request.ceiling_m)
    curve = error_curve(design)
    lines.append(design_text(design, curve, str(path)))
    picture = draw_design(design, curve)
    record |= design_record(design) | {"target": design.target.model_dump(mode="json")}
    written = []
    if request.output is not None:
        text, printed = _print_target(request, profile, design.target)
        lines.append(text)
        written = printed["files"]
    write_files({plot: picture})
    lines.append(f"wrote {plot}")
    return "\n".join(lines), record | {"files": [*written, str(plot)]}


# -- print truth ----------------------------------------------------------------


def _write_measured(request: TargetRequest) -> tuple[str, dict[str, Any]]:
    from perchctl.target.measured import (
        measured_target,
        new_profile_text,
        updated_profile_text,
        write_profile,
    )

    base, path = _profile_to_write(request)
    check_place(path)
    changed = path.exists() and request.output is None
    if path.exists() and not request.force:
        raise UsageError(
            f"{path} exists: --force writes the sizes into it, "
            f"or -o NEW.yaml makes a small profile that extends it"
        )
    profile = load_profile(base)
    found = measured_target(
        _target(request, profile),
        _measured(request.measured_large, "large"),
        _measured(request.measured_small, "small"),
    )
    if changed:
        text = updated_profile_text(path, path.read_text(encoding="utf-8"), found.target)
    else:
        text = new_profile_text(_named_from(base, path), found.target)
    write_profile(path, text, profile.model_copy(update={"target": found.target}))
    lines = [*found.notes, f"{'changed' if changed else 'wrote'} {path}: fly -p {path}"]
    record = {"files": [str(path)], "target": found.target.model_dump(mode="json")}
    return "\n".join(lines), record | {"notes": list(found.notes)}


def _profile_to_write(request: TargetRequest) -> tuple[str, Path]:
    """The profile that the sizes start from, and the file that gets them."""
    name = request.profile
    if request.output is not None:
        if request.output.suffix.lower() not in (".yaml", ".yml"):
            raise UsageError(f"-o {request.output}: measured sizes go into a profile, a .yaml file")
        return name or BASE_FOR_NEW, request.output
    if name is None or not ("/" in name or name.endswith((".yaml", ".yml"))):
        shown = name or BASE_FOR_NEW
        raise UsageError(
            f"name the profile that gets the sizes: -p my_vehicle.yaml, or -p {shown} "
            f"-o my_vehicle.yaml for a small new one that extends {shown}"
        )
    path = Path(name).expanduser()
    return (name if path.exists() else BASE_FOR_NEW), path


def _named_from(base: str, path: Path) -> str:
    """How the new profile at `path` names its base: a file by its path from there."""
    file = Path(base).expanduser()
    if not ("/" in base or base.endswith((".yaml", ".yml"))):
        return base
    same = file.resolve().parent == path.resolve().parent
    return file.name if same else str(file.resolve())


def _measured(text: str | None, name: str) -> float | None:
    return None if text is None else parse_length(text, f"--measured-{name}", bare_unit="mm")


# -- what both need -------------------------------------------------------------


def _target(request: TargetRequest, profile: Profile) -> TargetConfig:
    """The profile's target with the options on top."""
    markers = {}
    for name, side, marker_id, dictionary in (
        ("large", request.large, request.large_id, request.large_dict),
        ("small", request.small, request.small_id, request.small_dict),
    ):
        old: MarkerConfig = getattr(profile.target, name)
        if dictionary is not None and marker_id is None:
            raise UsageError(f"--{name}-dict needs --{name}-id: ids belong to their dictionary")
        chosen = dictionary or old.dictionary
        number = old.id if marker_id is None else marker_id
        try:
            check_marker_id(chosen, number)
        except ValueError as error:
            raise InvalidValue(f"--{name}-id, --{name}-dict: {error}") from None
        side_m = old.side_m if side is None else parse_length(side, f"--{name}")
        if not SIDE_LIMITS_M[0] <= side_m <= SIDE_LIMITS_M[1]:
            raise InvalidValue(
                f"--{name}: {millimetres(side_m)} mm is outside of {SIDE_LIMITS_M[0] * 1e3:g} mm "
                f"to {SIDE_LIMITS_M[1]:g} m"
            )
        markers[name] = MarkerConfig(dictionary=chosen, id=number, side_m=side_m)
    if markers["small"].side_m >= markers["large"].side_m / 2:
        raise InvalidValue(
            f"the small marker ({millimetres(markers['small'].side_m)} mm) must be less than half "
            f"of the large one ({millimetres(markers['large'].side_m)} mm)"
        )
    return TargetConfig(**markers)


def _magnet_m(request: TargetRequest) -> float:
    return parse_length(request.magnet, "--magnet")


def _within(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise InvalidValue(f"{name} {value:g}: allowed are {low:g} to {high:g} {unit}")
