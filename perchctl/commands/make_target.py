"""`perchctl make-target`: print the target or a board, design a target, write measured sizes."""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from perchctl.calibration import load_calibration
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    command,
    new_app,
)
from perchctl.commands.output import print_result
from perchctl.errors import InvalidValue, UsageError
from perchctl.files import check_output, write_files
from perchctl.profile import (
    MarkerConfig,
    Profile,
    TargetConfig,
    check_marker_id,
    find_calibration,
    load_profile,
    write_profile_values,
)
from perchctl.target import (
    Board,
    board_pdf,
    make_design,
    measured_target,
    mm_text,
    parse_length,
    target_pdf,
)
from perchctl.vision import CameraModel

SIDE_LIMITS_M = (0.004, 2.0)

PageOption = Annotated[str, typer.Option("--page", help="a4, letter, a3, or 220x240mm.")]
MagnetOption = Annotated[
    str, typer.Option("--magnet", help="Diameter of the magnet behind the sheet.")
]


def _of_target(name: str, text: str, **limits: Any) -> Any:
    return typer.Option(name, help=text, **limits)


LargeOption = Annotated[
    str | None, _of_target("--large", "Side of the large marker: 150mm, 15cm, 0.15m.")
]
LargeIdOption = Annotated[int | None, _of_target("--large-id", "Its id.", min=0)]
LargeDictOption = Annotated[
    str | None, _of_target("--large-dict", "Its dictionary, such as DICT_4X4_1000.")
]
SmallOption = Annotated[
    str | None, _of_target("--small", "Side of the small marker, with its unit.")
]
SmallIdOption = Annotated[int | None, _of_target("--small-id", "Its id.", min=0)]
SmallDictOption = Annotated[
    str | None, _of_target("--small-dict", "Its dictionary: DICT_ARUCO_ORIGINAL, ...")
]


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter("must be a number")
    return value


CameraArgument = Annotated[
    str | None, typer.Argument(help="Calibration file; by default the profile's.")
]
CeilingOption = Annotated[
    float | None,
    typer.Option(
        "--ceiling",
        min=0.3,
        max=50.0,
        callback=_finite,
        help="Height of the ceiling over the floor, m.",
    ),
]
BlurOption = Annotated[
    float,
    typer.Option(
        "--blur", min=0.0, max=20.0, callback=_finite, help="Sigma of the picture's blur, px."
    ),
]

app = new_app(Group)


@command(
    app,
    "perchctl make-target -p crazyflie -o target.pdf",
    "perchctl make-target --large 120mm --small 20mm --page letter",
    "perchctl make-target --large 355mm --small 35mm --page 442x478mm",
    short_help="Print the target true to size, front and back.",
)
def sheet(
    profile: ProfileOption = "sim",
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF to write.")] = Path(
        "target.pdf"
    ),
    page: PageOption = "a4",
    magnet: MagnetOption = "50mm",
    force: ForceOption = False,
    large: LargeOption = None,
    large_id: LargeIdOption = None,
    large_dict: LargeDictOption = None,
    small: SmallOption = None,
    small_id: SmallIdOption = None,
    small_dict: SmallDictOption = None,
) -> None:
    """Print the target true to size, or a board; design it; write measured sizes.

    sheet writes a PDF of the profile's target, front and back, checked before it is written.
    """
    config = load_profile(profile)
    target = _chosen(config, (large, large_id, large_dict), (small, small_id, small_dict))
    magnet_m = parse_length(magnet, "--magnet")
    check_output(output, (".pdf",), force, "what is printed")
    write_files({output: target_pdf(target, page, magnet_m, *_origin(config, target))})
    print(f"wrote {output}")
    print("both markers are read from the drawing")
    print("print at 100 % and measure both rulers: 100 mm each")


