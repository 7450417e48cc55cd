"""The work behind `perchctl log report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.commands.log_file import log_file
from perchctl.commands.output import print_record, say
from perchctl.errors import UsageError
from perchctl.files import check_output, same_file
from perchctl.report import (
    REPORT_SUFFIXES,
    ReportedFlight,
    flight_counts_text,
    report_path_of,
    session_path_of,
    write_report,
)


@dataclass(frozen=True)
class ReportRequest:
    """The command line as it was given; None is not given."""

    files: tuple[Path, ...] = ()
    output: Path | None = None
    force: bool = False
    profile: str | None = None
    log_dir: Path | None = None
    as_json: bool = False


def run(request: ReportRequest) -> int:
    """Errors: NotFound and InvalidValue (a log, the place of the page), UsageError."""
    files = _files(request)
    output = request.output or (report_path_of(files[0]) if len(files) == 1 else None)
    output = output or session_path_of(files)
    if any(same_file(output, path) for path in files):
        raise UsageError(f"{output} is one of the logs; write the page to another file")
    check_output(output, REPORT_SUFFIXES, request.force, "a page for a browser")
    flights = write_report(files, output)
    if request.as_json:
        print_record(_record(output, flights))
    else:
        print(output)
        say(
            flight_counts_text(flights) if len(flights) > 1 else f"one flight: {flights[0].outcome}"
        )
    return 0


def _files(request: ReportRequest) -> tuple[Path, ...]:
    """Each log once; without any the newest."""
    named = request.files or (None,)
    files: list[Path] = []
    for name in named:
        path = log_file(name, request.profile, request.log_dir)
        if any(path == known or same_file(path, known) for known in files):
            say(f"{path} is named twice: it is told once")
            continue
        files.append(path)
    return tuple(files)


def _record(output: Path, flights: tuple[ReportedFlight, ...]) -> dict[str, object]:
    return {
        "report": str(output),
        "bytes": output.stat().st_size,
        "flights": [
            {
                "log": str(told.log.path),
                "outcome": told.outcome,
                "miss_m": told.summary.miss_m,
                "used_mah": round(told.energy.used_mah, 1),
                "pictures": None if told.pictures is None else len(told.pictures),
                "advice": [f"{a.about}: {a.text} ({a.evidence})" for a in told.advice],
            }
            for told in flights
        ],
    }
