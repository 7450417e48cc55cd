"""Calibration files of other programs: read as the lens that they name, or refused."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.errors import InvalidValue
from perchctl.vision import CameraModel, project
from tests.helpers.flights import ROOT

SIZE_PX = (400, 300)
K = [210.5, 0.0, 203.25, 0.0, 212.0, 148.75, 0.0, 0.0, 1.0]
FIVE = [-0.21, 0.06, 0.0004, -0.0007, -0.003]
EIGHT = [0.4, -0.3, 0.001, 0.0005, 0.02, 0.7, -0.2, 0.01]
FISHEYE = [0.12, -0.02, 0.0006, -0.0004]
NUMBERS = {"plumb_bob": FIVE, "rational_polynomial": EIGHT, "fisheye": FISHEYE}


def ros(dist: list[float], more: str = "", matrix: list[float] = K) -> str:
    """A camera_info file of ROS; `more` are further lines."""
    return (
        f"image_width: {SIZE_PX[0]}\nimage_height: {SIZE_PX[1]}\ncamera_name: left\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {matrix}\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(dist)}\n  data: {dist}\n"
        # A stereo camera's, of its rectified pictures.
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [0.9998, 0.02, 0, -0.02, 0.9998, "
        f"0, 0, 0, 1]\n"
        f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: [190, 0, 200, -9, 0, 190, 150, 0, 0, "
        f"0, 1, 0]\n{more}"
    )


def opencv(dist: list[float], more: str = "") -> str:
    """A FileStorage file of OpenCV's calibration program."""
    return (
        f"%YAML:1.0\n---\ncalibration_time: 'Mo 2 Feb 2026'\nnframes: 20\n"
        f"image_width: {SIZE_PX[0]}\nimage_height: {SIZE_PX[1]}\nflags: 0\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {K}\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: {len(dist)}\n   cols: 1\n   dt: d\n"
        f"   data: {dist}\navg_reprojection_error: 0.31\n{more}"
    )


def message(dist: list[float], lens: str, stamp: int = 5) -> str:
    """A message as ``ros2 topic echo`` prints it."""
    return (
        f"header:\n  stamp:\n    sec: {stamp}\n    nanosec: 7\n  frame_id: cam\n"
        f"height: {SIZE_PX[1]}\nwidth: {SIZE_PX[0]}\ndistortion_model: {lens}\n"
        f"d: {dist}\nk: {K}\nr: [1, 0, 0, 0, 1, 0, 0, 0, 1]\np: {[0.0] * 12}\n"
        f"binning_x: 0\nbinning_y: 0\nroi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n"
        f"  do_rectify: false\n---\n"
    )


def kalibr(dist: list[float], lens: str) -> str:
    fx, _, cx, _, fy, cy, *_ = K
    return (
        f"%YAML:1.0\n\ncam0:\n  T_cam_imu:\n    - [1, 0, 0, 0]\n    - [0, 1, 0, 0]\n"
        f"    - [0, 0, 1, 0]\n    - [0, 0, 0, 1]\n  cam_overlaps: []\n  camera_model: pinhole\n"
        f"  distortion_coeffs: {dist}\n  distortion_model: {lens}\n"
        f"  intrinsics: [{fx}, {fy}, {cx}, {cy}]\n  resolution: [{SIZE_PX[0]}, {SIZE_PX[1]}]\n"
        f"  rostopic: /cam/image_raw\n  timeshift_cam_imu: 0.004\n"
    )


def load(tmp_path: Path, text: str | bytes, name: str = "camera.yaml") -> CameraModel:
    file = tmp_path / name
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    return load_calibration(file)


