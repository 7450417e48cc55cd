"""The files that a profile names: the camera's calibration and mask."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound, distinct_figures
from perchctl.places import data_file, data_folder, file_names


def find_calibration(name: str) -> Path:
    """A calibration file by path, or by name from `calib/`. (A loaded profile names its own by
    the whole path.)"""
    given = Path(name).expanduser()
    if given.is_file():
        return given
    found = data_file("calib", name)
    if found is None:
        raise NotFound(
            f"calibration file {name} not found; give a path, or one of "
            + (", ".join(file_names("calib")) or f"none ({data_folder('calib')} is empty)")
        )
    return found


MOST_COVERED = 0.75
"""Of the picture; with more of it covered there is no room for a target."""
_WHITE = 127


def find_mask(name: str) -> Path:
    """The file of a mask, which a loaded profile names by the whole path."""
    path = Path(name)
    if not path.is_file():
        raise NotFound(
            f"camera.mask: {name} does not exist; "
            f"perchctl calibrate mask SOURCE -o {path.name} makes one, or remove the key"
        )
    return path


def read_mask(name: str, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Where the vehicle covers a picture of that width and height, (height, width): white in
    the file. Errors: NotFound, InvalidValue."""
    path = find_mask(name)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InvalidValue(f"camera.mask: {path} cannot be read as a picture")
    height, width = image.shape[:2]
    if (width, height) != size_px:
        raise InvalidValue(
            f"camera.mask: {path} has {width}x{height} px, but the calibration was made at "
            f"{size_px[0]}x{size_px[1]} px: the mask must be of the camera's own pictures"
        )
    covered = np.asarray(image > _WHITE)
    share = float(covered.mean())
    if share > MOST_COVERED:
        covers, allowed = distinct_figures(100.0 * share, 100.0 * MOST_COVERED, 0)
        raise InvalidValue(
            f"camera.mask: {path} covers {covers} % of the picture, at most {allowed} % are "
            f"allowed: white is what the vehicle covers, black is free"
        )
    if share == 0.0:
        raise InvalidValue(
            f"camera.mask: {path} covers nothing: white is what the vehicle covers; "
            f"remove the key if that is nothing"
        )
    return covered
