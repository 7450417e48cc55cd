"""The work behind `perchctl log export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.errors import UsageError


@dataclass(frozen=True)
class ExportRequest:
    """The command line as it was given; None is not given."""

    file: Path | None = None
    csv: bool = False
    parquet: bool = False
    mcap: bool = False
    output: Path | None = None
    force: bool = False
    profile: str | None = None
    log_dir: Path | None = None
    as_json: bool = False


def run(request: ExportRequest) -> int:
    """Errors: UsageError, as it is not there yet."""
    raise UsageError("perchctl log export is not part of this version")
