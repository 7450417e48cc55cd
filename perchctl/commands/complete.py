"""What the shell offers at Tab: profiles and sources by name, and files by what they end in."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable
from pathlib import Path

from perchctl.camera import IMAGE_SUFFIXES
from perchctl.commands.positioning import POSITIONINGS
from perchctl.places import file_names

_DEVICES = Path("/dev")
_SCHEMES = ("video:", "images:", "http://", "rtsp://", "aideck://", "sim:")
_YAML = (".yaml", ".yml")
_LOGS = (".jsonl", ".jsonl.gz")
_PICTURES = (*IMAGE_SUFFIXES, ".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v")


def profiles(begun: str) -> list[str]:
    """Names that go on from what was typed, then profile files and folders."""
    return [*_that_begin(begun, file_names("profiles")), *_files(begun, _YAML)]


def logs(begun: str) -> list[str]:
    return _files(begun, _LOGS)


def positionings(begun: str) -> list[str]:
    return _that_begin(begun, POSITIONINGS)


def sources(begun: str) -> list[str]:
    """Cameras that are there, the other kinds of sources, and files behind a kind's colon."""
    kind, colon, place = begun.partition(":")
    if colon and f"{kind}:" in _SCHEMES:
        return [f"{kind}:{path}" for path in _files(place, _PICTURES)]
    cameras = (path.name.removeprefix("video") for path in _DEVICES.glob("video*"))
    offered = (*(f"camera:{n}" for n in sorted(filter(str.isdigit, cameras), key=int)), *_SCHEMES)
    return [*_that_begin(begun, offered), *_files(begun, _PICTURES)]


def _that_begin(begun: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(begun)]


def _files(begun: str, ends: tuple[str, ...]) -> list[str]:
    """Paths that go on from what was typed, a folder with its slash. Files whose name begins
    with a dot are offered to whom types it."""
    found = []
    for path in sorted(glob.glob(f"{glob.escape(os.path.expanduser(begun))}*")):
        if os.path.isdir(path):
            found.append(f"{path}/")
        elif path.lower().endswith(ends):
            found.append(path)
    return found
