"""What became of a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RecordingEnd:
    """What became of a recording.

    Attributes:
        pictures: how many are in it; `missing`: how many are not, and `problem`: the first
            reason why.
    """

    path: Path
    pictures: int
    missing: int = 0
    problem: str | None = None

    @property
    def text(self) -> str:
        told = f"{self.pictures} pictures in {self.path}"
        if self.missing:
            told += f", {self.missing} missing"
        return f"{told} ({self.problem})" if self.problem else told
