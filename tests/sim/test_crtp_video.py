"""The simulated vehicle's process: its video."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from perchctl.calibration import load_calibration
from perchctl.errors import ConnectionFailed, NotFound
from perchctl.places import data_file
from perchctl.sim import Scenario, SimProcess
from perchctl.sim.process.host import MjpegServer
from perchctl.vision import CameraModel
from tests.helpers.crtp_rig import WAIT_S, pictures_of


@pytest.fixture(scope="module")
def camera() -> CameraModel:
    path = data_file("calib", "example_640x480")
    if path is None:
        raise NotFound("the shipped calibration is missing")
    return load_calibration(path)


def test_newest_picture_wins_for_several_clients() -> None:
    server = MjpegServer()
    try:
        for grey in (10, 100, 200):
            server.publish(np.full((48, 64), grey, np.uint8))
        results: list[list[np.ndarray]] = []
        watchers = [
            threading.Thread(target=lambda: results.append(pictures_of(server.url, 1)))
            for _ in range(3)
        ]
        for watcher in watchers:
            watcher.start()
        for watcher in watchers:
            watcher.join(WAIT_S)
        assert len(results) == 3
        for (picture,) in results:
            assert picture.shape == (48, 64)  # grey
            assert abs(float(picture.mean()) - 200) < 2
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(server.url.replace("stream", "other"), timeout=WAIT_S)
        refused.value.close()
        assert refused.value.code == 404
    finally:
        server.close()


def test_a_taken_http_port_is_a_clear_error() -> None:
    server = MjpegServer()
    try:
        port = int(server.url.split(":")[2].split("/")[0])
        with pytest.raises(ConnectionFailed, match="choose another"):
            MjpegServer(port)
    finally:
        server.close()


def test_the_vehicles_picture_is_streamed(camera: CameraModel) -> None:
    """In real time, rendering in its own thread; a stock reader opens it too."""
    with SimProcess.start(Scenario(seed=1), "realtime", camera=camera) as sim:
        pictures = pictures_of(sim.stream_url, 3)
        width, height = camera.size_px
        assert all(p.shape == (height, width) for p in pictures)
        assert all(p.std() > 3.0 for p in pictures)
        assert any(not np.array_equal(pictures[0], p) for p in pictures[1:])  # noise, motion
        capture = cv2.VideoCapture(sim.stream_url, cv2.CAP_FFMPEG)
        ok, frame = capture.read()
        capture.release()
        assert ok
        assert frame.shape[:2] == (height, width)


def test_stepped_pictures_come_with_the_time(camera: CameraModel) -> None:
    with SimProcess.start(Scenario(seed=1), "stepped", camera=camera) as sim:
        sim.advance(0.3)
        (first,) = pictures_of(sim.stream_url, 1)
        (again,) = pictures_of(sim.stream_url, 1)
        assert np.array_equal(first, again)
        sim.advance(0.1)
        (later,) = pictures_of(sim.stream_url, 1)
        assert not np.array_equal(first, later)
