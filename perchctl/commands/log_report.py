"""The work behind `perchctl log report`."""

from __future__ import annotations

from collections.abc import Sequence
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


def run(
    named: Sequence[Path],
    output: Path | None,
    force: bool,
    profile: str | None,
    log_dir: Path | None,
    as_json: bool,
) -> int:
    """Errors: NotFound and InvalidValue (a log, the place of the page), UsageError."""
    files = _files([log_file(name, profile, log_dir) for name in named or (None,)])
    output = output or (report_path_of(files[0]) if len(files) == 1 else session_path_of(files))
    if any(same_file(output, path) for path in files):
        raise UsageError(f"{output} is one of the logs; write the page to another file")
    check_output(output, REPORT_SUFFIXES, force, "a page for a browser")
    flights = write_report(files, output)
    if as_json:
        print_record(_record(output, flights))
    else:
        print(output)
        say(
            flight_counts_text(flights) if len(flights) > 1 else f"one flight: {flights[0].outcome}"
        )
    return 0


def _files(paths: Sequence[Path]) -> tuple[Path, ...]:
    """Each log once."""
    files: list[Path] = []
    for path in paths:
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
