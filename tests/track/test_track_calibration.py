"""`perchctl track`: each form of a calibration is one camera, and sizes have to fit."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import SizeMissing, load_calibration
from perchctl.errors import InvalidValue, Note
from tests.helpers.recording import (
    VIEWS,
    picture,
)
from tests.helpers.track import track, write_ros

KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.17, 0.04, 0.0004, -0.0007]
  distortion_model: radtan
  intrinsics: [380.0, 380.6, 321.5, 238.2]
  resolution: [640, 480]
  rostopic: /camera/image_raw
"""


@pytest.mark.parametrize("suffix", [".yaml", ".xml"])
def test_the_three_forms_are_one_camera(tmp_path: Path, pictures: Path, suffix: str) -> None:
    dist = [-0.17, 0.04, 0.0004, -0.0007, 0.0]
    K = [380.0, 0.0, 321.5, 0.0, 380.6, 238.2, 0.0, 0.0, 1.0]
    ros, kalibr, opencv = write_ros(tmp_path, K, dist), tmp_path / "k.yaml", tmp_path / f"o{suffix}"
    kalibr.write_text(KALIBR)
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(dist).reshape(5, 1))
    storage.release()
    first, *others = (
        track(pictures / "near.png", stills=True, calibration=file)
        for file in (ros, opencv, kalibr)
    )
    assert first[0]["target"] is not None
    for other in others:
        got = np.array(other[0]["target"]["tvec_m"])
        assert got == pytest.approx(np.array(first[0]["target"]["tvec_m"]), abs=1e-9)


def test_kalibrs_equidistant_lens_is_the_fisheye(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    model = load_calibration(path)
    assert model.model == "fisheye"
    assert model.size_px == (640, 480)
    assert model.K[1] == pytest.approx([0.0, 380.6, 238.2])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("radtan", "fov", "'fov' is not supported"),
        ("pinhole", "omni", "'omni' is not supported"),
        ("intrinsics: [380.0, 380.6, 321.5, 238.2]", "intrinsics: [380.0, 1.0]", "fu, fv, pu, pv"),
        ("  resolution: [640, 480]\n", "", "key resolution is missing"),
        ("resolution: [640, 480]", "resolution: 640", "not a number"),
        ("intrinsics: [380.0,", "intrinsics: [wide,", "not a number"),
        ("rostopic: /camera/image_raw\n", "x: 1\ncam1: {}\n", "holds 2 cameras"),
        (KALIBR, "cam0: 3\n", "cam0 must hold keys"),
        ("-0.0007]", "-0.0007, 0.0, 0.0]", "found 6"),
    ],
)
def test_other_camchains_are_refused(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert old in KALIBR
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR.replace(old, new))
    with pytest.raises(InvalidValue, match=expected):
        load_calibration(path)


def test_the_opencv_fisheye_flag_is_heeded(tmp_path: Path) -> None:
    path = tmp_path / "fisheye.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[380.0, 0, 320], [0, 380.0, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.zeros((4, 1)))
    storage.release()
    assert load_calibration(path).model == "fisheye"


def test_a_missing_size_is_taken_from_the_first_picture_with_a_warning(
    tmp_path: Path, pictures: Path
) -> None:
    dist = [-0.17, 0.04, 0.0004, -0.0007, 0.0]
    K = [380.0, 0.0, 321.5, 0.0, 380.6, 238.2, 0.0, 0.0, 1.0]
    whole = write_ros(tmp_path, K, dist)
    known = track(pictures / "near.png", stills=True, calibration=whole)
    ros, opencv = tmp_path / "without.yaml", tmp_path / "opencv.yml"
    ros.write_text(whole.read_text().replace("image_width: 640\nimage_height: 480\n", ""))
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(dist).reshape(5, 1))
    storage.release()
    for file in (ros, opencv):
        with pytest.raises(SizeMissing, match="image size is missing: add image_width"):
            load_calibration(file)
        words = "the image size is missing; 640x480 px is taken from the first picture"
        with pytest.warns(Note, match=words):
            assert track(pictures / "near.png", stills=True, calibration=file) == known


def test_a_missing_size_is_refused_where_the_centre_is_outside_of_the_picture(
    tmp_path: Path,
) -> None:
    ros = write_ros(tmp_path, [760.0, 0.0, 643.0, 0.0, 761.0, 476.0, 0.0, 0.0, 1.0], [0.0] * 5)
    ros.write_text(ros.read_text().replace("image_width: 640\nimage_height: 480\n", ""))
    with pytest.raises(InvalidValue, match="does not fit a 640x480 picture"):
        load_calibration(ros, (640, 480))


def test_another_size_is_refused_before_anything_is_tracked(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    half = cv2.resize(picture(VIEWS["both"]), (320, 240))
    cv2.imwrite(str(tmp_path / "0.png"), half)
    with pytest.raises(InvalidValue, match=r"0\.png.*320x240.*640x480"):
        track(tmp_path, csv=tmp_path / "x.csv", overlay=tmp_path / "x.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["0.png"]
    assert capsys.readouterr().out == ""


def test_one_picture_of_another_size_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture(VIEWS["both"]))
    cv2.imwrite(str(tmp_path / "b.png"), np.full((100, 200), 90, np.uint8))
    with pytest.raises(InvalidValue, match=r"b\.png.*200x100.*640x480"):
        track(tmp_path, csv=tmp_path / "x.csv")
    assert not list(tmp_path.glob("*.csv")) + list(tmp_path.glob(".*"))