@command(
    app,
    "perchctl make-target board charuco:10x7:25mm:18mm:DICT_5X5_100",
    "perchctl make-target board chessboard:9x6:25mm --page letter -o chess.pdf",
    "perchctl make-target board chessboard:13x9:25mm --page a3",
)
def board(
    notation: Annotated[
        str,
        typer.Argument(
            help="charuco:10x7:25mm:18mm:DICT_5X5_100 (squares), chessboard:9x6:25mm (inner "
            "corners)."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF to write.")] = Path(
        "board.pdf"
    ),
    page: PageOption = "a4",
    force: ForceOption = False,
) -> None:
    """Print a calibration board, in the notation that calibrate reads."""
    printed = Board.parse(notation)
    if printed.scale != (1.0, 1.0):
        raise UsageError(f"{notation}: a board is printed as meant; leave out :measured=")
    check_output(output, (".pdf",), force, "what is printed")
    write_files({output: board_pdf(printed, page)})
    print(f"wrote {output}")
    print("print at 100 %, glue it on something flat, and measure both rulers: 100 mm each")


@command(
    app,
    "perchctl make-target design",
    "perchctl make-target design example_640x480.yaml --ceiling 2.4 --blur 2.0",
    "perchctl make-target design -p my_vehicle.yaml",
)
def design(
    camera: CameraArgument = None,
    profile: ProfileOption = "sim",
    ceiling: CeilingOption = None,
    blur: BlurOption = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Compute from where to where a camera sees each marker, and where a gap is."""
    config = load_profile(profile)
    name, model = _camera(config, camera)
    found = make_design(config.target, model, blur, config, ceiling)
    record = found.record() | {"target": config.target.model_dump(mode="json")}
    print_result(record if as_json else found.text(name))


@command(
    app,
    "perchctl make-target measured -p mine.yaml --measured-large 149.6 --force",
    "perchctl make-target measured -p mine.yaml --measured-small 24.9 --force",
    "perchctl make-target measured -p b.yaml --measured-large 151 --force --json",
)
def measured(
    profile: Annotated[
        str, typer.Option("--profile", "-p", help="The profile's file, which gets the sizes.")
    ],
    measured_large: Annotated[
        str | None,
        typer.Option("--measured-large", help="Side of the large black square as printed, mm."),
    ] = None,
    measured_small: Annotated[
        str | None,
        typer.Option("--measured-small", help="Side of the small black square as printed, mm."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the sizes that were measured on the print into the profile that flies."""
    if measured_large is None and measured_small is None:
        raise UsageError("give --measured-large and --measured-small, in mm: nothing was measured")
    if "/" not in profile and not profile.endswith((".yaml", ".yml")):
        raise UsageError(
            f"name the file of the profile that gets the sizes, as in -p my_vehicle.yaml, not "
            f"{profile}; perchctl profile new makes one"
        )
    path = Path(profile).expanduser()
    config = load_profile(profile)
    if not force:
        raise InvalidValue(f"{path} exists already; add --force to write the sizes into it")
    sides_m = {
        name: parse_length(text, f"--measured-{name}", bare_unit="mm")
        for name, text in (("large", measured_large), ("small", measured_small))
        if text is not None
    }
    found, notes = measured_target(config.target, sides_m)
    values = _changed_values(found, config.target)
    before = write_profile_values(path, values) if values else None
    lines = [*notes, f"changed {path}: fly -p {path}"]
    if before is not None:
        lines.append(f"as it was before it is {before}")
    record = {
        "files": [str(path)],
        "target": found.model_dump(mode="json"),
        "notes": notes,
        "profile_before": before and str(before),
    }
    print_result(record if as_json else "\n".join(lines))


def _changed_values(new: TargetConfig, old: TargetConfig) -> dict[str, float | int | str]:
    """Return what has changed by the keys of a profile. A marker is written whole, since no base
    may have it."""
    values: dict[str, float | int | str] = {}
    for name in ("large", "small"):
        marker: MarkerConfig = getattr(new, name)
        if marker != getattr(old, name):
            values[f"target.{name}.dictionary"] = marker.dictionary
            values[f"target.{name}.id"] = marker.id
            values[f"target.{name}.side_m"] = marker.side_m
    if new.size_sigma != old.size_sigma:
        values["target.size_sigma"] = new.size_sigma
    return values


# --- What several of them do ------------------------------------------


Marker = tuple[str | None, int | None, str | None]
"""Side, id and dictionary of a marker as they were given."""


def _chosen(profile: Profile, large: Marker, small: Marker) -> TargetConfig:
    """Return the profile's target with the options on top."""
    markers = {}
    for name, (side, marker_id, dictionary) in (("large", large), ("small", small)):
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
        low_m, high_m = SIDE_LIMITS_M
        if not low_m <= side_m <= high_m:
            raise InvalidValue(
                f"--{name}: {mm_text(side_m)} mm is outside of {mm_text(low_m)} mm to {high_m:g} m"
            )
        markers[name] = MarkerConfig(dictionary=chosen, id=number, side_m=side_m)
    if markers["small"].side_m >= markers["large"].side_m / 2:
        raise InvalidValue(
            f"the small marker ({mm_text(markers['small'].side_m)} mm) must be less than half "
            f"of the large one ({mm_text(markers['large'].side_m)} mm)"
        )
    return profile.target.model_copy(update=markers)


def _camera(profile: Profile, name: str | None) -> tuple[str, CameraModel]:
    """Return the calibration's file, and the camera."""
    path = find_calibration(name or profile.camera.calibration)
    return str(path), load_calibration(path)


def _origin(profile: Profile, target: TargetConfig) -> tuple[str, datetime.date | None]:
    """Return where the sizes are from, and their date. Options on top of a profile make it another
    target, with no date."""
    if target == profile.target:
        return f"profile {profile.name}", profile.date
    return "sizes from the command line", None
