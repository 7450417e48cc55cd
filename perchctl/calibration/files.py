"""Read calibration files from ROS, OpenCV and Kalibr, and write a YAML file that ROS, OpenCV and
PyYAML can read."""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.calibration.forms import Lens, parse_calibration
from perchctl.errors import InvalidValue, NotFound
from perchctl.files import file_kind, kind_note
from perchctl.geometry import Array
from perchctl.profile import CameraConfig, find_calibration
from perchctl.vision import CameraModel


def profile_camera(config: CameraConfig) -> CameraModel:
    """The calibrated camera of a profile. Raises the same errors as `load_calibration`."""
    return load_calibration(config.calibration)


@dataclass(frozen=True)
class CalibrationNotes:
    """What perchctl notes in a calibration file about its origin; empty for files from other
    programs.

    Attributes:
        board: the board's notation.
        picture_hashes: `perchctl.calibration.board.detect.BoardView.picture_hash` of the images.
    """

    board: str
    picture_hashes: frozenset[str]


def load_notes(path: Path) -> CalibrationNotes:
    """Read the notes in a calibration file. Raises the same errors as `load_calibration`."""
    _, values = _parsed(path)
    return CalibrationNotes(
        board=str(values.get("board") or ""),
        picture_hashes=frozenset(str(values.get("picture_hashes") or "").split()),
    )


def load_calibration(file: Path | str) -> CameraModel:
    """Read a camera model from a file, given by path or by name in `calib/`.

    Raises:
        NotFound: there is no such file. InvalidValue: the content of the file is invalid.
    """
    camera, _ = _parsed(find_calibration(file) if isinstance(file, str) else file)
    return camera


def _parsed(path: Path) -> tuple[CameraModel, dict[str, Any]]:
    """Return the camera, and the values of all keys in the file."""
    text = _text(path)
    try:
        lens, values = parse_calibration(text)
        return _checked(lens), values
    except InvalidValue as error:
        # If the file may be a calibration, tell the user which key is faulty; otherwise, what kind
        # of file it is.
        if note := kind_note(path, "a camera calibration", "a JSON file"):
            raise InvalidValue(f"{path} is not a camera calibration{note}") from None
        raise InvalidValue(f"{path}: {error}") from None


_MAY_BE_LATIN_1 = ("another kind of file", "a camera calibration", "a profile", "a JSON file")
"""Kinds of file, as named by `file_kind`, that an editor may have written in Latin-1."""


def _text(path: Path) -> str:
    """Return the text of a file in UTF-8 or, as written by some editors, UTF-16 or Latin-1. Raises
    NotFound, and InvalidValue if the content is not text."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise NotFound(f"calibration file {path} does not exist") from None
    except OSError as error:
        raise InvalidValue(f"{path}: cannot be read as a calibration: {error.strerror}") from None
    try:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return data.decode("utf-16")
        if b"\0" not in data:
            return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if file_kind(path) in _MAY_BE_LATIN_1:
            # Latin-1, with the quotation marks of Windows
            return data.decode("cp1252", errors="replace")
    raise InvalidValue(
        f"{path}: this is {file_kind(path)}, not a camera calibration: name the .yaml file from "
        "perchctl calibrate, or one from ROS, OpenCV or Kalibr"
    )


def _checked(lens: Lens) -> CameraModel:
    """Return the camera model for a lens. Raises InvalidValue for an implausible camera matrix."""
    camera = CameraModel(lens.size_px, lens.K, lens.distortion, lens.model)
    K = lens.K.copy()
    K[0, 1] = 0.0  # `CameraModel` allows a skew, but no computation uses it
    (width, height), (cx, cy) = camera.size_px, K[:2, 2]
    if not (0 < cx < width and 0 < cy < height and K[0, 0] > 0 and K[1, 1] > 0):
        raise InvalidValue(
            f"camera_matrix does not fit a {width}x{height} image: focal lengths "
            f"must be positive and the centre inside the image"
        )
    return replace(camera, K=K)


# --- Writing ---
# FileStorage requires ``dt: d`` and the first line ``%YAML 1.0``; PyYAML reads ``1e-05`` as text.


def calibration_text(
    camera: CameraModel, name: str, notes: Mapping[str, str | float | int | Array]
) -> str:
    """The text of a calibration file; `name` is the camera's name.

    `notes` are further keys, which ROS readers ignore, with numbers, strings or arrays (n, m).
    """
    # ROS requires five coefficients for plumb_bob.
    short = camera.model == "plumb_bob" and camera.dist.size == 4
    entries: dict[str, str | float | int | Array] = {
        "image_width": camera.size_px[0],
        "image_height": camera.size_px[1],
        "camera_name": name,
        "camera_matrix": camera.K,
        "distortion_model": "equidistant" if camera.model == "fisheye" else camera.model,
        "distortion_coefficients": np.append(camera.dist, [0.0] * short)[None],
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.column_stack([camera.K, np.zeros(3)]),
        **notes,
    }
    lines = ["%YAML 1.0", "---"]
    for key, value in entries.items():
        if isinstance(value, np.ndarray):
            rows, cols = value.shape
            data = ", ".join(_number(v) for v in value.ravel().tolist())
            lines += [f"{key}:", f"  rows: {rows}", f"  cols: {cols}", "  dt: d"]
            lines.append(f"  data: [{data}]")
        else:
            lines.append(f"{key}: {_quoted(value) if isinstance(value, str) else _number(value)}")
    return "\n".join(lines) + "\n"


def _number(value: float | int) -> str:
    """Return text that reads back as exactly the same number. The text contains a decimal point,
    because PyYAML would otherwise read the number as a string."""
    if isinstance(value, int):
        return str(value)
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"


def _quoted(text: str) -> str:
    plain = "".join(c if c.isprintable() and c.isascii() else "_" for c in text)
    return '"' + plain.replace("\\", "/").replace('"', "'") + '"'
