"""Calibration files: read from ROS (camera_info), OpenCV (FileStorage: YAML, XML, JSON) and Kalibr
(camchain); written as one YAML that ROS, OpenCV's FileStorage and PyYAML all read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from warnings import warn

import cv2
import numpy as np

from perchctl.errors import InvalidValue, Note, NotFound
from perchctl.files import file_kind
from perchctl.geometry import Array
from perchctl.plain_yaml import parse_yaml
from perchctl.profile import CameraConfig, find_calibration
from perchctl.vision import CameraModel

KALIBR_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
"""Kalibr's distortion models and their names in ROS; its radtan is k1 k2 p1 p2, k3 = 0."""
MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "fisheye": (4,), "equidistant": (4,)}


class SizeMissing(InvalidValue):
    """A calibration does not say for pictures of which size it holds."""


def profile_camera(config: CameraConfig) -> CameraModel:
    """Return the calibrated camera of a profile. Raises as `load_calibration`."""
    return load_calibration(config.calibration, cam=config.cam)


def load_calibration(
    file: Path | str, size_px: tuple[int, int] | None = None, cam: str | None = None
) -> CameraModel:
    """Read a camera model from a file, or by the name of one in `calib/`.

    Args:
        size_px: the pictures' size (width, height) for a file that has none; a Note says so.
        cam: one of the cameras of a Kalibr file.

    Raises:
        NotFound: no file. SizeMissing. InvalidValue: wrong content.
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
    if "opencv-matrix" in text or "<opencv_storage>" in text:
        _check_no_cam(path, cam)
        return _checked(path, _opencv_values(path), size_px)
    try:
        raw = parse_yaml(text)
    except ValueError as error:
        raise InvalidValue(f"{path}: {error}") from None
    if not isinstance(raw, dict):
        raise InvalidValue(
            f"{path}: must hold camera_info keys (image_width, camera_matrix, ...) or a Kalibr "
            f"camchain (cam0: ...)"
        )
    cameras = [key for key in raw if re.fullmatch(r"cam\d+", str(key))]
    try:
        if cameras:
            values = _kalibr_values(path, raw, _named(path, cameras, cam))
        else:
            _check_no_cam(path, cam)
            values = {
                "size": _size(raw.get("image_width"), raw.get("image_height")),
                "K": np.array(raw["camera_matrix"]["data"], dtype=float),
                "dist": np.array(raw["distortion_coefficients"]["data"], dtype=float),
                "model": str(raw.get("distortion_model", "plumb_bob")),
            }
    except KeyError as error:
        kind = file_kind(path)
        what = "" if "calibration" in kind else f" (it is {kind})"
        raise InvalidValue(f"{path}: key {error.args[0]} is missing{what}") from None
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"{path}: a value is not a number: {error}") from None
    return _checked(path, values, size_px)


def _check_no_cam(path: Path, cam: str | None) -> None:
    if cam is not None:
        raise InvalidValue(
            f"{path}: is no Kalibr file and holds one camera only: leave out {cam} "
            f"(--cam, or camera.cam in the profile)"
        )


def _named(path: Path, cameras: list[str], cam: str | None) -> str:
    """Return the name of the camera to read."""
    held = ", ".join(cameras)
    if cam is None and len(cameras) > 1:
        raise InvalidValue(
            f"{path}: holds {len(cameras)} cameras ({held}): name one with --cam {cameras[0]}, or "
            f"with camera.cam in the profile"
        )
    if cam is not None and cam not in cameras:
        raise InvalidValue(f"{path}: holds no camera {cam!r}; its cameras are {held}")
    return cam or cameras[0]


def _kalibr_values(path: Path, raw: dict[Any, Any], cam: str) -> dict[str, Any]:
    """Return the values of one camera of a camchain; pixel (0, 0) is a pixel's centre there too."""
    camera = raw[cam]
    if not isinstance(camera, dict):
        raise InvalidValue(f"{path}: {cam} must hold keys (intrinsics, resolution, ...)")
    projection = camera.get("camera_model", "pinhole")
    if projection != "pinhole":
        raise InvalidValue(f"{path}: camera_model {projection!r} is not supported; use pinhole")
    lens = str(camera.get("distortion_model", "none"))
    if lens not in KALIBR_MODELS:
        raise InvalidValue(
            f"{path}: Kalibr's distortion_model {lens!r} is not supported; calibrate as "
            f"pinhole-radtan or pinhole-equi"
        )
    intrinsics = np.array(camera["intrinsics"], dtype=float)
    if intrinsics.shape != (4,):
        raise InvalidValue(f"{path}: intrinsics needs fu, fv, pu, pv, found {intrinsics.size}")
    fu, fv, pu, pv = intrinsics
    width, height = camera["resolution"]
    dist = np.zeros(4) if lens == "none" else np.array(camera["distortion_coeffs"], dtype=float)
    return {
        "size": (int(width), int(height)),
        "K": np.array([fu, 0.0, pu, 0.0, fv, pv, 0.0, 0.0, 1.0]),
        "dist": dist,
        "model": KALIBR_MODELS[lens],
    }


