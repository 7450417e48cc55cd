"""Calibration files from other programs: recognise the format, and interpret each key.

If two lens models are confused, the target's position is wrong by centimetres although its standard
deviation is a few millimetres, and no later check detects this. Each format therefore has a table
of its keys:

- keys that are read: size, camera matrix, distortion, and the lens (the distortion model);
- keys that must have a neutral value, since any other would change the projection (binning, xi,
  ...);
- notes, which do not affect the projection of the camera's own images: those in the table, and keys
  that consist of words about boards, images, errors and dates.

A key that is not in the table might change the projection, so the file is refused, unless the value
is 0 or empty, which disables any term of a lens model. `rectification_matrix` and
`projection_matrix` are among the notes, because according to sensor_msgs/CameraInfo they describe
rectified images, whereas K and D describe the camera's own images.

Known formats that are not supported are refused with a message that names them.
"""

from __future__ import annotations

import difflib
import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.plain_yaml import clip_text, parse_documents

READ_FORMS = "camera_info file (ROS), FileStorage file (OpenCV) or camchain (Kalibr)"


@dataclass(frozen=True)
class Form:
    """The keys of one calibration file format.

    Attributes:
        name: the format's name in messages.
        read: the keys for each meaning. All keys for ``lens`` must agree; for any other meaning, a
            file contains only one.
        neutral: keys that can change the projection, each with the values at which it does not.
        notes: keys that do not affect the projection.
    """

    name: str
    read: Mapping[str, tuple[str, ...]]
    neutral: Mapping[str, tuple[float, ...]]
    notes: tuple[str, ...]


CAMERA_FILE = Form(
    name="camera_info or FileStorage file",
    read={
        "width": ("image_width", "width"),
        "height": ("image_height", "height"),
        "size": ("camera_resolution",),
        "K": ("camera_matrix",),
        "distortion": ("distortion_coefficients", "dist_coeffs", "dist_coeff"),
        "lens": ("distortion_model", "camera_model"),
        "fisheye": ("fisheye_model",),
        "region": ("roi",),
        "rms": ("avg_reprojection_error", "rms_px", "rms"),
        **{entry: (entry,) for entry in ("fx", "fy", "cx", "cy")},
    },
    neutral={"binning_x": (0, 1), "binning_y": (0, 1), "xi": (0,), "alpha": (0,), "skew": (0,)},
    notes=(
        # ROS
        *("rectification_matrix", "projection_matrix", "header", "frame_id", "camera_info_url"),
        # OpenCV's programs
        *("aspect_ratio", "fix_aspect_ratio", "flags", "flag_value", "extrinsic_parameters"),
        *("grid_points", "image_points", "camera_matrix_std_dev", "dist_coeffs_std_dev"),
        # Python scripts around OpenCV's calibrateCamera
        *("ret", "rvecs", "tvecs", "t_cam_imu"),
        # perchctl
        *("parameters", "parameter_std", "parameter_covariance", "views_rejected"),
        *("target_error", "target_error_columns", "converted_from", "picture_hashes"),
    ),
)
"""A file written by ROS's camera_calibration, by OpenCV's calibration programs, or by a script,
which all use the same keys, in any combination."""

CAMERA_MESSAGE = Form(
    name="CameraInfo message",
    read={
        "width": ("width", "image_width"),
        "height": ("height", "image_height"),
        "K": ("k",),
        "distortion": ("d",),
        "lens": ("distortion_model",),
        "region": ("roi",),
    },
    neutral={"binning_x": (0, 1), "binning_y": (0, 1)},
    notes=("header", "r", "p"),
)
"""The output of ``ros2 topic echo /camera_info``, or of ``rostopic echo`` with D, K, R and P; or a
script's file with K and D."""

KALIBR_CAMERA = Form(
    name="Kalibr camchain",
    read={
        "size": ("resolution",),
        "projection": ("camera_model",),
        "intrinsics": ("intrinsics",),
        "distortion": ("distortion_coeffs",),
        "lens": ("distortion_model",),
    },
    neutral={},
    notes=(
        *("cam_overlaps", "rostopic", "timeshift_cam_imu"),
        *("T_cam_imu", "T_imu_cam", "T_cn_cnm1"),
    ),
)
"""One camera of a camchain, as Kalibr and OpenVINS write it. Pixel (0, 0) is a pixel's centre."""

