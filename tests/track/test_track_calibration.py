"""`perchctl track`: each form of a calibration is one camera, and sizes have to fit."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import SizeMissing, load_calibration
from perchctl.errors import InvalidValue
from tests.helpers.recording import VIEWS, picture
from tests.helpers.track import DISTORTION, PINHOLE, lines, track, write_opencv, write_ros

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
    kalibr = tmp_path / "k.yaml"
    kalibr.write_text(KALIBR)
    ros = write_ros(tmp_path, PINHOLE, DISTORTION)
    opencv = write_opencv(tmp_path / f"o{suffix}", (640, 480))
    first, *others = (
        lines(pictures / "near.png", calibration=file)[0]["target"]["tvec_m"]
        for file in (ros, opencv, kalibr)
    )
    for other in others:
        assert np.array(other) == pytest.approx(np.array(first), abs=1e-9)


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
    path = write_opencv(tmp_path / "fisheye.yml", (640, 480), dist=np.zeros(4))
    path.write_text(path.read_text() + "fisheye_model: 1\n")
    assert load_calibration(path).model == "fisheye"


def test_a_missing_size_is_taken_from_the_first_picture_with_a_warning(
    tmp_path: Path, pictures: Path
) -> None:
    whole = write_ros(tmp_path, PINHOLE, DISTORTION)
    known = lines(pictures / "near.png", calibration=whole)
    ros = tmp_path / "without.yaml"
    ros.write_text(whole.read_text().replace("image_width: 640\nimage_height: 480\n", ""))
    for file in (ros, write_opencv(tmp_path / "opencv.yml", None)):
        with pytest.raises(SizeMissing, match="image size is missing"):
            load_calibration(file)
        tracked = track(pictures / "near.png", calibration=file)
        assert tracked.lines == known
        assert "640x480 px is taken from the first picture" in tracked.stderr


def test_a_missing_size_is_refused_where_the_centre_is_outside_of_the_picture(
    tmp_path: Path,
) -> None:
    ros = write_ros(tmp_path, [760.0, 0.0, 643.0, 0.0, 761.0, 476.0, 0.0, 0.0, 1.0], [0.0] * 5)
    ros.write_text(ros.read_text().replace("image_width: 640\nimage_height: 480\n", ""))
    with pytest.raises(InvalidValue, match="does not fit a 640x480 picture"):
        load_calibration(ros, (640, 480))


@pytest.mark.parametrize("number", [0, 1])
def test_a_picture_of_another_size_is_named_and_no_file_is_left(
    number: int, tmp_path: Path
) -> None:
    for k in range(2):
        size = (320, 240) if k == number else (640, 480)
        cv2.imwrite(str(tmp_path / f"{k}.png"), cv2.resize(picture(VIEWS["both"]), size))
    tracked = track(tmp_path, "--csv", tmp_path / "x.csv", "--overlay", tmp_path / "x.mp4")
    assert tracked.code == InvalidValue.exit_code
    for words in (f"{number}.png", "320x240", "640x480"):
        assert words in tracked.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.png", "1.png"]
