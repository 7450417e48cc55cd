"""What `perchctl calibrate` takes its views from: one source, or many picture files."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from perchctl.camera import (
    IMAGE_SUFFIXES,
    FrameSource,
    image_files,
    open_camera,
    parse_source,
    without_password,
)
from perchctl.errors import InvalidValue, NotFound, UsageError


@dataclass(frozen=True)
class Source:
    """A source as `open_camera` takes it, or the picture files that were named one by one."""

    spec: str
    files: tuple[Path, ...] = ()
    size_px: tuple[int, int] | None = None  # asked of a camera of this computer

    def __str__(self) -> str:
        """How messages name it."""
        if self.files:
            return f"{self.files[0]} and {len(self.files) - 1} more"
        return without_password(self.spec)

    @property
    def scheme(self) -> str:
        """``images``, ``video``, or a live source's."""
        return self.spec.partition(":")[0]

    @property
    def place(self) -> str:
        """What stands behind the scheme: a path, for ``images`` and ``video``."""
        return str(Path(self.spec.partition(":")[2]).expanduser())

    def pictures(self) -> list[Path]:
        """The picture files of a source of ``images``. Raises NotFound: there are none."""
        return image_files(self.files or self.place)

    def open(self) -> FrameSource:
        """Its frames, of a live source too. Errors: those of `open_camera`."""
        return open_camera(self.files or self.spec, time.monotonic, size_px=self.size_px)


def sized(source: Source, text: str | None) -> Source:
    """With `--size`. Errors: InvalidValue, UsageError."""
    if text is None:
        return source
    found = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text)
    if found is None:
        raise InvalidValue(f"--size: found {text!r}; needed is WIDTHxHEIGHT, as in 720x576")
    if source.scheme != "camera":
        raise UsageError(f"--size is asked of camera:N, and {source} has its own: leave it out")
    return replace(source, size_px=(int(found[1]), int(found[2])))


def source_of(words: Sequence[str]) -> Source:
    """The source that the command line names; several words are picture files, which is what
    a shell makes of ``left*.jpg``.

    Raises NotFound, UsageError.
    """
    if len(words) == 1:
        return Source(parse_source(words[0], files=True).spec)
    files = tuple(Path(word) for word in words)
    for file in files:
        if not file.exists():
            raise NotFound(f"{file} does not exist; several sources are picture files, one by one")
        if not file.is_file() or file.suffix.lower() not in IMAGE_SUFFIXES:
            raise UsageError(
                f"{file} is no picture file: several sources must all be pictures, as in "
                f"left*.jpg; a folder, a video or a camera stands alone"
            )
    return Source("images:", files)