_NOTE_WORDS = frozenset(
    (
        *("board", "pattern", "square", "squares", "checkerboard", "chessboard", "charuco"),
        *("aruco", "marker", "markers", "dictionary"),
        *("corner", "corners", "columns", "cols", "rows", "width", "height", "size", "length"),
        *("num", "number", "nr", "nframes", "count", "total", "of", "used", "valid"),
        *("image", "images", "picture", "pictures", "frame", "frames", "view", "views"),
        *("sample", "samples"),
        *("rms", "rmse", "reprojection", "error", "errors", "err", "mean", "avg", "average"),
        *("median", "max", "min", "per", "std"),
        *("calibration", "calibrated", "date", "time", "timestamp", "created", "hfov", "vfov"),
        *("dfov", "fps"),
        *("opencv", "version", "camera", "name", "id", "serial", "device", "author"),
        *("file", "path", "comment", "comments", "note", "notes", "description"),
    )
)
"""Words about boards, images, errors and dates: a key that consists only of these is also a
note."""
_UNITS = frozenset(("px", "mm", "cm", "m", "deg"))

_LENSES = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""The supported lens models, keyed by their names in ROS, OpenCV and Kalibr."""
_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "fisheye": (4,)}
_OPENCV_LONG = (12, 14)
"""Coefficients of OpenCV's thin prism and tilted sensor models."""

_MAX_RMS_SHARE = 0.01
"""Largest reprojection error relative to the image's width: a calibration that reports a larger
one on its own board is unusable."""

_AS_CAMERA_INFO = (
    "write its numbers to a file with image_width, image_height, camera_matrix, "
    "distortion_model and distortion_coefficients"
)
_OTHER_FORMS = (
    (
        r"^\[image\]\s*$",
        "a ROS .ini or ost.txt file, which does not name the lens model",
        "name the ost.yaml next to it",
    ),
    (
        r"^\d+ [A-Z_]+ \d+ \d+(?: [-+\d.e]+){3,}\s*$",
        "a COLMAP cameras.txt",
        f"{_AS_CAMERA_INFO}, and subtract 0.5 px from cx and cy",
    ),
    (
        r"^\s*Camera\d?\.fx\s*:",
        "an ORB-SLAM settings file",
        f"{_AS_CAMERA_INFO}; PinHole is plumb_bob, KannalaBrandt8 is equidistant",
    ),
    (
        r"^\s*model_type\s*:",
        "a VINS or camodocal camera file",
        f"{_AS_CAMERA_INFO}; PINHOLE is plumb_bob, KANNALA_BRANDT is equidistant, others are not "
        f"supported",
    ),
    (r"^sensor_type\s*:\s*camera", "a sensor.yaml from the EuRoC data set", _AS_CAMERA_INFO),
    (r'"camera_type"\s*:', "a Basalt calibration", _AS_CAMERA_INFO),
    (r'"cameraData"\s*:', "a DepthAI (OAK) calibration", _AS_CAMERA_INFO),
)
"""Formats that are recognised but not supported: a pattern in the text, the name, and what to
do."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Content of a calibration file: image size, camera matrix (3, 3), and distortion of the
    `model` of `perchctl.vision.CameraModel`."""

    size_px: tuple[int, int]
    K: NDArray[np.float64]
    distortion: NDArray[np.float64]
    model: str


def parse_calibration(text: str) -> tuple[Lens, dict[str, Any]]:
    """Return the lens that the text of a calibration file describes, and the values of all its
    keys.

    Raises InvalidValue, which names the format that was found and what is needed.
    """
    for pattern, name, advice in _OTHER_FORMS:
        if re.search(pattern, text, re.MULTILINE):
            raise InvalidValue(f"this is {name}, which is not supported: {advice}")
    values = _values(text)
    cameras = [key for key in values if re.fullmatch(r"cam\d+", key)]
    if len(cameras) > 1:
        raise InvalidValue(
            f"contains the cameras {', '.join(cameras)}: keep only the one on the vehicle"
        )
    if cameras:
        return _kalibr_lens(cameras[0], values[cameras[0]]), values
    is_message = {"k", "d"} <= {_plain_key(key) for key in values}
    return _camera_lens(values, CAMERA_MESSAGE if is_message else CAMERA_FILE), values


# --- Parse text into values ---


