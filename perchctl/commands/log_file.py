"""Which log a command of `perchctl log` means, and reading it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from perchctl.commands.output import say
from perchctl.errors import UsageError
from perchctl.log import FlightLog, log_values, newest_logs, read_log
from perchctl.profile import Profile, load_profile


def log_file(file: Path | None, profile: str | None, log_dir: Path | None) -> Path:
    """The one that is named; else the newest of the folder, which is said.

    Errors: NotFound, InvalidValue (a profile), UsageError.
    """
    if file is None:
        (newest,) = newest_logs(log_folder(profile, log_dir), 1)
        say(f"the newest log: {newest}")
        return newest
    for option, value in (("--profile", profile), ("--log-dir", log_dir)):
        if value is not None:
            raise UsageError(f"{option} says where the newest log is, but {file} is named: "
                             f"leave out one of them")  # fmt: skip
    return file


def log_folder(profile: str | None, log_dir: Path | None) -> Path:
    """Where `fly` puts the logs. Errors: NotFound, InvalidValue, UsageError."""
    if log_dir is not None:
        if profile is not None:
            raise UsageError("--profile and --log-dir both say where the logs are: leave out one")
        return log_dir
    return Path((Profile() if profile is None else load_profile(profile)).log.directory)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[FlightLog]:
    """The log; within, a value in it that is of no flight is an error of the file: read and decode
    within, and decide and draw after it, where a fault is the program's.

    Errors: NotFound, InvalidValue.
    """
    log = read_log(path)
    with log_values(path):
        yield log
