"""Cameras of this computer: their names, lasting paths and numbers, and what a driver grants."""

from __future__ import annotations

import json
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from perchctl.camera import find_cameras
from perchctl.camera.device import (
    Asked,
    DeviceSource,
    asked_of,
    camera_number,
    finder_of,
    set_up,
)
from perchctl.commands import app, check
from perchctl.errors import InvalidValue, NotFound
from perchctl.profile import CameraConfig

WAIT_S = 10.0


@pytest.fixture
def plugged(tmp_path: Path) -> Callable[..., Path]:
    """A folder as /dev and as the system's list of names: cameras by number with their names, of
    which one that begins with / gives no pictures, and lasting paths."""

    def make(cameras: dict[int, str], **by_id: int) -> Path:
        (tmp_path / "v4l" / "by-id").mkdir(parents=True, exist_ok=True)
        for number, name in cameras.items():
            node = tmp_path / f"video{number}"
            node.mkdir()
            (node / "name").write_text(f"{name.lstrip('/')}\n")
            (node / "index").write_text(f"{int(name.startswith('/'))}\n")
        for name, number in by_id.items():
            (tmp_path / "v4l" / "by-id" / name).symlink_to(tmp_path / f"video{number}")
        return tmp_path

    return make


def unplug(devices: Path, number: int) -> None:
    (devices / f"video{number}").rename(devices / f"gone{number}")


def test_a_camera_is_named_by_number_name_part_of_it_or_path(plugged: Callable[..., Path]) -> None:
    devices = plugged(
        {0: "HD Webcam C525", 1: "/HD Webcam C525", 2: "USB Video", 10: "USB Video: deluxe"},
        usb_cam=0, usb_grabber=2,
    )  # fmt: skip

    def number(text: str) -> int:
        return camera_number(text, devices, devices)

    assert number("7") == 7, "a number is not looked up"
    assert number("HD Webcam C525") == number('"webcam"') == number(" c525 ") == 0
    assert number("USB Video") == 2, "the whole name, though another holds it"
    assert number("'deluxe'") == 10
    assert number("usb_grabber") == number(f"{devices}/v4l/by-id/usb_grabber") == 2
    assert number(f"{devices}/video10") == 10
    with pytest.raises(InvalidValue, match=r"camera:usb fits 3 cameras: .*C525.* at .*usb_cam"):
        number("usb")
    with pytest.raises(NotFound, match=r"camera:nix was not found; there are camera:0 \(HD W"):
        number("nix")
    for text in ("", '""', " ", "-1"):
        with pytest.raises(InvalidValue, match="as in camera:0 or camera:USB Video"):
            number(text)


