"""Calibration files of ROS, OpenCV and Kalibr; one YAML for ROS, OpenCV and PyYAML written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound
from perchctl.files import file_kind
from perchctl.geometry import Array
from perchctl.plain_yaml import parse_yaml
from perchctl.profile import CameraConfig, find_calibration
from perchctl.vision import CameraModel

KALIBR_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
"""Kalibr's distortion models and their names in ROS; its radtan is k1 k2 p1 p2, k3 = 0."""
MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "fisheye": (4,), "equidistant": (4,)}


def profile_camera(config: CameraConfig) -> CameraModel:
    """The calibrated camera of a profile. Raises as `load_calibration`."""
    return load_calibration(config.calibration)


def load_calibration(file: Path | str) -> CameraModel:
    """Read a camera model from a file, or by the name of one in `calib/`.

    Raises:
        NotFound: no file. InvalidValue: wrong content.
    """
    path = find_calibration(file) if isinstance(file, str) else file
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise NotFound(f"calibration file {path} does not exist") from None
    except UnicodeDecodeError:
        raise InvalidValue(
            f"{path} is {file_kind(path)}, no camera calibration: name the .yaml of perchctl "
            f"calibrate, or one of ROS, OpenCV or Kalibr"
        ) from None
    except OSError as error:
        raise InvalidValue(f"{path}: cannot be read as a calibration: {error}") from None
    is_opencv = "opencv-matrix" in text or "<opencv_storage>" in text
    try:
        raw = {} if is_opencv else parse_yaml(text)
    except ValueError as error:
        raise InvalidValue(f"{path}: {error}") from None
    try:
        return _checked(*_values(path, raw, is_opencv))
    except InvalidValue as error:
        raise InvalidValue(f"{path}: {error}") from None
    except KeyError as error:
        kind = file_kind(path)
        what = "" if "calibration" in kind else f" (it is {kind})"
        raise InvalidValue(f"{path}: key {error.args[0]} is missing{what}") from None
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidValue(f"{path}: a value is not a number: {error}") from None


_Values = tuple[Any, NDArray[Any], NDArray[Any], str]
"""Size (width, height) in px, camera matrix (9 numbers), distortion, its model."""


def _values(path: Path, raw: Any, is_opencv: bool) -> _Values:
    if not isinstance(raw, dict):
        raise InvalidValue(
            "must hold camera_info keys (image_width, camera_matrix, ...) or a Kalibr "
            "camchain (cam0: ...)"
        )
    cameras = [key for key in raw if re.fullmatch(r"cam\d+", str(key))]
    if len(cameras) > 1:
        raise InvalidValue(f"holds the cameras {', '.join(cameras)}: keep the one that flies")
    if cameras:
        return _kalibr_values(cameras[0], raw[cameras[0]])
    if is_opencv:
        return _opencv_values(path)
    return (
        (raw.get("image_width"), raw.get("image_height")),
        np.array(raw["camera_matrix"]["data"], dtype=float),
        np.array(raw["distortion_coefficients"]["data"], dtype=float),
        str(raw.get("distortion_model", "plumb_bob")),
    )


def _kalibr_values(cam: str, camera: Any) -> _Values:
    """The values of a camera of a camchain; pixel (0, 0) is a pixel's centre there too."""
    if not isinstance(camera, dict):
        raise InvalidValue(f"{cam} must hold keys (intrinsics, resolution, ...)")
    projection = camera.get("camera_model", "pinhole")
    lens = str(camera.get("distortion_model", "none"))
    if projection != "pinhole" or lens not in KALIBR_MODELS:
        named = lens if projection == "pinhole" else projection
        raise InvalidValue(
            f"Kalibr's model {named!r} is not supported; calibrate as pinhole-radtan or "
            f"pinhole-equi"
        )
    intrinsics = np.array(camera["intrinsics"], dtype=float)
    if intrinsics.shape != (4,):
        raise InvalidValue(f"intrinsics needs fu, fv, pu, pv, found {intrinsics.size}")
    fu, fv, pu, pv = intrinsics
    dist = np.zeros(4) if lens == "none" else np.array(camera["distortion_coeffs"], dtype=float)
    K = np.array([fu, 0.0, pu, 0.0, fv, pv, 0.0, 0.0, 1.0])
    width, height = camera["resolution"]
    return (width, height), K, dist, KALIBR_MODELS[lens]


def _opencv_values(path: Path) -> _Values:
    keys = ("image_width", "image_height", "fisheye_model")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        K, dist = (storage.getNode(k).mat() for k in ("camera_matrix", "distortion_coefficients"))
        # The last one is written by OpenCV's calibration program where the lens is its fisheye's.
        width, height, fisheye = (
            None if (node := storage.getNode(key)).empty() else node.real() for key in keys
        )
    except (cv2.error, SystemError):
        raise InvalidValue("not a readable OpenCV FileStorage file") from None
    if K is None or dist is None:
        raise InvalidValue("camera_matrix and distortion_coefficients are needed in an OpenCV file")
    return (width, height), np.array(K), np.array(dist), "fisheye" if fisheye else "plumb_bob"


def _checked(size: Any, K: NDArray[Any], dist: NDArray[Any], model: str) -> CameraModel:
    width, height = size
    if width is None or height is None:
        raise InvalidValue(
            "the image size is missing: add image_width and image_height, in px, of the "
            "pictures that the camera was calibrated with"
        )
    width = int(width)
    height = int(height)
    dist = dist.ravel()
    if model not in MODELS:
        raise InvalidValue(
            f"distortion_model {model!r} is unknown; allowed are {', '.join(MODELS)}"
        )
    if K.size != 9:
        raise InvalidValue(f"camera_matrix needs 9 numbers, found {K.size}")
    K = K.reshape(3, 3)
    if not (np.isfinite(K).all() and np.isfinite(dist).all()):
        raise InvalidValue("camera_matrix or distortion holds NaN or infinity")
    if model == "plumb_bob" and dist.size == 8:
        model = "rational_polynomial"
    if dist.size not in MODELS[model]:
        raise InvalidValue(
            f"{model} needs {' or '.join(map(str, MODELS[model]))} distortion "
            f"coefficients, found {dist.size}"
        )
    if not (0 < K[0, 2] < width and 0 < K[1, 2] < height and K[0, 0] > 0 and K[1, 1] > 0):
        raise InvalidValue(
            f"camera_matrix does not fit a {width}x{height} picture: focal lengths "
            f"must be positive and the centre inside the picture"
        )
    return CameraModel((width, height), K, dist, "fisheye" if model == "equidistant" else model)


# --- Writing ---
# FileStorage wants ``dt: d`` and a first line ``%YAML 1.0``; PyYAML reads ``1e-05`` as a string.


def calibration_text(
    camera: CameraModel, name: str, notes: Mapping[str, str | float | int | Array]
) -> str:
    """The text of a calibration file; `name` is the camera's.

    `notes` are further keys, ignored by ROS readers, with numbers, texts or arrays (n, m).
    """
    # ROS wants five coefficients of plumb_bob.
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
    """Return text that reads back to the very same number; with a point, or PyYAML reads a
    string."""
    if isinstance(value, int):
        return str(value)
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"


def _quoted(text: str) -> str:
    plain = "".join(c if c.isprintable() and c.isascii() else "_" for c in text)
    return '"' + plain.replace("\\", "/").replace('"', "'") + '"'
