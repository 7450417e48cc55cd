"""The work behind `perchctl make-target`: print, check, design, and write what was measured."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perchctl.calibration import load_calibration, profile_camera
from perchctl.commands.make_target_request import (
    TargetOutcome,
    TargetRequest,
    check_request,
    check_within,
    requested_target,
)
from perchctl.commands.output import print_record
from perchctl.errors import InvalidValue, PerchError, UsageError
from perchctl.files import check_output, check_place, write_files
from perchctl.profile import Profile, TargetConfig, find_calibration, load_profile
from perchctl.target import (
    Optics,
    Page,
    blind_lines,
    board_page,
    check_target,
    compare_designs,
    describe_design,
    design_record,
    error_curve,
    make_design,
    measured_target,
    mm_text,
    mounted_camera,
    new_profile_text,
    parse_board,
    parse_length,
    parse_page,
    suggest_target,
    target_pages,
    tile_page,
    updated_profile_text,
    write_profile,
)

__all__ = ["TargetRequest", "run"]

DESIGN_PLOT, SUGGESTION_PLOT = Path("design.png"), Path("suggestion.png")
DEFAULT_PROFILE = "sim"
BLUR_LIMIT_PX, NOISE_LIMIT = 20.0, 60.0


def run(request: TargetRequest) -> int:
    """Do the one task that was requested, print what came of it; returns the exit code.

    Raises NotFound, InvalidValue, UsageError; then nothing has been written.
    """
    check_request(request)
    if request.board is not None:
        outcome = _board(request, request.board)
    elif request.measured_large is not None or request.measured_small is not None:
        outcome = write_measured(request)
    elif request.camera is not None:
        outcome = _design(request, request.camera)
    else:
        profile = load_profile(request.profile or DEFAULT_PROFILE)
        target = requested_target(request, profile)
        outcome = _target(request, profile, target)
        outcome.lines.extend(_mounting(profile, target))
    for path in outcome.files:
        check_place(path, request.force)
    write_files(outcome.files)
    if request.as_json:
        print_record(outcome.record)
    else:
        print("\n".join(outcome.lines))
    return 0


def _target(request: TargetRequest, profile: Profile, target: TargetConfig) -> TargetOutcome:
    """The target's sheet, front and back, checked before it is written."""
    page = parse_page(request.page)
    check = check_target(target, request.magnet_m)
    # Options on top of a profile make it another target, with no date.
    own = target == profile.target
    date = profile.date if own else None
    origin = f"profile {profile.name}" if own else "sizes from the command line"
    pages = target_pages(target, page, request.magnet_m, origin, date)
    title = f"perchctl target, {mm_text(target.large.side_m)} mm"
    files = _sheet_files(request, "target.pdf", pages, title, date)
    lines = [
        *(f"wrote {path}" for path in files),
        check.text(target),
        "print at 100 % and measure both rulers: 100 mm each",
    ]
    record = {
        "files": [str(path) for path in files],
        "target": target.model_dump(mode="json"),
        "white_centre": check.white_centre,
        "white_centre_ids": list(check.white_ids),
    }
    return TargetOutcome(files, lines, record)


def _mounting(profile: Profile, target: TargetConfig) -> list[str]:
    """What the profile's camera sees of that target to the end; nothing without a
    calibration, as a sheet needs none."""
    try:
        camera = profile_camera(profile.camera)
    except PerchError:
        return []
    name = profile.camera.calibration
    return [f"{name}: {text}" for text in blind_lines(mounted_camera(target, camera, profile))]


def _board(request: TargetRequest, notation: str) -> TargetOutcome:
    """The sheet of a calibration board."""
    board = parse_board(notation)
    if board.scale != (1.0, 1.0):
        raise UsageError(f"--board {notation}: a board is printed as meant; leave out :measured=")
    page = board_page(board, parse_page(request.page))
    files = _sheet_files(request, "board.pdf", [page], f"perchctl {board.notation()}")
    lines = [
        *(f"wrote {path}" for path in files),
        "print at 100 %, glue it on something flat, and measure both rulers: 100 mm each",
    ]
    record = {"files": [str(path) for path in files], "board": board.notation()}
    return TargetOutcome(files, lines, record)