def test_a_second_node_with_pictures_is_a_camera_and_one_without_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a stereo camera: the driver's answer counts, and not the node's index."""
    fcntl = pytest.importorskip("fcntl")

    def query(node: int, request: int, data: bytearray, mutate: bool) -> None:
        assert request == (2 << 30) | (104 << 16) | (ord("V") << 8)  # VIDIOC_QUERYCAP
        data[:] = os.read(node, 104)

    monkeypatch.setattr(fcntl, "ioctl", query)
    names = tmp_path / "names"
    whole, video, metadata = 0x84A00001, 0x04200001, 0x04A00000
    # Old drivers say nothing of a single node.
    for index, words in enumerate([(whole, video), (whole, metadata), (whole, video), (1, 0)]):
        (tmp_path / f"video{index}").write_bytes(struct.pack("=84xII12x", *words))
        (names / f"video{index}").mkdir(parents=True)
        (names / f"video{index}" / "index").write_text(f"{index}\n")
        (names / f"video{index}" / "name").write_text(f"Depth {index}\n")
    (tmp_path / "v4l" / "by-id").mkdir(parents=True)
    path = tmp_path / "v4l" / "by-id" / "usb-depth-video-index2"
    path.symlink_to(tmp_path / "video2")
    assert [camera.number for camera in find_cameras(tmp_path, names)] == [0, 2, 3]
    assert camera_number(str(path), tmp_path, names) == 2
    assert camera_number("Depth 2", tmp_path, names) == 2


def test_two_of_one_name_are_known_by_their_path(plugged: Callable[..., Path]) -> None:
    devices = plugged({0: "USB Video", 2: "USB Video"}, port_1=0, port_2=2)
    with pytest.raises(InvalidValue, match=r"fits 2 cameras: .*port_1, .*port_2; give"):
        camera_number("USB Video", devices, devices)
    assert camera_number("port_2", devices, devices) == 2


def test_the_list_for_people(plugged: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    devices = plugged({0: "USB Video"}, usb_grabber=0)
    monkeypatch.setattr(check, "find_cameras", lambda: find_cameras(devices, devices))
    said = CliRunner().invoke(app, ["check", "--cameras"]).stdout
    assert "camera:0" in said
    assert "USB Video" in said
    assert "usb_grabber" in said
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "Permission denied" in CliRunner().invoke(app, ["check", "--cameras"]).stdout


def test_no_camera_at_all(plugged: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    devices = plugged({})
    with pytest.raises(NotFound, match="this computer has no camera"):
        camera_number("USB", devices, devices)
    monkeypatch.setattr(check, "find_cameras", lambda: [])
    done = CliRunner().invoke(app, ["check", "--cameras", "--json"])
    assert done.exit_code == NotFound.exit_code
    said = json.loads(done.stdout)  # an object, as of every failure
    assert said["exit_code"] == NotFound.exit_code
    assert "has no camera" in said["error"]
    assert "has no camera" in done.stderr


def test_a_camera_that_was_unplugged_is_found_by_path_or_name(plugged: Callable[..., Path]) -> None:
    devices = plugged({0: "Webcam", 1: "USB Video", 2: "USB Video"}, usb_grabber=1)
    by_path, by_name, by_number = (finder_of(n, devices, devices) for n in (1, 2, 7))
    assert (by_path(), by_name(), by_number()) == (1, 2, 7)

    link = devices / "v4l" / "by-id" / "usb_grabber"
    link.unlink()
    for number in (1, 2):
        unplug(devices, number)
    for find in (by_path, by_name):
        with pytest.raises(NotFound, match=r"USB Video.*not back"):
            find()

    plugged({5: "USB Video"}, usb_grabber=5)
    assert by_path() == 5
    assert by_name() == 5, "the only one of its name"
    plugged({1: "Webcam"})
    assert by_path() == 5, "another camera has its number now"


# --- what a driver grants -------------------------------------------------------------


class Driver:
    """An OpenCV capture whose driver grants what it likes; `set` is noted."""

    def __init__(self, format: str, rate_hz: float, size: tuple[int, int]) -> None:
        self.format, self.rate_hz, self.size = format, rate_hz, size
        self.asked: list[tuple[int, float]] = []

    def set(self, prop: int, value: float) -> None:
        self.asked.append((prop, value))

    def get(self, prop: int) -> float:
        code = int.from_bytes(self.format.ljust(4).encode(), "little") if self.format else 0
        return {cv2.CAP_PROP_FOURCC: float(code), cv2.CAP_PROP_FPS: self.rate_hz}[prop]

    def read(self) -> tuple[bool, np.ndarray]:
        return True, np.random.default_rng().integers(0, 255, self.size[::-1], np.uint8)

    def release(self) -> None:
        return None


@pytest.mark.parametrize(("driver", "said"), [
    (Driver("YUYV", 15.0, (640, 480)),
     ["MJPG .* gives YUYV", "720x576 px, the cal.* 640x480", "25 Hz .* gives 15 Hz"]),
    (Driver("MJPG", 25.1, (720, 576)), []),
    (Driver("", 0.0, (720, 576)), []),
])  # fmt: skip
def test_what_is_delivered_otherwise_is_named(driver: Driver, said: list[str]) -> None:
    """What OpenCV does not know is no news."""
    asked = Asked((720, 576), "MJPG", 25.0)
    source = DeviceSource(0, 0.05, asked, lambda: 100.0, lambda n, asked: driver)
    try:
        assert source.wait_first(WAIT_S)
        remarks = source.remarks()
    finally:
        source.close()
    assert len(remarks) == len(said)
    for remark, words in zip(remarks, said, strict=True):
        assert re.search(f"^camera:0 was asked for {words}", remark)


def test_opencv_is_asked_for_format_then_size_then_rate() -> None:
    driver = Driver("", 0.0, (0, 0))
    asked = asked_of(CameraConfig(format="MJPG", rate_hz=25), (720, 576))
    assert asked == Asked((720, 576), "MJPG", 25.0)
    set_up(driver, asked)
    assert [prop for prop, _ in driver.asked] == [
        cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS, cv2.CAP_PROP_BUFFERSIZE,
    ]  # fmt: skip
    assert int(driver.asked[0][1]) == int.from_bytes(b"MJPG", "little")
