"""`perchctl track` on an interlaced recording."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.commands.track import resolve, track_source
from tests.helpers.interlaced import Pass
from tests.helpers.recording import write_video
from tests.helpers.target_picture import CAMERA

FRAMES = 10
PAL_S = 0.04


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("fields") / "camera.yaml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", CAMERA.size_px[0])
    storage.write("image_height", CAMERA.size_px[1])
    storage.write("camera_matrix", CAMERA.K)
    storage.write("distortion_coefficients", CAMERA.dist)
    storage.release()
    return file


def track(source: Path, calibration: Path, **options: Any) -> list[dict[str, Any]]:
    out = io.StringIO()
    options |= {"as_json": True, "calibration": calibration}
    track_source(resolve(str(source), "sim", **options), out)
    return [json.loads(line) for line in out.getvalue().splitlines()]


def recording(folder: Path, scene: Pass) -> Path:
    images = [frame.image for frame in scene.frames(FRAMES)]
    return write_video(folder / "flight.avi", images, rate_hz=1 / PAL_S)


def test_the_fields_of_a_video_are_tracked_one_by_one(
    tmp_path: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Pass(0.3, (0.2, 0.05, 0.0), camera_fields="bottom")
    file, overlay = recording(tmp_path, scene), tmp_path / "seen.mp4"
    lines = track(file, calibration, overlay=overlay)
    assert [line["frame"] for line in lines[-4:]] == [8, 8, 9, 9]
    assert np.diff([line["t_s"] for line in lines[-6:]]) == pytest.approx(PAL_S / 2, abs=1e-3)
    assert all(line["target"] is not None for line in lines)
    # The markers go on and on, and not to and fro.
    x = [np.mean(line["small"]["corners_px"], axis=0)[0] for line in lines[-8:]]
    assert (np.diff(x) < 0).all() or (np.diff(x) > 0).all()
    said = capsys.readouterr().err
    assert said.count("interlaced") == 2  # as it begins, in the summary
    video = cv2.VideoCapture(str(overlay))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == FRAMES


def test_a_camera_that_rests_and_moves_is_named_once(
    tmp_path: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At rest nothing is combed, and when it moves again that is no news."""
    images = [f.image for f in Pass(0.3, (0.2, 0.05, 0.0), camera_fields="top").frames(4)]
    still = [f.image for f in Pass(0.3, (0.0, 0.0, 0.0), 0.0, camera_fields="top").frames(3)]
    file = write_video(tmp_path / "rests.avi", images + still + images, rate_hz=1 / PAL_S)
    track(file, calibration)
    assert capsys.readouterr().err.count("interlaced") == 2


def test_stills_have_one_result_each(
    tmp_path: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Pass(0.3, (0.2, 0.05, 0.0), camera_fields="top")
    truth = {}
    for k, frame in enumerate(scene.frames(3)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), frame.image)
        truth[f"{k}.png"] = scene.target_m(frame.t_s - PAL_S / 4.0)  # of its top field
    lines = track(tmp_path, calibration, stills=True)
    assert [line["frame"] for line in lines] == list(truth)
    for line in lines:
        assert np.abs(np.array(line["target"]["tvec_m"]) - truth[line["frame"]]).max() < 2e-4
    assert "interlaced" in capsys.readouterr().err


def test_whole_pictures_are_not(
    tmp_path: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = track(recording(tmp_path, Pass(0.3, (0.2, 0.05, 0.0))), calibration)
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    assert "interlaced" not in capsys.readouterr().err
