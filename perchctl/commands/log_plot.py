"""The work behind `perchctl log plot`."""

from __future__ import annotations

from pathlib import Path

from perchctl.commands.log_file import log_file, opened
from perchctl.commands.output import print_record
from perchctl.files import check_output
from perchctl.log import path_beside, summarise_flight

FORMATS = (".png", ".pdf", ".svg")
DRAWN_IN = "what plots are drawn in"


def run(
    file: Path | None,
    output: Path | None = None,
    force: bool = False,
    profile: str | None = None,
    log_dir: Path | None = None,
    as_json: bool = False,
) -> int:
    """Draw; returns the exit code. Errors: NotFound, InvalidValue, UsageError."""
    path = log_file(file, profile, log_dir)
    picture = output or path_beside(path, ".png")
    with opened(path) as log:
        check_output(picture, FORMATS, force, DRAWN_IN)
        outcome = summarise_flight(log).outcome
    from perchctl.log import plot_flight

    plot_flight(log, picture)
    if as_json:
        print_record({"log": str(path), "plot": str(picture), "outcome": outcome})
    else:
        print(f"plot:      {picture}")
    return 0