def _values(text: str) -> dict[str, Any]:
    """Parse a text in YAML, JSON or OpenCV's XML, and return its values by key."""
    if text.lstrip().startswith("<"):
        return _xml_values(text)
    # OpenCV's first line and tags are not YAML; its keys contain the same information.
    plain = re.sub(r"^%YAML.*$", "", text, count=1, flags=re.MULTILINE)
    plain = re.sub(r"!!opencv-(?:nd-)?matrix", "", plain)
    try:
        documents = [json.loads(plain, object_pairs_hook=_unique_keys)]
    except (ValueError, RecursionError):
        try:
            documents = parse_documents(plain)
        except ValueError as error:
            raise InvalidValue(str(error)) from None
    if not documents or not all(isinstance(each, dict) for each in documents):
        raise InvalidValue(f"contains no keys: a calibration is a {READ_FORMS}")
    # In the output of a topic, each message is a document whose header contains its own time.
    first, *others = ({str(k): v for k, v in d.items() if k != "header"} for d in documents)
    try:
        differ = any(other != first for other in others)
    except RecursionError:  # in YAML, a value may contain itself
        raise InvalidValue("values are nested too deeply") from None
    if differ:
        raise InvalidValue(f"contains {len(documents)} different documents: keep one")
    return first


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a dict from the keys and values of a JSON object. Raises InvalidValue for a duplicate
    key, of which Python would silently keep the last value."""
    values = dict(pairs)
    if len(values) < len(pairs):
        (key, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise InvalidValue(f"key {clip_text(key)} appears twice: keep one")
    return values


def _xml_values(text: str) -> dict[str, Any]:
    """The values in an XML file written by OpenCV's FileStorage."""
    if "<opencv_storage>" not in text:
        raise InvalidValue(
            f"this XML file is from another program: a calibration is a {READ_FORMS}"
        )
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        keys = storage.root().keys()
        return {key: _node_value(storage.getNode(key)) for key in keys}
    except (cv2.error, SystemError):
        raise InvalidValue("this is not a readable OpenCV FileStorage file in XML") from None


def _node_value(node: Any) -> Any:
    if node.isMap():
        keys = node.keys()
        return {key: _node_value(node.getNode(key)) for key in keys}
    if node.isSeq():
        return [_node_value(node.at(i)) for i in range(node.size())]
    if node.isString():
        return node.string()
    return None if node.isNone() else node.real()


# --- Interpret values as a lens ---


def _camera_lens(values: Mapping[str, Any], form: Form) -> Lens:
    found = _by_meaning(values, form, needed=("K", "distortion"))
    _check_region(found)
    size_px = _size(found, form)
    key, value = found["K"][0]
    K = _numbers(key, value)
    if K.size != 9:
        raise InvalidValue(f"{key} needs 9 numbers, found {K.size}")
    if not K.any():
        raise InvalidValue(f"{key} contains only zeros: the camera was not calibrated")
    _check_rms(found, size_px[0])
    _check_entries(found, K)
    model, distortion = _distortion(found, _named_lens(found))
    return Lens(size_px, K.reshape(3, 3), distortion, model)


def _kalibr_lens(cam: str, camera: Any) -> Lens:
    if not isinstance(camera, dict):
        raise InvalidValue(f"{cam} must contain keys (intrinsics, resolution, ...)")
    camera = {str(key): value for key, value in camera.items()}
    found = _by_meaning(camera, KALIBR_CAMERA, needed=tuple(KALIBR_CAMERA.read))
    projection, lens = str(found["projection"][0][1]), str(found["lens"][0][1])
    if projection != "pinhole" or (lens != "none" and lens not in _LENSES):
        raise InvalidValue(
            f"Kalibr's model {clip_text(lens if projection == 'pinhole' else projection)!r} is not "
            f"supported; calibrate as pinhole-radtan or pinhole-equi"
        )
    key, value = found["intrinsics"][0]
    intrinsics = _numbers(key, value)
    if intrinsics.size != 4:
        raise InvalidValue(f"{key} needs fu, fv, pu, pv, found {intrinsics.size} numbers")
    fu, fv, pu, pv = intrinsics
    K = np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
    if lens == "none":
        if np.any(_numbers(*found["distortion"][0])):
            raise InvalidValue("distortion_coeffs are not 0 although distortion_model is none")
        return Lens(_size(found, KALIBR_CAMERA), K, np.zeros(4), "plumb_bob")
    model, distortion = _distortion(found, _named_lens(found))
    return Lens(_size(found, KALIBR_CAMERA), K, distortion, model)


