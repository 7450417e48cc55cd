"""The work behind `perchctl log show`: a flight told from its log, or the newest logs."""

from __future__ import annotations

from pathlib import Path

from perchctl.commands.log_file import log_file, log_folder, opened
from perchctl.commands.output import print_record
from perchctl.errors import UsageError
from perchctl.log import list_lines, list_log, list_record, newest_logs, show_record, show_text

MOST_LISTED = 10


def run(
    file: Path | None,
    listed: bool,
    count: int | None,
    profile: str | None,
    log_dir: Path | None,
    as_json: bool,
) -> int:
    """Print; returns the exit code. Errors: NotFound, InvalidValue, UsageError."""
    if listed:
        if file is not None:
            raise UsageError(
                f"--list is of a folder, and {file} is named: leave it out, or name the "
                f"folder with --log-dir"
            )
        return _list(log_folder(profile, log_dir), count or MOST_LISTED, as_json)
    if count is not None:
        raise UsageError("--count is of --list: add that, or leave it out")
    with opened(log_file(file, profile, log_dir)) as log:
        if as_json:
            print_record(show_record(log))
        else:
            print(show_text(log))
    return 0


def _list(folder: Path, count: int, as_json: bool) -> int:
    logs = [list_log(path) for path in newest_logs(folder, count)]
    if as_json:
        print_record({"folder": str(folder), "logs": [list_record(each) for each in logs]})
    else:
        print("\n".join(list_lines(logs)))
    return 0
