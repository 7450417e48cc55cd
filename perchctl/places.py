"""Paths of perchctl's shipped files and of the user's."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import platformdirs

_PACKAGE = Path(__file__).resolve().parent


def data_folder(kind: str) -> Path:
    """The folder of shipped `profiles` or `calib`: inside an installed wheel, or in the
    checkout."""
    shipped = _PACKAGE / "_data" / kind
    return shipped if shipped.is_dir() else _PACKAGE.parent / kind


def data_file(kind: str, name: str) -> Path | None:
    """A shipped or user file by name (with or without .yaml), or None."""
    for folder in (user_folder("config") / kind, data_folder(kind)):
        for candidate in (folder / name, folder / f"{name}.yaml"):
            if candidate.is_file():
                return candidate
    return None


def file_names(kind: str) -> list[str]:
    """The names, without folder and suffix, of the shipped and user files of a kind."""
    folders = (data_folder(kind), user_folder("config") / kind)
    return sorted({p.stem for f in folders if f.is_dir() for p in f.glob("*.yaml")})


def is_shipped_example(path: Path) -> bool:
    """Return whether a calibration is a shipped example by what is in it: a copy under another name
    fits no other lens."""
    try:
        text = path.read_bytes()
        return any(text == file.read_bytes() for file in data_folder("calib").glob("example_*"))
    except OSError:
        return False


def user_folder(kind: Literal["config", "cache", "state", "runtime"]) -> Path:
    """A folder of the user's by the XDG rules: for own profiles and calibrations, for what
    can be made anew, for results, or for what lives no longer than a session. It is not made."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where the system names none, another is taken
        find = getattr(platformdirs, f"user_{kind}_dir")
        return Path(find("perchctl", appauthor=False))