_Found = dict[str, list[tuple[str, Any]]]
"""The keys in the file and their values, grouped by meaning."""


def _plain_key(key: str) -> str:
    """Return a key in lower case without underscores, since programs and versions differ in case
    and underscores."""
    return key.replace("_", "").lower()


def _is_note(key: str) -> bool:
    """True if a key consists of words that do not concern the projection."""
    words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", key)} - _UNITS
    return bool(words) and words <= _NOTE_WORDS


def _by_meaning(values: Mapping[str, Any], form: Form, needed: tuple[str, ...]) -> _Found:
    """The values of the keys that are read. Raises InvalidValue for a key that is missing, that
    must have a neutral value but does not, or that is not in any table."""
    meanings = {_plain_key(k): meaning for meaning, keys in form.read.items() for k in keys}
    neutral = {_plain_key(k): allowed for k, allowed in form.neutral.items()}
    notes = {_plain_key(k) for k in form.notes}
    found: _Found = {}
    unknown = []
    for key, value in values.items():
        plain = _plain_key(key)
        if plain in meanings:
            found.setdefault(meanings[plain], []).append((key, value))
        elif plain in neutral:
            _check_neutral(key, value, neutral[plain])
        elif not (plain in notes or _is_note(key) or value in (0, None, "", [], {})):
            unknown.append(key)
    for meaning, pairs in found.items():
        if len(pairs) > 1 and meaning != "lens":
            raise InvalidValue(f"has {' and '.join(key for key, _ in pairs)}: keep one")
    for meaning in needed:
        if meaning not in found:
            raise InvalidValue(_missing(form.read[meaning][0], values, unknown))
    if unknown:
        raise InvalidValue(
            f"{'key' if len(unknown) == 1 else 'keys'} {clip_text(', '.join(unknown))} of "
            f"this {form.name} may change the projection, and perchctl does not know "
            f"{'it' if len(unknown) == 1 else 'them'}: remove keys that are only notes"
        )
    return found


def _missing(key: str, values: Mapping[str, Any], unknown: list[str]) -> str:
    """Return the sentence about a missing key, with a similar key that may have been meant."""
    if close := difflib.get_close_matches(key, unknown, 1):
        return f"key {key} is missing: did you misspell it as {close[0]}?"
    return (
        f"key {key} is missing, found {clip_text(', '.join(values))}: a calibration is a "
        f"{READ_FORMS}"
    )


def _check_neutral(key: str, value: Any, allowed: tuple[float, ...]) -> None:
    if value in allowed:
        return
    if _plain_key(key) == "xi":
        raise InvalidValue(
            f"xi = {clip_text(str(value))} means an omnidirectional lens, which is not "
            "supported: calibrate as plumb_bob, rational_polynomial or fisheye"
        )
    neutral = " or ".join(f"{each:g}" for each in allowed)
    raise InvalidValue(
        f"{key} = {clip_text(str(value))} changes the projection, which is not "
        f"supported: calibrate with unmodified images from the camera, and {key} "
        f"{neutral}"
    )


def _check_region(found: _Found) -> None:
    """Raise InvalidValue if the file describes images that are cropped from the calibrated ones."""
    for key, region in found.get("region", []):
        if not isinstance(region, dict):
            raise InvalidValue(f"{key} must contain x_offset, y_offset, height and width")
        x, y, width, height = (
            _pixels(f"{key}.{part}", region.get(part, 0), least=0)
            for part in ("x_offset", "y_offset", "width", "height")
        )
        offset, size = (x, y), (width, height)
        whole = tuple(_pixels(*found[each][0]) for each in ("width", "height") if each in found)
        if offset != (0, 0) or size not in ((0, 0), whole):
            raise InvalidValue(
                f"{key} is only a part of the image, {size[0]}x{size[1]} px at {offset}: "
                "calibrate with unmodified images from the camera"
            )


def _check_rms(found: _Found, width_px: int) -> None:
    """Raise InvalidValue if the file itself reports an error that makes it unusable."""
    for key, value in found.get("rms", []):
        rms_px = _numbers(key, value)
        if (rms_px > _MAX_RMS_SHARE * width_px).any():
            raise InvalidValue(
                f"{key} = {rms_px.max():g} px: the reprojection error in the calibration's own "
                f"images is more than {100 * _MAX_RMS_SHARE:g} % of their width; calibrate again"
            )


