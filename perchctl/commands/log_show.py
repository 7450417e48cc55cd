"""The work behind `perchctl log show`: a flight told from its log, or the newest logs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.commands.log_file import log_file, log_folder, opened
from perchctl.commands.output import print_record
from perchctl.errors import UsageError
from perchctl.log import list_lines, list_log, list_record, newest_logs, show_record, show_text

MOST_LISTED = 10


@dataclass(frozen=True)
class ShowRequest:
    """The command line as it was given; None is not given."""

    file: Path | None = None
    listed: bool = False
    count: int | None = None
    profile: str | None = None
    log_dir: Path | None = None
    as_json: bool = False


def run(request: ShowRequest) -> int:
    """Print; returns the exit code. Errors: NotFound, InvalidValue, UsageError."""
    if request.listed:
        return _list(request)
    if request.count is not None:
        raise UsageError("--count is of --list: add that, or leave it out")
    path = log_file(request.file, request.profile, request.log_dir)
    with opened(path) as log:
        if request.as_json:
            print_record(show_record(log))
        else:
            print(show_text(log))
    return 0


def _list(request: ShowRequest) -> int:
    if request.file is not None:
        raise UsageError(
            f"--list is of a folder, and {request.file} is named: leave it out, or name the "
            f"folder with --log-dir"
        )
    folder = log_folder(request.profile, request.log_dir)
    logs = [list_log(path) for path in newest_logs(folder, request.count or MOST_LISTED)]
    if request.as_json:
        print_record({"folder": str(folder), "logs": [list_record(each) for each in logs]})
    else:
        print("\n".join(list_lines(logs)))
    return 0
