"""The work behind `perchctl log plot`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.commands.log_file import log_file, opened
from perchctl.commands.output import print_record
from perchctl.files import check_output
from perchctl.log import path_beside, summarise_flight

FORMATS = (".png", ".pdf", ".svg")
DRAWN_IN = "what plots are drawn in"


@dataclass(frozen=True)
class PlotRequest:
    """The command line as it was given; None is not given."""

    file: Path | None = None
    output: Path | None = None
    force: bool = False
    profile: str | None = None
    log_dir: Path | None = None
    as_json: bool = False


def run(request: PlotRequest) -> int:
    """Draw; returns the exit code. Errors: NotFound, InvalidValue, UsageError."""
    path = log_file(request.file, request.profile, request.log_dir)
    picture = request.output or path_beside(path, ".png")
    with opened(path) as log:
        check_output(picture, FORMATS, request.force, DRAWN_IN)
        outcome = summarise_flight(log).outcome
    from perchctl.log import plot_flight

    plot_flight(log, picture)
    if request.as_json:
        print_record({"log": str(path), "plot": str(picture), "outcome": outcome})
    else:
        print(f"plot:      {picture}")
    return 0