def assert_reads(camera: CameraModel, model: str) -> None:
    """The camera is that of the numbers above, with the lens `model`."""
    assert (camera.size_px, camera.model) == (SIZE_PX, model)
    np.testing.assert_allclose(camera.K.ravel(), K, rtol=1e-12)
    np.testing.assert_allclose(camera.dist, NUMBERS[model], rtol=1e-12)
    # What it computes is what OpenCV computes from the numbers by the lens's name.
    points = np.array([[[0.3, -0.2, 0.8]], [[-0.1, 0.25, 0.6]]])
    call = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    zero = np.zeros(3)
    px = call(points, zero, zero, np.reshape(K, (3, 3)), np.array(NUMBERS[model]))[0]
    np.testing.assert_allclose(project(points, zero, zero, camera), px.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "model"),
    [
        (ros(FIVE, "distortion_model: plumb_bob\n"), "plumb_bob"),
        (ros(FIVE), "plumb_bob"),
        (ros(FIVE, "camera_model: plumb_bob\n"), "plumb_bob"),
        (ros(FISHEYE, "camera_model: fisheye\n"), "fisheye"),
        (ros(FISHEYE, "distortion_model: equidistant\n"), "fisheye"),
        (ros([*FISHEYE, 0.0], "distortion_model: equidistant\n"), "fisheye"),
        (ros(FISHEYE, "camera_model: pinhole\ndistortion_model: equidistant\n"), "fisheye"),
        (ros(EIGHT, "distortion_model: rational_polynomial\n"), "rational_polynomial"),
        (ros([*EIGHT, *[0] * 6], "distortion_model: rational_polynomial\n"), "rational_polynomial"),
        (ros([*EIGHT, *[0] * 4]), "rational_polynomial"),
        (ros(FIVE, "distortion_model: rational_polynomial\n"), "plumb_bob"),
        (opencv(FIVE), "plumb_bob"),
        (opencv(FIVE, "fisheye_model: 0\n"), "plumb_bob"),
        (opencv(FISHEYE, "fisheye_model: 1\n"), "fisheye"),
        (opencv(FISHEYE, "distortion_model: fisheye\n"), "fisheye"),
        (opencv(FISHEYE, "distortion_model: equidistant\n"), "fisheye"),
        (opencv(FISHEYE, 'camera_model: "fisheye"\n'), "fisheye"),
        (opencv(EIGHT), "rational_polynomial"),
        (opencv([*EIGHT, *[0] * 6]), "rational_polynomial"),
        (opencv(FIVE, "xi: 0.\nalpha: 0\nx: 0\n"), "plumb_bob"),
        (message(FIVE, "plumb_bob"), "plumb_bob"),
        (message(FISHEYE, "equidistant"), "fisheye"),
        (message([*EIGHT, *[0.0] * 6], "rational_polynomial"), "rational_polynomial"),
        (message(FIVE, "plumb_bob") + message(FIVE, "plumb_bob", stamp=6), "plumb_bob"),
        (message(FISHEYE, "equidistant").replace("\nk", "\nK").replace("\nd:", "\nD:"), "fisheye"),
        (kalibr(FISHEYE, "equidistant"), "fisheye"),
    ],
)
def test_a_file_is_read_as_the_lens_that_it_names(text: str, model: str, tmp_path: Path) -> None:
    assert_reads(load(tmp_path, text), model)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ros(FISHEYE), "may be plumb_bob or fisheye: add distortion_model"),
        (ros(FISHEYE, "camera_model: pinhole\n"), "may be plumb_bob or fisheye"),
        (ros(FISHEYE, "distortion_model: kb\n"), "distortion_model 'kb' is unknown"),
        (ros(FIVE, "distortion_model: ''\n"), "distortion_model is empty"),
        (
            ros(FISHEYE, "distortion_model: plumb_bob\ncamera_model: fisheye\n"),
            "distortion_model and camera_model name different lens models",
        ),
        (
            opencv(FISHEYE, "distortion_model: equidistant\nfisheye_model: 0\n"),
            "name different lens models",
        ),
        (ros(EIGHT, "distortion_model: plumb_bob\n"), "plumb_bob needs 4 or 5 .* found 8"),
        (ros(FIVE, "distortion_model: equidistant\n"), "fisheye needs 4 .* found 5"),
        (ros([*EIGHT, 0, 0, 0.001, 0]), "has 12 numbers, which describe a thin prism or a tilted"),
        (opencv([*EIGHT, *[0] * 5, 0.01]), "has 14 numbers, which describe a thin prism"),
        (opencv(FISHEYE, "xi: 0.77\n"), "xi = 0.77 means an omnidirectional lens"),
        (ros(FIVE, "alpha: 0.01\n"), "alpha = 0.01 changes the projection"),
        (ros(FIVE, "binning_x: 2\nbinning_y: 2\n"), "binning_x = 2 changes the projection"),
        (
            ros(FIVE, "roi: {x_offset: 9, y_offset: 0, width: 200, height: 150}\n"),
            "roi is only a part of the image",
        ),
        (
            ros(FIVE, "roi: {x_offset: 0, y_offset: 0, width: 200, height: 150}\n"),
            "roi is only a part",
        ),
        (ros(FIVE, "lens_type: wide\n"), "key lens_type of this .* may change the projection"),
        (opencv(FIVE, "w: 0.93\ngamma: [1.0, 2.0]\n"), "keys w, gamma of this"),
        (ros(FIVE, f"dist_coeffs: {FIVE}\n"), "has distortion_coefficients and dist_coeffs"),
        (ros(FIVE, f"fx: {K[0] + 1}\n"), "fx is 211.5, but the camera matrix has 210.5"),
        (ros(FIVE, "crop_width: 300\n"), "key crop_width of this"),
        (ros(FIVE, "mm: 3\nfov: 0.9\np: 1\n"), "keys mm, fov, p of this"),
        (
            ros(FIVE).replace("coefficients", "coefficents"),
            "did you misspell it as distortion_coefficents",
        ),
        (ros(FIVE).replace("image_width: 400", "image_width: 400.5"), "whole number of pixels"),
        (ros(FIVE, matrix=[0.0] * 9), "camera_matrix contains only zeros"),
        (message(FIVE, "plumb_bob").replace("binning_x: 0", "binning_x: 2"), "binning_x = 2"),
        (message(FIVE, "plumb_bob") + message(FISHEYE, "equidistant"), "2 different documents"),
        (message([], "''"), "distortion_model is empty: the camera was not calibrated"),
        (opencv(FIVE).replace("0.31", "31.0"), "avg_reprojection_error = 31 px"),
    ],
)
def test_a_lens_that_is_not_understood_is_refused(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match=said):
        load(tmp_path, text)


