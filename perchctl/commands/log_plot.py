"""The work behind `perchctl log plot`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.errors import UsageError


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
    """Errors: UsageError, as it is not there yet."""
    raise UsageError("perchctl log plot is not part of this version")
