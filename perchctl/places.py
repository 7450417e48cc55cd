"""Paths of the files that perchctl ships, and of the user's files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import platformdirs

_PACKAGE = Path(__file__).resolve().parent


def data_folder(kind: str) -> Path:
    """The folder of shipped files of a `kind` (`profiles`, `fleets`, `calib`), in the wheel or in
    the checkout."""
    shipped = _PACKAGE / "_data" / kind
    return shipped if shipped.is_dir() else _PACKAGE.parent / kind


def data_file(kind: str, name: str) -> Path | None:
    """The path of a user's or shipped file with this name, with or without .yaml; None if there is
    none."""
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
    """True if a calibration has the same content as a shipped example, even under another name."""
    try:
        text = path.read_bytes()
        return any(text == file.read_bytes() for file in data_folder("calib").glob("example_*"))
    except OSError:
        return False


def user_folder(kind: Literal["config", "cache", "state", "runtime"]) -> Path:
    """Return a user folder according to the XDG specification, without creating it: `config` for
    profiles and calibrations, `cache` for data that can be recreated, `state` for results,
    `runtime` for locks."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # if the system defines no such folder, another one is used
        find = getattr(platformdirs, f"user_{kind}_dir")
        return Path(find("perchctl", appauthor=False))