def _check_entries(found: _Found, K: NDArray[np.float64]) -> None:
    """Raise InvalidValue if fx, fy, cx or cy contradict a camera matrix (9,) in the same file."""
    for entry, i in (("fx", 0), ("fy", 4), ("cx", 2), ("cy", 5)):
        for key, value in found.get(entry, []):
            if not np.allclose(_numbers(key, value), K[i]):
                raise InvalidValue(
                    f"{key} is {clip_text(str(value))}, but the camera matrix has {K[i]:g}: "
                    f"keep one"
                )


def _size(found: _Found, form: Form) -> tuple[int, int]:
    if "size" in found:
        key, value = found["size"][0]
        numbers = _numbers(key, value)
        if numbers.size != 2:
            raise InvalidValue(f"{key} needs width and height, found {numbers.size} numbers")
        return _pixels(key, numbers[0]), _pixels(key, numbers[1])
    if not {"width", "height"} <= found.keys():
        raise InvalidValue(
            f"the image size is missing from this {form.name}: add {form.read['width'][0]} "
            f"and {form.read['height'][0]}, the size in px of the images that the camera "
            "was calibrated with"
        )
    width, height = (_pixels(*found[each][0]) for each in ("width", "height"))
    return width, height


def _pixels(key: str, value: Any, least: int = 1) -> int:
    number = _numbers(key, value)
    if number.size != 1 or number[0] < least or number[0] != np.floor(number[0]):
        raise InvalidValue(
            f"{key} must be a whole number of pixels, at least {least}, found "
            f"{clip_text(str(value))}"
        )
    return int(number[0])


def _named_lens(found: _Found) -> str | None:
    """Return the lens model that the file names; None if the file names none."""
    named: dict[str, str] = {}
    for key, value in found.get("lens", []):
        name = re.sub(r"[\s-]+", "_", str(value or "").strip().lower())
        if not name:
            raise InvalidValue(f"{key} is empty: the camera was not calibrated")
        if name == "pinhole":
            continue  # the projection only; the distortion has its own key, or is not named
        if name not in _LENSES:
            raise InvalidValue(
                f"{key} {clip_text(repr(value))} is unknown; allowed are {', '.join(_LENSES)}"
            )
        named[key] = _LENSES[name]
    for key, value in found.get("fisheye", []):
        if _numbers(key, value).any():
            named[key] = "fisheye"
        elif "fisheye" in named.values():
            named[key] = "no fisheye"
    if len(set(named.values())) > 1:
        raise InvalidValue(f"{' and '.join(named)} name different lens models: keep the right one")
    return next(iter(named.values()), None)


def _distortion(found: _Found, named: str | None) -> tuple[str, NDArray[np.float64]]:
    """Return the lens model and its coefficients; zeros beyond the model's number of coefficients
    are dropped."""
    key, value = found["distortion"][0]
    given = _numbers(key, value)
    model = named
    if model is None:
        if given.size == 4 and "fisheye" not in found:  # OpenCV writes a fisheye flag, 0 or 1
            raise InvalidValue(
                f"{key} has 4 numbers, so the model may be plumb_bob or fisheye: add "
                f"distortion_model with plumb_bob or equidistant"
            )
        model = "plumb_bob" if given.size < 8 else "rational_polynomial"
    counts = _COEFFICIENTS[model]
    kept = given
    while kept.size > counts[-1] and kept[-1] == 0.0:
        kept = kept[:-1]
    if model == "rational_polynomial" and kept.size in _COEFFICIENTS["plumb_bob"]:
        return "plumb_bob", kept  # the other coefficients are 0
    if kept.size in counts:
        return model, kept
    if given.size in _OPENCV_LONG and model != "fisheye":
        raise InvalidValue(
            f"{key} has {given.size} numbers, which describe a thin prism or a tilted "
            "sensor and are not supported: calibrate with 5 or 8 coefficients"
        )
    raise InvalidValue(
        f"{model} needs {' or '.join(map(str, counts))} distortion coefficients, found {given.size}"
    )


def _numbers(key: str, value: Any) -> NDArray[np.float64]:
    """The numbers of a matrix, (n,), which the file contains under ``data``, as a list, or as a
    list of rows."""
    data = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.array([] if data is None else data, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise InvalidValue(f"a value of {key} is not a number: {clip_text(str(data))}") from None
    if not np.isfinite(numbers).all():
        raise InvalidValue(f"{key} holds NaN or infinity")
    return numbers