def _opencv_values(path: Path) -> dict[str, Any]:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError):
        raise InvalidValue(f"{path}: not a readable OpenCV FileStorage file") from None
    try:
        K = storage.getNode("camera_matrix").mat()
        dist = storage.getNode("distortion_coefficients").mat()
        if K is None or dist is None:
            raise InvalidValue(
                f"{path}: camera_matrix and distortion_coefficients are needed in an OpenCV file"
            )
        nodes = [storage.getNode(key) for key in ("image_width", "image_height")]
        size = _size(*(None if node.empty() else node.real() for node in nodes))
        # Written by OpenCV's calibration program where the lens is its fisheye's.
        fisheye = storage.getNode("fisheye_model")
        is_fisheye = not fisheye.empty() and fisheye.real() != 0
        return {
            "size": size,
            "K": K,
            "dist": dist,
            "model": "fisheye" if is_fisheye else "plumb_bob",
        }
    finally:
        storage.release()


def _size(width: Any, height: Any) -> tuple[int, int] | None:
    """Return the size, None where either is missing."""
    return None if width is None or height is None else (int(width), int(height))


def _checked(
    path: Path, values: dict[str, Any], otherwise_px: tuple[int, int] | None
) -> CameraModel:
    size, model = values["size"] or otherwise_px, values["model"]
    if model not in MODELS:
        raise InvalidValue(
            f"{path}: distortion_model {model!r} is unknown; allowed are {', '.join(MODELS)}"
        )
    if values["K"].size != 9:
        raise InvalidValue(f"{path}: camera_matrix needs 9 numbers, found {values['K'].size}")
    K = values["K"].reshape(3, 3)
    dist = values["dist"].ravel()
    if not (np.isfinite(K).all() and np.isfinite(dist).all()):
        raise InvalidValue(f"{path}: camera_matrix or distortion holds NaN or infinity")
    if size is None:
        raise SizeMissing(
            f"{path}: the image size is missing: add image_width and image_height, in px, of the "
            f"pictures that the camera was calibrated with"
        )
    if size[0] <= 0 or size[1] <= 0:
        raise InvalidValue(f"{path}: image_width and image_height must be positive, found {size}")
    if model == "plumb_bob" and dist.size == 8:
        model = "rational_polynomial"
    if dist.size not in MODELS[model]:
        raise InvalidValue(
            f"{path}: {model} needs {' or '.join(map(str, MODELS[model]))} distortion "
            f"coefficients, found {dist.size}"
        )
    if not (0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1] and K[0, 0] > 0 and K[1, 1] > 0):
        raise InvalidValue(
            f"{path}: camera_matrix does not fit a {size[0]}x{size[1]} picture: focal lengths "
            f"must be positive and the centre inside the picture"
        )
    if values["size"] is None:
        warn(
            Note(
                f"{path}: the image size is missing; {size[0]}x{size[1]} px is taken from the "
                f"first picture, which is right only if the camera was calibrated at that size: "
                f"add image_width: {size[0]} and image_height: {size[1]} to the file"
            ),
            stacklevel=3,
        )
    return CameraModel(size, K, dist, "fisheye" if model == "equidistant" else model)


# --- Writing ---------------------------------------------------------------------------------
# ROS wants camera_info keys; FileStorage wants ``dt: d`` in each matrix and a first line
# ``%YAML 1.0``; PyYAML refuses ``%YAML:1.0`` and OpenCV's tags, and reads ``1e-05`` as a string.


def calibration_text(
    camera: CameraModel, name: str, notes: Mapping[str, str | float | int | Array]
) -> str:
    """Return the file's text; `notes` are further keys (ROS readers pass over them), arrays (n,
    m)."""
    entries: dict[str, str | float | int | Array] = {
        "image_width": camera.size_px[0],
        "image_height": camera.size_px[1],
        "camera_name": name,
        "camera_matrix": camera.K,
        "distortion_model": "equidistant" if camera.model == "fisheye" else camera.model,
        "distortion_coefficients": _coefficients(camera)[None],
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


def camera_record(camera: CameraModel) -> dict[str, Any]:
    """Return the camera model as JSON's own types: lengths in pixels, distances in metres."""
    K = camera.K
    return {
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "distortion": [float(d) for d in camera.dist],
        "model": camera.model,
        "size_px": list(camera.size_px),
    }


def _coefficients(camera: CameraModel) -> Array:
    """Return the distortion; ROS wants five coefficients of plumb_bob."""
    short = camera.model == "plumb_bob" and camera.dist.size == 4
    return np.append(camera.dist, 0.0) if short else camera.dist


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