KALIBR = {
    "camera_model": "pinhole",
    "intrinsics": [K[0], K[4], K[2], K[5]],
    "distortion_model": "radtan",
    "distortion_coeffs": FIVE[:4],
    "resolution": SIZE_PX,
}
PLAIN_FORMS: list[dict[str, Any]] = [
    {
        "image_width": SIZE_PX[0],
        "image_height": SIZE_PX[1],
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"data": FIVE},
        "rms": 0.3,
        "fx": K[0],
        "binning_x": 1,
        "roi": {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0},
    },
    {"width": SIZE_PX[0], "height": SIZE_PX[1], "K": K, "D": FISHEYE}
    | {"distortion_model": "equidistant", "binning_y": 0, "roi": {"do_rectify": False}},
    {"camera_resolution": SIZE_PX, "camera_matrix": K, "dist_coeffs": FIVE}
    | {"fisheye_model": 0, "xi": 0},
    KALIBR,
]
MALFORMED = (
    *(None, True, "", "50", "abc", "a" * 999, -1, 10**400, math.nan, math.inf),
    *([], {}, [50.0], [[1, 2], [3]], [None], [{}], {"data": {"data": 1}}, {"1": 2}),
)


@pytest.mark.parametrize("form", PLAIN_FORMS, ids=["ros", "message", "script", "kalibr"])
def test_a_value_of_another_kind_is_read_or_refused_in_one_sentence(
    form: dict[str, Any], tmp_path: Path
) -> None:
    """Never by an exception of Python."""
    said = set()
    for key, value in itertools.product(form, MALFORMED):
        places = [form | {key: value}]
        if isinstance(form[key], dict):
            places += [form | {key: form[key] | {part: value}} for part in form[key]]
        for values in places:
            content = {"cam0": values} if form is KALIBR else values
            try:
                load(tmp_path, json.dumps(content), "camera.json")
            except InvalidValue as error:
                said.add(str(error))
    assert len(said) > 20
    assert max(map(len, said)) < 300 + len(str(tmp_path))
    assert not any("\n" in sentence for sentence in said)


