"""The options of `perchctl fit-weights`, as they were given."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class CollectRequest:
    """The options of collecting as they were given; `session` is None without `--collect`."""

    session: Path | None = None
    profile: str = "sim"
    positions: int = 10
    frames: int = 100
    truth: str = "typed"
    source: str | None = None
    uri: str | None = None
    mocap: str | None = None
    bodies: str | None = None
    target: str | None = None
    seed: int = 0
    noise: float = 4.0
    blur: float = 1.0


@dataclass(frozen=True)
class FitRequest:
    """The command line as it was given; None is not given. What is collected is fitted too."""

    data: tuple[Path, ...] = ()
    profile: str = "sim"
    collecting: CollectRequest = field(default_factory=CollectRequest)
    method: str = "closed_form"
    step: float | None = None
    passes: int | None = None
    order: str = "shuffled"
    start: float = 0.5
    test: Path | None = None
    output: Path | None = None
    plot: Path | None = None
    anyway: bool = False
    force: bool = False
    as_json: bool = False
