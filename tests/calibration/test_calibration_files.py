"""Files: written for three readers, read from three writers, whole or not at all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from perchctl.calibration import FoundViews, calibrate_camera, calibration_text, load_calibration
from perchctl.calibration.board.adjust import MODEL_NAMES, PARAMETERS, lens_parameters
from perchctl.errors import InvalidValue
from perchctl.vision import CameraModel
from tests.helpers.boards import corner_views, draw_camera

ODD = [1e-05, -0.1, 0.30000000000000004, 1e-17, -123.456, 5e-324, 1 / 3, 0.0]


def _camera(model: str) -> CameraModel:
    K = np.array([[400.1, 0.0, 321 + 1 / 3], [0.0, 401.7, 1e-7 + 238], [0.0, 0.0, 1.0]])
    return CameraModel((640, 480), K, np.array(ODD[: len(PARAMETERS[model]) - 4]), model)


@pytest.mark.parametrize("model", MODEL_NAMES)
def test_all_numbers_come_back_equal(tmp_path: Path, model: str) -> None:
    camera = _camera(model)
    path = tmp_path / "camera.yaml"
    path.write_text(
        calibration_text(camera, 'odd "name"\n$', {"date": "2026-01-02", "rms_px": 1e-05})
    )
    assert path.read_text().splitlines()[0] == "%YAML 1.0"

    own = load_calibration(path)
    assert (own.size_px, own.model) == (camera.size_px, model)
    assert (own.K == camera.K).all()
    assert (own.dist == camera.dist).all()

    plain = yaml.safe_load(path.read_text())
    assert plain["camera_matrix"]["data"] == camera.K.ravel().tolist()
    assert plain["distortion_coefficients"]["data"] == camera.dist.tolist()
    assert plain["projection_matrix"]["data"][:3] == camera.K[0].tolist()
    assert plain["rms_px"] == 1e-05

    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert (storage.getNode("camera_matrix").mat() == camera.K).all()
    assert (storage.getNode("distortion_coefficients").mat().ravel() == camera.dist).all()
    assert storage.getNode("image_width").real() == 640
    ros = {"fisheye": "equidistant"}.get(model, model)
    assert storage.getNode("distortion_model").string() == plain["distortion_model"] == ros
    storage.release()


def test_a_calibration_s_file_holds_its_quality(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    camera = draw_camera(rng)
    result = calibrate_camera(FoundViews(tuple(corner_views(rng, camera))), "charuco:10x7:25mm")
    path = tmp_path / "camera.yaml"
    path.write_text(result.file_text("camera", "2026-01-02T03:04:05+00:00"))
    plain = yaml.safe_load(path.read_text())
    assert (load_calibration(path).K == result.camera.K).all()
    assert plain["views_used"] == len(result.views)
    assert plain["rms_px"] == result.fit.rms_px
    assert plain["date"] == "2026-01-02T03:04:05+00:00"
    assert plain["parameter_std"]["data"] == result.parameter_std.tolist()
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    covariance = storage.getNode("parameter_covariance").mat()
    assert (covariance == result.covariance).all()
    storage.release()


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_opencv_s_own_files_are_read(tmp_path: Path, suffix: str) -> None:
    camera = _camera("plumb_bob")
    path = tmp_path / f"opencv{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_coefficients", camera.dist[:, None])
    storage.release()
    read = load_calibration(path)
    np.testing.assert_allclose(read.K, camera.K, rtol=1e-15)
    np.testing.assert_allclose(read.dist, camera.dist, rtol=1e-15)


CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  intrinsics: [300.0, 300.0, 320.0, 240.0]
  resolution: [640, 480]
"""


def test_kalibr_s_file_of_one_camera_is_read(tmp_path: Path) -> None:
    chain = tmp_path / "camchain.yaml"
    chain.write_text(CAMCHAIN)
    again = tmp_path / "again.yaml"
    again.write_text(calibration_text(load_calibration(chain), "camera", {}))
    assert lens_parameters(load_calibration(again)).tolist() == [
        300.0, 300.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002, 0.0,
    ]  # fmt: skip
    chain.write_text(CAMCHAIN + CAMCHAIN.replace("cam0", "cam1"))
    with pytest.raises(InvalidValue, match="contains the cameras cam0, cam1"):
        load_calibration(chain)


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("radtan", "fov", "'fov' is not supported"),
    ("pinhole", "omni", "'omni' is not supported"),
    ("[300.0, 300.0, 320.0, 240.0]", "[380.0, 1.0]", "fu, fv, pu, pv"),
    ("  resolution: [640, 480]\n", "", "key resolution is missing"),
    ("resolution: [640, 480]", "resolution: 640", "needs width and height, found 1"),
    ("resolution: [640, 480]", "resolution: [.inf, 480]", "holds NaN or infinity"),
    ("intrinsics: [300.0,", "intrinsics: [wide,", "not a number"),
    ("-0.002]", "-0.002, 0.1, 0.2]", "found 6"),
    ("  distortion_model: radtan\n", "", "key distortion_model is missing"),
    ("  camera_model: pinhole\n", "", "key camera_model is missing"),
    ("radtan", "none", "are not 0 although distortion_model is none"),
    ("  resolution", "  xi: 0.9\n  resolution", "key xi of this Kalibr camchain may"),
])  # fmt: skip
def test_other_camchains_are_refused(tmp_path: Path, old: str, new: str, expected: str) -> None:
    chain = tmp_path / "camchain.yaml"
    assert old in CAMCHAIN
    chain.write_text(CAMCHAIN.replace(old, new))
    with pytest.raises(InvalidValue, match=expected):
        load_calibration(chain)


def test_a_missing_size_is_refused(tmp_path: Path) -> None:
    text = calibration_text(_camera("plumb_bob"), "camera", {})
    path = tmp_path / "camera.yaml"
    lines = [line for line in text.splitlines(keepends=True) if not line.startswith("image_")]
    path.write_text("".join(lines))
    with pytest.raises(InvalidValue, match="size"):
        load_calibration(path)
