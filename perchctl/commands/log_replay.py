"""The work behind `perchctl log replay`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.errors import UsageError


@dataclass(frozen=True)
class ReplayRequest:
    """The command line as it was given; None is not given."""

    file: Path
    as_json: bool = False


def run(request: ReplayRequest) -> int:
    """Errors: UsageError, as it is not there yet."""
    raise UsageError("perchctl log replay is not part of this version")