RECURSIVE = f"{ros(FIVE)}note: &own [*own]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            opencv(FIVE, "rms: [50.0]\n").replace("avg_re", "re"),
            "rms = 50 px: the reprojection error",
        ),
        (
            opencv(FIVE, "rms: '50'\n").replace("avg_re", "re"),
            "rms = 50 px: the reprojection error",
        ),
        (
            "cam0: {camera_model: pinhole, 1: 2}\n",
            "key resolution is missing, found camera_model, 1:",
        ),
        ("cam0: {2026-02-02: 2}\n", "is missing, found 2026-02-02"),
        pytest.param("[" * 2000, "values are nested too deeply", marks=pytest.mark.long),
        ('{"K":' * 2000, "values are nested too deeply"),
        (f"{RECURSIVE}---\n{RECURSIVE}", "values are nested too deeply"),
        ('{"image_width": 400, "image_width": 401}', "key image_width appears twice: keep one"),
        ('{"K": {"data": 1, "data": 2}}', "key data appears twice: keep one"),
        ("image_width: 400\nimage_width: 401\n", "line 2: key image_width appears twice"),
        ("a: 1\nb: !!timestamp x\n", "line 2: 'x' is not a valid timestamp"),
        ("a: !!bool 7\n", "line 1: '7' is not a valid bool"),
        ("a: !!int ''\n", "line 1: '' is not a valid int"),
        ("a: 2026-99-99\n", "line 1: '2026-99-99' is not a valid timestamp"),
        (ros(FIVE, "roi: {x_offset: left}\n"), "a value of roi.x_offset is not a number: left"),
        (
            ros(FIVE, "roi: {width: [1, 2]}\n"),
            "roi.width must be a whole number of pixels, at least 0",
        ),
    ],
)
def test_a_malformed_file_is_refused_in_one_sentence(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match=said):
        load(tmp_path, text)


def test_the_whole_picture_without_binning_is_read(tmp_path: Path) -> None:
    more = "roi: {x_offset: 0, y_offset: 0, width: 400, height: 300}\nbinning_x: 1\nbinning_y: 1\n"
    assert_reads(load(tmp_path, ros(FIVE, more)), "plumb_bob")


ROWS = [K[:3], K[3:6], K[6:]]
NOTES = {
    "board_cols": 9,
    "square_size_mm": 30.0,
    "num_images_used": 28,
    "opencv_rms": 0.22,
    "mean_reprojection_error_px": 0.18,
    "hfov_deg": 49.9,
    "fx": K[0],
    "cy": K[5],
    "calibrationTimestamp": "2026-09-28T17:18:22",
}
FLAT = {"image_width": SIZE_PX[0], "image_height": SIZE_PX[1]}


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (json.dumps(FLAT | {"camera_matrix": ROWS, "dist_coeff": [FIVE]}).encode(), "c.json"),
        (
            json.dumps(FLAT | {"cameraMatrix": ROWS, "distCoeffs": FIVE}, indent="\t").encode(),
            "c.json",
        ),
        (json.dumps(FLAT | {"K": ROWS, "D": [FIVE]}).encode(), "c.json"),
        (
            json.dumps(FLAT | NOTES | {"camera_matrix": ROWS, "dist_coeffs": FIVE}).encode(),
            "c.json",
        ),
        (f"# Kamera f\xfcr Drohne\n{ros(FIVE)}".encode("latin-1"), "camera.yaml"),
        (f"# \x93Drohne\x94\n{ros(FIVE)}".encode("latin-1"), "camera.yaml"),
        (opencv(FIVE).encode("utf-8-sig"), "camera.yaml"),
        (ros(FIVE).encode("utf-8-sig"), "camera.yaml"),
        (ros(FIVE).encode("utf-16"), "camera.yaml"),
        (f"%YAML:1.0\n---\n{ros(FIVE)}".encode(), "camera.yaml"),
        (f"%YAML:1.0\n{ros(FIVE)}".encode(), "camera.yaml"),
        (ros(FIVE).replace("\n", "\r\n").encode(), "camera.yaml"),
        (
            opencv(FIVE)
            .replace("image_width", "image_Width")
            .replace("camera_matrix", "Camera_Matrix")
            .replace("distortion_coefficients", "Distortion_Coefficients")
            .encode(),
            "camera.yaml",
        ),
    ],
)
def test_the_same_numbers_in_other_writing_are_read(
    content: bytes, name: str, tmp_path: Path
) -> None:
    assert_reads(load(tmp_path, content, name), "plumb_bob")