def _sheet_files(
    request: TargetRequest,
    default: str,
    pages: Sequence[Page],
    title: str,
    date: datetime.date | None = None,
) -> dict[Path, bytes]:
    """The PDF, by its place."""
    from perchctl.target import pdf_bytes

    pdf = request.output or Path(default)
    if pdf.suffix.lower() != ".pdf":
        raise UsageError(f"-o {pdf}: the file must end in .pdf")
    printed = list(pages)
    if request.tile is not None:
        sheet = parse_page(request.tile)
        printed = [tile for page in pages for tile in tile_page(page, sheet)]
    return {pdf: pdf_bytes(printed, title, date)}


def _design(request: TargetRequest, camera_name: str) -> TargetOutcome:
    """The ranges of a target for a camera, with its picture, and its sheet with `-o`."""
    from perchctl.target import draw_design

    if request.suggest and request.output is not None:
        raise UsageError("--suggest prints a command to run; give -o to that command")
    check_within("--blur", request.blur_px, 0.0, BLUR_LIMIT_PX, "px")
    check_within("--noise", request.noise, 0.0, NOISE_LIMIT, "grey levels")
    if request.ceiling_m is not None:
        check_within("--ceiling", request.ceiling_m, 0.3, 50.0, "m")
    profile = load_profile(request.profile or DEFAULT_PROFILE)
    path = find_calibration(camera_name)
    camera = load_calibration(path, cam=request.cam)
    plot = request.plot or (SUGGESTION_PLOT if request.suggest else DESIGN_PLOT)
    check_output(plot, (".png",), request.force)
    optics = Optics(request.blur_px, request.noise)
    lines: list[str] = []
    record: dict[str, Any] = {}
    if request.suggest:
        found, design = suggest_target(
            camera, optics, profile, request.magnet_m, request.ceiling_m, request.page
        )
        present = make_design(profile.target, camera, optics, profile, request.ceiling_m)
        lines += [f"note: {note}" for note in found.notes] + [found.command(), ""]
        lines += [f"why: {reason}" for reason in found.reasons]
        lines += [*compare_designs(design, present, f"profile {profile.name}"), ""]
        record = {
            "command": found.command(),
            "reasons": list(found.reasons),
            "notes": list(found.notes),
        }
    else:
        target = requested_target(request, profile)
        design = make_design(target, camera, optics, profile, request.ceiling_m)
    curve = error_curve(design)
    lines.append(describe_design(design, curve, str(path)))
    record |= design_record(design) | {"target": design.target.model_dump(mode="json")}
    files: dict[Path, bytes] = {}
    if request.output is not None:
        sheet = _target(request, profile, design.target)
        lines += sheet.lines
        files |= sheet.files
    if plot in files:
        raise UsageError(f"{plot} is the sheet's picture already; name another with --plot")
    files[plot] = draw_design(design, curve)
    lines.append(f"wrote {plot}")
    return TargetOutcome(files, lines, record | {"files": [str(path) for path in files]})


# --- `perchctl make-target --measured-large, --measured-small`: sizes of the print into a profile


BASE_FOR_NEW = "crazyflie"
"""What a new profile extends where -p names a file that does not exist yet."""


def write_measured(request: TargetRequest) -> TargetOutcome:
    """Write a profile with the measured sizes.

    Raises NotFound, InvalidValue, UsageError; then nothing has been written.
    """
    base, path = _profile_to_write(request)
    changed = path.exists() and request.output is None
    if changed and not request.force:
        raise InvalidValue(
            f"{path} exists already; add --force to write the sizes into it, "
            f"or -o NEW.yaml for a small profile that extends it"
        )
    check_place(path, request.force)
    profile = load_profile(base)
    found = measured_target(
        requested_target(request, profile),
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
    return TargetOutcome({}, lines, record | {"notes": list(found.notes)})


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
