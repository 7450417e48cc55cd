"""The work behind `perchctl log show`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.errors import UsageError


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
    """Errors: UsageError, as it is not there yet."""
    raise UsageError("perchctl log show is not part of this version")
