"""The text of a calibration file: one YAML that ROS, OpenCV's FileStorage and PyYAML all read.

ROS wants camera_info keys; FileStorage wants ``dt: d`` in each matrix and a first line
``%YAML 1.0``; PyYAML refuses ``%YAML:1.0`` and OpenCV's tags, and reads
``1e-05`` as a string.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from perchctl.calibration.lens import PARAMETERS, parameters_of
from perchctl.calibration.types import Calibration
from perchctl.geometry import Array
from perchctl.vision import CameraModel

ROS_NAMES = {"fisheye": "equidistant"}


def camera_text(camera: CameraModel, name: str, notes: Mapping[str, str | float | int]) -> str:
    """The file's text; `notes` are further keys (ROS readers pass over them)."""
    K = camera.K
    p = parameters_of(camera)
    projection = np.column_stack([K, np.zeros(3)])
    lines = [
        "%YAML 1.0",
        "---",
        f"image_width: {camera.size_px[0]}",
        f"image_height: {camera.size_px[1]}",
        f"camera_name: {_quoted(name)}",
        *_matrix("camera_matrix", K),
        f"distortion_model: {ROS_NAMES.get(camera.model, camera.model)}",
        *_matrix("distortion_coefficients", p[4:][None]),
        *_matrix("rectification_matrix", np.eye(3)),
        *_matrix("projection_matrix", projection),
    ]
    for key, value in notes.items():
        text = _quoted(value) if isinstance(value, str) else _number(value)
        lines.append(f"{key}: {text}")
    return "\n".join(lines) + "\n"


def calibration_text(calibration: Calibration, name: str, date: str) -> str:
    """The file of a fresh calibration: with its quality and the parameters' covariance."""
    solution = calibration.solution
    notes: dict[str, str | float | int] = {
        "date": date,
        "board": calibration.board,
        "rms_px": solution.rms_px,
        "views_used": len(calibration.views),
        "views_rejected": sum(1 for r in calibration.rejections if not r.corners),
        "parameters": " ".join(PARAMETERS[calibration.camera.model]),
    }
    text = camera_text(calibration.camera, name, notes)
    errors = np.array([[e.z_m, e.mm95, e.axis_mm95] for e in calibration.errors])
    more = [
        *_matrix("parameter_std", solution.std[None]),
        *_matrix("parameter_covariance", solution.covariance),
        "# columns: distance in m; 95 % lines in mm wherever boards were seen, and straight ahead",
        *_matrix("target_error", errors),
    ]
    return text + "\n".join(more) + "\n"


def _matrix(key: str, values: Array) -> list[str]:
    rows, cols = values.shape
    return [
        f"{key}:",
        f"  rows: {rows}",
        f"  cols: {cols}",
        "  dt: d",
        f"  data: [{', '.join(_number(float(v)) for v in values.ravel())}]",
    ]


def _number(value: float | int) -> str:
    """Read back to the very same number; with a point, or PyYAML reads a string."""
    if isinstance(value, int):
        return str(value)
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"


def _quoted(text: str) -> str:
    plain = "".join(c if c.isprintable() and c.isascii() else "_" for c in text)
    return '"' + plain.replace("\\", "/").replace('"', "'") + '"'
