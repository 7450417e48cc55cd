"""The work behind `perchctl log compare`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from perchctl.errors import UsageError


@dataclass(frozen=True)
class CompareRequest:
    """The command line as it was given; None is not given."""

    one: Path
    other: Path
    output: Path | None = None
    force: bool = False
    as_json: bool = False


def run(request: CompareRequest) -> int:
    """Errors: UsageError, as it is not there yet."""
    raise UsageError("perchctl log compare is not part of this version")