def test_lists_of_rows_are_read(tmp_path: Path) -> None:
    rows = "\n".join(f"- {row}" for row in ROWS)
    text = f"image_width: 400\nimage_height: 300\ncamera_matrix:\n{rows}\n"
    assert_reads(load(tmp_path, f"{text}distortion_coefficients: {FIVE}\n"), "plumb_bob")
    with pytest.raises(InvalidValue, match="this CameraInfo message: add width and height"):
        load(tmp_path, json.dumps({"K": ROWS, "D": [FIVE]}))
    with pytest.raises(InvalidValue, match="image size is missing from this camera_info or File"):
        load(tmp_path, f"camera_matrix:\n{rows}\ndist_coeff:\n- {FIVE}\n")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "# oST version 5.0 parameters\n\n[image]\n\nwidth\n400\n\n[narrow]\n\ncamera matrix\n"
            "210 0 203\n",
            "ROS .ini or ost.txt.*name the ost.yaml",
        ),
        ("# Camera list\n1 OPENCV 400 300 210.5 212 203.2 148.7 -0.2 0.1 0 0\n", "COLMAP.*0.5"),
        ('%YAML:1.0\nCamera.type: "KannalaBrandt8"\nCamera.fx: 210.5\n', "ORB-SLAM settings"),
        ('%YAML:1.0\nFile.version: "1.0"\nCamera1.fx: 210.5\n', "ORB-SLAM settings file"),
        ("%YAML:1.0\n---\nmodel_type: MEI\nmirror_parameters:\n   xi: 1.7\n", "VINS"),
        (
            "sensor_type: camera\nintrinsics: [210.5, 212, 203.2, 148.7]\n",
            "from the EuRoC data set",
        ),
        ('{"value0": {"intrinsics": [{"camera_type": "kb4"}]}}', "Basalt"),
        ('{"cameraData": []}', "DepthAI"),
        ("<calibration><f>210.5</f></calibration>", "XML file is from another program"),
        ("<opencv_storage><camera_matrix>", "not a readable OpenCV FileStorage file"),
        ("M1: [1, 2]\nD1: [0]\n", "camera_matrix is missing, found M1, D1"),
        ("extends: sim\ncamera: {}\n", "is not a camera calibration .it is a profile"),
        ("- 1\n", "contains no keys"),
        ("", "contains no keys"),
        ("a: !!python/tuple [1]\n", "line 1: only plain numbers, strings, lists and mappings"),
    ],
)
def test_other_forms_are_refused_by_name(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match=said):
        load(tmp_path, text)


def test_bytes_that_are_no_text_are_named(tmp_path: Path) -> None:
    for content, said in ((b"\x89PNG\r\n\x1a\n\0\0", "is a picture"), (b"PK\3\4\0", "is another")):
        with pytest.raises(InvalidValue, match=f"{said}.*, not a camera calibration") as refused:
            load(tmp_path, content)
        assert str(refused.value).count(str(tmp_path)) == 1
        assert "(it is" not in str(refused.value), "the kind is said once"


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({1: 4.0}, r"a skew of 4 px \(row 1, column 2\)"),
        ({1: -0.97}, "a skew of -0.97 px"),
        ({3: 0.5}, "must be fx 0 cx, 0 fy cy, 0 0 1"),
        ({6: 0.001}, "must be fx 0 cx"),
        ({8: 2.0}, "must be fx 0 cx"),
        ({2: 0.0, 5: 0.0, 6: 203.25, 7: 148.75}, "is transposed"),
    ],
)
def test_entries_that_nothing_computes_with_are_refused(
    entries: dict[int, float], said: str, tmp_path: Path
) -> None:
    matrix = [entries.get(i, value) for i, value in enumerate(K)]
    for text in (ros(FIVE, matrix=matrix), opencv(FIVE).replace(str(K), str(matrix))):
        with pytest.raises(InvalidValue, match=said):
            load(tmp_path, text)
    with pytest.raises(InvalidValue, match=said):
        CameraModel(SIZE_PX, np.reshape(matrix, (3, 3)), np.array(FIVE))


def test_a_skew_of_tenths_of_a_pixel_is_left_out(tmp_path: Path) -> None:
    matrix = [K[0], 0.06, *K[2:]]
    assert_reads(load(tmp_path, ros(FIVE, matrix=matrix)), "plumb_bob")


def test_the_page_s_example_is_read(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    example = page.split("```yaml\n")[1].split("```")[0]
    camera = load(tmp_path, example)
    own = load_calibration("example_640x480")
    assert (camera.size_px, camera.model) == (own.size_px, own.model)
    assert (camera.K == own.K).all()
    assert (camera.dist == own.dist).all()
