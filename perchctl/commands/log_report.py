"""The work behind `perchctl log report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.errors import UsageError


@dataclass(frozen=True)
class ReportRequest:
    """The command line as it was given; None is not given."""

    files: tuple[Path, ...]
    output: Path | None = None
    force: bool = False
    as_json: bool = False


def run(request: ReportRequest) -> int:
    """Errors: UsageError, as it is not there yet."""
    raise UsageError("perchctl log report is not part of this version")
