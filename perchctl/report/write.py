"""From logs to a page on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from perchctl.files import write_files
from perchctl.log import log_values, path_beside, read_log, recorded_pictures, recording_path
from perchctl.report.page import page_of
from perchctl.report.told import ReportedFlight, tell

REPORT_SUFFIXES = (".html", ".htm")
SESSION_NAME = "session.html"


def report_path_of(log_path: Path) -> Path:
    """Where a flight's report stands: beside its log, by its name."""
    return path_beside(log_path, REPORT_SUFFIXES[0])


def session_path_of(log_paths: Sequence[Path]) -> Path:
    """Where the report of several stands: beside the first log."""
    return log_paths[0].with_name(SESSION_NAME)


def told_of(log_path: Path) -> ReportedFlight:
    """One flight, with what was recorded beside its log. A recording that cannot be read costs
    the pictures only.

    Raises NotFound and InvalidValue for the log, as `read_log`.
    """
    log, recording = read_log(log_path), recording_path(log_path)
    with log_values(log_path):
        if not recording.is_file():
            return tell(log)
        return tell(log, lambda numbers: recorded_pictures(recording, exact=False, numbers=numbers))


def write_report(log_paths: Sequence[Path], output: Path) -> tuple[ReportedFlight, ...]:
    """Writes the page, whole or not at all; returns what it tells.

    Raises NotFound and InvalidValue, as `read_log` and `write_files`.
    """
    flights = tuple(told_of(path) for path in log_paths)
    write_files({output: page_of(flights).encode("utf-8")})
    return flights
