"""`perchctl make-target`: print the target or a board, design a target, write measured sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import profile as profiles
from perchctl import target as targets
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    ProfileOption,
    command,
    new_app,
)
from perchctl.commands.output import print_result, say_on_terminal
from perchctl.errors import UsageError
from perchctl.files import check_output, write_files

PageOption = Annotated[
    str, typer.Option("--page", help="Page size: a4, letter, a3, or a size such as 220x240mm.")
]
MagnetOption = Annotated[
    str, typer.Option("--magnet", help="Diameter of the magnet behind the sheet.")
]


CameraArgument = Annotated[
    str | None, typer.Argument(help="Calibration file. Default: the one in the profile.")
]
CeilingOption = Annotated[
    float | None,
    typer.Option(
        "--ceiling",
        min=0.3,
        max=50.0,
        help="Height of the ceiling above the floor, m.",
    ),
]
BlurOption = Annotated[
    float,
    typer.Option("--blur", min=0.0, max=20.0, help="Blur of the image, sigma in px."),
]

app = new_app(Group)


@command(
    app,
    "perchctl make-target -p crazyflie -o target.pdf",
    "perchctl make-target -p my_vehicle.yaml --page letter",
    "perchctl make-target -p my_vehicle.yaml --page 442x478mm --magnet 80mm",
    short_help="Write a true-to-size PDF of the target, front and back.",
)
def sheet(
    profile: ProfileOption = "sim",
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF to write.")] = Path(
        "target.pdf"
    ),
    page: PageOption = "a4",
    magnet: MagnetOption = "50mm",
    force: ForceOption = False,
) -> None:
    """Make a PDF of the target or a calibration board, design a target, or enter its printed size.

    By default (subcommand sheet), perchctl writes a true-to-size PDF of the profile's target, front
    and back. It first verifies that the markers can be detected.
    """
    say_on_terminal(f"reading profile {profile}")
    config = profiles.load_profile(profile)
    magnet_m = targets.parse_length(magnet, "--magnet")
    check_output(output, (".pdf",), force, "a sheet to print")
    origin = f"profile {config.name}"
    write_files({output: targets.target_pdf(config.target, page, magnet_m, origin, config.date)})
    print(f"wrote {output}")
    print("print at 100 %, and check that both rulers measure 100 mm")


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
            help="Board: charuco:10x7:25mm:18mm:DICT_5X5_100 (squares) or chessboard:9x6:25mm "
            "(inner corners)."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF to write.")] = Path(
        "board.pdf"
    ),
    page: PageOption = "a4",
    force: ForceOption = False,
) -> None:
    """Write a PDF of a calibration board, specified as for calibrate --board."""
    say_on_terminal(f"reading board {notation}")
    printed = targets.Board.parse(notation)
    if printed.scale != (1.0, 1.0):
        raise UsageError(
            f"{notation}: a board is printed at its nominal size; leave out :measured="
        )
    check_output(output, (".pdf",), force, "a sheet to print")
    write_files({output: targets.board_pdf(printed, page)})
    print(f"wrote {output}")
    print(
        "print at 100 %, check that both rulers measure 100 mm, and glue the board to "
        "something flat"
    )


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
    """Compute the distances at which each marker can be read, and any at which neither can."""
    say_on_terminal(f"reading profile {profile}")
    config = profiles.load_profile(profile)
    path = profiles.find_calibration(camera or config.camera.calibration)
    model = calibrations.load_calibration(path)
    say_on_terminal(f"finding the smallest markers that are readable at a blur of {blur:g} px")
    found = targets.make_design(config.target, model, blur, config, ceiling)
    record = found.record() | {"target": config.target.model_dump(mode="json")}
    print_result(record if as_json else found.text(str(path)))


@command(
    app,
    "perchctl make-target measured -p mine.yaml --measured-large 149.6",
    "perchctl make-target measured -p mine.yaml --measured-small 24.9mm",
    "perchctl make-target measured -p b.yaml --measured-large 15.1cm",
)
def measured(
    profile: ProfileOption,
    large: Annotated[
        str | None,
        typer.Option("--measured-large", help="Measured side of the large black square, mm."),
    ] = None,
    small: Annotated[
        str | None,
        typer.Option("--measured-small", help="Measured side of the small black square, mm."),
    ] = None,
) -> None:
    """Write the marker sizes that you measured on the print to the profile."""
    if large is None and small is None:
        raise UsageError("no size is given: add --measured-large, --measured-small or both, in mm")
    say_on_terminal(f"reading profile {profile}")
    config, path = profiles.load_profile(profile), profiles.writable_profile(profile)
    sides_m = {
        name: targets.parse_length(text, f"--measured-{name}", bare_unit="mm")
        for name, text in (("large", large), ("small", small))
        if text is not None
    }
    found, notes = targets.measured_target(config.target, sides_m)
    # All keys of a marker are written, because the base profile may lack that marker.
    values = {
        f"target.{name}.{key}": value
        for name in sides_m
        for key, value in getattr(found, name).model_dump().items()
    }
    before = profiles.write_profile_values(path, values | {"target.size_sigma": found.size_sigma})
    for note in notes:
        print(note)
    print(f"changed {path}; the old version is in {before}")
